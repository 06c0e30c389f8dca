"""Stress test of restart files: a run that writes one after each step is killed at random moments."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from stress_cases import COMM, MICROPOLAR, YOUNG, Record, block_points

import polarmpm as pm

STEPS = 30


def scene(reset):
    """A strip in the plane that bends; the grid is reset after every `reset`-th step."""
    grid = pm.Grid.box((0, -3), (8, 7), 1.0, COMM)
    points = block_points((0, 0.2), (5, 1), (6, 6), MICROPOLAR)
    problem = pm.QuasiStatic(grid, points, basis="bspline", reset=reset, balanced_reset=True)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0.0, 0.01 * YOUNG))
    return problem


def march(problem, file=None):
    """To the end, from wherever the problem is."""
    left = STEPS - problem.progress.step
    for _ in problem.march(left, progress=False) if left else ():
        if file is not None:
            pm.save_restart(problem, file)


def digits(problem):
    """The whole state of the points."""
    return {name: values.copy() for name, values in problem.points.arrays().items()}


def start(file, reset):
    """The run in a process of its own; returns when it has written its first file."""
    unwanted = ("OMPI_", "PMIX_", "PRTE_")  # of an MPI process that starts it
    environment = {k: v for k, v in os.environ.items() if not k.startswith(unwanted)}
    environment |= {k: v for k, v in os.environ.items() if k.startswith(("OMPI_ALLOW", "OMPI_MCA"))}
    command = [sys.executable, __file__, str(file), str(reset)]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    if run.stdout.readline() != b"marching\n":
        raise RuntimeError(f"the run that was to be killed ended with {run.wait()}")
    return run


def kill(file, reset, delay):
    """Kill a run after so many seconds of marching; False if it had ended before."""
    run = start(file, reset)
    time.sleep(delay)
    run.send_signal(signal.SIGKILL)
    return run.communicate()[0] != b"done\n"


def duration(file, reset):
    """Seconds that the run marches by itself."""
    run, begin = start(file, reset), time.perf_counter()
    run.stdout.readline()
    needed = time.perf_counter() - begin
    run.communicate()
    return needed


def killed_runs(folder, kills=20, resets=(1, 4), seed=0):
    """A record for each kind of reset; half of the kills go to each.

    A file is complete when it loads, and the run continued from it has to end at the same digits.
    """
    rng, records = np.random.default_rng(seed), []
    for reset in resets:
        whole = scene(reset)
        march(whole)
        expected = digits(whole)
        file = Path(folder) / f"reset{reset}.h5"
        time_needed = duration(file, reset)
        lost, differing, mid, steps = [], 0.0, 0, []
        for k in range(kills // len(resets)):
            while not kill(file, reset, rng.uniform(0.0, 0.95 * time_needed)):
                pass  # it had ended
            mid += file.with_name(file.name + ".part").exists()
            problem = scene(reset)
            try:
                pm.load_restart(problem, file)
            except pm.InputError as e:
                lost.append(f"kill {k}: {e}")
                continue
            steps.append(problem.progress.step)
            march(problem)
            for name, values in digits(problem).items():
                differing = max(differing, float(np.abs(values - expected[name]).max()))
        measure = (
            f"difference of any number; killed after steps {min(steps)} to {max(steps)}, {mid} while writing"
        )
        passed = not lost and differing == 0.0
        case = f"{kills // len(resets)} kills, reset every {reset} steps"
        records.append(Record("killed", case, passed, error=differing, measure="; ".join([measure, *lost])))
    return records


if __name__ == "__main__":
    problem = scene(int(sys.argv[2]))
    next(problem.march(STEPS, progress=False))
    pm.save_restart(problem, sys.argv[1])
    print("marching", flush=True)
    march(problem, sys.argv[1])
    print("done", flush=True)
