"""A rigid wedge pressed into a micropolar half space: it is the harder, the smaller the indent. Metres, Pa.

A blunt wedge whose sides rise by the angle beta is pressed into the middle of a block in plane strain, half
of it by symmetry. A classical half space has the hardness (load over the width of contact) E* tan(beta) / 2,
whatever the depth. In a micropolar one rotations of the surface are resisted by couple stresses: the hardness
grows with the characteristic length l over the half width a of the contact. All runs have the same depth; the
hardness is divided by that for a length of nearly nothing, with which the microrotations are free and the
body is classical.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

SIDE = 1.0  # m: half of the block's width, and its depth
ANGLE = 0.1  # rad
DEPTH = 0.02  # m
NOTHING = 1e-4  # m: l of a classical body
LAM, MU, COUPLING = 0.6e6, 0.4e6, 0.4e6  # Pa; the latter is kappa


def material(length):
    """Micropolar with a characteristic length (m)."""
    return pm.MicropolarElastic(lam=LAM, mu=MU, kappa=COUPLING, alpha=0.0, beta=0.0, gamma=4 * MU * length**2)


def wedge():
    """The tip touches the surface at the start."""
    rise = 2 * SIDE * math.tan(ANGLE)
    return pm.Polygon([(0.0, SIDE), (2 * SIDE, SIDE + rise), (-2 * SIDE, SIDE + rise)])


def solve(length, args, folder):
    """Load (N/m) and half width (m) of the whole contact, and the problem."""
    h = SIDE / args.cells
    grid = pm.Grid.box((0, 0), (SIDE, SIDE), h)
    points = pm.seed(grid, material=material(length), points_per_cell=args.points_per_cell)
    problem = pm.QuasiStatic(grid, points, basis=args.basis)
    problem.symmetry(pm.plane(x=0.0))
    problem.fix(pm.plane(x=SIDE), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    reach = 0.4 * SIDE
    top = pm.Surface.line((reach, SIDE), (0.0, SIDE), round(args.sites * reach / h))
    tool = problem.obstacle(wedge(), on=top, motion=(0.0, -DEPTH))
    with pm.Recorder(folder / f"l_{length:g}.pvd", problem, contact=True) as record:
        for step in problem.march(args.steps, adaptive=True, progress=False):
            record(step)
    force = tool.area * tool.traction[:, 1]
    touching = tool.touching
    spacing = reach / len(force)
    edge = float(tool.surface.x[touching, 0].max()) + 0.5 * spacing
    return -2.0 * float(force.sum()), edge, problem


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="penetration",
        argv=argv,
        more={
            "--lengths": {
                **{"nargs": "+", "type": demo.positive, "help": "characteristic lengths (m)"},
                "default": [0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32],
            },
            "--cells": {"type": demo.count, "default": 64, "help": "along a side"},
            "--points-per-cell": {"type": demo.count, "default": 2, "help": "in each direction"},
            "--sites": {"type": demo.count, "default": 8, "help": "of contact in a cell"},
            "--steps": {"type": demo.count, "default": 4, "help": "number of load steps"},
            "--basis": {"choices": ("bspline", "gimpm", "mpm"), "default": "bspline", "help": "functions"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    poisson = LAM / (2 * (LAM + MU))
    stiff = 2 * MU * (1 + poisson) / (1 - poisson**2)
    load, width, problem = solve(NOTHING, args, folder)
    classical = load / (2 * width)
    result = {
        "classical": classical,
        "classical_error": classical / (0.5 * stiff * math.tan(ANGLE)) - 1,
        "half_width": width,
        "lengths": list(args.lengths),
        "loads": [],
        "hardness": [],
        "half_widths": [],
    }
    for length in args.lengths:
        found, edge, problem = solve(length, args, folder)
        result["loads"].append(found / load)
        result["half_widths"].append(edge)
        result["hardness"].append(found / (2 * edge) / classical)
    draw(result, problem, args, folder / "penetration.png")
    names = ("cells", "points_per_cell", "sites", "steps", "basis")
    return demo.report(args, "penetration", problem, result, **{name: getattr(args, name) for name in names})


@styled()
def draw(result, problem, args, file):
    """Hardness over l / a, and the microrotation beneath the wedge of the last run."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.3), width_ratios=(1, 1.1))
    turn = problem.points.rotation_vector[:, 2]
    look = {"label": "microrotation (rad)", "undeformed": False}
    plot.plot_points(problem.points, turn, axes[1], **look)
    if MPI.COMM_WORLD.rank == 0:
        axes[1].set_xlim(0, 0.5 * SIDE)
        axes[1].set_ylim(0.5 * SIDE, 1.02 * SIDE)
        axes[1].set_title(f"l = {args.lengths[-1]:g} m")
        ratio = np.array(result["lengths"]) / np.array(result["half_widths"])
        ax = axes[0]
        ax.semilogx(ratio, result["hardness"], "o-", color="#0072b2", lw=1.4, label="hardness")
        ax.semilogx(
            ratio, result["loads"], "s--", color="#d55e00", lw=1.2, ms=4, label="load at the same depth"
        )
        ax.axhline(1.0, color="0.35", lw=1.0)
        ax.set_xlabel("characteristic length / half width of the contact (-)")
        ax.set_ylabel("over that of a classical body (-)")
        finish_curves(ax)
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
