"""Square sheets with fibres: a micro-space of one or two directors, in-plane. Micrometres, MPa.

S 6.4. Sheets of E = 1.55 GPa, nu = 0.3, as thick as a 300th of their side, held in z at their edges, under a
dead load; a quarter, by elements of degree 2. The generalised micropolar energy for directors e_1, e_2 or
both of length l = 21 um: the linear stiffness against Navier's series, then large deflections, where a sheet
with e_1 is pulled in less at its edge x = L/2 (A) than at y = L/2 (B). S's text has it the other way round,
which its equations don't give: see `docs/benchmarks.md`. `--model gradient` (S 6.3.3) has the fibres in a
micro-space of second gradients, l = 0.07 L, under a load that the classical sheet bears without wrinkles.
"""

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

YOUNG, POISSON = 1550.0, 0.3  # MPa
LENGTH, SLENDER = 21.0, 300  # um, side over thickness
LOAD, LOADED_SIDE = 0.08341, 600.0  # MPa at this side (um); larger sheets get less, with the third power
LAM, MU = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)), YOUNG / (2 * (1 + POISSON))
CLASSICAL_SHARE = 0.08  # of the load, up to which the classical sheet has no wrinkles
DIRECTORS = {"classical": (0, 0), "e_1": (1, 0), "e_2": (0, 1), "both": (1, 1)}
TITLES = {
    "classical": "classical",
    "e_1": "director $e_1$",
    "e_2": "director $e_2$",
    "both": "both directors",
}


def material(name, model="micropolar", side=LOADED_SIDE):
    if model == "micropolar":
        lengths = (*(LENGTH * k for k in DIRECTORS[name]), 0.0)
        return pm.OrientedMicropolar(lam=LAM, mu=MU, lengths=lengths)
    solid = pm.SaintVenantKirchhoff(lam=LAM, mu=MU)
    if name == "classical":
        return solid
    return pm.GradientElastic(solid, (*(0.07 * side * k for k in DIRECTORS[name]), 0.0))


def quarter(side, elements):
    """Hexahedra of a quarter; its middle is at the origin, and the middle plane is z = 0."""
    half, thick = side / 2, side / SLENDER / 2
    corners = [np.array((0.0, 0.0, -thick)), np.array((half, half, thick))]
    return mesh.create_box(MPI.COMM_WORLD, corners, [elements, elements, 1], mesh.CellType.hexahedron)


def build(name, side, load, args):
    """The problem of a sheet under a dead load (MPa)."""
    body = pm.Elements(quarter(side, args.elements), material=material(name, args.model, side), degree=2)
    problem = pm.QuasiStaticFEM(body, controls=pm.Controls(force_tolerance=1e-9, energy_tolerance=1e-20))
    for axis in "xy":
        problem.symmetry(pm.plane(**{axis: 0.0}))
    near = 1e-6 * side

    def edge(x):
        return (np.abs(np.abs(x[:, :2]).max(axis=1) - side / 2) < near) & (np.abs(x[:, 2]) < near)

    problem.fix(edge, uz=0)
    thickness = side / SLENDER
    problem.body_load(force=(0.0, 0.0, load / thickness))
    return problem


def at(problem, *position):
    """Displacement (3,) of the node at a position. Collective."""
    body = problem.elements
    here = np.linalg.norm(body.nodes.position - position, axis=1) < 1e-6 * body.cell_size
    own = np.arange(len(here)) < body.nodes.owned
    found = body.displacement[here & own].sum(axis=0)
    return problem.comm.allreduce(found, op=MPI.SUM)


def linear(name, side, args):
    """Deflection of the middle per load (um / MPa), of a thousandth of the thickness."""
    bending = YOUNG * (side / SLENDER) ** 3 / (12 * (1 - POISSON**2))
    load = 1e-3 * side / SLENDER / (0.00406 * side**4 / bending)
    problem = build(name, side, load, args)
    for _ in problem.march(1, progress=False):
        pass
    return at(problem, 0, 0, 0)[2] / load


def navier(name, side, terms=200):
    """Linear stiffness of the middle over the classical one, by Navier's series for thin plates."""
    h = side / SLENDER
    bending = YOUNG * h**3 / (12 * (1 - POISSON**2))
    m, n = np.meshgrid(2 * np.arange(terms) + 1.0, 2 * np.arange(terms) + 1.0, indexing="ij")
    first, second = (LENGTH * k for k in DIRECTORS[name])
    plain = bending * (m**2 + n**2) ** 2
    fibres = first**2 * (m**4 + m**2 * n**2) + second**2 * (n**4 + m**2 * n**2)
    sign = (-1.0) ** ((m + n) / 2 - 1) / (m * n)
    return (sign / plain).sum() / (sign / (plain + h * MU / 6 * fibres)).sum()


def solve(name, side, args, folder):
    """A sheet under its load, or the share of it that it bears: the problem, and a path of the load factor
    and (middle, A, B) over its side, (steps + 1, 4)."""
    problem = build(name, side, LOAD * (LOADED_SIDE / side) ** 3, args)
    path = [np.zeros(4)]

    def places():
        a, b = at(problem, side / 2, 0, 0), at(problem, 0, side / 2, 0)
        return np.array((at(problem, 0, 0, 0)[2], -a[0], -b[1])) / side

    stem = f"sheet_{name}_{side:g}um"
    share = CLASSICAL_SHARE if name == "classical" or args.model == "gradient" else 1.0
    with (
        pm.Recorder(folder / f"{stem}.pvd", problem, fields=("displacement", "rotation", "stress")) as record,
        pm.Table(folder / f"{stem}.csv", middle_A_B=places) as table,
    ):
        for step in problem.march_arc_length(side / args.steps, to=share):  # its edges snap inwards
            table.record(step)
            if step.factor == share:
                record(step)
            path.append(np.array((step.factor, *places())))
    return problem, np.array(path)


def main(argv=None):
    args = demo.element_arguments(
        __doc__.splitlines()[0],
        output="oriented_sheet",
        elements=6,
        degree=2,
        steps=75,
        argv=argv,
        more={
            "--side": {"type": demo.positive, "default": 600.0, "help": "of the sheet that is bent far (um)"},
            "--sides": {
                "type": demo.positive,
                "nargs": "*",
                "default": [600.0],
                "help": "of the sheets whose linear stiffness is compared (um); S: 6000 3000 1200 600",
            },
            "--model": {
                "choices": ("micropolar", "gradient"),
                "default": "micropolar",
                "help": "of the fibres; series and linear stiffness are those of the first",
            },
            "--directors": {"nargs": "+", "choices": tuple(DIRECTORS), "default": list(DIRECTORS)},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    ratios = {name: {} for name in DIRECTORS if name != "classical"}
    for side in args.sides if args.model == "micropolar" else ():
        plain = linear("classical", side, args)
        for name, row in ratios.items():
            row[f"{side / SLENDER:g}"] = [plain / linear(name, side, args), navier(name, side)]
    solved = {name: solve(name, args.side, args, folder) for name in args.directors}
    draw(solved, args.side, folder / "oriented_sheet.png")
    result = {"linear_ratio": ratios}
    for name, (problem, path) in solved.items():
        result[name] = dict(zip(("load", "middle", "A", "B"), path[-1], strict=True))
        result[f"path_{name}"] = path
        result[f"iterations_{name}"] = sum(step.iterations for step in problem.steps)
    last = solved[args.directors[-1]][0]
    return demo.report(args, "oriented_sheet", last, result, side=args.side, model=args.model)


@styled()
def draw(solved, side, file):
    """Two of the sheets, coloured by their deflection, and the pull-ins of all over the load."""
    from polarmpm.plot import figures as plot

    shown = [name for name in ("e_1", "both", "e_2", "classical") if name in solved][:2]
    count = len(shown) + 1
    figure, axes = plot.subplots(
        1,
        count,
        figsize=(plot.PAGE, 2.6),
        solid=list(range(count - 1)),
        width_ratios=[1.2] * (count - 1) + [1],
    )
    comm = MPI.COMM_WORLD
    bodies = {name: solved[name][0].elements for name in shown}
    highest = max(body.displacement[:, 2].max(initial=0.0) for body in bodies.values())
    limits = (0.0, comm.allreduce(highest, op=MPI.MAX) / side)
    for ax, (name, body) in zip(axes, bodies.items(), strict=False):
        look = {"limits": limits, "length": (1 / side, "L"), "view": (35.0, 40.0), "undeformed": False}
        label = "deflection (L)" if name == shown[-1] else None
        plot.plot_mesh(body, body.displacement[:, 2] / side, ax, label=label, **look)
        if ax is not None:
            ax.set_title(f"a quarter, {TITLES[name]}")
    curves = {}
    for name, (_, path) in solved.items():
        for k, place in ((2, "A"), (3, "B")):
            curves[f"{TITLES[name]}, {place}"] = (path[:, k], path[:, 0])
    plot.load_displacement(curves, axes[-1], xlabel="pull-in of the edge (L)", ylabel="load factor (-)")
    if comm.rank == 0:
        for k, line in enumerate(axes[-1].get_lines()):
            line.set(marker="", color=f"C{k // 2}", linestyle=("-", "--")[k % 2])
        plot.legend_below(figure)
    plot.save(figure, file, comm=comm)


if __name__ == "__main__":
    main()
