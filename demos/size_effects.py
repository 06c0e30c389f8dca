"""Size effects: beams, bars in torsion and clamped sheets, the thinner the stiffer. Micrometres, MPa.

S 5.7, 6.3. Epoxy cantilevers (Lam et al. 2003 measured a rigidity of 1 + (24 um / h)^2), square bars of bone
in torsion, clamped sheets, in the range of small displacements, by elements of degree 2 and, for the beams,
by material points with splines. The micropolar material is the mean over a micro-space of the length l. Every
row is a stiffness over the classical one, beside a closed form or Ritz' numbers.
"""

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

YOUNG = 1550.0  # MPa
HEIGHTS = (115.0, 75.0, 38.0, 20.0)  # um, of the beams; they are ten times as long
EPOXY = 25.0  # um, internal length of the beams
SHEETS, SHEET_LENGTH = (20.0, 10.0, 4.0, 2.0), 21.0  # um, thickness and internal length of the sheets
BARS = (5000.0, 2000.0, 1000.0, 500.0)  # um, side of the bars
BONE = 250.0  # um, internal length of the bars
LAYOUT = "gauss"  # bodies that fit the grid; second gradients aren't integrated over uniform points' boxes
SQUARE = 0.1405770  # J of a square over the side^4
RITZ = {
    "micropolar": {5000.0: 1.00578, 2000.0: 1.03489, 1000.0: 1.13216, 500.0: 1.48386},
    "second gradient": {5000.0: 1.0056, 2000.0: 1.0328, 1000.0: 1.1175, 500.0: 1.3953},
}
FITTED = 24.0  # um, internal length of second-gradient beams, which is that of the experiment


def classical(nu):
    return pm.SaintVenantKirchhoff.from_engineering(E=YOUNG, nu=nu)


def micropolar(nu, length):
    return pm.MicropolarElastic.from_microspace(E=YOUNG, nu=nu, l=length)


def gradient(nu, lengths):
    """W = psi(E) + sum l_a^2/12 psi(E,a), one length for each of the first axes."""
    return pm.GradientElastic(classical(nu), lengths)


def once(problem):
    """One load step, in the range of small displacements."""
    for _ in problem.march(1, progress=False):
        pass
    return problem


def clamp(material, held):
    return {"u": 0, "theta": 0} if material.micropolar and held else {"u": 0}


# beams ------------------------------------------------------------------------------------------
def force(h):
    """End force (MPa um) that bends a classical beam by about h / 1000."""
    return 1e-3 * h * YOUNG * (h / (10 * h)) ** 3 / 4


def beam_of_elements(h, material, args, held=True):
    """Plane strain: the problem after its step, and the deflection of the end (um)."""
    cells = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (10 * h, h)], [10 * args.cells, args.cells], mesh.CellType.quadrilateral
    )
    body = pm.Elements(cells, material=material, degree=2)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), **clamp(material, held))
    tip = body.farthest((1, 0))
    problem.load(tip, force=(0, force(h)))
    return once(problem), float(body.mean_displacement(tip)[1])


def beam_of_points(h, material, args, held=True):
    """The same with material points; the deflection is that of the last column of them."""
    cell = h / args.cells
    grid = pm.Grid.box((0, -h), (12 * h, 2 * h), cell)
    bounds = ((0, 0), (10 * h, h))
    points = pm.seed(
        grid, bounds=bounds, material=material, points_per_cell=args.points_per_cell, layout=LAYOUT
    )
    problem = pm.QuasiStatic(grid, points, reset=None)
    problem.fix(pm.plane(x=0.0), **clamp(material, held))
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, force(h)))
    return once(problem), float(points.mean_displacement(tip)[1])


def beams(args, folder):
    """Rows of stiffness over the classical one by method and material; and the last problem."""
    rows, problem = {}, None
    rows["Lam et al. 2003, fit"] = [1 + (24 / h) ** 2 for h in HEIGHTS]
    for nu in (0.0, 0.3):
        rows[f"micropolar, closed, nu = {nu:g}"] = [1 + (1 - nu) * (EPOXY / h) ** 2 for h in HEIGHTS]
        for name, make in {"elements": beam_of_elements, "points": beam_of_points}.items():
            row = rows[f"micropolar, {name}, nu = {nu:g}"] = []
            for h in HEIGHTS:
                plain = make(h, classical(nu), args)[1]
                problem, deflection = make(h, micropolar(nu, EPOXY), args)
                row.append(plain / deflection)
            with pm.Recorder(folder / f"beam_{name}_{nu:g}.pvd", problem) as record:
                record(problem.steps[-1])
    rows["second gradient, closed"] = [1 + (FITTED / h) ** 2 for h in HEIGHTS]
    for name, make in {"elements": beam_of_elements, "points": beam_of_points}.items():
        row = rows[f"second gradient, {name}, nu = 0.3"] = []
        for h in HEIGHTS:
            plain = make(h, classical(0.3), args)[1]
            problem, deflection = make(h, gradient(0.3, (0.0, FITTED)), args)
            row.append(plain / deflection)
        with pm.Recorder(folder / f"beam_gradient_{name}.pvd", problem) as record:
            record(problem.steps[-1])
    return rows, problem


# bars -------------------------------------------------------------------------------------------
def bar_of_elements(a, material, args):
    """The problem of a square bar and the positions and displacements of its own nodes."""
    half, n = a / 2, args.bar_cells
    corners = [np.array((0.0, -half, -half)), np.array((3 * a, half, half))]
    cells = mesh.create_box(MPI.COMM_WORLD, corners, [6, n, n], mesh.CellType.hexahedron)
    body = pm.Elements(cells, material=material, degree=2)
    problem = twist(pm.QuasiStaticFEM(body), a)
    own = np.arange(len(body.nodes)) < body.nodes.owned
    return problem, body.nodes.position[own], body.displacement[own]


def bar_of_points(a, material, args):
    """The same with material points, which fill their grid from end to end."""
    half, cell = a / 2, a / 4
    grid = pm.Grid.box(
        (0, -half - 2 * cell, -half - 2 * cell), (3 * a, half + 2 * cell, half + 2 * cell), cell
    )
    bounds = ((0, -half, -half), (3 * a, half, half))
    points = pm.seed(grid, bounds=bounds, material=material, points_per_cell=2, layout=LAYOUT)
    problem = twist(pm.QuasiStatic(grid, points, reset=None), a)
    return problem, points.X, points.displacement


def twist(problem, a):
    """Turn the ends in their planes, in which they may warp, by a thousandth in all."""
    problem.fix(pm.plane(x=0.0), uy=0, uz=0)
    turned = {"uy": lambda t, x: -1e-3 * t * x[:, 2], "uz": lambda t, x: 1e-3 * t * x[:, 1]}
    problem.fix(pm.plane(x=3 * a), **turned)
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 0.2 * a, ux=0)
    return once(problem)


def torsion(a, make, material, args):
    """Torsional stiffness over the classical one of a square bar, from its middle third."""
    problem, x, u = make(a, material, args)
    middle = np.abs(x[:, 0] - 1.5 * a) < 0.51 * a
    (along, y, z), (_, v, w) = x[middle].T, u[middle].T
    # the angle of a section is (y w - z v) / (y^2 + z^2): a line over x is fitted to it
    square, turn, along = y**2 + z**2, y * w - z * v, along / a - 1.5
    sums = [square.sum(), (square * along).sum(), (square * along**2).sum(), turn.sum(), (turn * along).sum()]
    n, first, second, t, t_along = problem.comm.allreduce(np.array(sums))
    rate = (n * t_along - first * t) / (n * second - first**2) / a
    moment = 2 * problem.energy() / 1e-3
    return problem, float(moment / rate / (SQUARE * YOUNG / (2 * (1 + 0.3)) * a**4))


def bars(args, folder):
    rows, problem = {}, None
    scenes = {
        ("micropolar", "elements"): (bar_of_elements, micropolar(0.3, BONE)),
        ("second gradient", "elements"): (bar_of_elements, gradient(0.3, (0.0, BONE, BONE))),
        ("second gradient", "points"): (bar_of_points, gradient(0.3, (0.0, BONE, BONE))),
    }
    for (kind, method), (make, material) in scenes.items():
        rows[f"{kind}, Ritz"] = [RITZ[kind][a] for a in BARS]
        plain = torsion(BARS[0], make, classical(0.3), args)[1]  # the mesh's or grid's own error
        row = rows[f"{kind}, {method}"] = []
        for a in BARS:
            problem, ratio = torsion(a, make, material, args)
            row.append(ratio / plain)
        with pm.Recorder(folder / f"bar_{method}.pvd", problem) as record:
            record(problem.steps[-1])
    return rows, problem


# sheets -----------------------------------------------------------------------------------------
def sheet(h, material, args, held):
    """The deflection (um) of the middle of a clamped square sheet of 300 h, by a quarter."""
    half, load = 150 * h, 1e-3 * h / (0.00126532 * (300 * h) ** 4 * 12 * (1 - 0.3**2) / (YOUNG * h**3))
    n = args.sheet_cells
    cells = mesh.create_box(
        MPI.COMM_WORLD,
        [np.array((0.0, 0.0, -h / 2)), np.array((half, half, h / 2))],
        [n, n, 1],
        mesh.CellType.hexahedron,
    )
    flat = cells.geometry.x[:, :2] / half
    cells.geometry.x[:, :2] = half * (1 - (1 - flat) ** 1.5)  # graded to the clamp
    body = pm.Elements(cells, material=material, degree=2)
    problem = pm.QuasiStaticFEM(body)
    mirrors = ({"theta_y": 0, "theta_z": 0}, {"theta_x": 0, "theta_z": 0})
    for axis, kept in zip("xy", mirrors, strict=True):
        rotations = kept if material.micropolar else {}
        problem.fix(pm.plane(**{axis: 0.0}), **{f"u{axis}": 0}, **rotations)
        problem.fix(pm.plane(**{axis: half}), **clamp(material, held))
    problem.body_load(force=(0, 0, load / h))
    once(problem)
    middle = (np.linalg.norm(body.nodes.position, axis=1) < 1e-6 * h) & (
        np.arange(len(body.nodes)) < body.nodes.owned
    )
    return problem, float(problem.comm.allreduce(body.displacement[middle, 2].sum()))


def sheets(args, folder):
    rows, problem = {"micropolar, closed": [1 + 0.7 * (SHEET_LENGTH / h) ** 2 for h in SHEETS]}, None
    plain = [sheet(h, classical(0.3), args, True)[1] for h in SHEETS]
    for held in (False, True):
        row = rows[f"micropolar, elements, rotations {'held' if held else 'free'}"] = []
        for h, deflection in zip(SHEETS, plain, strict=True):
            problem, found = sheet(h, micropolar(0.3, SHEET_LENGTH), args, held)
            row.append(deflection / found)
    rows["second gradient, closed"] = [1 + (SHEET_LENGTH / h) ** 2 for h in SHEETS]
    row = rows["second gradient, elements"] = []
    for h, deflection in zip(SHEETS, plain, strict=True):
        problem, found = sheet(h, gradient(0.3, (0.0, 0.0, SHEET_LENGTH)), args, True)
        row.append(deflection / found)
    with pm.Recorder(folder / "sheet.pvd", problem) as record:
        record(problem.steps[-1])
    return rows, problem


SCENES = {  # what makes the rows, sizes (um), names of both axes
    "beams": (beams, HEIGHTS, "height of the beam (µm)", "bending stiffness / classical (-)"),
    "bars": (bars, BARS, "side of the bar (µm)", "torsional stiffness / classical (-)"),
    "sheets": (sheets, SHEETS, "thickness of the sheet (µm)", "bending stiffness / classical (-)"),
}


def main(argv=None):
    parser_options = {
        "--scenes": {"nargs": "+", "choices": tuple(SCENES), "default": list(SCENES)},
        "--cells": {"type": demo.count, "default": 2, "help": "across a beam, of elements and of points"},
        "--points-per-cell": {"type": demo.count, "default": 3, "help": "in each direction"},
        "--bar-cells": {"type": demo.count, "default": 3, "help": "elements across a bar"},
        "--sheet-cells": {"type": demo.count, "default": 6, "help": "elements along half of a sheet"},
    }
    args = demo.scene_arguments(
        __doc__.splitlines()[0], output="size_effects", argv=argv, more=parser_options
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    result, problem = {}, None
    for name in args.scenes:
        make, sizes, *_ = SCENES[name]
        rows, problem = make(args, folder)
        result[name] = {"size": list(sizes), **rows}
    draw(result, folder / "size_effects.png")
    return demo.report(args, "size_effects", problem, result, scenes=args.scenes)


@styled()
def draw(result, file):
    """Stiffness over the classical one, less one, over the size: lines are closed forms, marks computed."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, len(result), figsize=(plot.PAGE, 2.8), squeeze=False)
    for k, (ax, (name, rows)) in enumerate(zip(axes.flat, result.items(), strict=True)):
        if MPI.COMM_WORLD.rank:
            continue
        draw_rows(ax, rows)
        ax.set_xlabel(SCENES[name][2])
        ax.set_ylabel(SCENES[name][3].replace("(-)", "− 1 (-)"))
        ax.get_legend().remove()  # below the panel, where it hides no mark
        where = {"loc": "upper center", "bbox_to_anchor": ((k + 0.55) / len(result), 0.0), "frameon": False}
        figure.legend(*ax.get_legend_handles_labels(), **where)
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def draw_rows(ax, rows):
    from matplotlib.ticker import FuncFormatter, NullLocator

    sizes = np.array(rows["size"])
    lines = [name for name in rows if any(word in name for word in ("closed", "Ritz", "fit"))]
    for name in rows:
        ratio = np.array(rows[name]) - 1
        if name in lines:
            style = (":", "-", "--", "-.")[lines.index(name) % 4]
            ax.loglog(sizes, ratio, style, color="0.35", lw=1.2, label=name.replace("nu", "ν"))
        elif name != "size":
            k = [n for n in rows if n not in lines].index(name) - 1
            style = {"color": f"C{k}", "marker": "osD^v<>P"[k % 8], "markersize": 7 - k}
            ax.loglog(sizes, ratio, ls="none", markerfacecolor="none", label=name.replace("nu", "ν"), **style)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xticks(sizes, [f"{size:g}" for size in sizes])
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    finish_curves(ax)


if __name__ == "__main__":
    main()
