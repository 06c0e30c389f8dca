"""What B-splines of any degree share.

Knots are at the grid's planes, the outer ones as often as the degree asks for: N cells in a direction have
N + degree functions, which are numbered as lattice nodes 0 .. N + degree - 1. Only the first and the last one
don't vanish on the grid's boundary planes. Increments are control values, which belong to the functions'
Greville positions: a linear field has its own values there.
"""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid
from .base import Basis


class Splines(Basis):
    """B-splines whose derivatives are continuous up to the order degree - 1."""

    walls_only = True
    no_projection = "splines don't live on the cells' Lagrange space"

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        """Means of a function's inner knots: of function i the planes i - degree + 1 .. i, in the grid."""
        index = grid.node_index(numbers)
        knots = (np.clip(index - k, 0, grid.shape) for k in range(self.degree))
        return sum((grid.position(k) for k in knots), np.zeros(index.shape)) / self.degree


def neighbours(grid: Grid, cells: np.ndarray, step: int) -> np.ndarray:
    """Sizes (m), (n, d), of the cells that are `step` away in each direction; beyond the walls, where knots
    coincide, zero."""
    there = cells + step
    return np.where((there >= 0) & (there < np.array(grid.shape)), grid.sizes(there), 0.0)
