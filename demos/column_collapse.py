"""Collapse of a soil column under its growing weight, far past the limit load, on three grids. SI units.

Thesis 4.5.3. 1 x 1 m of micropolar Drucker-Prager soil, held horizontally on the left and fully at the base;
the floor goes on to the right, and what reaches it sticks. Load control ends at the limit load; here the
arc-length method follows the path on, down and up again as the toe comes to lie on the floor.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

WEIGHT = 20e3  # N/m^3 at load factor 1
SETTLEMENT = 0.47  # m, where the runs end; the thesis' one got to 0.45
MU, LENGTH = 192.3077e3, 0.01  # Pa, m


def material():
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=288.4615e3, mu=MU, kappa=MU / 8, l_b=LENGTH)
    return pm.DruckerPrager(
        elastic, phi=math.radians(25), psi=math.radians(5), c=1e3, cone="compression", l_p=LENGTH
    )


def build(cells, args):
    """The problem with `cells` cells along the column's sides, and its upper outer corner."""
    cell = 1.0 / cells
    grid = pm.Grid.box((0, 0), (3, 1 + 2 * cell), cell)
    solid = material()
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=solid, points_per_cell=args.points_per_cell)
    # cells at the free face lose most of their points: the thesis' ghost penalty is too light for them
    ghost = pm.GhostPenalty(displacement=args.ghost * MU, rotation=args.ghost * solid.elastic.gamma)
    problem = pm.QuasiStatic(
        grid,
        points,
        basis=args.basis,
        ghost=ghost,
        balanced_reset=True,  # past the limit load nothing holds what a reset lets go
        controls=pm.Controls(force_tolerance=1e-7, energy_tolerance=1e-11),
        reset=1,
    )
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), ux=0, uy=0)
    problem.body_load(force=(0, -WEIGHT))
    return problem, points.nearest((1, 1))


def solve(cells, args, folder):
    """One grid: its problem, and settlement (m), specific weight (N/m^3) and yielding share of the body."""
    problem, corner = build(cells, args)
    points, path = problem.points, [(0.0, 0.0, 0.0)]

    def settlement():
        return float(np.linalg.norm(points.mean_displacement(corner)))

    def yielding():
        share = [points.volume0[points.hardening > 0].sum(), points.volume0.sum()]
        share = problem.comm.allreduce(np.array(share))
        return share[0] / share[1]

    def steps():
        yield from problem.march(args.steps, to=0.3, adaptive=True)
        yield from problem.march_arc_length(
            0.005, largest=0.01, smallest=1e-4, until=lambda step: settlement() >= args.settlement
        )

    fields = ("displacement", "rotation", "stress", "hardening")
    with (
        pm.Recorder(folder / f"column_{cells}.pvd", problem, fields=fields) as record,
        pm.Table(folder / f"column_{cells}.csv", settlement=settlement, work=problem.energies) as table,
        demo.film(args, folder / f"column_{cells}.gif", problem, "hardening") as film,
    ):
        for step in steps():
            table.record(step)
            film.record(step)
            if step.number % 5 == 0:
                record(step)
            path.append((settlement(), WEIGHT * step.factor, yielding()))
    return problem, np.array(path).T


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="column_collapse",
        cell=None,
        points_per_cell=3,
        steps=6,
        basis="gimpm",
        argv=argv,
        more={
            "--cells": {"type": int, "nargs": "+", "default": [12, 24, 48], "help": "along the sides"},
            "--ghost": {"type": float, "default": 0.3, "help": "ghost penalty as a share of the moduli"},
            "--settlement": {"type": float, "default": SETTLEMENT, "help": "at which runs end (m)"},
            **demo.MOVIE,
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    solved = {cells: solve(cells, args, folder) for cells in args.cells}
    draw(solved, folder / "column_collapse.png")
    result = {"cells": args.cells} | measure(solved.values())
    return demo.report(args, "column_collapse", solved[args.cells[-1]][0], result, ghost=args.ghost)


def measure(columns):
    """What is compared among the grids and with the thesis, a list of each over the columns."""
    out = {}
    for problem, (settlement, weight, yielding) in columns:
        # on the way up to the limit load, before the toe reaches the floor
        limit = int(np.argmax(np.diff(weight, append=-np.inf) < 0))
        work = problem.energies()
        row = {
            "first_yield": weight[np.argmax(yielding > 0)],
            "limit": weight[limit],
            "settlement_at_limit": settlement[limit],
            "settlement": settlement[-1],
            "weight": weight[-1],
            "hardening": problem.comm.allreduce(problem.points.hardening.max(initial=0.0), op=MPI.MAX),
            "ghost_share": work["ghost"] / work["external"],
            "carried_share": work["carried"] / work["external"],
            "iterations": sum(step.iterations for step in problem.steps),
        }
        for name, value in row.items():
            out.setdefault(name, []).append(float(value))
    return out


@styled()
def draw(solved, file):
    """The columns at the end, coloured by chi, and the curves of weight over settlement."""
    from polarmpm.plot import figures as plot

    figure, (axes, below) = plot.subplots(2, len(solved), figsize=(plot.PAGE, 4.4), squeeze=False)
    below[0].set_subplotspec(below[0].get_gridspec()[1, :])
    for ax in below[1:]:
        ax.remove()
    curves, last = {}, list(solved)[-1]
    chi = [float(problem.points.hardening.max(initial=0.0)) for problem, _ in solved.values()]
    limits = 0.0, MPI.COMM_WORLD.allreduce(max(chi), op=MPI.MAX)  # one scale for all
    for ax, (cells, (problem, path)) in zip(axes, solved.items(), strict=True):
        label = "hardening variable $\\chi$ (-)" if cells == last else None
        plot.plot_points(problem.points, problem.points.hardening, ax, label=label, limits=limits)
        ax.set_title(f"{cells} x {cells} cells")
        curves[f"{cells} x {cells} cells"] = (path[0], path[1] / 1e3)
    plot.load_displacement(
        curves, below[0], xlabel="displacement of the corner (m)", ylabel="specific weight (kN/m$^3$)"
    )
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
