"""Averaged splines against means by quadrature; what fades, what supports nothing; a column's order."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import basis_of
from tests.conftest import COMM, MICROPOLAR, by_id
from tests.helpers.ranks import on_ranks

AVERAGED, SPLINES = basis_of("bspline-averaged"), basis_of("bspline")


def dense(grid: pm.Grid, w, point: int, axis: int) -> np.ndarray:
    """Values and gradients in one direction, for all functions of the grid (2, functions)."""
    out = np.zeros((2, grid.shape[axis] + 2))
    n = w.count[point, axis]
    out[:, w.lowest[point, axis] : w.lowest[point, axis] + n] = w.table[point, axis, :2, :n]
    assert not np.any(w.table[point, axis, :, n:])
    return out


def everywhere(grid: pm.Grid, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and half lengths of boxes in the grid, and then a point in each cell; all on each rank."""
    half = rng.uniform(0.03, 0.49, (n, grid.dim)) * grid.smallest
    low, high = np.array(grid.lower) + half, np.array(grid.upper) - half
    x = low + rng.random((n, grid.dim)) * (high - low)
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, grid.dim)
    return np.vstack([x, grid.position(index + 0.5)]), np.vstack([half, np.zeros(index.shape)])


@pytest.mark.parametrize("dim", [2, 3])
def test_means_over_boxes(dim):
    """Values and gradients are the splines' means over the intervals, where a box reaches far enough."""
    grid = pm.Grid.box((1.0, -2.0, 0.0)[:dim], (4.0, 0.0, 3.0)[:dim], (0.5, 1.0, 1.0)[:dim])
    x, half = everywhere(grid, np.random.default_rng(5), 60)
    w = AVERAGED.weights(grid, x, half)
    t, weight = np.polynomial.legendre.leggauss(80)
    size, compared = np.array(grid.smallest), 0
    for p in range(60):
        for i in range(dim):
            reach = np.abs(np.rint(grid.local(x[p : p + 1])) - grid.local(x[p : p + 1]))[0, i]
            over = half[p, i] / size[i] - reach
            if 0 < over < 0.01:
                continue  # so little over a plane is not worth the nodes
            compared += 1
            at = np.tile(x[p], (80, 1))
            at[:, i] += half[p, i] * t
            plain = SPLINES.weights(grid, at)
            mean = 0.5 * sum(weight[k] * dense(grid, plain, k, i) for k in range(80))
            np.testing.assert_allclose(dense(grid, w, p, i), mean, atol=1e-12 if over < 0 else 1e-3)
    assert compared > 50 * dim


@pytest.mark.parametrize("dim", [2, 3])
def test_linear_fields_and_their_gradients(dim):
    """Control values of a linear field give the field at the box's centre, wherever the box is."""
    grid = pm.Grid.box((1.0, -2.0, 0.0)[:dim], (4.0, 0.0, 3.0)[:dim], (0.5, 1.0, 1.0)[:dim])
    x, half = everywhere(grid, np.random.default_rng(6), 200)
    w = AVERAGED.weights(grid, x, half)
    numbers, value = w.products(grid)
    slope = np.array([0.7, -1.3, 2.1])[:dim]
    control = (AVERAGED.positions(grid, numbers.ravel()) @ slope).reshape(numbers.shape)
    np.testing.assert_allclose(np.sum(value * control, axis=1), x @ slope, atol=1e-13)
    np.testing.assert_allclose(w.table[:, :, 0].sum(axis=2), 1.0, atol=1e-14)
    np.testing.assert_allclose(w.table[:, :, 1].sum(axis=2), 0.0, atol=1e-12)


def test_boxes_fade_out_as_they_turn():
    """Half lengths by hand: F_ii stretches, the largest F_ij beside it takes away."""
    F = np.tile(np.eye(3), (4, 1, 1))
    F[1, 0, 0], F[1, 0, 1], F[1, 1, 0] = 1.5, -0.1, 0.2
    F[2, 2, 0] = F[2, 2, 1] = 0.05
    F[3, 0, 1], F[3, 1, 1] = 0.3, -0.9
    l0 = np.array([0.2, 0.4, 0.1])
    expected = l0 * [[1, 1, 1], [1.5 * 0.6, 0.2, 1], [1, 1, 0.8], [0, 0.9, 1]]
    np.testing.assert_allclose(AVERAGED.domains(F, np.tile(l0, (4, 1))), expected, atol=1e-15)
    plane = AVERAGED.domains(F, np.tile(l0[:2], (4, 1)))
    np.testing.assert_allclose(plane, expected[:, :2], atol=1e-15)


def test_nothing_is_taken_from_cells_that_support_nothing():
    """A box that reaches into an empty cell, or diagonally into one, keeps its own cell's polynomials, which
    represent quadratic fields; one that leans on the cell behind it, too."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    x = np.array([[2.8, 2.5], [3.8, 2.5], [2.8, 3.8], [2.2, 3.5], [3.02, 1.5], [2.5, 1.5], [2.5, 2.4]])
    half = np.full(x.shape, 0.3)
    mine = np.array_split(np.arange(len(x)), COMM.size)[COMM.rank]
    cells = AVERAGED.supporting_cells(grid, x[mine])
    w = AVERAGED.weights(grid, x[mine], half[mine], cells)
    lowest = np.concatenate(COMM.allgather(w.lowest))
    count = np.concatenate(COMM.allgather(w.count))
    expected = [[2, 2], [3, 2], [2, 3], [2, 2], [2, 1], [2, 1], [2, 1]]
    # the first reaches to the right; the second finds nothing there; the third neither above nor to the
    # right; the fourth below, but not to the left; the fifth leans; the sixth reaches nothing; the last below
    np.testing.assert_array_equal(lowest[[0, 1, 2, 4, 5]], np.array(expected)[[0, 1, 2, 4, 5]])
    np.testing.assert_array_equal(count[[0, 1, 2, 4, 5]], [[4, 3], [3, 3], [3, 3], [3, 3], [3, 3]])
    numbers, value = w.products(grid)
    index = grid.node_index(numbers.ravel()).reshape(*numbers.shape, 2)
    # control values of y^2 are products of the knots on both sides; its mean is larger by the variance
    square = np.prod([np.clip(index[:, :, 1] - k, 0, 6) for k in (0, 1)], axis=0)
    np.testing.assert_allclose(np.sum(value * square, axis=1), x[mine, 1] ** 2 + 0.03, atol=1e-12)


# whole runs -------------------------------------------------------------------------------------------
def column(cells: int, basis: str) -> float:
    """Mean error of the stress, over the largest, of a column under its own weight with a reset a step."""
    h, weight = 1.0 / cells, 8e3
    grid = pm.Grid.box((0, 0), (h, 1), h)
    points = pm.seed(grid, material=pm.NeoHookean.from_engineering(E=1e4, nu=0.3))
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=1)
    for x in (0.0, h):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.body_load(force=(0, -weight))
    list(problem.march(10, progress=False))
    # sections keep their area
    error = np.abs(problem.fields().stress[:, 1, 1] + weight * (1 - points.X[:, 1])) / weight
    return COMM.allreduce(error.sum()) / points.total


def test_stress_of_a_column_converges():
    """Points cross planes at every reset: averaged splines are of second order, plain ones stay where they
    are."""
    coarse, fine = (column(cells, "bspline-averaged") for cells in (8, 32))
    assert coarse < 2e-4
    assert np.log2(coarse / fine) > 2 * 1.5
    assert column(32, "bspline") > 100 * fine


def bent() -> pm.QuasiStatic:
    """A bar in space that lies across the planes and is bent."""
    grid = pm.Grid.box((0, 0, 0), (5, 4, 4), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, points_per_cell=3, bounds=((0.0, 0.7, 1.0), (4.0, 2.7, 3.0)))
    controls = pm.Controls(force_tolerance=1e-11)
    problem = pm.QuasiStatic(grid, points, basis="bspline-averaged", reset=1, controls=controls)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0, 0)), force=(50.0, -120.0, 60.0))
    list(problem.march(3, progress=False))
    assert problem.system.interpolation.reach == 3
    return problem


def answer() -> list:
    problem = bent()
    return by_id(problem.points, problem.points.displacement).tolist()


@pytest.mark.mpi
def test_ranks_agree():
    serial = np.array(answer())
    for found in on_ranks(2, "answer", script=__file__):
        np.testing.assert_allclose(found["x"], serial, rtol=0, atol=1e-9 * np.abs(serial).max())


def test_what_does_not_go_with_it():
    grid = pm.Grid.box((0, 0), (2, 2), 1.0)
    points = pm.seed(grid, material=MICROPOLAR)
    with pytest.raises(pm.InputError, match=r"plane x = 1 .*bspline-averaged.*allowed are 0 and 2"):
        pm.QuasiStatic(grid, points, basis="bspline-averaged").fix(pm.plane(x=1.0), u=0)


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps({"x": answer()}))
