"""Round and square excavations under outer pressure, with second gradients and without. Metres, MPa.

S 6.3.3. A quarter in plane strain between two planes of symmetry, on which the slope of the tangential
displacement vanishes, too. The round one, of 4 m in a disc of 10 m, has a closed form: with an internal
length of 4 m its hoop stress is a quarter lower, and all remains axisymmetric. In the corner of the square
one the classical stress grows with every refinement; with second gradients it doesn't.
"""

import argparse
import itertools

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo
from polarmpm.study.exact import GradientRing

INNER, OUTER, LENGTH = 2.0, 5.0, 4.0  # m; of the square half the sides
YOUNG, POISSON = 20e3, 0.0  # MPa
PRESSURE = {"round": 54.0189, "square": 60.0}  # MPa


def material(length):
    rock = pm.SaintVenantKirchhoff.from_engineering(E=YOUNG, nu=POISSON)
    return pm.GradientElastic(rock, (length, length)) if length else rock


# scenes -----------------------------------------------------------------------------------------
def rings(cell):
    """Quadrilaterals between the radii, of about the size of a cell; as many chords as circles have area."""
    along, around = round((OUTER - INNER) / cell), round(np.pi / 2 * (INNER + OUTER) / 2 / cell)
    corners = [(INNER, 0.0), (OUTER, np.pi / 2)]
    body = mesh.create_rectangle(MPI.COMM_WORLD, corners, [along, around], mesh.CellType.quadrilateral)
    radius, angle = body.geometry.x[:, :2].T.copy()
    step = np.pi / 2 / around
    radius *= np.sqrt(step / np.sin(step))
    body.geometry.x[:, :2] = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return body


def rim(cell):
    """The outer boundary of the round one as a surface, with its exact length."""
    n = 4 * round(np.pi / 2 * OUTER / cell)
    angle = (np.arange(n) + 0.5) / n * np.pi / 2
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return pm.Surface(OUTER * normal, np.full(n, OUTER * np.pi / 2 / n), normal)


def of_points(shape, length, cell, args):
    """Material points with splines."""
    upper = np.ceil((OUTER + cell) / cell) * cell
    if args.grid == "graded":  # fine to a quarter of the opening's size beyond it
        lines = pm.lines(0, upper, fine=cell, where=(0, 1.25 * INNER), keep=[INNER, OUTER])
        grid = pm.Grid.graded(lines, lines)
    else:
        grid = pm.Grid.box((0, 0), (upper, upper), cell)
    if shape == "square":
        points = pm.seed(
            grid,
            lambda x: x.max(axis=1) > INNER,
            bounds=((0, 0), (OUTER, OUTER)),
            material=material(length),
            points_per_cell=args.points_per_cell,
            layout="gauss",
        )
    elif args.seeding == "mesh":
        points = pm.seed_mesh(
            grid, rings(cell), material=material(length), points_per_cell=args.points_per_cell
        )
    else:
        points = pm.seed(
            grid,
            lambda x: (np.hypot(*x.T) > INNER) & (np.hypot(*x.T) < OUTER),
            bounds=((0, 0), (OUTER, OUTER)),
            material=material(length),
            points_per_cell=args.points_per_cell,
        )
    problem = pm.QuasiStatic(grid, points, reset=None)
    mirror(problem, args)
    if shape == "round":
        problem.pressure(rim(cell), args.share * PRESSURE[shape])
    else:
        n, corner = 4 * round(OUTER / cell), (OUTER, OUTER)
        for ends in (((OUTER, 0), corner), (corner, (0, OUTER))):
            problem.pressure(pm.Surface.line(*ends, n), args.share * PRESSURE[shape])
    return problem


def of_elements(length, cell, args):
    """The round one by elements of degree 2."""
    body = pm.Elements(rings(cell), material=material(length), degree=2)
    problem = pm.QuasiStaticFEM(body)
    mirror(problem, args)
    middle = (INNER + OUTER) / 2
    problem.pressure(
        lambda x: np.hypot(*x[:, :2].T) > middle + 0.4 * (OUTER - INNER), args.share * PRESSURE["round"]
    )
    return problem


def mirror(problem, args):
    """Both planes of symmetry; without their slopes for comparison."""
    if args.symmetry == "whole":
        for axis in "xy":
            problem.symmetry(pm.plane(**{axis: 0.0}))
    else:
        problem.fix(pm.plane(x=0.0), ux=0)
        problem.fix(pm.plane(y=0.0), uy=0)


def solve(problem, args, file):
    """March to the share of the pressure, with files for ParaView."""
    with pm.Recorder(file, problem, fields=("displacement", "stress")) as record:
        for step in problem.march(args.steps, progress=False):
            if step.factor == 1.0:
                record(step)
    return problem


# results ----------------------------------------------------------------------------------------
def polar(problem, share):
    """Radius (m) and angle of the points, hoop and radial stress (MPa, compression positive), and inward
    displacement (mm), at the whole pressure."""
    points, stress = problem.points, problem.fields("stress").stress[:, :2, :2] / share
    radius, angle = np.hypot(*points.X.T), np.arctan2(points.X[:, 1], points.X[:, 0])
    radial = points.X / radius[:, None]
    around = np.stack([-radial[:, 1], radial[:, 0]], axis=1)
    hoop, normal = (-np.einsum("ni,nij,nj->n", e, stress, e) for e in (around, radial))
    inward = -1e3 * np.einsum("ni,ni->n", points.displacement, radial) / share
    return radius, angle, hoop, normal, inward


def wall(problem, cell, share):
    """Hoop and radial stress (MPa) and displacement (mm) at the hole: the mean around it, and the spread
    there, that is the largest less the smallest (the same units).

    In sectors of a cell a cubic of the distance from the wall is fitted to the points next to it.
    """
    radius, angle, *values = polar(problem, share)
    mine = np.column_stack([radius - INNER, angle, problem.points.volume0, *values])
    rows = np.concatenate(problem.comm.allgather(mine))
    near = max(0.75, 2 * cell)  # m
    rows = rows[rows[:, 0] < near]
    sectors = max(3, int(np.pi / 2 * INNER / cell))
    sector = np.minimum((rows[:, 1] / (np.pi / 2) * sectors).astype(int), sectors - 1)
    found = []
    for k in range(sectors):
        distance, _, volume = rows[sector == k, :3].T
        root = np.sqrt(volume)[:, None]
        powers = (distance[:, None] / near) ** np.arange(4)
        found.append(np.linalg.lstsq(root * powers, root * rows[sector == k, 3:], rcond=None)[0][0])
    names = ("hoop", "radial", "displacement")
    return [dict(zip(names, map(float, of(found, axis=0)), strict=True)) for of in (np.mean, np.ptp)]


def error(problem, exact, share):
    """Of the displacement, relative, in the mean over the body (L2)."""
    radius, _, _, _, inward = polar(problem, share)
    wrong, all_ = (
        (v**2) @ problem.points.volume0 for v in (inward / 1e3 + exact.displacement(radius), inward / 1e3)
    )
    return float(np.sqrt(problem.comm.allreduce(wrong) / problem.comm.allreduce(all_)))


def principal(problem, share):
    """Largest compressive principal stress at the local points (MPa)."""
    return -np.linalg.eigvalsh(problem.fields("stress").stress)[:, 0] / share


def largest(problem, values):
    return float(problem.comm.allreduce(values.max(initial=-np.inf), op=MPI.MAX))


def shear(problem, share):
    """Largest shear stress in the plane (MPa)."""
    low, high = np.linalg.eigvalsh(problem.fields("stress").stress[:, :2, :2]).T / share
    return largest(problem, (high - low) / 2)


# the whole --------------------------------------------------------------------------------------
def round_one(args, folder):
    """What is found of the round one, and the problems by length at the finest cells."""
    found, problems = {}, {}
    for length, prefix in ((args.length, ""), (0.0, "classical_")):
        exact = GradientRing(
            inner=INNER, outer=OUTER, pressure=PRESSURE["round"], E=YOUNG, nu=POISSON, l=length
        )
        radial, hoop = -exact.stress(INNER)[:, 0]
        inward = -1e3 * exact.displacement(INNER)[0]
        found[f"{prefix}exact"] = {"hoop": hoop, "radial": radial, "displacement": inward}
        errors, by_cell, by_elements = {}, {}, {}
        for cell in args.cells:
            file = folder / f"round_{length:g}m_{cell:g}m.pvd"
            problem = solve(of_points("round", length, cell, args), args, file)
            by_cell[f"{cell:g}"], spread = wall(problem, cell, args.share)
            errors[f"{cell:g}"] = error(problem, exact, args.share)
            if args.elements:
                file = folder / f"elements_{length:g}m_{cell:g}m.pvd"
                by_elements[f"{cell:g}"] = wall(
                    solve(of_elements(length, cell, args), args, file), cell, args.share
                )[0]
        found |= {f"{prefix}wall": by_cell[f"{cell:g}"], f"{prefix}wall_spread": spread}
        found |= {f"{prefix}wall_by_cell": by_cell, f"{prefix}error": errors}
        if args.elements:
            found[f"{prefix}elements_wall_by_cell"] = by_elements
        found[f"{prefix}order"] = [
            float(np.log(errors[f"{a:g}"] / errors[f"{b:g}"]) / np.log(a / b))
            for a, b in itertools.pairwise(args.cells)
        ]
        problems[length] = problem
    return found, problems


def square_one(args, folder):
    """What is found of the square one, and the problems by length at the finest cells."""
    found, problems = {}, {}
    for length, prefix in ((args.length, ""), (0.0, "classical_")):
        peaks, shears = {}, {}
        for cell in args.cells:
            file = folder / f"square_{length:g}m_{cell:g}m.pvd"
            problem = solve(of_points("square", length, cell, args), args, file)
            peaks[f"{cell:g}"] = largest(problem, principal(problem, args.share))
            shears[f"{cell:g}"] = shear(problem, args.share)
        found |= {f"{prefix}corner_peak": peaks, f"{prefix}corner_shear": shears}
        found[f"{prefix}corner_growth"] = [b / a for a, b in itertools.pairwise(peaks.values())]
        problems[length] = problem
    return found, problems


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="excavation",
        argv=argv,
        more={
            "--shapes": {"nargs": "+", "choices": ("round", "square"), "default": ["round", "square"]},
            "--cells": {
                "type": demo.positive,
                "nargs": "+",
                "default": [0.5, 0.25, 0.125],
                "help": "sizes (m)",
            },
            "--length": {"type": demo.positive, "default": LENGTH, "help": "internal length (m)"},
            "--points-per-cell": {"type": demo.count, "default": 3, "help": "in each direction"},
            "--steps": {"type": demo.count, "default": 1, "help": "number of load steps"},
            "--seeding": {
                "choices": ("predicate", "mesh"),
                "default": "predicate",
                "help": "of the round one: cells of the grid that circles cut, or rings",
            },
            "--grid": {
                "choices": ("equal", "graded"),
                "default": "equal",
                "help": "graded: cells of that size at the opening, growing from there",
            },
            "--elements": {
                "action": argparse.BooleanOptionalAction,
                "default": True,
                "help": "the round one by elements of degree 2, too",
            },
            "--symmetry": {
                "choices": ("whole", "displacement"),
                "default": "whole",
                "help": "without the slopes it is another problem",
            },
            "--share": {
                "type": demo.positive,
                "default": 1e-3,
                "help": "of the pressure, by which results are divided: closed forms are of small strains",
            },
        },
    )
    args.cells = sorted(args.cells, reverse=True)
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    result, solved = {}, {}
    for shape, make in (("round", round_one), ("square", square_one)):
        if shape in args.shapes:
            found, solved[shape] = make(args, folder)
            result |= found
    draw(result, solved, args, folder / "excavation.png")
    last = list(solved.values())[-1][args.length]
    options = ("cells", "length", "points_per_cell", "steps", "seeding", "symmetry", "share", "grid")
    return demo.report(args, "excavation", last, result, **{name: getattr(args, name) for name in options})


@styled()
def draw(result, solved, args, file):
    """Stresses of the round one over the radius; the square one with the largest principal stress, and that
    of its corner over the size of the cells."""
    from polarmpm.plot import figures as plot

    names = {0.0: "classical", args.length: f"l = {args.length:g} m"}
    panels = ["round"] * ("round" in solved) + ["peaks", *names] * ("square" in solved)  # curves above maps
    rows, columns = (2, 2) if len(panels) > 3 else (1, len(panels))
    figure, axes = plot.subplots(
        rows, columns, figsize=(plot.PAGE, 2.8 * rows), squeeze=False, height_ratios=(3, 4)[-rows:]
    )
    axes = dict(zip(panels, axes.flat, strict=True))
    if "round" in solved:
        draw_profiles(axes["round"], solved["round"], names, args)
    if "square" in solved:
        cap = 2 * largest(solved["square"][args.length], principal(solved["square"][args.length], args.share))
        for length, problem in solved["square"].items():
            look = {"limits": (0.0, cap), "undeformed": False}
            label = "largest compression (MPa)" if length else None  # one bar for both
            values = principal(problem, args.share)
            plot.plot_points(problem.points, np.minimum(values, cap), axes[length], label=label, **look)
            if MPI.COMM_WORLD.rank == 0:
                axes[length].set_title(f"square, {names[length]}")
        if MPI.COMM_WORLD.rank == 0:
            for prefix, name in (("", names[args.length]), ("classical_", names[0.0])):
                peaks = result[f"{prefix}corner_peak"]
                axes["peaks"].plot(args.cells, list(peaks.values()), "o-", label=name)
            axes["peaks"].set_xscale("log")
            axes["peaks"].set_xticks(args.cells, [f"{cell:g}" for cell in args.cells])
            axes["peaks"].minorticks_off()
            axes["peaks"].set_ylim(bottom=0)
            axes["peaks"].set_title("square: at the corner")
            finish(axes["peaks"], "size of the cells (m)", "largest compression (MPa)")
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def draw_profiles(ax, problems, names, args):
    from polarmpm.plot import figures as plot

    for k, (length, problem) in enumerate(sorted(problems.items())):
        radius, _, hoop, radial, _ = (plot.gather(problem.comm, v) for v in polar(problem, args.share))
        if radius is None:
            continue
        exact = GradientRing(
            inner=INNER, outer=OUTER, pressure=PRESSURE["round"], E=YOUNG, nu=POISSON, l=length
        )
        r = np.linspace(INNER, OUTER, 200)
        for values, line, mark, what in zip(
            (hoop, radial), -exact.stress(r)[::-1], ".x", ("hoop", "radial"), strict=True
        ):
            some = slice(None, None, max(1, len(radius) // 400))
            ax.plot(
                radius[some], values[some], mark, ms=3, color=f"C{1 - k}", label=f"{what}, {names[length]}"
            )
            ax.plot(r, line, color="0.2", lw=0.9, label="closed form" if k and what == "radial" else None)
    if MPI.COMM_WORLD.rank == 0:
        ax.set_ylim(top=1.2 * ax.get_ylim()[1])  # room for the legend
        finish(ax, "radius (m)", "compression (MPa)")
        ax.set_title("round")


def finish(ax, xlabel, ylabel):
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    finish_curves(ax)


if __name__ == "__main__":
    main()
