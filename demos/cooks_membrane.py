"""Cook's membrane, nearly incompressible: how far its corner rises on coarse cells, cured of locking or not.

Lengths in any unit, here called metres: 48 wide, 44 high at the clamp and 16 at the end, E = 240.565, a dead
load of 100 along the end (per unit of thickness), plane strain, neo-Hookean. The corner (48, 60) rises by
7.78 for nu = 0.3 and by 6.92 for nu = 0.4999. Material points with three bases and elements of degree 1 and
2, 8 and 16 cells along the clamp. `--locking none` shows what the cure is for.
"""

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

WIDTH, CLAMP, END, TOP = 48.0, 44.0, 16.0, 60.0  # m
YOUNG, LOAD = 240.565, 100.0  # Pa, N/m
REFERENCE = {"0.3": 7.78, "0.4999": 6.92}  # m, by Poisson's ratio
CORNER = np.array((WIDTH, TOP))
BASES = {
    "mpm": "mpm",
    "gimpm": "GIMPM",
    "bspline": "B-splines",
    "fem1": "FEM, degree 1",
    "fem2": "FEM, degree 2",
}
CHOICES = {"none": None, "auto": "auto", "always": "always"}


def material(nu):
    return pm.NeoHookean.from_engineering(E=YOUNG, nu=nu)


def of_points(basis, nu, cells, args):
    def inside(x):
        low, high = CLAMP / WIDTH * x[:, 0], CLAMP + (TOP - CLAMP) / WIDTH * x[:, 0]
        return (x[:, 0] >= 0) & (x[:, 0] <= WIDTH) & (x[:, 1] >= low) & (x[:, 1] <= high)

    inside.bounds = ((0, 0), (WIDTH, TOP))
    cell = CLAMP / cells
    low, high = (0, -2 * cell), (WIDTH + 2 * cell, TOP + 12 + 2 * cell)
    counts = [int(np.ceil((b - a) / cell)) for a, b in zip(low, high, strict=True)]
    grid = pm.Grid.box(low, tuple(a + n * cell for a, n in zip(low, counts, strict=True)), cell)
    points = pm.seed(grid, inside, material=material(nu), points_per_cell=args.points_per_cell)
    problem = pm.QuasiStatic(grid, points, basis=basis, locking=CHOICES[args.locking])
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pm.Surface.line((WIDTH, CLAMP), (WIDTH, TOP), 64), force=(0, LOAD / END))
    return problem


def of_elements(degree, nu, cells, args):
    body = mesh.create_unit_square(MPI.COMM_WORLD, cells, cells, mesh.CellType.quadrilateral)
    s, t = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
    body.geometry.x[:, 0], body.geometry.x[:, 1] = WIDTH * s, CLAMP * s + t * (CLAMP + (END - CLAMP) * s)
    elements = pm.Elements(body, material=material(nu), degree=degree)
    problem = pm.QuasiStaticFEM(elements, locking=CHOICES[args.locking])
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pm.plane(x=WIDTH), force=(0, LOAD / END))
    return problem


def corner(problem):
    """The point nearest to the corner, of the undeformed body; none of elements, which have a node there."""
    return None if isinstance(problem, pm.QuasiStaticFEM) else problem.points.nearest(CORNER)


def tip(problem, nearest):
    """How far the corner has risen (m): its node, or the nearest point's displacement carried on with F."""
    if isinstance(problem, pm.QuasiStaticFEM):
        nodes = problem.elements.nodes
        here = np.linalg.norm(nodes.position - CORNER, axis=1) < 1e-6 * WIDTH
        here &= np.arange(len(nodes)) < nodes.owned
        return float(problem.comm.allreduce(problem.elements.displacement[here, 1].sum()))
    points = problem.points
    rows = points.rows(nearest)
    arm = np.einsum("nij,nj->ni", points.F[rows, :2, :2] - np.eye(2), CORNER - points.X[rows])
    return float(problem.comm.allreduce((points.displacement[rows] + arm)[:, 1].sum()))


def solve(name, nu, cells, args, folder):
    """The problem at its full load, whose state is written, and how far the corner has risen (m)."""
    kind = (of_elements, int(name[-1])) if name.startswith("fem") else (of_points, name)
    problem = kind[0](kind[1], nu, cells, args)
    nearest = corner(problem)
    with pm.Recorder(folder / f"{name}_{nu:g}_{cells}.pvd", problem) as record:
        *_, last = problem.march(args.steps, adaptive=True, progress=False)
        record(last)
    return problem, tip(problem, nearest)


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="cooks_membrane",
        argv=argv,
        more={
            "--bases": {"nargs": "+", "choices": tuple(BASES), "default": list(BASES)},
            "--cells": {
                "type": demo.count,
                "nargs": "+",
                "default": [8, 16],
                "help": "numbers along the clamp",
            },
            "--nu": {"nargs": "+", "choices": tuple(REFERENCE), "default": list(REFERENCE)},
            "--points-per-cell": {"type": demo.count, "default": 4, "help": "in each direction"},
            "--steps": {"type": demo.count, "default": 10, "help": "number of load steps"},
            "--locking": {"choices": tuple(CHOICES), "default": "auto", "help": "what is cured of it"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    found, iterations, shown = {}, {}, {}
    for name in args.bases:
        for nu in args.nu:
            for cells in sorted(set(args.cells)):
                problem, rise = solve(name, float(nu), cells, args, folder)
                shown[name] = problem
                found.setdefault(name, {}).setdefault(nu, {})[str(cells)] = rise
                number = sum(step.iterations for step in problem.steps)
                iterations.setdefault(name, {}).setdefault(nu, {})[str(cells)] = number
    error = {
        name: {nu: {n: u / REFERENCE[nu] - 1 for n, u in of_cells.items()} for nu, of_cells in of_nu.items()}
        for name, of_nu in found.items()
    }
    result = {
        "tip": found,
        "reference": {nu: REFERENCE[nu] for nu in args.nu},
        "error": error,
        "iterations": iterations,
    }
    draw(result, shown, folder / "cooks_membrane.png")
    parameters = {name: getattr(args, name) for name in ("bases", "cells", "nu", "steps", "locking")}
    return demo.report(
        args, "cooks_membrane", problem, result, points_per_cell=args.points_per_cell, **parameters
    )


@styled()
def draw(result, shown, file):
    """The corner over the cells for each ratio, and the pressure in one body."""
    from polarmpm.plot import figures as plot

    ratios, last = list(result["reference"]), list(shown)[-1]
    points = [name for name in shown if not name.startswith("fem")]
    name = points[-1] if points else last
    figure, axes = plot.subplots(
        1, len(ratios) + 1, figsize=plot.fitted(4.9 * (len(ratios) + 1), 4.9), squeeze=False
    )
    axes, body = axes.flat, shown[name]
    plot_body(plot, body, axes[-1])
    for ax, nu in zip(axes, ratios, strict=False):
        if MPI.COMM_WORLD.rank:
            continue
        for k, (kind, of_nu) in enumerate(result["tip"].items()):
            cells = [int(n) for n in of_nu[nu]]
            ax.plot(
                cells, list(of_nu[nu].values()), marker="osD^v"[k], markersize=6 - 0.8 * k, label=BASES[kind]
            )
        ax.axhline(REFERENCE[nu], color="0.35", lw=1.2, ls="--", label="reference")
        ax.set_xticks(cells)
        ax.set_title(f"ν = {nu}")
        finish(ax)
    if MPI.COMM_WORLD.rank == 0:
        axes[-1].set_title(f"{BASES[name]}, ν = {ratios[-1]}, {cells[-1]} cells")
        plot.legend_below(figure, columns=6)
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def plot_body(plot, problem, ax):
    pressure = -np.trace(problem.fields("stress").stress, axis1=1, axis2=2) / 3
    limits = (-25.0, 25.0)
    values, look = np.clip(pressure, *limits), {"label": "pressure (Pa)", "limits": limits}
    if isinstance(problem, pm.QuasiStaticFEM):
        plot.plot_mesh(problem.elements, values, ax, at="points", **look)
    else:
        plot.plot_points(problem.points, values, ax, **look)


def finish(ax):
    ax.set_xlabel("cells along the clamp")
    ax.set_ylabel("rise of the corner (m)")
    finish_curves(ax)


if __name__ == "__main__":
    main()
