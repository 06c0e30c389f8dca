"""Multigrid on the lattice: the direct solver's answers, few iterations whatever the body, fallbacks."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.kernels import native
from polarmpm.solvers import hierarchy as hierarchies
from polarmpm.solvers.coarsening import Lines, coarsened
from polarmpm.solvers.lattice import LatticeSolver
from polarmpm.solvers.linear import SingularTangent
from tests.conftest import COMM, HENCKY, beam
from tests.solvers.test_multigrid import (
    E_MODULUS,
    STRICT,
    block,
    material,
    mean_of,
    solved,
    solver_of,
    tangent,
)

SERIAL = pytest.mark.skipif(COMM.size > 1, reason="rows of one rank")


def right_of(system: Any) -> np.ndarray:
    own = slice(0, system.nodes.owned)
    return np.where(system.prescribed.fixed, 0.0, -system.residual)[own].ravel()


def product(system: Any, x: np.ndarray) -> np.ndarray:
    """The tangent times x (n,), by PETSc. Collective."""
    v, w = system.tangent.createVecs()
    v.array[:] = x
    system.tangent.mult(v, w)
    return np.array(w.array)


def left(system: Any, x: np.ndarray, right: np.ndarray) -> float:
    """Relative residual. Collective."""
    rest = right - product(system, x)
    sums = COMM.allreduce(np.array([np.sum(rest**2), np.sum(right**2)]))
    return float(np.sqrt(sums[0] / sums[1]))


# the same answer --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("of", "options"),
    [
        (None, {"basis": "mpm"}),
        (None, {"basis": "gimpm", "reset": 1}),
        (None, {"basis": "bspline"}),
        (HENCKY, {"basis": "gimpm"}),
        (material(1e-3), {"basis": "mpm"}),
    ],
    ids=["standard", "gimpm", "splines", "classical", "short length"],
)
def test_answers_are_the_direct_solvers(of, options):
    found = []
    for solver in ("direct", "multigrid"):
        problem, top = block(of=of, solver=solver, controls=STRICT, **options)
        found.append((mean_of(problem, top), [s.iterations for s in problem.steps]))
    assert isinstance(solver_of(problem), LatticeSolver)
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-9, atol=1e-10)
    assert max(np.abs(np.subtract(found[1][1], found[0][1]))) <= 1


def test_unsymmetric_tangents_are_solved():
    """A dead couple in space."""
    found = []
    for solver in ("direct", "multigrid"):
        problem, top = block(4, solver=solver, controls=STRICT)
        problem.load(top, couple=(0.0, 0.0, 0.05 * E_MODULUS))
        found.append(mean_of(problem, top))
    assert not solver_of(problem).symmetric
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("of", [None, HENCKY])
def test_the_plane_is_solved_too(of, monkeypatch):
    """Three and two unknowns a node; prescribed displacements."""
    monkeypatch.setattr(hierarchies, "_FEW", 50)
    found = []
    for solver in ("direct", "multigrid"):
        problem = beam(2, *(() if of is None else (of,)), solver=solver, controls=STRICT)
        problem.fix(pm.plane(x=4.0), uy=0.4)
        for _ in problem.march(2):
            pass
        found.append(problem.points.mean_displacement())
    assert solver_of(problem).failures == 0
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-11)


# iterations -------------------------------------------------------------------------------------------
def iterations(problem: Any) -> int:
    """Of one linear solution to 1e-8. Collective."""
    system = tangent(problem)
    x = solved(system, 1e-8).ravel()
    solver = solver_of(problem)
    assert solver.failures == 0
    assert solver.hierarchies == 1
    assert left(system, x, right_of(system)) < 1e-6
    return solver.iterations


@pytest.mark.parametrize(
    ("options", "most"),
    [
        ({"cells": 9, "shift": (0, 0, 0), "basis": "mpm"}, 11),
        ({"cells": 9, "basis": "mpm"}, 14),
        ({"cells": 6, "turn": (1.0, 0.4, 0.3), "of": material(100.0), "basis": "mpm"}, 14),
        ({"cells": 6, "turn": (0.3, 0.4, 0.5), "of": material(1e-3), "basis": "mpm"}, 30),
        ({"cells": 6, "of": material(1e-3), "basis": "mpm"}, 33),
        ({"cells": 6, "basis": "bspline"}, 25),
        ({"cells": 6, "basis": "gimpm", "h": 1e-3}, 14),
    ],
    ids=["aligned", "off the planes", "turned", "turned, short length", "short length", "splines", "mm"],
)
def test_iterations_are_few(options, most):
    assert iterations(block(solver="multigrid", **options)[0]) <= most * (1.0 if COMM.size == 1 else 1.5)


def test_more_solutions_leave_the_solver_as_it_is():
    """Which sensitivities ask for, after a step."""
    system = tangent(block(4, solver="multigrid")[0])
    x, right, solver = solved(system).ravel(), right_of(system), system.solver
    count = solver.iterations
    np.testing.assert_allclose(solver.solve_again(right), x, rtol=1e-5, atol=1e-6 * np.abs(x).max())
    assert solver.iterations == count
    assert left(system, solver.precondition(right), right) < 1.0
    solver.destroy()
    with pytest.raises(SingularTangent):
        solver.precondition(right)


# parts ------------------------------------------------------------------------------------------------
@SERIAL
def test_products_and_coarse_operators_are_those_of_the_tangent():
    """In the half rows of a symmetric tangent, and in whole ones."""
    rng = np.random.default_rng(3)
    for couple in (False, True):
        problem, top = block(4, solver="multigrid", basis="gimpm")
        if couple:
            problem.load(top, couple=(0.0, 0.0, 0.05 * E_MODULUS))
        system = tangent(problem)
        solved(system)
        found = system.solver._hierarchy
        fine, coarse = found.levels[:2]
        x = rng.normal(size=fine.nodes * fine.block)
        np.testing.assert_allclose(
            found.product(x), product(system, x), atol=1e-12 * np.abs(x).max() * E_MODULUS
        )
        y = rng.normal(size=(coarse.nodes, coarse.block))
        up, through, down = (
            np.zeros((fine.columns, fine.block)),
            np.zeros((fine.nodes, fine.block)),
            np.zeros_like(y),
        )
        transfer = fine.nodes, fine.block, ctypes.byref(fine.transfer)
        native.library().polarmpm_prolong(*transfer, y, up)
        assert np.any(fine.free == 0)
        assert not np.any(up[fine.free == 0])
        fine.product(up, through)
        native.library().polarmpm_restrict(*transfer, through, down)
        expected = np.zeros_like(y)
        coarse.product(y, expected)
        np.testing.assert_allclose(down, expected, atol=1e-12 * E_MODULUS * np.abs(y).max())


@SERIAL
def test_the_preconditioner_is_symmetric_and_definite():
    problem, _ = block(5, turn=(0.3, 0.4, 0.5), of=material(1e-1), solver="multigrid", basis="mpm")
    system = tangent(problem)
    solved(system)
    found, rng = system.solver._hierarchy, np.random.default_rng(4)
    assert found.any_weak
    free = ~system.prescribed.fixed[: system.nodes.owned].ravel()
    for sweeps in (1, 2):
        found.sweeps = sweeps
        a, b = (product(system, free * rng.normal(size=len(free))) for _ in range(2))
        Ma, Mb = found.precondition(a).copy(), found.precondition(b)
        scale = np.sqrt(np.dot(a, Ma) * np.dot(b, Mb))
        assert np.dot(a, Ma) > 0.0
        assert abs(np.dot(a, Mb) - np.dot(b, Ma)) < 1e-4 * scale


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("at", [np.arange(12.0), np.cumsum(1.2 ** np.arange(15)), np.r_[0:4:0.5, 4:12:2.0]])
def test_linear_functions_are_interpolated_exactly(at, between):
    lines = (Lines(at, between), Lines(np.arange(8.0), between))
    n = [len(a.nodes) for a in lines]
    index = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, 2)
    found = coarsened(lines, index, 1, index)
    assert found is not None
    assert len(found.index) < 0.7 * len(index) + 2 * sum(n) * between
    for axis in range(2):
        coarse, fine = found.lines[axis].nodes[found.index[:, axis]], lines[axis].nodes[index[:, axis]]
        np.testing.assert_allclose(np.sum(found.weights * coarse[found.parents], axis=1), fine, atol=1e-9)
    np.testing.assert_allclose(found.weights.sum(axis=1), 1.0)


# what fails -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("share", "direct"), [(0.02, None), (0.7, True)])
def test_indefinite_tangents_are_solved(share, direct):
    """By GMRES, or by the direct solver when most of the spectrum is negative."""
    system = tangent(block(4, shift=(0, 0, 0), solver="multigrid")[0])
    solved(system)
    right, solver = right_of(system), system.solver
    system.pattern.values[system.pattern.diagonal] *= 1.0 - share
    for _ in range(3):
        solver.factor()
        assert left(system, solver.solve(right, 1e-9), right) < 1e-7
    assert direct is None or (solver.failures > 0) == direct


def test_an_old_hierarchy_is_replaced_when_it_is_worn():
    """The tangent changes beyond recognition, and back."""
    system = tangent(block(4, solver="multigrid")[0])
    first = solved(system)
    pattern, own = system.pattern, system.nodes.owned * system.layout.block
    row = np.repeat(COMM.scan(own) - own + np.arange(own), np.diff(pattern.indptr))
    pattern.values[: len(row)] *= 1.0 + 0.1 * np.sin(row + pattern.indices)  # and stays symmetric
    x = system.solve(right_of(system).reshape(first.shape), True, 1e-10)
    assert left(system, x.ravel(), right_of(system)) < 1e-8
    system.evaluate(True)
    np.testing.assert_allclose(solved(system), first, rtol=1e-6, atol=1e-8 * np.abs(first).max())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_entries_that_arent_finite_are_told(bad):
    system = tangent(block(4, solver="multigrid")[0])
    solved(system)
    right, solver = right_of(system), system.solver
    with pytest.raises(SingularTangent, match="residual has entries"):
        solver.solve(np.where(np.arange(len(right)) == 3, bad, right))
    system.pattern.values[len(right) // 2] = bad
    with pytest.raises(SingularTangent, match="tangent has entries"):
        solver.factor()


def test_a_zero_matrix_is_no_tangent():
    system = tangent(block(4, solver="multigrid")[0])
    solved(system)
    right, solver = right_of(system), system.solver
    system.pattern.values[:] = 0.0
    with pytest.raises(SingularTangent):  # noqa: PT012
        solver.factor()
        solver.solve(right)


# cells of several sizes ---------------------------------------------------------------------------------
def sized(lines: list[np.ndarray], basis: str) -> Any:
    """A body between the first and the last of the lines along each axis."""
    ends = [np.r_[2 * a[0] - a[1], a, 2 * a[-1] - a[-2]] for a in lines]
    low, high = (np.array([a[k] for a in lines]) for k in (0, -1))
    points = pm.seed(
        grid := pm.Grid.graded(*ends, comm=COMM), material=material(), points_per_cell=2, bounds=(low, high)
    )
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": basis}, solver="multigrid")
    floor = low[-1] + 1e-9 * (high - low)[-1]
    problem.fix(lambda x: x[:, -1] <= floor, u=0, theta=0)
    problem.load(points.farthest((0,) * (len(lines) - 1) + (1,)), force=np.full(len(lines), 1e3))
    return problem


EQUAL = np.arange(9.0)
GRADED = np.r_[0.0, np.cumsum(20.0 ** (np.arange(8) / 7))] * 0.2
MIDDLE = np.r_[0.0, np.cumsum(20.0 ** (np.abs(np.arange(8) - 3.5) / 3.5))]


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_iterations_hardly_depend_on_the_sizes_of_cells(basis):
    """Flat cells 1:8, lines 1:20 in one direction and in all, at one end and in the middle."""
    count = iterations(sized([EQUAL] * 3, basis))
    for lines in ([EQUAL, EQUAL, EQUAL / 8], [GRADED, EQUAL, EQUAL], [GRADED] * 3, [MIDDLE] * 3):
        assert iterations(sized(lines, basis)) <= 1.5 * count + 2 * (COMM.size - 1)
