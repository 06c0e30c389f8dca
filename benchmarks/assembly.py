"""What an evaluation at the points costs: kernel, residual, residual with tangent, set-up, empty space.

The curved cantilever at 1 m cells, its points moved off the lattice so that GIMPM domains cross cells as they
do after some steps. Then load steps of blocks in the plane and in space and of a plastic column, all settings
default, with points that integrate over their boxes and, where this version can, without; and whole runs.
Prints microseconds a point (the least of many calls: machines are noisy), writes JSON.
"""

import argparse
import ctypes
import inspect
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import scenes
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


# load steps ---------------------------------------------------------------------------------------
def block(dim, number, material, **options):
    """A block of 24 x 8 or 8 x 4 x 4 cells, held at one end, under its own weight."""
    size = (24, 8) if dim == 2 else (8, 4, 4)
    grid = pm.Grid.box((0, -2, -2)[:dim], [s + 2 for s in size], 1.0)
    points = pm.seed(grid, bounds=((0,) * dim, size), material=material, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(0, -1e-3 * scenes.YOUNG / size[0], 0)[:dim])
    return problem


def column(number, **options):
    """The sand column of `demos/biaxial.py`."""
    return scenes.biaxial(number, **options)[0]


def step_costs(repeat):
    """CPU microseconds a point of an iteration, in the first steps, and its parts; by scene, then with and
    without boxes."""
    builds = {}
    for dim, numbers in ((2, (2, 3, 4)), (3, (2, 3))):
        for name, stuff in (("classical", scenes.classical()), ("micropolar", scenes.micropolar())):
            for number in numbers:
                where = f"{'plane' if dim == 2 else 'space'}, {name}, {number} points"
                builds[where] = partial(block, dim, number, stuff)
    for number in (2, 3):
        builds[f"plastic column, {number} points"] = partial(column, number)
    switch = "boxes" in inspect.signature(pm.QuasiStatic.__init__).parameters
    found = {}
    for where, build in builds.items():
        choices = {"boxes": {"boxes": True}, "none": {"boxes": False}} if switch else {"none": {}}
        runs = {name: [] for name in choices}
        for _ in range(repeat):  # in turn, so that all see the same machine
            for name, options in choices.items():
                runs[name].append(step_cost(build(**options)))
        found[where] = {
            name: {key: min(r[key] for r in some) for key in some[0]} for name, some in runs.items()
        }
        if switch:
            found[where]["ratio"] = (
                found[where]["boxes"]["iteration_us"] / found[where]["none"]["iteration_us"]
            )
        print(where, json.dumps(found[where]), flush=True)
    return found


def whole_runs(repeat):
    """CPU seconds of whole runs, with and without boxes in turn, the least of each: blocks in ten steps, the
    curved cantilever at 1 m (B4) in 15, the plastic column in 40."""
    scenes_of = {"curved cantilever, 1 m": (arch, 15), "plastic column": (partial(column, 2), 40)}
    for dim in (2, 3):
        for name, stuff in (("classical", scenes.classical()), ("micropolar", scenes.micropolar())):
            where = f"block in {'the plane' if dim == 2 else 'space'}, {name}"
            scenes_of[where] = partial(block, dim, 2, stuff), 10
    found = {}
    for where, (build, steps) in scenes_of.items():
        seconds, iterations = {True: [], False: []}, {}
        for _ in range(repeat):
            for boxes in (True, False):
                problem = build(boxes=boxes)
                begin = time.process_time()
                for _ in problem.march(steps, adaptive=True, progress=False):
                    pass
                seconds[boxes].append(time.process_time() - begin)
                iterations[boxes] = sum(step.iterations for step in problem.steps)
        with_boxes, without = min(seconds[True]), min(seconds[False])
        found[where] = {
            "boxes_s": with_boxes,
            "none_s": without,
            "ratio": with_boxes / without,
            "iterations": [iterations[True], iterations[False]],
        }
        print(where, json.dumps(found[where]), flush=True)
    return found


def arch(**options):
    """The curved cantilever as a stranger has it."""
    demo = load_demo()
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), 1.0)
    points = pm.seed(grid, demo.Arch(-100.0, 0.0), material=demo.MATERIAL)
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, -1, 0)), force=(0, 0, demo.FORCE))
    return problem


def step_cost(problem, steps=10):
    """A fifth of the load in so many steps, the first one apart: iterations, and microseconds a point of one
    of them."""
    marching = problem.march(steps, to=0.2, adaptive=True, progress=False)
    next(marching)
    before, begin = dict(problem.timer.seconds), time.process_time()
    for _ in marching:
        pass
    spent = time.process_time() - begin
    iterations = sum(step.iterations for step in problem.steps[1:])
    per = 1e6 / iterations / len(problem.points)
    parts = {
        f"{name}_us": per * (problem.timer.seconds.get(name, 0.0) - before.get(name, 0.0))
        for name in ("assembly", "factor", "solve", "update")
    }
    return {
        "points": len(problem.points),
        "unknowns": problem.unknowns,
        "iterations": iterations,
        "iteration_us": per * spent,
        **parts,
    }


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
    parser.add_argument("--steps-only", action="store_true", help="leave out all but the load steps")
    args = parser.parse_args()
    found = {} if args.steps_only else evaluation_costs(args.repeat)
    found["steps"] = step_costs(max(1, args.repeat // 10))
    found["runs"] = whole_runs(max(1, args.repeat // 10))
    text = json.dumps(found, indent=2)
    print(text)
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "assembly.json").write_text(text + "\n")


def evaluation_costs(repeat):
    """Microseconds a point of evaluations, and seconds of set-ups, of the curved cantilever."""
    demo, found = load_demo(), {}
    for basis in ("mpm", "gimpm"):
        problem, _ = problem_of(demo, basis)
        n, system = len(problem.points), problem.system
        found[basis] = {
            "points": n,
            "kernel_us": 1e6 / n * kernel_seconds(problem, repeat),
            "residual_us": 1e6 / n * least(lambda s=system: s.evaluate(False), repeat),
            "residual_and_tangent_us": 1e6 / n * least(lambda s=system: s.evaluate(True), repeat),
            "factor_us": 1e6 / n * least(partial(factor, system), 5),
        }
    small, large = [], []
    for _ in range(repeat):  # in turn, so that both see the same machine
        small.append(problem_of(demo, "mpm")[1])
        large.append(problem_of(demo, "mpm", ((0, -400, -80), (800, 400, 640)))[1])
    found["empty_space"] = {"seconds": min(small), "seconds_of_ten_times_the_box": min(large)}
    cold, warm = first_use(_START)
    found["start"] = {"first_use_s": cold, "warm_s": warm}
    return found


if __name__ == "__main__":
    main()
