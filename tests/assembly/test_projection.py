"""Projected moments: dolfinx assembles what the direct sum over the points gives, to rounding."""

from __future__ import annotations

import sys

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly.interpolation import Interpolation
from polarmpm.assembly.loadedpoints import LoadedPoints
from polarmpm.assembly.points import PointSystem
from polarmpm.assembly.projection import DEGREE, CellProjection, ProjectedSystem, lagrange
from polarmpm.basis.registry import basis_of
from polarmpm.bodies.points import Points
from polarmpm.conditions.prescribed import Prescribed
from polarmpm.conditions.supports import make_support
from polarmpm.forms.couples import CoupleForm
from polarmpm.forms.points import PointForm
from polarmpm.forms.stresses import FieldForm
from polarmpm.io import restart
from polarmpm.kinematics import rotations
from polarmpm.tools import compat
from polarmpm.tools.timing import Timer
from tests.conftest import ANISOTROPIC, COMM, GENERAL, HENCKY, MICROPOLAR, NEO_HOOKEAN, beam, by_id

CELL = np.array([1.0, 0.8, 1.25])
STIFF = pm.MicropolarElastic(lam=5e4, mu=3e4, kappa=9e3, alpha=110.0, beta=130.0, gamma=170.0)


def positions(dim: int, where: str) -> np.ndarray:
    """Places of points on a lattice of 3 x 2 (x 2) unit cells."""
    rng = np.random.default_rng(11)
    if where == "eccentric":  # one point in a cell, near its corner
        return np.array([[0.02, 0.95, 0.03], [1.01, 1.97, 0.5]])[:, :dim]
    if where == "many":
        inside = rng.uniform(0.0, 2.0, (40, dim))
        return np.concatenate([inside, rng.uniform(0.0, 0.1, (7, dim)) + 1.9])
    # faces, edges and corners of cells, and the upper boundary of the grid
    planes = [
        [1, 0.3, 0.6],
        [1, 1, 0.4],
        [1, 1, 1],
        [0, 0, 0],
        [3, 0.7, 1.2],
        [3, 2, 0.1],
        [3, 2, 2],
        [2.5, 2, 1],
    ]
    return np.array(planes, dtype=float)[:, :dim]


def body(dim: int, materials: list[pm.Material], where: str) -> tuple[pm.Grid, Points]:
    """Points at given places with random volumes, F, Q and wryness; the materials take turns."""
    cell = CELL[:dim]
    grid = pm.Grid.box((0.0,) * dim, np.array((3, 2, 2))[:dim] * cell, cell)
    x, rng = positions(dim, where) * cell, np.random.default_rng(1)
    n = len(x)
    volume = rng.uniform(0.1, 2.0, n)
    F, gamma, vector = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    F[:, :dim, :dim] += rng.uniform(-0.2, 0.2, (n, dim, dim))
    if dim == 3:
        gamma, vector = rng.uniform(-1, 1, (n, 3, 3)), rng.uniform(-2, 2, (n, 3))
    else:
        gamma[:, 2, :2], vector[:, 2] = rng.uniform(-1, 1, (n, 2)), rng.uniform(-2, 2, n)
    points = None
    for k, material in enumerate(materials[:n]):
        mine = np.array_split(np.arange(n)[k :: len(materials)], COMM.size)[COMM.rank]
        part = Points(x[mine], volume[mine], np.full((len(mine), dim), 0.1), material, COMM)
        part.F = F[mine]
        if material.micropolar:
            part.q, part.wryness = rotations.from_vector(vector[mine]), gamma[mine]
        if points is None:
            points = part
        else:
            points.join(part)
    return grid, points


def systems(
    grid: pm.Grid, points: Points, *, couples: bool = False, supports=()
) -> tuple[PointSystem, ProjectedSystem]:
    """The direct sum and the projection of the same points."""
    forms = [PointForm(m, points.dim) for m in points.materials]
    layout, kernels = forms[0].layout, [form.compile(COMM) for form in forms]
    couple = CoupleForm().compile(COMM) if couples else None
    interpolation = Interpolation(grid, points, basis_of("mpm"), forms)
    made = [make_support(w, "nodes", c, layout, k) for k, (w, c) in enumerate(supports)]
    prescribed = Prescribed(interpolation.nodes, made, layout)
    rng = np.random.default_rng(COMM.rank)
    moments = rng.uniform(-500, 500, (len(points), layout.rotations)) if couples else None
    found = []
    for kind in (PointSystem, ProjectedSystem):
        system = kind(interpolation, kernels, couple, prescribed, Timer())
        loads = np.zeros((len(points), layout.rotations)) if moments is None else moments
        system.set_loads(np.ones((len(points), points.dim)), loads)
        found.append(system)
    return found[0], found[1]


def randomise(*some: LoadedPoints) -> None:
    """The same random increments, which don't depend on the number of ranks."""
    system = some[0]
    all_nodes = np.random.default_rng(7).uniform(-0.15, 0.15, (system.nodes.total, system.layout.block))
    for s in some:
        s.x[:] = all_nodes[s.nodes.number]


def collected(system: LoadedPoints, nodal: np.ndarray) -> np.ndarray:
    """Owned rows of all ranks as one vector."""
    return np.concatenate(COMM.allgather(nodal[: system.nodes.owned])).ravel()


def direct_tangent(system: PointSystem) -> np.ndarray:
    """The stored entries, dense."""
    p, n = system.pattern, system.nodes.total * system.layout.block
    rows = (
        np.repeat(np.arange(len(p.indptr) - 1), np.diff(p.indptr)) + system.nodes.start * system.layout.block
    )
    out = np.zeros((n, n))
    for i, j, v in COMM.allgather((rows, p.indices, p.values[: p.owned_entries].copy())):
        out[i, j] = v
    return out + np.triu(out, 1).T if p.symmetric else out


def projected_tangent(system: ProjectedSystem) -> np.ndarray:
    """Columns of the matrix that the solver has, in the order of the active nodes."""
    matrix, nodes, block = system.matrix.solver.matrix, system.nodes, system.layout.block
    n = nodes.total * block
    out = np.zeros((n, n))
    right, left = matrix.createVecs()
    for column in range(n):
        unit = np.zeros((nodes.owned, block))
        node, component = divmod(column, block)
        if nodes.start <= node < nodes.start + nodes.owned:
            unit[node - nodes.start, component] = 1.0
        right.array[:] = system.exchange.to_mesh(unit)[: system.cells.nodes.owned].ravel()
        matrix.mult(right, left)
        product = system.exchange.to_points(left.array.reshape(-1, block))
        out[:, column] = np.concatenate(COMM.allgather(product)).ravel()
    return out


def close(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-12) -> None:
    assert abs(expected).max() > 0
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * abs(expected).max())


BODIES = [
    pytest.param(2, [MICROPOLAR], False, id="2d"),
    pytest.param(2, [ANISOTROPIC], False, id="2d-anisotropic"),
    pytest.param(2, [HENCKY], False, id="2d-hencky"),
    pytest.param(2, [MICROPOLAR, ANISOTROPIC, STIFF], False, id="2d-three-materials"),
    pytest.param(3, [NEO_HOOKEAN], False, id="3d-neo-hookean"),
    pytest.param(3, [MICROPOLAR], False, id="3d"),
    pytest.param(3, [GENERAL, STIFF], False, id="3d-both-frames"),
    pytest.param(3, [MICROPOLAR], True, id="3d-couples", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("where", ["eccentric", "many", "planes"])
@pytest.mark.parametrize(("dim", "materials", "couples"), BODIES)
def test_same_residual_and_tangent_as_the_direct_sum(dim, materials, couples, where):
    """To 1e-12, for any number and place of points in a cell."""
    grid, points = body(dim, materials, where)
    direct, projected = systems(grid, points, couples=couples)
    randomise(direct, projected)
    for system in (direct, projected):
        system.evaluate(True)
    close(collected(projected, projected.residual), collected(direct, direct.residual))
    close(collected(projected, projected.diagonal()), collected(direct, direct.diagonal()))
    found, expected = projected_tangent(projected), direct_tangent(direct)
    close(found, expected)
    assert (abs(found - found.T).max() > 1e-3 * abs(found).max()) == couples
    projected.evaluate(False)  # without the tangent: the same forces
    close(collected(projected, projected.residual), collected(direct, direct.residual))


@pytest.mark.parametrize("dim", [2, 3])
def test_prescribed_increments_load_the_free_unknowns(dim):
    """What prescribed increments add to the residual of the others, and the correction that follows."""
    grid, points = body(dim, [MICROPOLAR], "many")
    held = {"ux": 0.1, "theta": 0.2 if dim == 2 else (0.2,) * 3, **({"uz": 0.15} if dim == 3 else {})}
    supports = [(lambda x: x[:, 0] < 0.5, held), (lambda x: x[:, 1] > 1.5, {"uy": -0.3})]
    direct, projected = both = systems(grid, points, supports=supports)
    randomise(*both)
    fixed = collected(direct, direct.prescribed.fixed)
    for system in both:
        system.set_prescribed(system.prescribed.increments(1.0))
        assert system.pending()
        system.evaluate(True)
    lifts = [collected(s, s.step.lifted)[~fixed] for s in (projected, direct)]
    close(*lifts)
    for system in both:
        system.update(fresh=True)
        assert not system.pending()
    close(collected(projected, projected.x), collected(direct, direct.x), 1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_multiquadratic_functions_integrate_to_sums_over_points(dim):
    """The integral of projected volumes, times any product of quadratics, by dolfinx alone."""
    import ufl
    from dolfinx import fem

    grid, points = body(dim, [MICROPOLAR], "many")
    cells = CellProjection(grid, points.x, dim)
    volume = fem.Function(compat.quadrature_space(cells.mesh, 1, DEGREE))
    cells.project(points.volume0[:, None].copy(), volume)
    dx = ufl.dx(domain=cells.mesh, metadata={"quadrature_degree": DEGREE})
    X = ufl.SpatialCoordinate(cells.mesh)

    def quadratics(x):
        return [1.0 + 0.3 * x[i] - (0.2 + 0.1 * i) * x[i] ** 2 for i in range(dim)]

    for integrand, values in (
        (volume[0], points.volume0),
        (volume[0] * np.prod(quadratics(X)), points.volume0 * np.prod(quadratics(points.x.T), axis=0)),
    ):
        found = COMM.allreduce(fem.assemble_scalar(compat.compile_form(integrand * dx)))
        assert found == pytest.approx(COMM.allreduce(values.sum()), rel=1e-13)
    lowest = COMM.allreduce(volume.x.array.min(initial=0.0), op=MPI.MIN)
    assert lowest < -0.01 * points.volume0.mean()  # moments, not volumes: some are negative


def test_lagrange_polynomials_belong_to_the_quadrature_points():
    """One at their own point, zero at the others, in the order of quadrature functions."""
    for cell in ("quadrilateral", "hexahedron"):
        x = compat.quadrature_positions(cell, DEGREE)
        np.testing.assert_allclose(lagrange(cell, x), np.eye(len(x)), rtol=0, atol=1e-14)


def test_projected_history_is_not_exact():
    """Means of F, Q and wryness at the quadrature points store less energy than the points do."""
    x = np.random.default_rng(2).uniform(0.0, 1.0, (400, 2))
    F, vector, gamma = np.tile(np.eye(3), (400, 1, 1)), np.zeros((400, 3)), np.zeros((400, 3, 3))
    F[:, :2, :2] += 0.1 * np.random.default_rng(3).standard_normal((400, 2, 2))
    weight = lagrange("quadrilateral", x)
    volume = weight.sum(axis=0)

    def energy(f, q, wryness, volumes):
        numbers = np.tile(list(MICROPOLAR.parameters().values()), (len(f), 1))
        return FieldForm(MICROPOLAR).compile(COMM)(f, q, wryness, numbers)[:, 0] @ volumes

    at_points = energy(F, rotations.from_vector(vector), gamma, np.ones(400))
    mean = np.einsum("pk,pij->kij", weight, F) / volume[:, None, None]
    at_quadrature = energy(mean, rotations.from_vector(np.zeros((9, 3))), np.zeros((9, 3, 3)), volume)
    assert at_quadrature < 0.5 * at_points


# whole runs -------------------------------------------------------------------------------------------
def arch(assembly: str) -> pm.QuasiStatic:
    """A small curved cantilever that bends out of its plane; the grid's planes cut it at all angles."""
    grid = pm.Grid.box((0, -4, -2), (6, 2, 4), 1.0)
    points = pm.seed(
        grid,
        lambda x: (
            (abs(np.hypot(x[:, 0], x[:, 1] + 6) - 6) <= 0.5)
            & (x[:, 0] < x[:, 1] + 6)
            & (abs(x[:, 2] - 0.5) < 0.5)
        ),
        material=MICROPOLAR,
        points_per_cell=4,
    )
    problem = pm.QuasiStatic(grid, points, basis="mpm", assembly=assembly, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, -1, 0)), force=(0, 0, 4.0))
    return problem


def cantilever(assembly: str) -> pm.QuasiStatic:
    problem = beam(2, basis="mpm", assembly=assembly)
    problem.load(problem.points.farthest((1, 0)), force=(0, -8.0), couple=5.0)
    return problem


def balanced(assembly: str) -> pm.QuasiStatic:
    """Resets that carry along what the new basis can't balance."""
    problem = beam(2, basis="mpm", assembly=assembly, balanced_reset=True)
    problem.load(problem.points.farthest((1, 0)), force=(0, -8.0))
    return problem


def moved(assembly: str) -> pm.QuasiStatic:
    """Supports that move and turn, without resets, and couples."""
    problem = beam(3, basis="mpm", assembly=assembly, reset=None)
    problem.fix(lambda x: x[:, 0] > 3.5, ux=0.1, uz=lambda t, x: 0.2 * t, theta_x=0.3)
    problem.load(problem.points.farthest((0, 1, 0)), couple=(3.0, 2.0, -4.0))
    return problem


def two_materials(assembly: str) -> pm.QuasiStatic:
    grid = pm.Grid.box((-1, -2), (6, 3), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (2, 1)))
    points.join(pm.seed(grid, material=STIFF, bounds=((2, 0), (4, 1))))
    problem = pm.QuasiStatic(grid, points, basis="mpm", assembly=assembly, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(1.0, -5.0))
    return problem


@pytest.mark.parametrize(
    "build", [arch, cantilever, balanced, pytest.param(moved, marks=pytest.mark.slow), two_materials]
)
def test_same_run_as_the_direct_sum(build, strict):
    """The same iterations, the same displacements to 1e-10, the same reactions."""
    results = []
    for assembly in ("direct", "projection"):
        problem = build(assembly)
        problem.controls = strict
        iterations = [step.iterations for step in problem.march(3)]
        reactions = np.concatenate([np.concatenate(problem.reaction(s)) for s in problem.supports])
        u = by_id(problem.points, problem.points.displacement)
        results.append((iterations, u, reactions, problem.unknowns))
    (iterations, u, reactions, unknowns), projected = results
    assert abs(u).max() > 0.05
    assert projected[0] == iterations
    close(projected[1], u, 1e-10)
    close(projected[2], reactions, 1e-9)
    assert projected[3] == unknowns


@pytest.mark.parametrize("reset", [1, None])
def test_restart_with_the_other_assembly(folder, reset):
    """A state belongs to the points, not to the way in which they are summed."""

    def problem(assembly):
        controls = pm.Controls(force_tolerance=1e-12)
        made = beam(2, basis="mpm", assembly=assembly, reset=reset, controls=controls)
        made.load(made.points.farthest((1, 0)), force=(0, -8.0))
        return made

    whole = problem("direct")
    list(whole.march(4))
    first, second = problem("direct"), problem("projection")
    list(first.march(2, to=0.5))
    restart.save(first, folder / "half.h5")
    restart.load(second, folder / "half.h5")
    list(second.march(2))
    close(
        by_id(second.points, second.points.displacement),
        by_id(whole.points, whole.points.displacement),
        1e-10,
    )


def test_new_conditions_between_resets():
    """The projection is built anew for the same weights."""
    answers = []
    for assembly in ("direct", "projection"):
        problem = beam(2, basis="mpm", assembly=assembly, reset=None)
        problem.load(problem.points.farthest((1, 0)), force=(0, -8.0))
        list(problem.march(1, to=0.5))
        problem.fix(lambda x: x[:, 0] > 3.5, ux=0.01)
        list(problem.march(1))
        answers.append(by_id(problem.points, problem.points.displacement))
    close(answers[1], answers[0], 1e-10)


# choice -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"assembly": "project"}, "assembly = 'project': allowed are direct, projection"),
        ({"assembly": None}, "assembly = None"),
        ({"assembly": "projection"}, "couples the parts"),
        ({"assembly": "projection", "basis": "gimpm"}, "basis = 'gimpm', allowed is 'mpm'"),
        ({"assembly": "projection", "basis": "bspline"}, "cells' Lagrange space"),
    ],
)
def test_what_cannot_be_projected(options, message):
    with pytest.raises(pm.InputError, match=message):
        beam(2, **options)


def test_the_direct_sum_does_without_the_projection(monkeypatch):
    """Nothing of it is imported or compiled."""
    for name in ("assembly.projection", "forms.numbers"):
        monkeypatch.setitem(sys.modules, f"polarmpm.{name}", None)
    monkeypatch.setattr(compat, "compile_form", None)
    list(cantilever("direct").march(1))
