"""Grids of graded lines: arithmetic, and the functions of all bases on them."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import basis_of
from polarmpm.geometry.grid import MARGIN, GradedGrid
from tests.conftest import COMM, NEO_HOOKEAN

NAMES = ("bspline", "bspline-averaged", "bspline3", "gimpm", "mpm")  # not those that tests register
STEEP = np.array([0.0, 1.0, 9.0, 10.0, 18.0, 19.0, 20.0, 28.0])  # neighbours 1:8
SMOOTH = np.concatenate([[0.0], np.cumsum(1.2 ** np.arange(8))])
JITTERED = np.array([-0.5, 0.11, 0.74, 1.6, 2.02, 2.9, 3.3, 4.2])


def graded(lines: np.ndarray, dim: int) -> pm.Grid:
    """The lines along x, shorter and mirrored along y, others along z."""
    axes = {"x": lines, "y": -lines[::-1], "z": 0.3 * lines}
    with pytest.warns(pm.TrustWarning, match="differ by a factor of 8") if lines is STEEP else _silent():
        return pm.Grid.graded(**{name: axes[name] for name in "xyz"[:dim]})


class _silent:
    def __enter__(self) -> None: ...

    def __exit__(self, *args: object) -> None: ...


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("lines", [STEEP, SMOOTH, JITTERED], ids=["1:8", "smooth", "jittered"])
def test_places_and_coordinates(lines, dim):
    grid, rng = graded(lines, dim), np.random.default_rng(1)
    assert not grid.equal
    x = rng.uniform(grid.lower, grid.upper, (200, dim))
    scale = np.abs(grid.upper).max()
    index = grid.cells_of(x)
    np.testing.assert_allclose(grid.position(grid.local(x)), x, rtol=0, atol=1e-15 * scale)
    r = grid.within(x, index)
    assert np.all((r >= 0) & (r <= 1))
    np.testing.assert_allclose(grid.corners(index) + r * grid.sizes(index), x, rtol=0, atol=1e-15 * scale)
    np.testing.assert_array_equal(grid.local(grid.corners(index)), index)
    for axis in range(dim):
        planes = [grid.plane(axis, i) for i in range(grid.shape[axis] + 1)]
        np.testing.assert_array_equal(planes, grid.lines[axis])
        assert (planes[0], planes[-1]) == (grid.lower[axis], grid.upper[axis])
        assert np.diff(planes).min() == pytest.approx(grid.smallest[axis], rel=1e-12)
        assert np.diff(planes).max() == pytest.approx(grid.largest[axis], rel=1e-12)
        # beyond the walls cells are mirrored, as nodes there mirror those inside
        for k in range(1, MARGIN + 1):
            for wall, step in ((0, 1), (grid.shape[axis], -1)):
                mirrored = 2 * grid.plane(axis, wall) - grid.plane(axis, wall + k * step)
                assert grid.plane(axis, wall - k * step) == pytest.approx(mirrored, abs=1e-12 * scale)


def test_equal_lines_are_a_box():
    box = pm.Grid.box((0.1, -1), (1.3, 2), (0.1, 0.3))
    for made in (
        pm.Grid.graded(x=np.linspace(0.1, 1.3, 13), y=np.linspace(-1, 2, 11)),
        pm.Grid.graded([0.1 + k * 0.1 for k in range(12)] + [1.3], list(box.lines[1])),
    ):
        assert type(made) is pm.Grid
        assert made == box
    mixed = pm.Grid.graded(x=np.linspace(0.1, 1.3, 13), y=[0, 1, 3])
    assert len(np.unique(mixed.sizes(np.stack([np.arange(12)] * 2, axis=1))[:, 0])) == 1


def test_a_graded_grid_is_a_value():
    grid = graded(SMOOTH, 2)
    assert copy.deepcopy(grid) is grid
    grid.sizes(np.zeros((1, 2), dtype=int))
    same = pickle.loads(pickle.dumps(grid))
    assert same == grid
    assert same.description() == grid.description() != graded(JITTERED, 2).description()
    assert "7 x 7" in repr(graded(JITTERED, 2))
    part = grid.part(np.array([2, 1]), np.array([5, 1]))
    assert part.shape == (3, 0)
    assert [part.plane(0, i) for i in range(4)] == [grid.plane(0, 2 + i) for i in range(4)]


def test_stretched_lines():
    grid = graded(SMOOTH, 2)
    wide = grid.stretched(0, 8, 0, 2.0 * grid.upper[0])
    np.testing.assert_allclose(wide.lines[0], 2 * SMOOTH, rtol=1e-15)
    np.testing.assert_array_equal(wide.lines[1], grid.lines[1])
    assert wide.plane(0, 8) == 2.0 * grid.upper[0]
    with pytest.raises(pm.InputError, match=r"x = -1 has reached the wall 0"):
        grid.stretched(0, 8, 0, -1.0)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([0, 1, 1, 2], "x: line 2 at 1 doesn't exceed line 1 at 1"),
        ([0, 2, 1.5], "x: line 2 at 1.5 doesn't exceed line 1 at 2"),
        ([0.0], "x = .* two or more"),
        ([0, 1, np.nan], "x = "),
        ([[0, 1], [1, 2]], "x = "),
        ("abc", "x = "),
        ([1e6, 1e6 + 1e-8, 2e6], "x: line 1 .* too near to line 0"),
        ([0, 1e308, np.inf], "x = "),
    ],
)
def test_bad_lines_are_named(lines, message):
    with pytest.raises(pm.InputError, match=message):
        pm.Grid.graded(x=lines, y=[0, 1, 3])


def test_a_steep_grid_warns_and_three_to_one_does_not():
    with pytest.warns(pm.TrustWarning, match=r"y: the cells on both sides of line 1 at 1 differ by .* 3.1"):
        pm.Grid.graded(x=[0, 1, 2], y=[0, 1, 4.1])
    pm.Grid.graded(x=[0, 1, 2], y=[0, 1, 4])  # a warning is an error here


def test_planes_are_named():
    grid = graded(JITTERED, 2)
    points = pm.seed(grid, material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    assert problem.fix(pm.plane(x=1.6), u=0).where.index == 3
    with pytest.raises(pm.InputError, match=r"x = 1.5 is not a plane of the grid, .* 1.6, 2.02, 2.9"):
        problem.fix(pm.plane(x=1.5), u=0)


def body(grid: pm.Grid, n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Random points of the whole grid and half lengths of domains; this rank's part."""
    rng = np.random.default_rng(3)
    x = rng.uniform(grid.lower, grid.upper, (n, grid.dim))
    half = rng.uniform(0.1, 0.5, x.shape) * grid.sizes(grid.cells_of(x))
    return tuple(np.array_split(a, COMM.size)[COMM.rank] for a in (x, half))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("lines", [STEEP, SMOOTH, JITTERED], ids=["1:8", "smooth", "jittered"])
@pytest.mark.parametrize("name", NAMES)
def test_unity_and_linear_completeness(name, lines, dim):
    """Of all bases, in cells and beyond them, where points lean on other cells."""
    basis, grid = basis_of(name), graded(lines, dim)
    x, half = body(grid)
    cells = basis.supporting_cells(grid, x)
    leaning = cells + np.random.default_rng(5).integers(-1, 2, cells.shape)
    choices = [None] if name == "gimpm" else [None, cells, np.clip(leaning, 0, np.array(grid.shape) - 1)]
    scale = max(np.abs(c).max() for c in (grid.lower, grid.upper))
    for chosen in choices:
        w = basis.weights(grid, x, half, chosen)
        far = 1.0 if chosen is None or chosen is cells else 200.0  # polynomials continued through big cells
        _check_linear(basis, grid, w, x, scale, far)


def _check_linear(basis, grid, w, x, scale, far) -> None:
    slots = np.arange(w.table.shape[3])
    for axis in range(grid.dim):
        index = np.zeros((len(x), len(slots), grid.dim), dtype=int)
        index[:, :, axis] = w.lowest[:, axis, None] + slots
        used = slots < w.count[:, axis, None]
        index[~used] = 0
        at = basis.positions(grid, grid.node_number(index.reshape(-1, grid.dim)))[:, axis].reshape(used.shape)
        value, slope = (np.where(used, w.table[:, axis, k], 0.0) for k in (0, 1))
        size = grid.smallest[axis]
        np.testing.assert_allclose(value.sum(axis=1), 1, rtol=0, atol=1e-14 * far)
        np.testing.assert_allclose(np.sum(value * at, axis=1), x[:, axis], rtol=0, atol=1e-14 * scale * far)
        np.testing.assert_allclose(slope.sum(axis=1) * size, 0, rtol=0, atol=1e-13 * far)
        np.testing.assert_allclose(np.sum(slope * at, axis=1), 1, rtol=0, atol=1e-13 * scale / size * far)


@pytest.mark.parametrize("name", NAMES)
def test_the_general_code_on_equal_cells(name):
    """Gives the weights of a box, but for rounding."""
    basis, box = basis_of(name), pm.Grid.box((0, -1), (4, 1), 0.5)
    general = GradedGrid(
        box.origin, box.cell, box.shape, box.comm, tuple(tuple(map(float, a)) for a in box.lines)
    )
    x, half = body(box, 1000)
    for cells in (None, basis.supporting_cells(box, x)):
        if cells is None or name != "gimpm":
            a, b = (basis.weights(g, x, half, cells) for g in (box, general))
            np.testing.assert_array_equal(a.lowest, b.lowest)
            np.testing.assert_allclose(a.table, b.table, rtol=0, atol=1e-13)
