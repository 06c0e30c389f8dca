"""A rough strip footing on von Mises soil: its bearing capacity, (2 + pi) c, on coarse cells. Metres, Pa.

Half of the scene: a layer of 5 x 2.5 b, smooth sides, a rough base, and a rough rigid footing of half a
width b that is pushed in by 0.02 b. Hencky's energy with E = 1e4 c, nu = 0.3, strength c in plane strain.
Plastic flow keeps the volume, so that functions lock and the load rises without a limit, unless they are
cured of it. The load is divided by c and an effective half width, which ends in the middle between the last
node that is held and the first one that is free (their mean positions, with splines).
"""

import argparse
import math

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

HALF, LENGTH, DEPTH = 1.0, 5.0, 2.5  # m: b, and the soil
STRENGTH, YOUNG, POISSON = 1.0, 1e4, 0.3  # Pa
SETTLEMENT = 0.02  # b
LIMIT = 2 + math.pi
BASES = {
    "mpm": "mpm",
    "gimpm": "GIMPM",
    "bspline": "B-splines",
    "fem1": "FEM, degree 1",
    "fem2": "FEM, degree 2",
}


def even(text):
    """An even number of the command line: the layer is 2.5 b deep."""
    number = demo.count(text)
    if number % 2:
        raise argparse.ArgumentTypeError(f"{text!r} is not even: the layer of 2.5 b wouldn't fit its cells")
    return number


def soil():
    elastic = pm.Hencky.from_engineering(E=YOUNG, nu=POISSON)
    return pm.VonMises(elastic, k=math.sqrt(3.0) * STRENGTH)


def grid_of(args):
    """Equal cells, or lines that are fine to a quarter of b beside the footing and to b / 2 below it."""
    fine = HALF / args.cells
    if args.grid == "equal":
        return pm.Grid.box((0, 0), (LENGTH, DEPTH), fine)
    return pm.Grid.graded(
        x=pm.lines(0, LENGTH, fine=fine, where=(0, 1.25 * HALF), growth=args.growth, keep=[HALF]),
        y=pm.lines(0, DEPTH, fine=fine, where=(DEPTH - HALF / 2, DEPTH), growth=args.growth),
    )


def of_points(basis, args):
    grid = grid_of(args)
    points = pm.seed(grid, material=soil(), points_per_cell=args.points_per_cell)
    locking = None if args.locking == "none" else "auto"
    return pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)


def of_elements(degree, args):
    counts = [round(size * args.cells / HALF) for size in (LENGTH, DEPTH)]
    body = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (LENGTH, DEPTH)], counts, mesh.CellType.quadrilateral
    )
    locking = None if args.locking == "none" else "auto"
    return pm.QuasiStaticFEM(pm.Elements(body, material=soil(), degree=degree), locking=locking)


def under(x):
    return (x[:, 0] < HALF + 1e-6) & (x[:, 1] > DEPTH - 1e-6)


def effective_width(problem):
    """To the middle between the last node of the footing and the first one beside it (m)."""
    body = problem.elements if isinstance(problem, pm.QuasiStaticFEM) else problem.system
    x = body.nodes.position
    top = x[np.abs(x[:, 1] - DEPTH) < 1e-6, 0]
    held, free = top[top < HALF + 1e-6].max(initial=0.0), top[top > HALF + 1e-6].min(initial=LENGTH)
    comm = problem.comm
    return 0.5 * (comm.allreduce(held, op=MPI.MAX) + comm.allreduce(free, op=MPI.MIN))


def unknowns(problem):
    body = problem.elements if isinstance(problem, pm.QuasiStaticFEM) else problem.system
    return int(body.nodes.total * problem.layout.block)


def solve(name, args, folder):
    """Settlements over b and loads over c times the effective width, and the problem."""
    problem = of_elements(int(name[-1]), args) if name.startswith("fem") else of_points(name, args)
    for x in (0.0, LENGTH):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    footing = problem.fix(under, ux=0, uy=-SETTLEMENT * HALF)
    depths, loads = [0.0], [0.0]
    with pm.Recorder(folder / f"{name}.pvd", problem) as record:
        for step in problem.march(args.steps, adaptive=True, progress=False):
            depths.append(SETTLEMENT * step.factor)
            loads.append(-float(problem.reaction(footing).force[1]))
        record(step)
    return depths, [load / (STRENGTH * effective_width(problem)) for load in loads], problem


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="strip_footing",
        argv=argv,
        more={
            "--bases": {"nargs": "+", "choices": tuple(BASES), "default": list(BASES)},
            "--cells": {"type": even, "default": 8, "help": "under half of the footing, even"},
            "--points-per-cell": {"type": demo.count, "default": 4, "help": "in each direction"},
            "--steps": {"type": demo.count, "default": 20, "help": "number of load steps"},
            "--grid": {
                "choices": ("equal", "graded"),
                "default": "equal",
                "help": "of material points; graded: fine at the footing only",
            },
            "--growth": {"type": demo.positive, "default": 1.15, "help": "of neighbours on graded grids"},
            "--locking": {"choices": ("none", "cured"), "default": "cured", "help": "what is done about it"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    curves, result, shown = {}, {"bearing": {}, "limit": LIMIT, "error": {}, "rise": {}, "width": {}}, {}
    for name in args.bases:
        depths, loads, problem = solve(name, args, folder)
        curves[name], shown[name] = {"settlement": depths, "load": loads}, problem
        result["bearing"][name] = loads[-1]
        result["error"][name] = loads[-1] / LIMIT - 1
        result["rise"][name] = loads[-1] / float(np.interp(SETTLEMENT / 2, depths, loads)) - 1
        result["width"][name] = effective_width(problem)
    result["curves"] = curves
    draw(result, shown, args, folder / "strip_footing.png")
    result["unknowns"] = {name: unknowns(problem) for name, problem in shown.items()}
    parameters = {name: getattr(args, name) for name in ("bases", "cells", "steps", "locking", "grid")}
    return demo.report(
        args, "strip_footing", problem, result, points_per_cell=args.points_per_cell, **parameters
    )


@styled()
def draw(result, shown, args, file):
    """Loads over settlements, and the plastic strain under one footing."""
    from polarmpm.plot import figures as plot

    points = [name for name in shown if not name.startswith("fem")]
    name = (points or list(shown))[0]
    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.4), width_ratios=(1, 1.3))
    problem = shown[name]
    values = problem.points.hardening
    cap = problem.comm.allreduce(float(np.quantile(values, 0.99)) if len(values) else 0.0, op=MPI.MAX)
    look = {"label": "plastic strain (-)", "limits": (0.0, cap), "undeformed": False}
    if name.startswith("fem"):
        plot.plot_mesh(problem.elements, np.minimum(values, cap), axes[1], at="points", **look)
    else:
        plot.plot_points(problem.points, np.minimum(values, cap), axes[1], **look)
    if MPI.COMM_WORLD.rank == 0:
        axes[1].set_title(f"{BASES[name]}, {args.cells} cells under the half")
        draw_curves(axes[0], result["curves"])
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def draw_curves(ax, curves):
    for kind, curve in curves.items():
        style = "--" if kind == "gimpm" else "-"  # it lies on that of mpm
        ax.plot(curve["settlement"], curve["load"], style, lw=1.4, label=BASES[kind])
    ax.axhline(LIMIT, color="0.35", lw=1.2, ls="--", label="2 + π")
    ax.set_ylim(bottom=0.75 * LIMIT)
    ax.set_xticks(np.linspace(0, SETTLEMENT, 5))
    ax.set_xlabel("settlement / b (-)")
    ax.set_ylabel("load / (c effective width) (-)")
    finish_curves(ax)


if __name__ == "__main__":
    main()
