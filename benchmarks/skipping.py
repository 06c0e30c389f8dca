"""What a scene doesn't need isn't paid for: pairs of runs with and without it, in turn, CPU seconds.

Each pair is run several times alternately on the same machine, and the least time of each counts. Writes a
table of ratios, and of how far the answers of a pair are apart where they ought to agree.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from mpm_versus_fem import demo

import polarmpm as pm
from polarmpm.solvers import newton

HERE = Path(__file__).parent
SOFT = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=1e5, alpha=0.0, beta=1e4, gamma=1e4)  # Pa, N


class Timed:
    """CPU seconds of a march, its iterations, phases and answer."""

    def __init__(self, problem, steps, **options):
        problem._compile() if hasattr(problem, "_compile") else None
        begin = time.process_time()
        made = list(problem.march(steps, progress=False, **options))
        self.seconds, self.phases = time.process_time() - begin, problem.timer.seconds
        self.iterations = sum(step.iterations for step in made)
        self.answer = problem.points.mean_displacement()
        self.problem = problem


def bar(dim, material=SOFT, box=1.0, steps=6, **options):
    """A cantilever of 16 x 4 (x 1) cells, bent by its weight; in space it is a slab in plane strain."""
    size, thick = 4.0, 0.25
    lower, upper = [-1.0 * box, -4.0 * box], [5.0 * box, 2.0 * box]
    low, high = [0.0, 0.0], [size, 1.0]
    if dim == 3:
        lower, upper, low, high = [*lower, 0.0], [*upper, thick], [*low, 0.0], [*high, thick]
    grid = pm.Grid.box(lower, upper, 0.25)
    points = pm.seed(grid, bounds=(low, high), material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, **{"basis": "mpm", "reset": 1, "balanced_reset": False, **options})
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    if dim == 3:
        turns = {"theta_x": 0, "theta_y": 0} if material.micropolar else {}
        problem.fix(lambda x: np.ones(len(x), bool), uz=0, **turns)
    problem.body_load(force=(0.0, -2e3, 0.0)[:dim])
    return Timed(problem, steps)


def block(material=SOFT, steps=2, **options):
    grid = pm.Grid.box((-1, -1, 0), (2, 2, 1), 0.125)
    points = pm.seed(grid, bounds=((0, 0, 0), (1, 1, 1)), material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, **{"basis": "mpm", "reset": 1, "balanced_reset": False, **options})
    problem.fix(pm.plane(z=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.body_load(force=(1e5, 0, -1e5))
    return Timed(problem, steps)


def arch(material=None, reset=1, steps=15):
    module = demo("curved_cantilever")
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), 1.0)
    points = pm.seed(
        grid, module.Arch(-100.0, 0.0), material=material or module.MATERIAL, points_per_cell=4, cut=False
    )
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=reset, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, -1, 0)), force=(0, 0, module.FORCE))
    return Timed(problem, steps)


def without_chords(function):
    """A run whose every correction has a tangent of its own."""
    kept, newton._SAFETY = newton._SAFETY, np.inf
    try:
        return function()
    finally:
        newton._SAFETY = kept


class _Unpredicted(pm.MicropolarElastic):
    stress_prediction = False


def unpredicted(material):
    return _Unpredicted(**dataclasses.asdict(material))


def hard(material):
    """A plastic material that doesn't yield here."""
    return pm.VonMises(material, k=1e12, l_p=0.1)


def yielding(material):
    return pm.VonMises(material, k=3e4, H=1e6, l_p=0.1)


CLASSICAL = pm.NeoHookean(lam=1e6, mu=1e6)
# what is skipped: the run that skips it, the run that doesn't, what is compared, whether answers agree
PAIRS = {
    "the third dimension (plane strain against a slab)": (
        lambda: bar(2), lambda: bar(3), "whole", True),
    "rotations (classical against micropolar block)": (
        lambda: block(CLASSICAL), lambda: block(), "whole", False),
    "empty space (box ten times as long)": (
        lambda: bar(2), lambda: bar(2, box=10.0), "whole", True),
    "a new pattern while the active set stays (no reset against a reset a step)": (
        lambda: arch(reset=None), lambda: arch(), "start", False),
    "a tangent for the last correction (chord steps)": (
        lambda: arch(), lambda: without_chords(arch), "whole", True),
    "iterations, by predicted stresses": (
        lambda: arch(), lambda: arch(unpredicted(demo("curved_cantilever").MATERIAL)), "whole", True),
    "yield functions (elastic against plastic that doesn't yield)": (
        lambda: bar(2), lambda: bar(2, hard(SOFT)), "assembly", True),
    "return mapping of points that don't yield (none of them against most)": (
        lambda: bar(2, hard(SOFT)), lambda: bar(2, yielding(SOFT)), "assembly", False),
}  # fmt: skip
START = ("reset", "pattern", "conditions")


def seconds(run, what):
    if what == "whole":
        return run.seconds
    return sum(run.phases.get(phase, 0.0) for phase in (START if what == "start" else (what,)))


def compare(name, repeat):
    skips, pays, what, agree = PAIRS[name]
    runs = [(skips(), pays()) for _ in range(repeat + 1)][1:]  # the first ones fill caches
    times = [min(seconds(pair[k], what) for pair in runs) for k in (0, 1)]
    one, two = runs[-1]
    size = min(len(one.answer), len(two.answer))
    apart = float(np.linalg.norm(one.answer[:size] - two.answer[:size]) / np.linalg.norm(one.answer))
    return {
        "skipped": name,
        "compared": what,
        "with_s": times[0],
        "without_s": times[1],
        "ratio": times[1] / times[0],
        "iterations_with": one.iterations,
        "iterations_without": two.iterations,
        "apart": apart if agree else None,
    }


def factors(repeat):
    """First factor of a pattern, with analysis, against a later one."""
    first, later = [], []
    for _ in range(repeat):
        system = arch(steps=15).problem.system
        solver = system.solver
        solver._release_solver()
        for times in (first, later, later):
            system.pattern.put(solver.matrix)  # entries that haven't been factored yet
            begin = time.process_time()
            solver.factor()
            times.append(time.process_time() - begin)
    return {
        "skipped": "the symbolic factorisation of a pattern that is known",
        "compared": "factor",
        "with_s": min(later),
        "without_s": min(first),
        "ratio": min(first) / min(later),
    }


def table(rows):
    lines = ["| skipped | compared | with the skip (s) | without (s) | ratio | iterations | answers apart |"]
    lines.append("|---" * 7 + "|")
    for row in rows:
        iterations = (
            f"{row['iterations_with']}, {row['iterations_without']}" if "iterations_with" in row else ""
        )
        apart = f"{row['apart']:.0e}" if row.get("apart") is not None else ""
        lines.append(
            f"| {row['skipped']} | {row['compared']} | {row['with_s']:.3g} | {row['without_s']:.3g} | "
            f"{row['ratio']:.1f} | {iterations} | {apart} |"
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=4)
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    rows = [compare(name, args.repeat) for name in PAIRS]
    rows.append(factors(args.repeat))
    text = table(rows)
    print(text)
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "skipping.json").write_text(json.dumps(rows, indent=2) + "\n")
    (args.output / "skipping.md").write_text(text)


if __name__ == "__main__":
    main()
