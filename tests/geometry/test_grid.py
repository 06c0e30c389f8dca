"""The grid's lines by the interface that all other modules use."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.geometry.cells import corner_numbers, unit_corners

LOWER, CELL, CELLS = (-1.3, 0.4, 2.0), (0.5, 0.8, 1.25), (6, 5, 7)


def lattice(dim: int) -> pm.Grid:
    lower = np.array(LOWER[:dim])
    return pm.Grid.box(lower, lower + np.multiply(CELL[:dim], CELLS[:dim]), CELL[:dim])


@pytest.mark.parametrize("dim", [2, 3])
def test_places_and_coordinates(dim):
    """Positions and lattice coordinates are inverse; corners, sizes and planes fit to each other."""
    grid, rng = lattice(dim), np.random.default_rng(1)
    x = rng.uniform(grid.lower, grid.upper, (100, dim))
    index = grid.cells_of(x)
    np.testing.assert_allclose(grid.position(grid.local(x)), x, rtol=0, atol=1e-14)
    r = grid.within(x, index)
    assert np.all((r >= 0) & (r <= 1))
    np.testing.assert_allclose(grid.corners(index) + r * grid.sizes(index), x, rtol=0, atol=1e-14)
    np.testing.assert_allclose(grid.within(x, index + 1), r - 1, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(grid.corners(index), grid.node_position(grid.cell_number(index)))
    for axis in range(dim):
        planes = [grid.plane(axis, i) for i in range(grid.shape[axis] + 1)]
        np.testing.assert_array_equal(np.array(planes)[index[:, axis]], grid.corners(index)[:, axis])
        assert planes[0] == grid.lower[axis]
        assert planes[-1] == grid.upper[axis]
        np.testing.assert_allclose(np.diff(planes).min(), grid.smallest[axis], rtol=1e-14)
        np.testing.assert_allclose(np.diff(planes).max(), grid.largest[axis], rtol=1e-14)


def test_part_of_a_lattice():
    """Its planes are planes of the whole."""
    grid = lattice(3)
    part = grid.part(np.array([1, 0, 2]), np.array([4, 5, 2]))
    assert part.shape == (3, 5, 0)
    for axis, start in enumerate((1, 0, 2)):
        for i in range(part.shape[axis] + 1):
            assert part.plane(axis, i) == pytest.approx(grid.plane(axis, start + i), rel=1e-14)


def test_description_tells_lattices_apart():
    grid = pm.Grid.box((0, 0), (2, 1), 0.5)
    assert grid.description() == pm.Grid.box((0, 0), (2, 1), (0.5, 0.5)).description()
    for other in (((0, 0), (2, 1), 1.0), ((0, 0), (2, 2), 0.5), ((1, 0), (3, 1), 0.5)):
        assert grid.description() != pm.Grid.box(*other).description()


def test_corners_of_cells():
    """The first axis runs fastest, as in dolfinx."""
    np.testing.assert_array_equal(unit_corners(2), [[0, 0], [1, 0], [0, 1], [1, 1]])
    grid = lattice(3)
    cell = np.array([[1, 2, 3]])
    numbers = corner_numbers(grid, grid.cell_number(cell))
    np.testing.assert_array_equal(grid.node_index(numbers[0]), cell + unit_corners(3))
