"""Cubic B-splines on the lattice, by the recursion of de Boor and Cox on any knots."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .splines import Splines, neighbours


class CubicSplines(Splines):
    """Cubic B-splines: second derivatives are continuous. Their positions are the inner planes, the walls,
    and a place a third of a cell from each wall.

    Four points a cell in each direction are needed where a body is one cell across.
    """

    name = "bspline3"
    degree = 3
    # a tail's stiffness goes with the fifth power of the layer's thickness, that of quadratic ones with the
    # third: this thickness leaves about as little of it as theirs (and see `aggregation`)
    sliver = 0.344
    fills_boxes = True

    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        r, size = snap(grid.within(x, cells)), grid.sizes(cells)
        a1, a2, b1, b2 = _knots(grid, cells)
        left, right = (r, r + a1, r + a2), (1.0 - r, 1.0 - r + b1, 1.0 - r + b2)
        # quadratic ones over the length of their support
        low, high = right[0] / (1.0 + a1), left[0] / (1.0 + b1)
        t0 = right[0] * low / (1.0 + a2)
        t1 = (left[1] * low + right[1] * high) / (1.0 + a1 + b1)
        t2 = left[0] * high / (1.0 + b2)
        values = (right[0] * t0, left[2] * t0 + right[1] * t1, left[1] * t1 + right[2] * t2, left[0] * t2)
        slopes = (-t0, t0 - t1, t1 - t2, t2)
        table = np.empty((*x.shape, 2, 4))
        for k in range(4):
            table[:, :, 0, k], table[:, :, 1, k] = values[k], 3.0 * slopes[k] / size
        return table

    def curvatures(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        r, size = snap(grid.within(x, cells)), grid.sizes(cells)
        a1, a2, b1, b2 = _knots(grid, cells)
        # slopes of the quadratic ones over the length of their support, which `lines` differentiates
        low, high = (1.0 - r) / (1.0 + a1), r / (1.0 + b1)
        t0 = -2.0 * low / (1.0 + a2)
        t1 = 2.0 * (low - high) / (1.0 + a1 + b1)
        t2 = 2.0 * high / (1.0 + b2)
        curved: np.ndarray = 3.0 * np.stack([-t0, t0 - t1, t1 - t2, t2], axis=2) / size[:, :, None] ** 2
        return curved


def _knots(grid: Grid, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """a1, a2, b1, b2 of the knots -a2, -a1, 0, 1, 1 + b1, 1 + b2 around cells, in the cells' own sizes."""
    size = grid.sizes(cells)
    a1, b1 = (neighbours(grid, cells, s) / size for s in (-1, 1))
    a2, b2 = (near + neighbours(grid, cells, s) / size for near, s in ((a1, -2), (b1, 2)))
    return a1, a2, b1, b2
