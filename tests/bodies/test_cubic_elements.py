"""Elements of degree 3: nodes on edges that two cells see from opposite ends, and their order."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.study import manufactured
from polarmpm.tools import compat
from tests.conftest import COMM, NEO_HOOKEAN
from tests.helpers.bodies import DIMENSION, box, everywhere, own_rows, prepared, tangent_at
from tests.helpers.gradient import gradient_solid

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
# local corners of a cell, seen from other ones of them or mirrored
VIEWS = {
    "triangle": [[0, 1, 2], [2, 0, 1], [1, 0, 2], [2, 1, 0]],
    "quadrilateral": [[0, 1, 2, 3], [1, 3, 0, 2], [3, 2, 1, 0], [0, 2, 1, 3]],
    "tetrahedron": [[0, 1, 2, 3], [3, 2, 1, 0], [1, 2, 0, 3], [2, 0, 3, 1]],
    "hexahedron": [[0, 1, 2, 3, 4, 5, 6, 7], [1, 3, 0, 2, 5, 7, 4, 6], [7, 6, 5, 4, 3, 2, 1, 0]],
}


def mixed(cell: str, distort: float) -> Any:
    """A box whose cells number their corners each in its own way. Collective."""
    dim, rng = DIMENSION[cell], np.random.default_rng(7)
    regular = box(cell, (3, 3, 2)[:dim], distort=distort, comm=MPI.COMM_SELF)
    table = compat.cell_geometry(regular)
    views = np.array(VIEWS[cell])[rng.integers(len(VIEWS[cell]), size=len(table))]
    new = rng.permutation(len(regular.geometry.x))
    x = np.empty((len(new), dim))
    x[new] = regular.geometry.x[:, :dim]
    cells, given = new[np.take_along_axis(table, views, axis=1)], slice(None if COMM.rank == 0 else 0)
    return compat.create_mesh(COMM, cells[given], x[given], cell, ghosts=True)


def cubic(x: np.ndarray) -> np.ndarray:
    """All monomials up to degree 3 of a few directions."""
    d = x.shape[1]
    ways = np.array([[1.0, 0.4, -0.3], [-0.5, 0.8, 0.6], [0.3, -0.7, 1.0]])[:, :d]
    return np.stack([0.1 * (x @ w + 0.3) ** 3 - 0.2 * (x @ w) ** 2 for w in ways[:d]], axis=1)


def gradient(x: np.ndarray) -> np.ndarray:
    """Complex steps."""
    step = 1e-30j * np.eye(x.shape[1])
    return np.stack([cubic(x + s).imag / 1e-30 for s in step], axis=2)


def largest(values: np.ndarray) -> float:
    return COMM.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


@pytest.mark.parametrize("assembly", ["native", "dolfinx"])
@pytest.mark.parametrize("cell", CELLS)
def test_cubic_fields_are_exact(cell, assembly):
    """Values and gradients at the quadrature points, whichever way the cells see their edges and faces."""
    affine = cell in ("triangle", "tetrahedron")
    body = pm.Elements(mixed(cell, 0.1 if affine else 0.0), material=NEO_HOOKEAN, degree=3)
    problem = pm.QuasiStaticFEM(body, assembly=assembly)
    problem.forms.x.x.array[:] = cubic(body.nodes.position).ravel()
    value, slope = problem.forms.values_at_points()
    np.testing.assert_allclose(value, cubic(body.points.X), rtol=0, atol=1e-14)
    np.testing.assert_allclose(slope, gradient(body.points.X), rtol=0, atol=1e-13)


@pytest.mark.parametrize("assembly", ["native", "dolfinx"])
@pytest.mark.parametrize("cell", CELLS)
def test_patch(cell, assembly, strict):
    """A homogeneous deformation of the boundary is one of the inside, on distorted cells."""
    body = pm.Elements(mixed(cell, 0.12), material=NEO_HOOKEAN, degree=3)
    problem = pm.QuasiStaticFEM(body, assembly=assembly, controls=strict)
    d = body.dim
    F = np.array([[0.1, 0.2, 0.05], [-0.1, -0.08, 0.1], [0.02, 0.1, 0.1]])[:d, :d]
    problem.fix(body.facets(everywhere), u=lambda t, X: t * X @ F.T)
    list(problem.march(1, progress=False))
    np.testing.assert_allclose(body.displacement, body.nodes.position @ F.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(body.points.F[:, :d, :d] - np.eye(d) - F, 0.0, atol=1e-11)


@pytest.mark.parametrize("cell", CELLS)
def test_assemblies_agree_on_mixed_cells(cell):
    mesh, found = mixed(cell, 0.12), []
    for assembly in ("native", "dolfinx"):
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=NEO_HOOKEAN, degree=3), assembly=assembly)
        system = prepared(problem)
        at = 0.01 * np.random.default_rng(2).uniform(-1, 1, problem.unknowns)
        matrix = tangent_at(problem, system, at)
        found.append((matrix, own_rows(problem, system.residual)))
    for one, other in zip(*found, strict=True):
        assert np.abs(one - other).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_second_gradients_on_mixed_cells(cell):
    """Of a cubic field; no face sees a jump of its slope."""
    body = pm.Elements(
        mixed(cell, 0.1 if cell == "triangle" else 0.0),
        material=gradient_solid(1e3, 0.3, (0.5, 0.8)),
        degree=3,
    )
    problem = pm.QuasiStaticFEM(body)
    problem.forms.total.x.array[:] = (1e-3 * cubic(body.nodes.position)).ravel()
    exact = np.zeros((len(body.points), 3, 3, 3))
    step, X = 1e-4, body.points.X
    for k, direction in enumerate(np.eye(2)):
        exact[:, :2, :2, k] = (gradient(X + step * direction) - gradient(X - step * direction)) / (2e3 * step)
    np.testing.assert_allclose(problem.forms.second_gradient(), exact, rtol=0, atol=1e-11)
    # J; jumps are rounding: noise of 1e-6 m at the nodes makes 1e-4 J
    assert abs(problem.forms.face_energy()) < 1e-17


# convergence -------------------------------------------------------------------------------------------
LONG = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=170.0)


def displacement(X: Any) -> Any:
    one = ufl.sin(np.pi * X[0]) * ufl.sin(np.pi * X[1]) / 30
    return ufl.as_vector((one, -one, 0.0 * X[0]))


def rotation(X: Any) -> Any:
    return ufl.as_vector((0.0 * X[0], 0.0 * X[0], ufl.sin(np.pi * X[0]) * ufl.sin(np.pi * X[1]) / 30))


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_order_four(cell):
    """L2 errors of displacement and rotation of a manufactured solution."""
    exact, errors = manufactured.Solution(LONG, displacement, rotation, COMM), []

    def in_space(X: np.ndarray) -> np.ndarray:
        return np.pad(X, ((0, 0), (0, 1)))

    for n in (4, 8):
        body = pm.Elements(box(cell, (n, n)), material=LONG, degree=3)
        problem = pm.QuasiStaticFEM(body)
        problem.fix(body.facets(everywhere), u=0, theta=0)
        problem.body_load(
            force=lambda t, X: t * exact.sources(in_space(X))[:, :2],
            couple=lambda t, X: t * exact.sources(in_space(X))[:, 5:],
        )
        list(problem.march(1, progress=False))
        p = body.points
        u, theta, *_ = exact.fields(in_space(p.X))
        off = np.column_stack([p.displacement - u[:, :2], p.rotation_vector[:, 2] - theta[:, 2]])
        squares = np.stack([(off[:, :2] ** 2).sum(axis=1), off[:, 2] ** 2])
        errors.append(np.sqrt(COMM.allreduce(squares @ p.volume0)))
    order = np.log2(errors[0] / errors[1])
    assert np.all(order > 3.8), order
    assert np.all(order < 4.6), order


def test_no_cure_of_locking():
    """They hardly lock, and are never changed."""
    body = pm.Elements(box("quadrilateral", (2, 2)), material=pm.NeoHookean(lam=1e7, mu=2e3), degree=3)
    for locking in ("auto", "always", None):
        problem = pm.QuasiStaticFEM(body, locking=locking)
        assert problem.forms.uncured == list(body.points.materials)


def test_loads_and_supports():
    """Facets' weights, planes and reactions of a bar in tension."""
    body = pm.Elements(box("hexahedron", (2, 1, 1), (2, 1, 1)), material=NEO_HOOKEAN, degree=3)
    held, pulled = (body.facets(pm.plane(x=value)) for value in (0.0, 2.0))
    assert COMM.allreduce(int(held.nodes[: body.nodes.owned].sum())) == 16
    assert held.area == pytest.approx(1.0, rel=1e-12)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.traction(pulled, force=(10.0, 0.0, 0.0))
    list(problem.march(1, progress=False))
    reaction = problem.reaction(problem.supports[0])
    np.testing.assert_allclose(reaction.force, [-10.0, 0.0, 0.0], rtol=0, atol=1e-6)
    assert problem.energies()["external"] > 0
