"""Derivatives by parameters (docs/sensitivity.md): how close, how dear, and what they mean across resets.

    python benchmarks/sensitivity.py [--only accuracy|cost|sawtooth|exact] [--case NAME] [--quick]

Accuracy: digits against differences of fourth order of tight whole runs (the best of four steps, as points
that pass planes of the grid spoil differences). Cost: CPU time of a twin over that of the run. Sawtooth: how
far the slope of a tooth is off the trend of ten runs. Exact: digits to which the tangent-linear run and twins
agree, and its CPU time for a parameter of several.
"""

import argparse
import json
import time
import warnings
from functools import partial
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm

TIGHT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-30, max_iterations=40)
STEPS = (1e-4, 1e-6, 2e-7, 1e-7)  # of differences
BEAM = {"E": 12.5e6, "n": 0.5, "l_b": 0.2}
COPPER = {"kappa": 3e9, "l": 3.7e-6, "k": 150e6, "H": 75e6, "l_p": 3.7e-6}
SOIL = {"mu": 8e6, "kappa": 8e5, "l_b": 2e-3, "phi": 0.5236, "c": 100e3, "H": -1e4, "l_p": 2e-3}
SHAFT = {"E": 12.0, "n": 0.5, "l_b": 0.5, "l_t": 0.4}


# scenes -------------------------------------------------------------------------------------------
def cantilever(p, reset=1, **options):
    """A bar of 10 m x 1 m that its end load bends by 2 m."""
    material = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.25, n=p["n"], l_b=p["l_b"], l_t=0.2, psi=1.0
    )
    grid = pm.Grid.box((0, -6), (12, 3), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (10, 1)), material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=reset, **options)
    root, tip = problem.fix(pm.plane(x=0.0), u=0, theta=0), points.farthest((1, 0))
    problem.load(tip, force=(0, -20e3))
    return problem, {
        "tip": lambda: points.mean_displacement(tip),
        "root": lambda: problem.reaction(root).couple[0],
    }


def wire(p, cells=4, reset=1, basis="mpm", balanced_reset=False, **options):
    """A copper wire of 20 um, turned by half a radian."""
    scale, radius = (p["l"] / 3.7e-6) ** 2, 10e-6
    elastic = pm.MicropolarElastic(
        lam=69e9, mu=46e9, kappa=p["kappa"], alpha=-0.41938 * scale, beta=0.0, gamma=0.62974 * scale
    )
    cell = 2 * radius / cells
    half = (cells // 2 + 2) * cell
    top_of_grid = 2 * radius if basis.startswith("bspline") else 2 * radius + 2 * cell
    grid = pm.Grid.box((-half, -half, 0), (half, half, top_of_grid), cell)
    points = pm.seed(
        grid,
        inside=lambda x: (np.hypot(x[:, 0], x[:, 1]) <= radius) & (x[:, 2] <= 2 * radius),
        material=pm.VonMises(elastic, k=p["k"], H=p["H"], l_p=p["l_p"]),
        points_per_cell=2,
    )
    options.setdefault("controls", pm.Controls(energy_tolerance=1e-20))
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=reset, balanced_reset=balanced_reset, **options)
    problem.fix(pm.plane(z=0.0), uz=0, theta_z=0)
    top = problem.fix(pm.plane(z=2 * radius), uz=0, theta_z=0.5)
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 1e-3 * cell, ux=0, uy=0, theta_x=0, theta_y=0)
    return problem, {"torque": lambda: problem.reaction(top).couple[2] / radius**3}


def soil(p):
    """Softening soil."""
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=8e6, mu=p["mu"], kappa=p["kappa"], l_b=p["l_b"])
    flow = {name: p[name] for name in ("phi", "c", "H", "l_p")}
    return pm.DruckerPrager(elastic, cone="compression", psi=0.1745, **flow)


def column(p, cell=5e-3, reset=1, **options):
    """A quarter of a column of it under a platen."""
    grid = pm.Grid.box((0, 0), (0.05, 0.05), cell)
    points = pm.seed(grid, bounds=((0, 0), (0.025, 0.05)), material=soil(p))
    problem = pm.QuasiStatic(grid, points, reset=reset, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    top = problem.fix(pm.plane(y=0.05, moving=True), ux=0, uy=-0.005)
    side = points.where(lambda x: x[:, 0] > 0.02)
    return problem, {
        "force": lambda: problem.reaction(top).force[1],
        "side": lambda: points.mean_displacement(side)[0],
    }


def elements(p, **options):
    """The same of elements of degree 2."""
    corners = [(0, 0), (0.025, 0.05)]
    body = mesh.create_rectangle(MPI.COMM_WORLD, corners, (5, 10), mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=soil(p), degree=2), **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    top = problem.fix(pm.plane(y=0.05), ux=0, uy=-0.005)
    return problem, {"force": lambda: problem.reaction(top).force[1]}


def shaft(p, **options):
    """A shaft in space that dead couples turn and bend."""
    material = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.25, n=p["n"], l_b=p["l_b"], l_t=p["l_t"], psi=1.0
    )
    grid = pm.Grid.box((-2, -2, 0), (4, 4, 6), 1.0)
    points = pm.seed(grid, bounds=((0, 0, 0), (2, 2, 4)), material=material, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    root = problem.fix(pm.plane(z=0.0), u=0, theta=0)
    end = points.where(lambda x: x[:, 2] > 3.4)
    problem.load(end, couple=(0.6, 0, 2.0), force=(0.2, 0, 0))
    return problem, {
        "end": lambda: points.mean_displacement(end),
        "root": lambda: problem.reaction(root).couple[2],
    }


def arch(p, **options):
    """Half of a shallow arch that snaps through."""
    material = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.25, n=p["n"], l_b=p["l_b"], l_t=0.1, psi=1.0
    )
    grid = pm.Grid.box((0, -4), (10, 3), 0.5)
    points = pm.seed(
        grid,
        inside=lambda x: np.abs(x[:, 1] - 0.15 * x[:, 0]) < 0.25,
        material=material,
        points_per_cell=3,
    )
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    root, tip = problem.fix(pm.plane(x=0.0), u=0), points.farthest((1, 0))
    problem.fix(pm.plane(x=10.0), ux=0, theta=0)
    problem.load(tip, force=(0, -20e3))
    return problem, {
        "factor": lambda: problem.progress.factor,
        "root": lambda: problem.reaction(root).force[0],
    }


def strip(p, **options):
    """A strip whose side is held as a surface, under a pressure that turns with it."""
    material = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.25, n=p["n"], l_b=p["l_b"], l_t=0.2, psi=1.0
    )
    grid = pm.Grid.box((0, -2), (5, 3), 1.0)
    points = pm.seed(grid, bounds=((0.1, 0.1), (4.2, 1.3)), material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)

    def side(x, y, length, normal):
        return pm.Surface(np.stack([x, y], axis=1), np.full(len(x), length), np.tile(normal, (len(x), 1)))

    left = side(np.full(8, 0.1), 0.1 + 0.15 * (np.arange(8) + 0.5), 0.15, (-1.0, 0.0))
    top = side(0.1 + 0.205 * (np.arange(20) + 0.5), np.full(20, 1.3), 0.205, (0.0, 1.0))
    support, tip = problem.fix(left, u=0), points.farthest((1, 0))
    problem.pressure(top, 4e4)
    return problem, {
        "tip": lambda: points.mean_displacement(tip),
        "held": lambda: problem.reaction(support).moment,
    }


def steps(number):
    return lambda run: run.march(number)


def along(run):
    return run.march_arc_length(0.2, steps=4)


ACCURACY = {
    "cantilever, bspline": (cantilever, BEAM, steps(4)),
    "cantilever, bspline, not balanced": (partial(cantilever, balanced_reset=False), BEAM, steps(4)),
    "cantilever, bspline, default resets": (
        partial(cantilever, reset=pm.WhenDistorted(0.2)),
        BEAM,
        steps(4),
    ),
    "cantilever, mpm": (partial(cantilever, basis="mpm"), BEAM, steps(4)),
    "cantilever, mpm, not balanced": (
        partial(cantilever, basis="mpm", balanced_reset=False),
        BEAM,
        steps(4),
    ),
    "cantilever, gimpm with ghost": (partial(cantilever, basis="gimpm", ghost="light"), BEAM, steps(4)),
    "cantilever, gimpm without ghost, not balanced": (
        partial(cantilever, basis="gimpm", balanced_reset=False),
        BEAM,
        steps(4),
    ),
    "column, default resets": (partial(column, reset=pm.WhenDistorted(0.2)), SOIL, steps(5)),
    "column": (column, SOIL, steps(5)),
    "column, elements": (elements, SOIL, steps(5)),
    "wire in space": (wire, COPPER, steps(4)),
    "shaft in space, couples": (shaft, SHAFT, steps(4)),
    "arch, along the path": (arch, {**BEAM, "l_b": 0.1}, along),
    "strip, held on a surface": (strip, BEAM, steps(3)),
}
COST = {
    "wire": (partial(wire, cells=8), COPPER, "H", 4),
    "column": (partial(column, cell=1.25e-3), SOIL, "c", 4),
    "column, default resets": (partial(column, cell=1.25e-3, reset=pm.WhenDistorted(0.2)), SOIL, "c", 4),
    "column, elements": (elements, SOIL, "c", 5),
    "cantilever": (cantilever, BEAM, "l_b", 4),
}
SAWTOOTH = {
    "bspline, default resets": {"reset": pm.WhenDistorted(0.2)},
    "bspline, each step": {},
    "bspline, each step, not balanced": {"balanced_reset": False},
    "mpm, each step": {"basis": "mpm"},
    "mpm, each step, not balanced": {"basis": "mpm", "balanced_reset": False},
    "gimpm, each step": {"basis": "gimpm"},
    "gimpm, each step, not balanced": {"basis": "gimpm", "balanced_reset": False},
}


# measures -----------------------------------------------------------------------------------------
def answers(build, values, march, **options):
    problem, observables = build(values, **options)
    found = [{o: np.array(f()) for o, f in observables.items()} for _ in march(problem)]
    problem.close()
    return found


def slopes(build, values, name, march, h):
    """Differences of fourth order, (steps, ...) by observable."""
    at = {}
    for k in (-2, -1, 1, 2):
        at[k] = answers(build, {**values, name: values[name] * (1 + k * h)}, march, controls=TIGHT)
    out = {}
    for o in at[1][0]:
        y = {k: np.array([step[o] for step in found]) for k, found in at.items()}
        out[o] = (8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h * values[name])
    return out


def digits_of(found, exact):
    """The least of all observables whose derivative isn't zero but for rounding."""
    least = 16.0
    for o, slope in exact.items():
        largest = np.abs(slope).max()
        if np.abs(found[o]).max() > 0.0 and largest > 0.0:
            least = min(least, -np.log10(np.abs(found[o] - slope).max() / largest + 1e-16))
    return least


def accuracy(name):
    """Digits by parameter, and the largest check."""
    build, values, march = ACCURACY[name]
    with pm.Sensitivity(build, values) as run:
        found, check = [], 0.0
        for _ in march(run):
            found.append(run.rates)
            check = max(check, *run.check.values())
        used = max(run.steps.values())
    digits = {}
    for n in values:
        mine = {o: np.array([step[o][n] for step in found]) for o in found[0]}
        digits[n] = max(digits_of(mine, slopes(build, values, n, march, h)) for h in STEPS)
    return {"digits": digits, "check": check, "step": used}


def cost(name):
    """CPU time of a twin over that of the run."""
    build, values, parameter, number = COST[name]

    def run_alone():
        problem, observables = build(values)
        for _ in problem.march(number):
            _ = [f() for f in observables.values()]
        points = len(problem.points)
        problem.close()
        return points

    def march(run):
        for _ in run.march(number):
            pass

    run_alone()  # compiled, and in the cache
    begin = time.process_time()
    points = run_alone()
    alone = time.process_time() - begin
    with pm.Sensitivity(build, values, [parameter]) as run:
        begin = time.process_time()
        march(run)
        both = time.process_time() - begin
    return {"points": points, "run": alone, "ratio": (both - alone) / 2.0 / alone}


def exact(name):
    """Digits to which both methods agree, and the cost of a parameter of the tangent-linear run."""
    build, values, march = ACCURACY[name]
    found, times = {}, {}
    for method in (None, "exact", "exact", "twins"):  # compiled, and in the cache
        if method is None:
            answers(build, values, march)
            begin = time.process_time()
            answers(build, values, march)
            times[method] = time.process_time() - begin
            continue
        begin = time.process_time()
        with pm.Sensitivity(build, values, method=method) as run:
            steps = [run.rates for _ in march(run)]
        times[method] = time.process_time() - begin
        found[method] = {n: {o: np.array([step[o][n] for step in steps]) for o in steps[0]} for n in values}
    digits = {n: digits_of(found["twins"][n], found["exact"][n]) for n in values}
    return {"digits": digits, "ratio": (times["exact"] - times[None]) / times[None] / len(values)}


def sawtooth(name):
    """Largest distance of the slopes at ten values from the slope of a parabola through the answers."""
    options, tip, rate = SAWTOOTH[name], [], []
    lengths = BEAM["l_b"] * np.linspace(0.95, 1.05, 10)
    for length in lengths:
        build = partial(cantilever, **options)
        with pm.Sensitivity(build, {**BEAM, "l_b": length}, ["l_b"]) as run:
            for _ in run.march(8):
                pass
            tip.append(run.values["tip"][1])
            rate.append(run.rates["tip"]["l_b"][1])
    trend = np.polyder(np.polyfit(lengths, tip, 2))
    off = np.abs(np.array(rate) - np.polyval(trend, lengths)).max()
    return {"off": float(off / np.abs(np.polyval(trend, BEAM["l_b"])))}


# command line -------------------------------------------------------------------------------------
def table(heads, rows):
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines)


def listed(one):
    return ", ".join(f"{name} {digits:.1f}" for name, digits in one["digits"].items())


def report(found):
    """The tables of docs/sensitivity.md."""
    if "accuracy" in found:
        rows = [(n, listed(one), f"{one['check']:.0e}") for n, one in found["accuracy"].items()]
        print(table(("run", "digits", "check"), rows), "\n")
    if "cost" in found:
        rows = [(n, str(c["points"]), f"{c['ratio']:.2f}") for n, c in found["cost"].items()]
        print(table(("run", "points", "a twin, in runs"), rows), "\n")
    if "exact" in found:
        rows = [(n, listed(one), f"{one['ratio']:.2f}") for n, one in found["exact"].items()]
        print(table(("run", "digits to which both agree", "a parameter, in runs"), rows), "\n")
    if "sawtooth" in found:
        rows = [(n, f"{100 * s['off']:.2g} %") for n, s in found["sawtooth"].items()]
        print(table(("cantilever", "a tooth's slope off the trend, by at most"), rows))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("accuracy", "cost", "sawtooth", "exact"))
    parser.add_argument("--quick", action="store_true", help="leave out what is in space")
    parser.add_argument("--case", help="runs whose names begin with it")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found = {}
    parts = {"accuracy": (accuracy, ACCURACY), "cost": (cost, COST), "sawtooth": (sawtooth, SAWTOOTH)}
    parts["exact"] = exact, ACCURACY
    for part, (measure, cases) in parts.items():
        if args.only not in (None, part):
            continue
        for name in cases:
            if (args.quick and ("space" in name or name == "wire")) or not name.startswith(args.case or ""):
                continue
            with warnings.catch_warnings(action="ignore"):
                found.setdefault(part, {})[name] = measure(name)
            print(part, name, found[part][name], flush=True)
    report(found)
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
