"""Shear layer with a weak row: a shear band whose width the material decides, or else the mesh. SI units.

Thesis 2.4 and 4.4. A slice of 0.01 x 0.1 m of a layer, its base fixed, its top moved sideways; vertical
displacements are constrained, microrotations free. The strength is lower by `--weakness` in the central row
of cells or, with `--zone`, in a zone that is the same for all grids. `--model micropolar` (grids 9x1, 19x2,
39x4) gives one force-displacement curve; `--model classical` (9x5, 19x10, 39x20) a brittle one for each grid.

`--regrid 0.5e-3 --basis bspline --grids 25x1 --length 2e-3 --zone 4e-3 --steps 40 --to 0.5` begins with cells
of twice the length, and goes on with cells of .5 mm where the layer yields; beside it a run on the lines that
this ends with, from the start.
"""

import math
from dataclasses import replace

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

WIDTH, HEIGHT, SHIFT = 0.01, 0.1, 0.02  # m
LAM, MU = 4e9, 4e9  # Pa
YOUNG = MU * (3 * LAM + 2 * MU) / (LAM + MU)
STRENGTH, FRICTION, DILATANCY = 100e6, math.radians(8.6), math.radians(2)  # Pa, rad, rad
GRIDS = {"micropolar": ("9x1", "19x2", "39x4"), "classical": ("9x5", "19x10", "39x20")}  # rows x columns


def material(model, length):
    """Drucker-Prager plasticity; `length` (m) is that of bending and the plastic one."""
    cone = {"phi": FRICTION, "psi": DILATANCY, "k": STRENGTH, "cone": "compression"}
    if model == "classical":
        return pm.DruckerPrager(pm.Hencky(lam=LAM, mu=MU), **cone)
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=LAM, mu=MU, kappa=MU / 10, l_b=length)
    return pm.DruckerPrager(elastic, **cone, l_p=length)


def controls(model):
    if model == "classical":  # localisation without a length spoils convergence
        return pm.Controls(force_tolerance=1e-5, energy_tolerance=1e-12)
    return pm.Controls(force_tolerance=1e-9, energy_tolerance=1e-14)


def penalty(choice, model, length):
    """The ghost penalty: as in the thesis, or a hundredth of the moduli whatever the size of the cells."""
    if choice == "none":
        return None
    if choice == "thesis":
        return pm.GhostPenalty(10 * YOUNG, power=3) if model == "classical" else "thesis"
    rotation = 0.0 if model == "classical" else 4 * MU * length**2 / 100
    return pm.GhostPenalty(LAM / 100, rotation, power=1)


def build(rows, columns, length, args, lines=None):
    """The problem on a grid, or with other `lines` across its height, and the support of its base."""
    strong = material(args.model, length)
    weak = replace(strong, k=(1 - args.weakness) * STRENGTH)
    half = (args.zone or HEIGHT / rows) / 2

    def in_zone(x):
        return abs(x[:, 1] - HEIGHT / 2) < half

    if args.mode == "fem":
        problem = pm.QuasiStaticFEM(
            _elements(rows, columns, strong, weak, in_zone),
            controls=controls(args.model),
            locking=None,  # the published curves are those of elements without a cure
        )
    else:
        cell = (WIDTH / columns, HEIGHT / rows)
        grid = pm.Grid.box((0, 0), (5 * WIDTH, HEIGHT), cell)
        if lines is not None:
            grid = pm.Grid.graded(x=grid.lines[0], y=lines)
        points = pm.seed(
            grid,
            bounds=((0, 0), (WIDTH, HEIGHT)),
            material=strong,
            points_per_cell=args.points_per_cell,
        )
        points.assign(points.where(in_zone), weak)
        ghost = None if args.basis == "bspline" else penalty(args.ghost, args.model, length)
        options = {"reset": 1, "balanced_reset": False, "locking": None}  # as in the thesis
        if args.regrid is not None:
            regrid = pm.AlongBands(h=args.regrid) if lines is None else None
            options = {"reset": None, "locking": None, "regrid": regrid}
        problem = pm.QuasiStatic(
            grid, points, basis=args.basis, ghost=ghost, controls=controls(args.model), **options
        )
    problem.fix(lambda x: np.ones(len(x), dtype=bool), uy=0)
    base = problem.fix(pm.plane(y=0.0), ux=0)
    problem.fix(pm.plane(y=HEIGHT), ux=SHIFT)
    return problem, base


def _elements(rows, columns, strong, weak, in_zone):
    """Squares of degree 2; those whose middle is in the zone are weak."""
    body = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (WIDTH, HEIGHT)], [columns, rows], mesh.CellType.quadrilateral
    )
    cells = body.topology.index_map(2)
    number = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    region = np.where(in_zone(mesh.compute_midpoints(body, 2, number)), 2, 1).astype(np.int32)
    tags = mesh.meshtags(body, 2, number, region)
    return pm.Elements(body, material={1: strong, 2: weak}, degree=2, cells=tags)


def profile(points, values):
    """Means of a value over rows of points: initial heights (m), means, and the rows' heights (m)."""
    comm = points.comm
    y, v, volume = (
        np.concatenate(comm.allgather(a)) for a in (np.round(points.X[:, 1], 9), values, points.volume0)
    )
    rows, at = np.unique(y, return_inverse=True)
    volumes = np.bincount(at, volume)
    return rows, np.bincount(at, volume * v) / volumes, volumes / WIDTH


def widths(points):
    """Width (m) of the band, from the profile of chi: its integral over its maximum, and where it is above
    half of its maximum (nan where it doesn't fall to that on both sides)."""
    y, chi, height = profile(points, points.hardening)
    top, half = int(np.argmax(chi)), chi.max() / 2
    if not half > 0:
        return math.nan, math.nan
    ends = []
    for side in (range(top, len(y)), range(top, -1, -1)):
        below = [k for k in side if chi[k] < half]
        k = below[0] if below else None
        step = 1 if side.step > 0 else -1
        ends.append(math.nan if k is None else float(np.interp(half, chi[[k, k - step]], y[[k, k - step]])))
    return float(chi @ height / chi.max()), ends[0] - ends[1]


def largest(points):
    """Of the hardening variable, over all ranks."""
    return points.comm.allreduce(points.hardening.max(initial=0.0), op=MPI.MAX)


def solve(name, length, args, folder, lines=None):
    """One grid, maybe with other `lines`: its problem, and the displacement of the top (m), the force at the
    base (N per metre) and the largest hardening variable of each step."""
    problem, base = build(*map(int, name.split("x")), length, args, lines)
    stem, path = f"{args.model}_{name}_{length * 1e3:g}mm", [(0.0, 0.0, 0.0)]
    stem += "_from_the_start" * (lines is not None)
    fields = ("displacement", "rotation", "hardening", "stress")
    columns = {"base": lambda: problem.reaction(base)[0], "hardening": lambda: largest(problem.points)}
    with (
        pm.Recorder(folder / f"{stem}.pvd", problem, fields=fields) as record,
        pm.Table(folder / f"{stem}.csv", energies=problem.energies, **columns) as table,
    ):
        try:
            adaptive = args.adaptive or args.model == "classical"
            for step in problem.march(args.steps, to=args.to, adaptive=adaptive):
                table.record(step)
                path.append((SHIFT * step.factor, -problem.reaction(base)[0][0], largest(problem.points)))
                if step.number % max(1, args.steps // 10) == 0 or step.factor == args.to:
                    record(step)
        except pm.NotConverged as error:
            if problem.comm.rank == 0 and not args.json:
                print(f"{name}, {length * 1e3:g} mm: {str(error).splitlines()[0]}")
    return problem, np.array(path)


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="shear_layer",
        cell=None,
        points_per_cell=4,
        steps=200,
        basis="gimpm",
        bases=("gimpm", "mpm", "bspline"),
        argv=argv,
        more={
            "--model": {"choices": tuple(GRIDS), "default": "micropolar", "help": "continuum"},
            "--mode": {
                "choices": ("mpm", "fem"),
                "default": "mpm",
                "help": "points, or elements of degree 2",
            },
            "--grids": {"nargs": "+", "help": "rows x columns; default: those of the thesis"},
            "--length": {"type": float, "nargs": "+", "default": [5e-3], "help": "internal length (m)"},
            "--zone": {"type": float, "help": "height of the weak zone (m); default: one row of cells"},
            "--weakness": {"type": float, "default": 0.1, "help": "by how much the zone is weaker"},
            "--ghost": {"choices": ("thesis", "scaled", "none"), "default": "thesis", "help": "penalty"},
            "--to": {"type": demo.positive, "default": 1.0, "help": "share of the shift"},
            "--regrid": {
                "type": demo.positive,
                "help": "size of cells (m) that the grid takes where the layer yields; resets are balanced",
            },
            "--adaptive": {
                "action": "store_true",
                "help": "cut steps that fail; the classical model always does",
            },
        },
    )
    if args.regrid is not None and args.mode == "fem":
        raise pm.InputError("--regrid: elements stay as they are; use --mode mpm")
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    grids = args.grids or GRIDS[args.model]
    solved = {}
    for length in args.length:
        for g in grids:
            solved[g, length] = solve(g, length, args, folder)
            if args.regrid is not None:
                lines = solved[g, length][0].grid.lines[1]
                solved[f"{g} from the start", length] = solve(g, length, args, folder, lines)
    draw(solved, args, folder / "shear_layer.png")
    result = {"grids": [f"{g}, {length * 1e3:g} mm" for g, length in solved]} | summary(solved)
    last = list(solved.values())[-1][0]
    if args.regrid is not None:
        result["regrids"] = [list(map(str, problem.regrids)) for problem, _ in solved.values()]
        result["unknowns"] = [
            problem.system.nodes.total * problem.layout.block for problem, _ in solved.values()
        ]
    options = {name: getattr(args, name) for name in ("model", "mode", "zone", "weakness", "ghost", "regrid")}
    return demo.report(args, "shear_layer", last, result, **options)


def summary(solved):
    """What the grids are compared by."""
    paths = [path for _, path in solved.values()]
    bands = [widths(problem.points) for problem, _ in solved.values()]
    return {
        "displacement": [float(path[-1, 0]) for path in paths],
        "force": [float(path[-1, 1]) for path in paths],
        "peak": [float(path[:, 1].max()) for path in paths],
        "hardening": [float(path[-1, 2]) for path in paths],
        "width": [equivalent for equivalent, _ in bands],
        "half_width": [None if math.isnan(half) else half for _, half in bands],
        "most_iterations": [max(step.iterations for step in problem.steps) for problem, _ in solved.values()],
        "steps": [len(problem.steps) for problem, _ in solved.values()],
    }


@styled()
def draw(solved, args, file):
    """Force-displacement curves, profiles over the height, and the slices of the first length."""
    from polarmpm.plot import figures as plot

    shown = {g: problem for (g, length), (problem, _) in solved.items() if length == args.length[0]}
    views = {"hardening variable $\\chi$ (-)": lambda points: points.hardening}
    if args.model == "micropolar":
        views["microrotation (rad)"] = lambda points: points.rotation_vector[:, 2]
    ratios = [2.6, 2.0] + [0.75] * (len(views) * len(shown))
    figure, axes = plot.subplots(
        1, len(ratios), figsize=plot.fitted(2.1 * sum(ratios), 4.6), gridspec_kw={"width_ratios": ratios}
    )
    curves, profiles = {}, {}
    for (g, length), (problem, path) in solved.items():
        label = f"{g}, {length * 1e3:g} mm" if len(args.length) > 1 else g
        y, chi, _ = profile(problem.points, problem.points.hardening)
        curves[label] = (path[:, 0] * 1e3, path[:, 1] / 1e3)
        profiles[label] = (chi, y * 1e3)
    plot.load_displacement(curves, axes[0], xlabel="displacement of the top (mm)", ylabel="force (kN/m)")
    plot.load_displacement(profiles, axes[1], xlabel=next(iter(views)), ylabel="initial height (mm)")
    for ax in axes[:2] if MPI.COMM_WORLD.rank == 0 else []:
        for line in ax.get_lines():
            line.set_marker("")
            if line.get_label().endswith("from the start"):
                line.set_linestyle("--")
        ax.legend(frameon=False)
    for k, (label, value) in enumerate(views.items()):
        draw_slices(shown, value, label, axes[2 + k * len(shown) :])
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def draw_slices(problems, value, label, axes):
    """The deformed slices of all grids, with the same colours of a value of the points."""
    from polarmpm.plot import figures as plot

    comm, last = MPI.COMM_WORLD, list(problems)[-1]
    values = {g: value(problem.points) for g, problem in problems.items()}
    low = comm.allreduce(min(v.min(initial=np.inf) for v in values.values()), MPI.MIN)
    high = comm.allreduce(max(v.max(initial=-np.inf) for v in values.values()), MPI.MAX)
    for ax, (g, problem) in zip(axes, problems.items(), strict=False):
        options = {
            "limits": (low, high),
            "label": label if g == last else None,
            "length": (1e3, "mm"),
            "undeformed": False,
        }
        if isinstance(problem, pm.QuasiStaticFEM):
            plot.plot_mesh(problem.elements, values[g], ax, at="points", edges=False, **options)
        else:
            plot.plot_points(problem.points, values[g], ax, **options)
        ax.set(title=g, xlabel="x (mm)" if g == last else "", ylabel="", yticks=[])


if __name__ == "__main__":
    main()
