"""Quadratic B-splines on the lattice."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .base import Weights


def spline_weights(grid: Grid, x: np.ndarray, first: np.ndarray) -> Weights:
    """Quadratic B-splines at x (n, d): of cell c = first the functions c, c + 1 and c + 2."""
    cell = np.array(grid.cell)
    right = snap(grid.local(x)) - first
    left = 1.0 - right
    # one over the cells that the outer two functions share with the middle one: two, or one at the boundary,
    # where knots coincide
    lower = np.where(first == 0, 1.0, 0.5)
    upper = np.where(first == np.array(grid.shape) - 1, 1.0, 0.5)
    values = [lower * left**2, upper * right**2]
    slopes = [-2.0 * lower * left / cell, 2.0 * upper * right / cell]
    table = np.empty((*x.shape, 2, 3))
    for k, (below, above) in enumerate((values, slopes)):
        table[:, :, k, 0], table[:, :, k, 2] = below, above
        table[:, :, k, 1] = (1.0 if k == 0 else 0.0) - below - above
    return Weights(first, np.full(x.shape, 3, dtype=np.int32), table)
