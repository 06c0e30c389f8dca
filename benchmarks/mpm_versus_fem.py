"""Which method gives an error in the least time: material points, splines or finite elements?

The curved cantilever (P 4.4, T 3.5.4) by all methods with several cell sizes, each run in a process of its
own, with errors against the classical beam solution, as published, and against the converged micropolar
solution; then the orders of convergence in the manufactured solution (P 4.1, T 3.5.1). Writes tables and
figures. `--full` adds finer cells, other numbers of points and other positions in the grid.
"""

import argparse
import dataclasses
import functools
import importlib.util
import json
import operator
from pathlib import Path

from mpi4py import MPI

import numpy as np
from assembly import kernel_seconds
from dolfinx import mesh as dmesh

import polarmpm as pm
from polarmpm import study

DEMOS = Path(__file__).parents[1] / "demos"
BEAM = (-23.30, 13.64, 53.21)  # m, classical beam theory, as published
# m, +-0.003: the converged micropolar solution, by finite elements of degree 2: 32 elements along and 1 to 4
# across, extrapolated, plus the change from 32 to 64 and 128 along
REFERENCE = (-22.980, 13.270, 52.861)
REFERENCES = {"beam": BEAM, "micropolar": REFERENCE}
LENGTH = 25 * np.pi  # m, of the arch's axis; the section is 1 x 1 m
STEPS = 15
POSITIONS = [
    (-99.5, 0.0),
    (-99.75, 0.25),
    (-100.0, -0.5),
]  # besides the demo's: y of the centre, lowest z (m)
LEVELS = (6.0, 3.0, 1.5, 1.0, 0.5, 0.2)  # m, errors for which times are compared

# cells, displacement (m), CPU s
PUBLISHED = {
    "FEM, degree 1": [
        ((64, 1), (-14.40, 8.52, 43.40), 7.9),
        ((128, 2), (-20.04, 11.64, 50.05), 153.8),
        ((256, 4), (-22.18, 12.83, 52.14), 5425.0),
    ],
    "MPM": [
        (2.0, (-22.00, 16.57, 48.10), 90.1),
        (1.0, (-23.52, 14.27, 52.08), 792.7),
        (0.5, (-23.67, 13.74, 53.09), 23736.5),
    ],
}


@functools.cache
def demo(name):
    """A demo's module: its geometry and problem."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# the curved cantilever ----------------------------------------------------------------------------
def arch_mesh(along, across):
    """Hexahedra that fit the arch: `along` its axis, `across` in both directions of the section."""
    mesh = dmesh.create_box(
        MPI.COMM_WORLD, [np.zeros(3), np.ones(3)], [along, across, across], dmesh.CellType.hexahedron
    )
    s, radius, z = mesh.geometry.x.T.copy()
    angle, radius = s * np.pi / 4, radius + 99.5
    mesh.geometry.x[:] = np.stack([radius * np.sin(angle), radius * np.cos(angle) - 100, z], axis=1)
    return mesh


def finite_elements(along, across, degree, **options):
    arch = demo("curved_cantilever")
    body = pm.Elements(arch_mesh(along, across), material=arch.MATERIAL, degree=degree)
    problem = pm.QuasiStaticFEM(body, **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = body.farthest((1, -1, 0))
    problem.load(end, force=(0, 0, arch.FORCE))
    return study.Case(problem, lambda: body.mean_displacement(end))


def material_points(cell, basis, points_per_cell=4, centre=-100.0, bottom=0.0):
    """As published: points on the grid's own lattice, a reset after each step."""
    args = argparse.Namespace(
        cell=cell, basis=basis, points_per_cell=points_per_cell, centre=centre, bottom=bottom
    )
    problem, end = demo("curved_cantilever").build(args)
    kernel = functools.partial(kernel_seconds, problem, 10)
    return study.Case(problem, lambda: problem.points.mean_displacement(end), kernel)


def splines(cell, side):
    """Quadratic B-splines, no resets; points at the Gauss positions, two a direction, of a mesh that fits the
    arch, with elements of about `side` (m).

    The end's force and displacement are extrapolated from the last two layers of points to the end face.
    """
    arch = demo("curved_cantilever")
    mesh = arch_mesh(round(LENGTH / side), round(1 / side))
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), cell)
    points = pm.seed_mesh(grid, mesh, material=arch.MATERIAL, degree=3)
    problem = pm.QuasiStatic(grid, points, basis="bspline", reset=None, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    # angle from the end in units of a mesh cell's; Gauss positions lie (1 -+ 1/sqrt 3) / 2 cells from the end
    angle = np.pi / 4 - np.arctan2(points.X[:, 0], points.X[:, 1] + 100)
    layer = np.floor(2 * angle / (np.pi / 4) * round(LENGTH / side))
    last, before = (pm.Selection(np.sort(points.id[layer == k])) for k in (0, 1))
    near, far = (0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5)
    shares = {"last": far / (far - near), "before": -near / (far - near)}
    problem.load(last, force=(0, 0, shares["last"] * arch.FORCE))
    problem.load(before, force=(0, 0, shares["before"] * arch.FORCE))
    kernel = functools.partial(kernel_seconds, problem, 10)
    return study.Case(
        problem,
        lambda: (
            shares["last"] * points.mean_displacement(last)
            + shares["before"] * points.mean_displacement(before)
        ),
        kernel,
    )


def edge(along, across):
    """Edge (m) of a cube as large as a hexahedron of the arch."""
    return float((LENGTH / (along * across**2)) ** (1 / 3))


def size(along, across):
    return f"{along} x {across} x {across}"


def cantilever_discretisations(full):
    """Discretisations of the curved cantilever."""
    elements = {
        1: [(64, 1), (128, 2), (256, 4)] + [(384, 6)] * full,
        2: [(8, 1), (16, 1), (32, 1), (64, 1), (32, 2), (64, 2)] + [(64, 4)] * full,
    }
    cells, discretisations = [2.0, 1.0, 0.5], []

    def add(method, label, h, build, **arguments):
        discretisations.append(study.Discretisation(method, label, h, build, arguments, STEPS, adaptive=True))

    for degree, sizes in elements.items():
        for along, across in sizes:
            name, arguments = f"FEM, degree {degree}", {"along": along, "across": across, "degree": degree}
            add(name, size(along, across), edge(along, across), finite_elements, **arguments)
    for basis in ("mpm", "gimpm"):
        for cell in cells + [0.25] * (full and basis == "mpm"):
            add(basis.upper(), f"{cell:g} m", cell, material_points, cell=cell, basis=basis)
    for cell, side in [(8.0, 1.0), (4.0, 1.0), (2.0, 0.5), (1.0, 0.5), (0.5, 0.25)]:
        add("B-splines", f"{cell:g} m", cell, splines, cell=cell, side=side)
    return discretisations


def variants():
    """Standard material points again: other numbers of points, other positions of the arch in the grid."""
    variants = []
    for cell in (2.0, 1.0, 0.5):
        for number in (3, 6):
            arguments = {"cell": cell, "basis": "mpm", "points_per_cell": number}
            variants.append((f"MPM, {number}³ points", cell, arguments))
        for centre, bottom in POSITIONS:
            arguments = {"cell": cell, "basis": "mpm", "centre": centre, "bottom": bottom}
            variants.append((f"MPM, arch at y = {centre:g}, z = {bottom:g} m", cell, arguments))
    return [
        study.Discretisation(method, f"{cell:g} m", cell, material_points, arguments, STEPS, adaptive=True)
        for method, cell, arguments in sorted(variants, key=lambda r: r[0])
    ]


def published():
    """The published results as rows."""
    rows = []
    for method, found in PUBLISHED.items():
        for cells, result, cpu in found:
            label, h = (f"{cells:g} m", cells) if method == "MPM" else (size(*cells), edge(*cells))
            row = study.Row(method, f"{label}, published", h, result, cpu_s=cpu)
            rows.append(study.compare(row, REFERENCES))
    return rows


# the manufactured solution ------------------------------------------------------------------------
FIELDS = ("displacement", "rotation", "stress", "couple stress")


def cube_of_points(cells, basis, points_per_cell):
    args = argparse.Namespace(basis=basis, points_per_cell=points_per_cell)
    problem, exact = demo("manufactured_solution").build(cells, args)
    return study.Case(problem, lambda: list(exact.errors(problem).values()))


def cube_of_elements(cells, degree):
    cube = demo("manufactured_solution")
    mesh = dmesh.create_unit_cube(MPI.COMM_WORLD, cells, cells, cells, dmesh.CellType.hexahedron)
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=cube.MATERIAL, degree=degree))
    exact = cube.impose(problem)
    return study.Case(problem, lambda: list(exact.errors(problem).values()))


def cube_discretisations(full):
    """Discretisations of the manufactured solution.

    On 2³ cells the wave vanishes at all nodes, and where Gauss points meet its crests the exact couple stress
    is zero, so that no error can be related to it.
    """
    points = {"basis": "mpm", "points_per_cell": 2}
    smooth = {"basis": "bspline", "points_per_cell": 3}
    methods = {
        "FEM, degree 1": (cube_of_elements, {"degree": 1}, [4, 8] + [16] * full),
        "FEM, degree 2": (cube_of_elements, {"degree": 2}, [4, 8] + [12] * full),
        "MPM": (cube_of_points, points, [4, 8] + [16] * full),
        "B-splines": (cube_of_points, smooth, [4, 8] + [16] * full),
    }
    return [
        study.Discretisation(method, f"{n}³", 1 / n, build, {"cells": n, **arguments}, steps=1)
        for method, (build, arguments, sizes) in methods.items()
        for n in sizes
    ]


# output -------------------------------------------------------------------------------------------
def show(row):
    """One line for a row that has just been found."""
    found = ", ".join(f"{name} {value:.3g}" for name, value in row.errors.items())
    found = found or f"no equilibrium at load factor {row.failed_at:.4g}"
    print(f"{row.method}, {row.label}: error: {found}; {row.cpu_s or 0:.1f} CPU s", flush=True)


def draw_orders(rows, path):
    study.figures.save_errors(rows, path, over="h", slopes=(1, 2, 3))


def write(folder, cantilever, others, cube):
    """All tables and figures of the rows."""
    known = published()
    study.write(cantilever, folder, name="mpm_versus_fem", unit="m", published=known)
    tables = [study.markdown_times(cantilever, name, LEVELS, unit="m") for name in REFERENCES]
    study.write_text(folder / "mpm_versus_fem_times.md", "\n".join(tables))
    if others:
        study.write_csv(others, folder / "mpm_versus_fem_variants.csv")
        study.write_text(folder / "mpm_versus_fem_variants.md", study.markdown(others, unit="m"))
    study.write_csv(cube, folder / "mpm_versus_fem_orders.csv")
    tables = [study.markdown_orders(cube), study.markdown(cube)]
    study.write_text(folder / "mpm_versus_fem_orders.md", "\n".join(tables))
    draw_orders(cube, folder / "mpm_versus_fem_orders.png")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="finer cells and variants; half an hour")
    parser.add_argument("--redraw", action="store_true", help="tables and figures anew from the CSV files")
    parser.add_argument("--output", type=Path, default=Path("results/mpm_versus_fem"), metavar="DIR")
    parser.add_argument("--json", action="store_true", help="last line of output is one JSON object")
    args = parser.parse_args(argv)
    names = {name: args.output / f"mpm_versus_fem{name}.csv" for name in ("", "_variants", "_orders")}
    if args.redraw:
        rows = {name: study.read_csv(path) if path.exists() else [] for name, path in names.items()}
        for name in ("", "_variants"):  # the references may have changed
            rows[name] = [study.compare(row, REFERENCES) for row in rows[name]]
    else:
        exact = {name: operator.itemgetter(k) for k, name in enumerate(FIELDS)}
        rows = {
            "": study.run(cantilever_discretisations(args.full), REFERENCES, record=show),
            "_variants": study.run(variants(), REFERENCES, record=show) if args.full else [],
            "_orders": study.run(cube_discretisations(args.full), exact, record=show),
        }
    write(args.output, *rows.values())
    if args.json:
        print(
            json.dumps({name or "cantilever": [dataclasses.asdict(r) for r in rows[name]] for name in rows})
        )
    else:
        print((args.output / "mpm_versus_fem_times.md").read_text(), f"files in {args.output}", sep="\n")


if __name__ == "__main__":
    main()
