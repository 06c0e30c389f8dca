"""Quadratic B-splines on the lattice."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .splines import Splines


class QuadraticSplines(Splines):
    """Quadratic B-splines; their positions are the cells' centres and the grid's boundary planes."""

    name = "bspline"
    degree = 2
    sliver = 0.1

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        return grid.position(np.clip(grid.node_index(numbers) - 0.5, 0.0, grid.shape))

    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        right, size = snap(grid.within(x, cells)), grid.sizes(cells)
        left = 1.0 - right
        lower, upper = _shares(grid, cells)
        values = [lower * left**2, upper * right**2]
        slopes = [-2.0 * lower * left / size, 2.0 * upper * right / size]
        table = np.empty((*x.shape, 2, 3))
        for k, (below, above) in enumerate((values, slopes)):
            table[:, :, k, 0], table[:, :, k, 2] = below, above
            table[:, :, k, 1] = (1.0 if k == 0 else 0.0) - below - above
        return table


def _shares(grid: Grid, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Size of the cells (n, d) over that of them and the cell below, which the lower outer function shares
    with the middle one, and the same above: a half, as cells are equal; one at walls, where knots coincide.
    """
    return np.where(cells == 0, 1.0, 0.5), np.where(cells == np.array(grid.shape) - 1, 1.0, 0.5)
