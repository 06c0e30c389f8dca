"""Direct solver against multigrid: iterations, CPU time and memory over the number of unknowns.

A cube is held below and pulled and sheared above in one load step, once with each solver: the direct one,
multigrid on the lattice, and the algebraic one that meshes have. Then the iterations of one linear solution
to 1e-8, for lengths of the material from a thousandth of a cell to a hundred cells, for cubes that cut the
grid at random, for flat cells and graded lines. Each step has a process of its own. `--full` adds a million
material points (7 GB), with standard weighting functions beside the algebraic solver; `--quick` leaves out
the larger cubes. `--cells 50` has cubes of that size alone, beside the rows that the file has already.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.solvers.choice import algebraic, register_solver

HERE = Path(__file__).parent
E, POISSON = 1e6, 0.3  # Pa, -
ALIGNED, OFF, TURNED = "aligned", "off the planes", "turned"
FLAT, GRADED = "flat cells 1:8", "lines 1:20"
SOLVERS = ("direct", "algebraic", "multigrid")
register_solver("algebraic", algebraic, whole_rows=True)
NAMES = {"mpm": "MPM", "gimpm": "GIMPM", "bspline": "B-splines"}
LENGTHS = (1e-3, 1.0, 1e2)  # of a cell
COLUMNS = [
    "kind", "basis", "cut", "length", "cells", "points", "unknowns", "solver", "newton", "krylov",
    "hierarchies", "failures", "displacement", "set_up_s", "solve_s", "assembly_s", "step_s", "memory_mb",
]  # fmt: skip


def material(length):
    G = E / (2 * (1 + POISSON))
    lam, square = 2 * G * POISSON / (1 - 2 * POISSON), G * length**2
    return pm.MicropolarElastic(lam=lam, mu=G, kappa=0.3 * G, alpha=0.0, beta=0.5 * square, gamma=square)


class Cube:
    """Predicate of a cube turned about its centre by a random rotation."""

    def __init__(self, cells, seed):
        q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
        self.frame, self.half = q * np.sign(np.diag(r)), cells / 2
        extent = np.abs(self.frame) @ np.full(3, self.half)
        self.bounds = (-extent, extent)

    def __call__(self, x):
        return np.all(np.abs(x @ self.frame) <= self.half, axis=1)


def lines_of(cells, cut):
    """Lines across each axis, one beyond each side of the body."""
    sizes = [np.ones(cells)] * 3
    if cut == FLAT:
        sizes = [np.ones(cells), np.ones(cells), np.full(cells, 1 / 8)]
    elif cut == GRADED:
        sizes = [20.0 ** (np.arange(cells) / (cells - 1) - 0.5)] * 3
    return [np.concatenate([[-s[0], 0.0], np.cumsum(np.r_[s, s[-1]])]) for s in sizes]


def build(cells, basis, cut, length, solver, seed=0):
    """A cube of cells of 1 m and 2^3 points each, and its points on top."""
    if cut in (FLAT, GRADED):
        lines = lines_of(cells, cut)
        grid, bounds = pm.Grid.graded(*lines), np.array([a[[1, -2]] for a in lines]).T
        points = pm.seed(grid, material=material(length), points_per_cell=2, bounds=bounds)
        foot = 1e-6
    elif cut == TURNED:
        inside = Cube(cells, seed)
        low, high = inside.bounds
        grid = pm.Grid.box(np.floor(low) - 1, np.ceil(high) + 1, 1.0)
        points = pm.seed(grid, inside, material=material(length), points_per_cell=2)
        foot = low[2] + 1.01
    else:
        grid = pm.Grid.box((-1, -1, -1), (cells + 2,) * 3, 1.0)
        bounds = (np.zeros(3), np.full(3, float(cells)))
        points = pm.seed(grid, material=material(length), points_per_cell=2, bounds=bounds)
        points.x = points.X = points.x + np.array((0.3, 0.6, 0.0) if cut == OFF else (0.0, 0.0, 0.0))
        foot = 0.01
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": basis}, solver=solver)
    problem.fix(lambda x: x[:, 2] <= foot, u=0, theta=0)
    top = points.farthest((0, 0, 1))
    problem.load(top, force=E * cells**2 * np.array([0.005, 0.0, 0.01]))
    return problem, top


def run(kind, cells, basis, cut, length, solver, seed):
    """One row."""
    problem, top = build(cells, basis, cut, length, solver, seed)
    begin = time.process_time()
    if kind == "step":
        (step,) = problem.march(1, progress=False)
        system = problem.system
        found = {"newton": step.iterations, "displacement": problem.points.mean_displacement(top).tolist()}
    else:
        system = problem.system_at(1.0)
        system.set_prescribed(system.prescribed.increments(1.0))
        system.evaluate(True)
        system.solve_free(-system.residual, True, 1e-8)
        found = {}
    seconds, solver_ = problem.timer.seconds, system.solver
    return found | {
        "kind": kind,
        "basis": basis,
        "cut": cut,
        "length": length,
        "cells": cells,
        "points": problem.points.total,
        "unknowns": problem.unknowns,
        "solver": solver,
        "krylov": getattr(solver_, "iterations", None),
        "hierarchies": getattr(solver_, "hierarchies", None),
        "failures": getattr(solver_, "failures", None),
        "set_up_s": seconds["factor"],
        "solve_s": seconds["solve"],
        "assembly_s": seconds["assembly"],
        "step_s": time.process_time() - begin,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def in_a_process(*arguments):
    """A row, of a step from a process of its own."""
    if arguments[0] == "solution":
        return run(*arguments)
    code = [sys.executable, __file__, "--row", json.dumps(arguments)]
    out = subprocess.run(code, check=True, capture_output=True, text=True).stdout
    return json.loads(out.splitlines()[-1])


def runs(quick, full):
    """Arguments of all rows."""
    sizes = (8, 12, 16, 20) if quick else (8, 12, 16, 20, 26)
    for basis, cut in (("mpm", ALIGNED), ("gimpm", OFF)):
        for cells in sizes:
            for solver in SOLVERS:
                if solver != "direct" or cells <= 16:
                    yield "step", cells, basis, cut, 1.0, solver, 0
        if full:
            for solver in ("algebraic", "multigrid") if basis == "mpm" else ("multigrid",):
                yield "step", 50, basis, cut, 1.0, solver, 0
    for length in LENGTHS:
        for basis, cut in (("mpm", ALIGNED), ("mpm", OFF), ("gimpm", OFF), ("mpm", TURNED), ("bspline", OFF)):
            for cells in (8, 12, 16) if quick else (8, 12, 16, 26):
                if (basis, cells) != ("bspline", 26):
                    yield "solution", cells, basis, cut, length, "multigrid", cells
    for basis in ("mpm", "bspline"):
        for cut in (FLAT, GRADED):
            for cells in (8, 12, 16):
                yield "solution", cells, basis, cut, 1.0, "multigrid", cells


# results ------------------------------------------------------------------------------------------
def steps_table(rows):
    lines = [
        "| basis, cube | cells | points | unknowns | solver | Newton | Krylov | set-up (s) | solve (s) "
        "| step (s) | memory (MB) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        if r["kind"] == "step":
            lines.append(
                f"| {r['basis']}, {r['cut']} | {r['cells']}³ | {r['points']} | {r['unknowns']} "
                f"| {r['solver']} | {r['newton']} | {r['krylov'] or ''} | {r['set_up_s']:.2f} "
                f"| {r['solve_s']:.2f} | {r['step_s']:.2f} | {r['memory_mb']:.0f} |"
            )
    return "\n".join(lines) + "\n"


def solutions_table(rows):
    """Iterations over cells, a line for each case."""
    rows = [r for r in rows if r["kind"] == "solution"]
    cells = sorted({r["cells"] for r in rows})
    lines = ["| basis, cube | length / cell | " + " | ".join(f"{c}³" for c in cells) + " |"]
    lines.append("|---|---|" + "---|" * len(cells))
    for case in dict.fromkeys((r["basis"], r["cut"], r["length"]) for r in rows):
        mine = {r["cells"]: r for r in rows if (r["basis"], r["cut"], r["length"]) == case}
        counts = [f"{mine[c]['krylov']}{'*' if mine[c]['failures'] else ''}" for c in cells if c in mine]
        lines.append(f"| {case[0]}, {case[1]} | {case[2]:g} | " + " | ".join(counts) + " |")
    return "\n".join(lines) + "\n"


@styled()
def draw(rows, file):
    """CPU time and memory of a step, and iterations of a solution, over unknowns."""
    from polarmpm import plot

    figure, axes = plot.subplots(1, 3, figsize=(plot.PAGE, 3.0))
    styles = {
        (basis, solver): f"{colour}{mark}"
        for basis, colour in (("mpm", "C0"), ("gimpm", "C1"))
        for solver, mark in zip(SOLVERS, ("s--", "^:", "o-"), strict=True)
    }
    for (basis, solver), style in styles.items():
        mine = [r for r in rows if (r["kind"], r["basis"], r["solver"]) == ("step", basis, solver)]
        unknowns, label = [r["unknowns"] for r in mine], f"{NAMES[basis]}, {solver}"
        seconds = [r["set_up_s"] + r["solve_s"] for r in mine]
        axes[0].plot(unknowns, seconds, style, label=label)
        axes[1].plot(unknowns, [r["memory_mb"] for r in mine], style, label=label)
    colours = dict(zip(LENGTHS, ("C2", "C3", "C4"), strict=True))
    marks = {("mpm", ALIGNED): "o-", ("mpm", OFF): "^-", ("gimpm", OFF): "v--", ("mpm", TURNED): "s:"}
    marks |= {("bspline", OFF): "d-."}
    solutions = [r for r in rows if r["kind"] == "solution"]
    for length, colour in colours.items():
        for (basis, cut), mark in marks.items():
            mine = [r for r in solutions if (r["basis"], r["cut"], r["length"]) == (basis, cut, length)]
            axes[2].plot(
                [r["unknowns"] for r in mine],
                [r["krylov"] for r in mine],
                mark,
                color=colour,
            )
    for (basis, cut), mark in marks.items():
        axes[2].plot([], [], f"k{mark}", label=f"{NAMES[basis]}, {cut}")
    for length, colour in colours.items():
        axes[2].plot([], [], color=colour, label=f"length {length:g} cells")
    for axis, name in zip(axes, ("set-up and solve (CPU s)", "memory (MB)", "iterations"), strict=True):
        axis.set(xscale="log", xlabel="unknowns", ylabel=name)
        axis.grid(color="0.88", linewidth=0.6)
    axes[0].set(yscale="log", title="(a) one load step")
    axes[1].set(yscale="log", title="(b) one load step")
    axes[1].set_yticks([200, 500, 1000, 2000], ["200", "500", "1000", "2000"])
    axes[1].minorticks_off()
    axes[2].set(title="(c) one linear solution to $10^{-8}$", ylim=(0, None))
    below = {"loc": "upper center", "frameon": False, "columnspacing": 0.8}
    figure.legend(
        *axes[0].get_legend_handles_labels(), bbox_to_anchor=(0.28, 0.0), ncol=2, title="(a), (b)", **below
    )
    figure.legend(
        *axes[2].get_legend_handles_labels(), bbox_to_anchor=(0.76, 0.0), ncol=2, title="(c)", **below
    )
    plot.save(figure, file)


def read(file):
    """Rows of an earlier run."""

    def value(text):
        try:
            return json.loads(text)
        except json.JSONDecodeError:
            return text or None

    with file.open() as lines:
        return [{k: value(v) for k, v in row.items()} for row in csv.DictReader(lines)]


def place(row):
    """Where a row stands in the tables: as in `runs`."""
    return (
        row["kind"] != "step",
        0 if row["kind"] == "step" else row["length"],
        list(NAMES).index(row["basis"]),
        (ALIGNED, OFF, TURNED, FLAT, GRADED).index(row["cut"]),
        row["cells"],
        SOLVERS.index(row["solver"]),
    )


def write(rows, folder):
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "iterative.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)
    text = steps_table(rows) + "\nIterations of one linear solution to 1e-8:\n\n" + solutions_table(rows)
    (folder / "iterative.md").write_text(text)
    draw(rows, folder / "iterative.png")
    print(text)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="smaller cubes only")
    parser.add_argument("--full", action="store_true", help="also a million material points")
    parser.add_argument("--cells", type=int, nargs="+", metavar="N", help="only cubes of these sizes")
    parser.add_argument("--redraw", action="store_true", help="table and figure from the CSV file")
    parser.add_argument("--row", type=json.loads, help=argparse.SUPPRESS)
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    if args.row:
        print(json.dumps(run(*args.row)))
        return
    rows = read(args.output / "iterative.csv") if args.redraw or args.cells else []
    if args.cells:
        rows = [r for r in rows if r["cells"] not in args.cells]
    for arguments in [] if args.redraw else runs(args.quick, args.full or bool(args.cells)):
        if args.cells and arguments[1] not in args.cells:
            continue
        rows.append(in_a_process(*arguments))
        print(*(rows[-1].get(k) for k in COLUMNS if k != "displacement"), flush=True)
    write(sorted(rows, key=place), args.output)


if __name__ == "__main__":
    main()
