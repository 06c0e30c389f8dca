"""The tent functions on the lattice: standard material points, T 2.3.2."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .base import Basis, Weights


class Tents(Basis):
    """Multilinear functions, one at each lattice node."""

    name = "mpm"
    degree = 1
    gradients_jump = True
    locks = True
    patch = 1
    patch_stiffness = 0.5

    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        return tents(grid.within(x, cells), grid.sizes(cells))

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        """A point on a plane is in the cell above, but for the grid's last plane."""
        xi = snap(grid.local(x))
        if cells is None:
            cells = np.minimum(np.floor(xi).astype(np.int64), np.array(grid.shape) - 1)
        return Weights(cells, np.full(x.shape, 2, dtype=np.int32), tents(xi - cells, grid.sizes(cells)))


def tents(r: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Values and gradients (1/m) of the tents at both ends of cells of some sizes (n, d) (m), at places r
    (n, d) in the cells, from 0 to 1: (n, d, 2, 2)."""
    table = np.empty((*r.shape, 2, 2))
    table[:, :, 0, 1] = r
    np.subtract(1.0, r, out=table[:, :, 0, 0])
    np.divide(1.0, sizes, out=table[:, :, 1, 1])
    np.negative(table[:, :, 1, 1], out=table[:, :, 1, 0])
    return table
