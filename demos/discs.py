"""Two elastic discs that meet and rebound: momentum, energy, and the gap at which they meet. SI units.

Sulsky et al. 1994: radius 0.2 m, 0.1 m/s in both directions, plane strain. The discs are bodies of their own,
which share no nodes, and touch by their outlines. Stiff ones ring after the impact: 9 % of their speed stays
behind in that, as elements against a smooth wall have it, too. By default their surfaces are soft, springs of
7 kPa per metre, chosen so that the discs hardly ring; they overlap by 0.02 m. `--stiffness 0` takes stiff
ones.

`--contact nodes`: one body of points, as usual in this benchmark. The discs meet through the nodes that they
share, so they feel each other before they touch, by less on finer cells, and stick while they share nodes;
the grid is reset at each step while they are near, or they would be glued.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

RADIUS, SPEED = 0.2, 0.1  # m, m/s
SITES = 8  # of contact, a cell
MIDDLES = np.array([[0.2, 0.2], [0.8, 0.8]])
E, NU, DENSITY = 1000.0, 0.3, 1000.0  # Pa, -, kg/m^3
MATERIAL = pm.NeoHookean(lam=E * NU / (1 + NU) / (1 - 2 * NU), mu=0.5 * E / (1 + NU))
CLOSING = 2 * SPEED * math.sqrt(2)  # m/s
TOUCHING = (math.dist(*MIDDLES) - 2 * RADIUS) / CLOSING  # s


def build(cell, args):
    """The discs in flight, and the points of the first one."""
    grid = pm.Grid.box((-0.2, -0.2), (1.2, 1.2), cell)

    def disc(middle):
        inside = lambda x: np.linalg.norm(x - middle, axis=1) <= RADIUS  # noqa: E731
        return pm.seed(grid, inside, material=MATERIAL, points_per_cell=args.points_per_cell)

    apart = args.contact == "bodies"
    points = disc(MIDDLES[0])
    points.join(disc(MIDDLES[1]), apart=apart)
    first = points.where(lambda x: x.sum(axis=1) < 1.0)
    reset = args.reset or (None if apart else pm.InMotion())
    problem = pm.Dynamic(
        grid, points, density=DENSITY, rho_inf=args.rho_inf, basis=args.basis, reset=reset, locking=None
    )
    problem.velocity(v=(-SPEED, -SPEED))
    problem.velocity(first, v=(SPEED, SPEED))
    if apart:
        sites = round(SITES * 2 * math.pi * RADIUS / cell)
        outlines = [pm.Surface.arc(middle, RADIUS, sites) for middle in MIDDLES]
        problem.contact(on=outlines, stiffness=args.stiffness or None)
    return problem, first


def solve(cell, args, folder):
    """The impact on one grid."""
    problem, first = build(cell, args)
    points, begin = problem.points, problem.energies()["kinetic"]
    path, felt, most = [], None, 0.0

    def approach():
        """Velocity (m/s) of the first disc's middle along the line of middles."""
        return float(points.mean(points.velocity, first).sum()) / math.sqrt(2)

    before = approach()
    with pm.Recorder(
        folder / f"discs_{cell * 1e3:g}mm.pvd", problem, fields=("velocity", "stress")
    ) as record:
        for step in problem.march(args.time, steps=args.steps):
            work = problem.energies()
            total = work["kinetic"] + work["stored"]
            path.append((step.time, work["kinetic"] / begin, work["stored"] / begin, approach()))
            most = max(most, float(np.abs(problem.momentum()).max()))
            if felt is None and work["stored"] > 1e-6 * begin:
                felt = step.time
            if step.number % 20 == 0:
                record(step)
    return (
        {
            "cell": cell,
            "restitution": -approach() / before,
            "gap_cells": (TOUCHING - (felt or args.time)) * CLOSING / cell,
            "energy_error": abs(total / begin - 1.0),
            "momentum": most / (0.5 * float(problem.inertia()["mass"]) * SPEED),
            "stored": work["stored"] / begin,
            "iterations": sum(one.iterations for one in problem.steps),
        },
        np.array(path).T,
        problem,
    )


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="discs",
        cell=None,
        points_per_cell=3,
        steps=400,
        basis="bspline",
        argv=argv,
        more={
            "--cells": {"type": float, "nargs": "+", "default": [0.05], "help": "sizes (m)"},
            "--time": {"type": float, "default": 4.0, "help": "(s)"},
            "--reset": {"type": int, "default": 0, "help": "of the grid, after so many steps; 0: never"},
            "--contact": {"choices": ("bodies", "nodes"), "default": "bodies", "help": "how they meet"},
            "--stiffness": {"type": float, "default": 7e3, "help": "of their surfaces (Pa/m); 0: stiff"},
            "--rho-inf": {"type": float, "default": 1.0, "help": "1: the midpoint rule"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    solved = [solve(cell, args, folder) for cell in args.cells]
    draw(solved, folder / "discs.png")
    result = {**solved[-1][0], "runs": [row for row, _, _ in solved]}
    return demo.report(args, "discs", solved[-1][2], result)


@styled()
def draw(solved, file):
    """Energies and velocity over time, and the discs at the end."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.2))
    if axes[0] is not None:
        for k, (row, (time, kinetic, stored, _), _) in enumerate(solved):
            label = f"cells of {row['cell'] * 1e3:g} mm"
            axes[0].plot(time, kinetic, color=f"C{k}", label=f"kinetic, {label}")
            axes[0].plot(time, stored, color=f"C{k}", ls="--", label=f"stored, {label}")
        axes[0].axvline(TOUCHING, color="0.6", lw=1, label="they meet")
        axes[0].set_xlabel("time (s)")
        axes[0].set_ylabel("energy over the first one (-)")
        if MPI.COMM_WORLD.rank == 0:
            plot.legend_below(figure, axes[:1])
    points = solved[-1][2].points
    plot.plot_points(points, np.linalg.norm(points.velocity, axis=1), axes[1], label="speed (m/s)")
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
