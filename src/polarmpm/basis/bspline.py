"""Quadratic B-splines on the lattice."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .base import Chosen, Weights
from .parts import joined, on_planes, supported
from .splines import Splines, neighbours


class QuadraticSplines(Splines):
    """Quadratic B-splines; their positions are the cells' centres and the grid's boundary planes."""

    name = "bspline"
    degree = 2
    sliver = 0.0955  # see `aggregation`
    fills_boxes = True
    curvatures_jump = True
    patch = 2
    patch_linear = True
    patch_stiffness = 1.0

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        return grid.position(np.clip(grid.node_index(numbers) - 0.5, 0.0, grid.shape))

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        """A point on a plane has the mean of the second derivatives on both sides, or a mirrored body would
        have another answer; values and gradients are the same."""
        own = super().weights(grid, x, half_length, cells, orders)
        if orders == 2:
            return own
        step = supported(grid, own.lowest, -on_planes(grid, x, own.lowest))

        def other(rows: np.ndarray, there: np.ndarray) -> np.ndarray:
            return self.derivatives(grid, x[rows], there, orders)

        return joined(own.lowest, step, np.full(x.shape, 0.5), own.table, other)

    def continued(self, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, like: Chosen) -> Weights:
        def other(rows: np.ndarray, there: np.ndarray) -> np.ndarray:
            return self.derivatives(grid, x[rows], there, like.orders)

        mine, share = self.derivatives(grid, x, like.cells, like.orders), np.full(x.shape, 0.5)
        return joined(like.cells, like.lowest - like.cells, share, mine, other)

    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        right, size = snap(grid.within(x, cells)), grid.sizes(cells)
        left = 1.0 - right
        below, above = (share * r for share, r in zip(_shares(grid, cells), (left, right), strict=True))
        table = np.empty((*x.shape, 2, 3))
        values, slopes = table[:, :, 0], table[:, :, 1]
        np.multiply(below, left, out=values[:, :, 0])
        np.multiply(above, right, out=values[:, :, 2])
        np.divide(-2.0 * below, size, out=slopes[:, :, 0])
        np.divide(2.0 * above, size, out=slopes[:, :, 2])
        for of, total in ((values, 1.0), (slopes, 0.0)):
            np.subtract(total, of[:, :, 0], out=of[:, :, 1])
            of[:, :, 1] -= of[:, :, 2]
        return table

    def curvatures(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        below, above = _shares(grid, cells)
        table = np.stack([below, -below - above, above], axis=2)
        curved: np.ndarray = 2.0 * table / grid.sizes(cells)[:, :, None] ** 2
        return curved


def _shares(grid: Grid, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Size of the cells (n, d) over that of them and the cell below, which the lower outer function shares
    with the middle one; the same above. A half where cells are equal; at walls, where knots coincide, one."""
    if not grid.equal:
        size = grid.sizes(cells)
        lower, upper = (size / (size + neighbours(grid, cells, step)) for step in (-1, 1))
        return lower, upper
    return np.where(cells == 0, 1.0, 0.5), np.where(cells == np.array(grid.shape) - 1, 1.0, 0.5)
