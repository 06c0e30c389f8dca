"""What an evaluation at the points costs: kernel, residual, residual with tangent, set-up, empty space.

The curved cantilever at 1 m cells, its points moved off the lattice so that GIMPM domains cross cells as they
do after some steps. Prints microseconds a point (the least of many calls: machines are noisy), writes JSON.
"""

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from curved_cantilever import load_demo

import polarmpm as pm

HERE = Path(__file__).parent


def least(function, repeat, clock=time.perf_counter):
    """Shortest time of `repeat` calls (s), by default on the wall."""
    times = []
    for _ in range(repeat):
        begin = clock()
        function()
        times.append(clock() - begin)
    return min(times)


def problem_of(demo, basis, box=((0, -40, -8), (80, 40, 64))):
    """The cantilever's problem, points moved by a random tenth of a cell, and the seconds to build it."""
    begin = time.perf_counter()
    grid = pm.Grid.box(*box, 1.0)
    points = pm.seed(grid, demo.Arch(-100.0, 0.0), material=demo.MATERIAL, points_per_cell=4, cut=False)
    points.x = points.x + 0.07 + 0.02 * np.random.default_rng(0).random(points.x.shape)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, -1, 0)), force=(0, 0, demo.FORCE))
    problem.system_at(0.0)
    return problem, time.perf_counter() - begin


def factor(system):
    """Factor the tangent as it stands, though it has been before."""
    system.pattern.put(system.solver.matrix)
    system.solver.factor()


def kernel_seconds(problem, repeat, tangent=True):
    """CPU seconds of the compiled kernel alone, eight points a call, over all points."""
    kernel = problem._compiled.kernels[0][tangent]
    rows = (kernel.inputs + kernel.outputs + 1) * 8
    lanes = np.zeros(rows + 8)
    start = (-lanes.ctypes.data // 8) % 8
    address = lanes.ctypes.data + 8 * start
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(kernel.address)
    inputs, outputs = address, address + 8 * 8 * kernel.inputs
    calls = len(problem.points) // 8
    empty = ctypes.CDLL(None).abs

    def run(function, *args):
        for _ in range(calls):
            function(*args)

    # what Python and ctypes need for the calls themselves is taken off
    clock = time.process_time
    return least(lambda: run(call, inputs, outputs), repeat, clock) - least(
        lambda: run(empty, 1), repeat, clock
    )


def first_use(code):
    """Seconds of a new process with an empty kernel cache, and with a warm one."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, POLARMPM_CACHE=cache)
        return [
            least(lambda: subprocess.run([sys.executable, "-c", code], env=environment, check=True), 1)
            for _ in range(2)
        ]


_START = """
import polarmpm as pm
grid = pm.Grid.box((0, 0, 0), (2, 1, 1), 0.5)
material = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=1e6, alpha=0.0, beta=1e3, gamma=1e3)
problem = pm.QuasiStatic(grid, pm.seed(grid, material=material))
problem.fix(pm.plane(x=0.0), u=0, theta=0)
problem.load(problem.points.farthest((1, 0, 0)), force=(0, 0, 1e3))
next(problem.march(10))
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=40)
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    demo, found = load_demo(), {}
    for basis in ("mpm", "gimpm"):
        problem, _ = problem_of(demo, basis)
        n, system = len(problem.points), problem.system
        found[basis] = {
            "points": n,
            "kernel_us": 1e6 / n * kernel_seconds(problem, args.repeat),
            "residual_us": 1e6 / n * least(lambda s=system: s.evaluate(False), args.repeat),
            "residual_and_tangent_us": 1e6 / n * least(lambda s=system: s.evaluate(True), args.repeat),
            "factor_us": 1e6 / n * least(partial(factor, system), 5),
        }
    small, large = [], []
    for _ in range(args.repeat):  # in turn, so that both see the same machine
        small.append(problem_of(demo, "mpm")[1])
        large.append(problem_of(demo, "mpm", ((0, -400, -80), (800, 400, 640)))[1])
    found["empty_space"] = {"seconds": min(small), "seconds_of_ten_times_the_box": min(large)}
    cold, warm = first_use(_START)
    found["start"] = {"first_use_s": cold, "warm_s": warm}
    text = json.dumps(found, indent=2)
    print(text)
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "assembly.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
