"""Cubic B-splines against SciPy's, on equal cells and on any; solvers and ranks."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

import polarmpm as pm
from polarmpm.basis.bspline3 import CubicSplines
from polarmpm.basis.registry import basis_of
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id
from tests.helpers.ranks import on_ranks

CUBIC = basis_of("bspline3")


def equal(cells: int) -> pm.Grid:
    return pm.Grid.box((0.0, 0.0), (1.0, 1.0), 1.0 / cells)


def graded(cells: int) -> pm.Grid:
    rng = np.random.default_rng(cells)
    lines = np.concatenate([[0.0], np.cumsum(rng.uniform(0.4, 1.0, cells))])
    return pm.Grid.graded(x=lines, y=lines)


def diagonal(n: int) -> np.ndarray:
    """Indices (0, 0), (1, 1), ... (n, 2)."""
    return np.repeat(np.arange(n)[:, None], 2, axis=1)


def places(grid: pm.Grid, n: int = 200) -> np.ndarray:
    """Random ones in all cells, those at the walls included, on the planes, and just beside them."""
    rng = np.random.default_rng(7)
    inside = rng.uniform(grid.lower, grid.upper, (n, 2))
    planes = grid.corners(diagonal(grid.shape[0] + 1))
    beside = np.clip(planes + 1e-7, grid.lower, grid.upper), np.clip(planes - 1e-7, grid.lower, grid.upper)
    return np.concatenate([inside, planes, *beside])


def dense(grid: pm.Grid, x: np.ndarray) -> np.ndarray:
    """Values and gradients of all functions of the first axis, (n, 2, functions)."""
    w = CUBIC.weights(grid, x)
    out = np.zeros((len(x), 2, grid.shape[0] + 3))
    for p in range(len(x)):
        out[p, :, w.lowest[p, 0] : w.lowest[p, 0] + 4] = w.table[p, 0]
    return out


@pytest.mark.parametrize("cells", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("make", [equal, graded])
def test_functions_are_those_of_scipy(make, cells):
    """Values and gradients of all functions, with the walls' planes as fourfold knots."""
    grid = make(cells)
    x = places(grid)
    planes = grid.corners(diagonal(cells + 1))[:, 0]
    knots = np.concatenate([[planes[0]] * 3, planes, [planes[-1]] * 3])
    found = dense(grid, x)
    for k in range(cells + 3):
        spline = BSpline(knots, np.eye(cells + 3)[k], 3)
        scale = 1.0 / np.diff(planes).min()
        np.testing.assert_allclose(found[:, 0, k], spline(x[:, 0]), atol=1e-13)
        np.testing.assert_allclose(found[:, 1, k], spline.derivative()(x[:, 0]), atol=1e-12 * scale)


@pytest.mark.parametrize("cells", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("make", [equal, graded])
def test_partition_of_unity_and_linear_completeness(make, cells):
    """To rounding; positions of nodes are reproduced, and their gradient is one."""
    grid = make(cells)
    x = places(grid)
    found = dense(grid, x)
    position = CUBIC.positions(grid, grid.node_number(diagonal(cells + 3)))[:, 0]
    assert found[:, 0].min() >= 0.0
    np.testing.assert_allclose(found[:, 0].sum(axis=1), 1.0, atol=1e-14)
    scale = 1.0 / grid.sizes(diagonal(cells)).min()
    np.testing.assert_allclose(found[:, 1].sum(axis=1), 0.0, atol=1e-14 * scale)
    np.testing.assert_allclose(found[:, 0] @ position, x[:, 0], atol=1e-14 * np.abs(x).max())
    np.testing.assert_allclose(found[:, 1] @ position, 1.0, atol=1e-13)
    assert position[0] == grid.lower[0]
    assert position[-1] == pytest.approx(grid.upper[0], rel=1e-15)


def test_positions_of_nodes():
    """The inner planes, the walls, and a place a third of a cell from each wall."""
    grid = pm.Grid.box((1, 0), (4, 6), (1.0, 2.0))
    index = np.array([[0, 0], [1, 1], [2, 2], [3, 3], [4, 4], [5, 5]])
    third = 1.0 / 3.0
    expected = [[1, 0], [1 + third, 2 * third], [2, 2], [3, 4], [4 - third, 6 - 2 * third], [4, 6]]
    np.testing.assert_allclose(CUBIC.positions(grid, grid.node_number(index)), expected, rtol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_cubics_are_continued_beyond_the_cell(dim):
    """A cell's functions reproduce a cubic wherever they are evaluated, also in the slivers beside."""
    grid, rng = pm.Grid.box((0,) * dim, (5,) * dim, 1.0), np.random.default_rng(2)
    cells = rng.integers(0, 5, (50, dim))
    near, x = cells[:, None] + rng.random((50, 300, dim)), cells + rng.uniform(-0.4, 1.4, (50, dim))

    def cubic(y: np.ndarray) -> np.ndarray:
        return (1 + y[..., 0]) ** 3 - (2 - y[..., 1]) ** 2 * y[..., -1]

    for k in range(50):
        inside = CUBIC.at(grid, near[k], np.tile(cells[k], (300, 1)))
        control = np.linalg.lstsq(inside[:, 0], cubic(near[k]), rcond=None)[0]
        value = CUBIC.at(grid, x[k : k + 1], cells[k : k + 1])
        assert value[0, 0] @ control == pytest.approx(cubic(x[k]), abs=1e-8)
        for axis in range(dim):
            step = 1e-5 * np.eye(dim)[axis]
            slope = (cubic(x[k] + step) - cubic(x[k] - step)) / 2e-5
            assert value[0, 1 + axis] @ control == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize(("depth", "cell"), [(0.1, 2), (0.34, 2), (0.36, 3)])
def test_single_layers_of_points_lean_on_the_cell_behind(depth, cell):
    """A third of a cell is a sliver: with three or four points a cell no single layer reaches farther."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    x = np.array([[2.5, 2.5], [2.1, 2.9], [3.0 + depth, 2.5], [3.0 + 0.5 * depth, 2.2]])
    mine = np.array_split(x, COMM.size)[COMM.rank]
    expected = np.array_split([2, 2, cell, cell], COMM.size)[COMM.rank]
    np.testing.assert_array_equal(CUBIC.supporting_cells(grid, mine)[:, 0], expected)


def bent(solver: str = "direct", material: pm.Material = MICROPOLAR) -> pm.QuasiStatic:
    """A bar in space that lies across the planes and is bent."""
    grid = pm.Grid.box((0, 0, 0), (5, 4, 4), 1.0)
    points = pm.seed(grid, material=material, points_per_cell=3, bounds=((0.0, 0.7, 1.0), (4.0, 2.7, 3.0)))
    controls = pm.Controls(force_tolerance=1e-11)
    problem = pm.QuasiStatic(grid, points, basis="bspline3", reset=1, solver=solver, controls=controls)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.load(points.farthest((1, 0, 0)), force=(50.0, -120.0, 60.0))
    list(problem.march(2, progress=False))
    return problem


def test_multigrid_finds_what_the_direct_solver_finds():
    found = [bent(solver, NEO_HOOKEAN) for solver in ("direct", "multigrid")]
    x, expected = (by_id(p.points, p.points.displacement) for p in reversed(found))
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert found[0].system.interpolation.reach == 3


def answer() -> list:
    problem = bent()
    return by_id(problem.points, problem.points.displacement).tolist()


@pytest.mark.mpi
def test_ranks_agree():
    serial = np.array(answer())
    for found in on_ranks(2, "answer", script=__file__):
        np.testing.assert_allclose(found["x"], serial, rtol=0, atol=1e-9 * np.abs(serial).max())


def test_what_does_not_go_with_it():
    """Messages name the basis and what is allowed."""
    grid = equal(4)
    points = pm.seed(grid, material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match=r"plane x = 0.5 .*bspline3.*allowed are 0 and 1"):
        pm.QuasiStatic(grid, points, basis="bspline3").fix(pm.plane(x=0.5), u=0)
    with pytest.raises(pm.InputError, match="'bspline3', allowed is 'mpm': splines"):
        pm.QuasiStatic(grid, points, basis="bspline3", assembly="projection")
    assert isinstance(pm.QuasiStatic(grid, points, basis="bspline3").basis, CubicSplines)


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps({"x": answer()}))
