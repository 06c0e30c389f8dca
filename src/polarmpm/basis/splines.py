"""What B-splines of any degree share.

Knots are at the grid's planes, the outer ones as often as the degree asks for: N cells in a direction have
N + degree functions, which are numbered as lattice nodes 0 .. N + degree - 1. Only the first and the last one
don't vanish on the grid's boundary planes. Increments are control values, which belong to the functions'
Greville positions: a linear field has its own values there.
"""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid
from .base import Basis, Layer


class Splines(Basis):
    """B-splines whose derivatives are continuous up to the order degree - 1."""

    walls_only = True
    no_projection = "splines don't live on the cells' Lagrange space"
    no_slope = ""

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        """Means of a function's inner knots: of function i the planes i - degree + 1 .. i, in the grid."""
        index = grid.node_index(numbers)
        knots = (np.clip(index - k, 0, grid.shape) for k in range(self.degree))
        return sum((grid.position(k) for k in knots), np.zeros(index.shape)) / self.degree

    def extents(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        index = grid.node_index(numbers)
        size: np.ndarray = (grid.position(index + 1) - grid.position(index - self.degree)) / (self.degree + 1)
        return size

    def mirror(self, grid: Grid, axis: int, index: int, side: int, even: bool) -> list[Layer]:
        """On a wall the slope is a multiple of the difference of the first two layers, as knots are repeated
        there: an even field has the same in both. The second derivative of an odd one vanishes where it is
        continuous in the whole body; with the wall's own layer zero, it is one of the following two."""
        cells = grid.shape[axis]
        first, step = (0, 1) if index == 0 else (cells + self.degree - 1, -1)
        if even:
            return [Layer(first, first + step, 1.0)]
        if self.degree < 3:
            return []
        at = np.zeros((1, grid.dim), dtype=np.int64)
        at[0, axis] = 0 if step == 1 else cells - 1
        size, following = (float(a[0, axis]) for a in (grid.sizes(at), neighbours(grid, at, step)))
        return [Layer(first + step, first + 2 * step, size / (2.0 * size + following))]


def neighbours(grid: Grid, cells: np.ndarray, step: int) -> np.ndarray:
    """Sizes (m), (n, d), of the cells that are `step` away in each direction; beyond the walls, where knots
    coincide, zero."""
    there = cells + step
    return np.where((there >= 0) & (there < np.array(grid.shape)), grid.sizes(there), 0.0)
