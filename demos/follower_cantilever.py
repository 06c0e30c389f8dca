"""Cantilever under a pressure that follows it: it curls up until it meets its root. No units: length 1.

S 4.3.1. A beam of 1 x 1/50 in plane strain, pressed on its upper face by p = c EI / L^3 on current areas: by
finite elements of degree 2, by material points with a surface that the body carries, and by a micropolar
material whose internal length is a thirtieth of the height. The reference is the elastica under the same load
on its axis; the beam is as thick as it is, so that distances of the order of its height remain.
"""

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo
from polarmpm.study.exact import pressed_cantilever

LENGTH = 1.0
YOUNG, POISSON = 1e6, 0.3


def material(kind, args):
    if kind == "micropolar":
        return pm.MicropolarElastic.from_microspace(E=YOUNG, nu=POISSON, l=args.height / 30)
    if kind == "arruda-boyce":  # rubber, nearly incompressible
        return pm.ArrudaBoyce(C_R=1e4, N=8.0, kappa=1e7)
    return pm.SaintVenantKirchhoff.from_engineering(E=YOUNG, nu=POISSON)


def pressure(solid, args):
    """p for the load c, with the EI of plane strain."""
    lam, mu = (solid.moduli(name)[name] for name in ("lam", "mu"))
    bending = 4 * mu * (lam + mu) / (lam + 2 * mu) * args.height**3 / 12  # E / (1 - nu^2) h^3 / 12
    return args.load * bending / LENGTH**3


def of_elements(kind, args):
    """The problem, and a function for the mean displacement of the free end."""
    corners = [(0.0, 0.0), (LENGTH, args.height)]
    along = args.elements * (2 if kind == "arruda-boyce" else 1)  # nearly incompressible ones are too stiff
    across = max(1, round(along * args.height / LENGTH))
    cells = mesh.create_rectangle(MPI.COMM_WORLD, corners, [along, across], mesh.CellType.quadrilateral)
    body = pm.Elements(cells, material=material(kind, args), degree=2)
    problem = pm.QuasiStaticFEM(body)
    root = {"u": 0, "theta": 0} if kind == "micropolar" else {"u": 0}
    problem.fix(pm.plane(x=0.0), **root)
    problem.pressure(pm.plane(y=args.height), pressure(body.points.materials[0], args))
    tip = body.farthest((1, 0))
    return problem, lambda: body.mean_displacement(tip)


def of_points(kind, args):
    """The same with material points. The end's displacement is extrapolated from the last two columns."""
    cell = args.height
    lower, upper = (-np.ceil(1.4 / cell) * cell, -np.ceil(1.2 / cell) * cell), (1.5 * LENGTH, 0.6 * LENGTH)
    upper = tuple(np.ceil(v / cell) * cell for v in upper)
    grid = pm.Grid.box(lower, upper, cell)
    points = pm.seed(
        grid,
        bounds=((0, 0), (LENGTH, args.height)),
        material=material(kind, args),
        points_per_cell=args.points_per_cell,
    )
    problem = pm.QuasiStatic(grid, points)
    number = args.points_per_cell * int(np.ceil(LENGTH / cell))
    # the end comes round to the root: neither is on the border of the grid
    problem.fix(pm.Surface.line((0, args.height), (0, 0), 12), u=0)
    problem.pressure(
        pm.Surface.line((LENGTH, args.height), (0, args.height), number), pressure(points.materials[0], args)
    )
    width = LENGTH - points.mean(points.X[:, 0], points.farthest((1, 0)))  # half a column's
    columns = [
        points.where(lambda x, k=k: np.abs(x[:, 0] - LENGTH + (2 * k + 1) * width) < width / 2)
        for k in (0, 1)
    ]

    def tip():
        last, before = (points.mean_displacement(one) for one in columns)
        return last + (last - before) / 2

    return problem, tip


def solve(name, make, kind, args, folder):
    """A problem, and its path of the free end (steps + 1, 2)."""
    problem, tip = make(kind, args)
    path = [np.zeros(2)]
    with (
        pm.Recorder(folder / f"{name}.pvd", problem, fields=("displacement", "stress")) as record,
        pm.Table(folder / f"{name}.csv", tip=tip) as table,
    ):
        for step in problem.march(args.steps):
            table.record(step)
            if step.number % 5 == 0 or step.factor == 1.0:
                record(step)
            path.append(tip())
    return problem, np.array(path)


def main(argv=None):
    args = demo.element_arguments(
        __doc__.splitlines()[0],
        output="follower_cantilever",
        elements=50,
        degree=2,
        steps=20,
        argv=argv,
        more={
            "--load": {"type": demo.positive, "default": 20.0, "help": "c = p L^3 / EI"},
            "--height": {"type": demo.positive, "default": 0.02, "help": "of the beam; cells of the points"},
            "--points-per-cell": {"type": demo.count, "default": 3, "help": "in each direction"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    scenes = {
        "elements": (of_elements, "classical"),
        "micropolar": (of_elements, "micropolar"),
        "arruda-boyce": (of_elements, "arruda-boyce"),
        "points": (of_points, "classical"),
    }
    solved = {name: solve(name, *scene, args, folder) for name, scene in scenes.items()}
    loads = args.load * np.arange(args.steps + 1) / args.steps
    exact = np.array([pressed_cantilever(c)[-1] - (LENGTH, 0) for c in loads])
    draw(solved, loads, exact, args.height, folder / "follower_cantilever.png")
    result = {"load": loads, "elastica": exact[-1], "path_elastica": exact}
    for name, (problem, path) in solved.items():
        result[name] = path[-1]
        result[f"path_{name}"] = path
        result[f"distance_{name}"] = np.linalg.norm(path - exact, axis=1)
        result[f"iterations_{name}"] = sum(step.iterations for step in problem.steps)
    options = {
        "load": args.load,
        "height": args.height,
        "points_per_cell": args.points_per_cell,
    }
    return demo.report(args, "follower_cantilever", solved["points"][0], result, **options)


@styled()
def draw(solved, loads, exact, height, file):
    """The curled beam of points upon the elastica, the end's path over the load, and how far it is from the
    elastica's."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 3, figsize=plot.fitted(15, 4.4))
    problem = solved["points"][0]
    stress = problem.fields("stress").stress[:, 2, 2] / (POISSON * YOUNG)
    plot.plot_points(
        problem.points,
        stress,
        axes[0],
        label="$\\sigma_{zz}/\\nu E$ (-)",
        cmap="coolwarm",
        length=(1.0, "L"),
        undeformed=False,
    )
    if MPI.COMM_WORLD.rank == 0:
        for k in np.linspace(0, len(loads) - 1, 6).round().astype(int):
            x, y = pressed_cantilever(loads[k]).T
            axes[0].plot(x, y + height / 2, color="0.4", lw=0.8, ls="--")
        axes[0].set_title(f"dashed: elastica up to $pL^3/EI$ = {loads[-1]:g}")
    paths = {f"$u_{c}$, {n}": (p[:, k], loads) for n, (_, p) in solved.items() for k, c in enumerate("xy")}
    every = max(1, len(loads) // 10)  # of the marks
    reference = {"elastica": (exact[::every].T.ravel(), np.tile(loads[::every], 2))}
    plot.load_displacement(
        paths, axes[1], reference=reference, xlabel="displacement of the end (L)", ylabel="$pL^3/EI$ (-)"
    )
    apart = {n: (loads, np.linalg.norm(p - exact, axis=1) / height) for n, (_, p) in solved.items()}
    plot.load_displacement(apart, axes[2], xlabel="$pL^3/EI$ (-)", ylabel="distance of the ends (h)")
    if MPI.COMM_WORLD.rank == 0:
        styles = dict(zip(solved, ("-", ":", "-.", "--"), strict=True))
        for k, line in enumerate(axes[1].get_lines()[:-1]):
            line.set(marker="", color=f"C{k % 2}", linestyle=list(styles.values())[k // 2])
        plot.legend_below(figure, axes[1:2], columns=5)
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
