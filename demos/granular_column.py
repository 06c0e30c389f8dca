"""Collapse of a column of aluminium bars on a rough floor, as in an experiment, on three grids. SI units.

Bui et al. 2008: 0.2 x 0.1 m of bars of 1 and 1.5 mm, two-dimensional sand, at a wall, let go at once.
Friction of 19.8 degrees in plane strain, no dilatancy; a cohesion of a hundredth of the weight's stress, or
what `--cohesion` says, keeps points at the front from falling apart. The same with microrotations
(`--micropolar`), of bars that turn; and columns of other shapes (`--aspect`), whose run-out is to be laid
beside that of Lube et al. 2005.
"""

import math
import warnings

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

WIDTH, HEIGHT = 0.2, 0.1  # m
DENSITY, GRAVITY = 2650.0, 9.81  # kg/m^3, m/s^2
E, NU, PHI, LENGTH = 0.84e6, 0.3, 19.8, 1.3e-3  # Pa, -, degrees, m
LAM, MU = E * NU / (1 + NU) / (1 - 2 * NU), 0.5 * E / (1 + NU)
FRONT = 0.44  # m, in the experiment
# digitised, to 2 mm
SURFACE = np.column_stack(
    [np.arange(0.02, 0.43, 0.04), [0.1, 0.09, 0.078, 0.067, 0.055, 0.043, 0.031, 0.022, 0.014, 0.008, 0.002]]
)


def material(args):
    """The bars: Drucker and Prager's cone that fits their friction in plane strain."""
    options = {"phi": math.radians(args.phi), "psi": 0.0, "c": args.cohesion, "cone": "plane strain"}
    if not args.micropolar:
        return pm.DruckerPrager(pm.Hencky(lam=LAM, mu=MU), **options)
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=LAM, mu=MU, kappa=MU / 2, l_b=args.length)
    return pm.DruckerPrager(elastic, l_p=args.length, **options)


def build(cell, args):
    """The column at rest. Two layers of cells below the floor catch points that sink into it."""
    height = args.aspect * WIDTH
    width = WIDTH * (1.0 + 3.0 * max(args.aspect, 0.5))
    grid = pm.Grid.box((0, -2 * cell), (width, height + 4 * cell), cell)
    bounds = ((0, 0), (WIDTH, height))
    points = pm.seed(grid, bounds=bounds, material=material(args), points_per_cell=args.points_per_cell)
    problem = pm.Dynamic(
        grid,
        points,
        density=DENSITY,
        microinertia=args.length**2 / 8 if args.micropolar else None,
        rho_inf=0.8,
        basis=args.basis,
        ghost=pm.GhostPenalty(args.ghost * E, args.ghost * E * args.length**2) if args.ghost else None,
        reset=pm.WhenDistorted(0.2),
        locking=None,
        controls=pm.Controls(force_tolerance=1e-5, energy_tolerance=1e-11),
    )
    problem.fix(pm.plane(x=0.0), ux=0)
    # a rough floor: it's meant to hold what comes down on it
    warnings.filterwarnings("ignore", ".*wherever its predicate is true", pm.TrustWarning)
    problem.fix(lambda X: X[:, 1] < 1e-3 * cell, ux=0, uy=0)
    problem.body_load(force=lambda t: (0, -DENSITY * GRAVITY))
    return problem


def surface(problem, cell, places):
    """Height (m) of the highest point within a cell of each place."""
    p = problem.points
    top = p.x[:, 1] + 0.5 * cell / 2
    near = np.abs(p.x[:, 0] - places[:, None]) < 0.5 * cell
    found = np.where(near, top, 0.0).max(axis=1, initial=0.0)
    problem.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
    return found


def front_of(problem):
    return problem.comm.allreduce(problem.points.x[:, 0].max(initial=0.0), op=MPI.MAX)


def solve(cell, args, folder):
    """One grid, until the column has come to rest: what is compared, and the problem."""
    problem, path, most = build(cell, args), [], 0.0
    name = f"column_{cell * 1e3:g}mm"
    with (
        pm.Recorder(folder / f"{name}.pvd", problem, fields=("velocity", "hardening")) as record,
        pm.Table(folder / f"{name}.csv", front=lambda: front_of(problem), work=problem.energies) as table,
        demo.film(
            args, folder / f"{name}.gif", problem, "velocity", length=(1e3, "mm"), domains=True
        ) as film,
    ):
        for step in problem.march(args.time, dt=args.dt, adaptive=True, smallest=1e-2):
            if step.number % 5 == 0:
                film.record(step)
            work = problem.energies()
            path.append((step.time, front_of(problem), work["kinetic"]))
            if step.number % 20 == 0:
                table.record(step)
                record(step)
            most = max(most, work["kinetic"])
            if step.time > 0.1 and work["kinetic"] < 1e-4 * most:
                break
        record(step)
    distance = np.abs(surface(problem, cell, SURFACE[:, 0]) - SURFACE[:, 1])
    work, end = problem.energies(), front_of(problem)
    row = {
        "cell": cell,
        "front": end,
        "runout": (end - WIDTH) / WIDTH,
        "surface_error": float(np.sqrt(np.mean(distance**2))),
        "surface_worst": float(distance.max()),
        "time": step.time,
        "steps": len(problem.steps),
        "iterations": sum(one.iterations for one in problem.steps),
        "cuts": sum(one.cuts for one in problem.steps),
        "ledger": work["residue"] / work["external"],
        "ghost": work["ghost"] / work["external"],
    }
    return row, problem, np.array(path).T


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="granular_column",
        cell=None,
        points_per_cell=2,
        steps=350,
        basis="gimpm",
        bases=("gimpm", "mpm", "bspline"),
        argv=argv,
        more={
            "--cells": {"type": float, "nargs": "+", "default": [0.01, 0.005, 0.0025], "help": "sizes (m)"},
            "--cohesion": {"type": float, "help": "(Pa); default: 20 of this column, more of higher ones"},
            "--phi": {"type": float, "default": PHI, "help": "angle of friction (degrees)"},
            "--ghost": {"type": float, "default": 1e-3, "help": "ghost penalty as a share of E"},
            "--aspect": {"type": float, "default": HEIGHT / WIDTH, "help": "height over width"},
            "--time": {"type": float, "default": 0.7, "help": "at which runs end at the latest (s)"},
            "--micropolar": {"action": "store_true", "help": "bars that turn"},
            "--length": {"type": float, "default": LENGTH, "help": "of them, with --micropolar (m)"},
            **demo.MOVIE,
        },
    )
    args.dt = args.time / args.steps
    if args.cohesion is None:
        args.cohesion = 20.0 * args.aspect * WIDTH / HEIGHT
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    solved = [solve(cell, args, folder) for cell in args.cells]
    draw(solved, folder / "granular_column.png")
    result = {"runs": [row for row, _, _ in solved], "experiment": {"front": FRONT}}
    return demo.report(args, "granular_column", solved[-1][1], result, aspect=args.aspect)


@styled()
def draw(solved, file):
    """The column at rest on the finest grid, all surfaces, and the fronts over time."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 3, figsize=plot.fitted(15, 3.8))
    problem = solved[-1][1]
    strain = problem.points.hardening
    plot.plot_points(problem.points, strain, axes[0], label="plastic strain (-)", domains=True)
    curves = {f"cells of {row['cell'] * 1e3:g} mm": (path[0], path[1]) for row, _, path in solved}
    places = np.linspace(0.005, 0.6, 120)
    lines = {row["cell"]: surface(one, row["cell"], places) for row, one, _ in solved}
    if axes[1] is not None:
        for cell, line in lines.items():
            axes[1].plot(places[line > 0], line[line > 0], lw=1, label=f"cells of {cell * 1e3:g} mm")
        axes[1].plot(*SURFACE.T, "ko", mfc="none", label="experiment")
        axes[1].set_xlabel("x (m)")
        axes[1].set_ylabel("y (m)")
        axes[1].grid(color="0.88", linewidth=0.6)
    plot.load_displacement(curves, axes[2], xlabel="time (s)", ylabel="front (m)")
    if MPI.COMM_WORLD.rank == 0:
        for line in axes[2].get_lines():
            line.set(marker="", label=f"_{line.get_label()}")  # as beside
        axes[2].get_legend().remove()
        plot.legend_below(figure, axes[1:2])
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
