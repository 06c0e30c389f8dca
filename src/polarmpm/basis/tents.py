"""The tent functions on the lattice: standard material points, T 2.3.2."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..geometry.grid import MARGIN, Grid, snap
from .base import Basis, Chosen, Layer, Weights


class Tents(Basis):
    """Multilinear functions, one at each lattice node."""

    name = "mpm"
    degree = 1
    gradients_jump = True
    no_slope = "its functions have kinks at the planes of the grid, and no slope there"
    locks = costly = True
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
        right = xi - cells if grid.equal else snap(grid.within(x, cells))
        return Weights(cells, np.full(x.shape, 2, dtype=np.int32), tents(right, grid.sizes(cells)))

    def continued(self, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, like: Chosen) -> Weights:
        return Weights(like.lowest, like.count, tents(grid.within(x, like.lowest), grid.sizes(like.lowest)))

    def mirror(self, grid: Grid, axis: int, index: int, side: int, even: bool) -> list[Layer]:
        """Nodes beyond the plane, which domains of points may reach, mirror those before it.

        Raises:
            InputError: domains may reach beyond the plane, and the grid's lines there aren't mirrored.
        """
        sign = 1.0 if even else -1.0
        if self.uses_domains and not grid.equal:
            _check_mirrored(grid, axis, index)
        return [Layer(index + k * side, index - k * side, sign) for k in range(1, MARGIN + 1)]


def _check_mirrored(grid: Grid, axis: int, index: int) -> None:
    cells = np.zeros((2 * MARGIN, grid.dim), dtype=np.int64)
    cells[:, axis] = np.arange(index - MARGIN, index + MARGIN)
    size = grid.sizes(cells)[:, axis]
    if np.any(np.abs(size - size[::-1]) > 1e-6 * size):
        raise InputError(
            f"symmetry: plane {'xyz'[axis]} = {grid.plane(axis, index):g}: domains of points reach beyond "
            f"it, so the grid's next {MARGIN} lines on both sides have to be mirrored there; end the grid at "
            "this plane, or take basis 'mpm' or a spline basis"
        )


def tents(r: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Values and gradients (1/m) of the tents at both ends of cells of some sizes (n, d) (m), at places r
    (n, d) in the cells, from 0 to 1: (n, d, 2, 2)."""
    table = np.empty((*r.shape, 2, 2))
    table[:, :, 0, 1] = r
    np.subtract(1.0, r, out=table[:, :, 0, 0])
    np.divide(1.0, sizes, out=table[:, :, 1, 1])
    np.negative(table[:, :, 1, 1], out=table[:, :, 1, 0])
    return table
