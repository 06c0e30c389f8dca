"""Weighting functions of material points on the lattice: standard MPM and GIMPM (T 2.3.2), and splines.

The GIMPM weight T (2.26) is the mean of the tent function over the point's interval. The interval is cut
by grid planes; on each part the tent is linear, so its mean is its value at the part's centre. That is
exact, has no case distinction, and tends to the standard weight as the interval shrinks.

An interval that reaches less than `_SLIVER` of a cell across a plane would hang nodes on the body by a
thread: their
stiffness is that of the sliver squared. Such an interval is shortened on both sides, so that it ends on the
plane and keeps its centre; linear fields are still weighted exactly.

Quadratic B-splines have their knots at the grid's planes, the outer ones threefold: N cells in a direction
have N + 2 functions, which are numbered as lattice nodes 0 .. N + 1. Only the first and the last one don't
vanish on the grid's boundary planes. Increments are control values, which belong to the functions' Greville
positions: a linear field has its own values there.
"""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .base import Weights, check_basis, check_margin
from .bspline import spline_weights

_SLIVER = 1e-4


def weights(
    basis: str, grid: Grid, x: np.ndarray, half_length: np.ndarray, cells: np.ndarray | None = None
) -> Weights:
    """Weights of points on the lattice.

    Args:
        x: positions (n, d) (m).
        half_length: of the domains (n, d) (m); only GIMPM looks at it.
        cells: lattice index (n, d) of the cell whose polynomials weight a point; only splines look at it.
            Default: the cell that the point is in. See `aggregation`.
    """
    if check_basis(basis) == "bspline":
        return spline_weights(grid, x, grid.cells_of(x) if cells is None else cells)
    if basis == "mpm":
        return _tent_weights(grid, x)
    xi, cell = grid.local(x), np.array(grid.cell)
    half = _without_slivers(xi, half_length / cell)
    low, high = snap(xi - half), snap(xi + half)
    inner = np.array(grid.shape)
    # a domain that ends on a plane doesn't touch the next cell; one of no length takes the cell above,
    # except on the upper boundary of the grid
    first = np.floor(low).astype(np.int64)
    first = np.where((high <= low) & (first >= inner), inner - 1, first)
    last = np.maximum(np.ceil(high).astype(np.int64), first + 1)
    check_margin(grid, first, last)
    count = (last - first + 1).astype(np.int32)
    slots = int(count.max(initial=2))
    table = np.zeros((len(x), grid.dim, 2, slots))
    length = high - low
    for k in range(slots - 1):  # the part of the domain in cell first + k
        left = np.maximum(low, first + k)
        right = np.minimum(high, first + k + 1)
        part = np.where(length > 0, (right - left) / np.where(length > 0, length, 1.0), float(k == 0))
        part = np.where(k < count - 1, np.maximum(part, 0.0), 0.0)
        centre = 0.5 * (left + right) - (first + k)
        table[:, :, 0, k] += part * (1.0 - centre)
        table[:, :, 0, k + 1] += part * centre
        table[:, :, 1, k] -= part / cell
        table[:, :, 1, k + 1] += part / cell
    return Weights(first, count, table)


def _tent_weights(grid: Grid, x: np.ndarray) -> Weights:
    """The tent functions at x (n, d). A point on a plane is in the cell above, but for the grid's last."""
    xi, inner = snap(grid.local(x)), np.array(grid.shape)
    first = np.floor(xi).astype(np.int64)
    first = np.where(first >= inner, inner - 1, first)
    check_margin(grid, first, first + 1)
    table = np.empty((*x.shape, 2, 2))
    table[:, :, 0, 1] = xi - first
    table[:, :, 0, 0] = 1.0 - table[:, :, 0, 1]
    table[:, :, 1, 0], table[:, :, 1, 1] = -1.0 / np.array(grid.cell), 1.0 / np.array(grid.cell)
    return Weights(first, np.full(x.shape, 2, dtype=np.int32), table)


def node_positions(basis: str, grid: Grid, numbers: np.ndarray) -> np.ndarray:
    """Positions (m), (n, d), at which nodal values of a linear field are the field's own.

    The lattice nodes; for B-splines the Greville positions: cells' centres, and the grid's boundary planes.
    """
    if basis != "bspline":
        return grid.node_position(numbers)
    at = np.clip(grid.node_index(numbers) - 0.5, 0.0, grid.shape)
    return np.array(grid.origin) + at * np.array(grid.cell)


def _without_slivers(xi: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Half-lengths (in cells) of intervals around xi that don't reach just across a plane."""
    plane_below, plane_above = np.ceil(xi - half), np.floor(xi + half)
    to_below, to_above = xi - plane_below, plane_above - xi
    shorter = half.copy()
    for reach in (to_below, to_above):
        sliver = (half - reach < _SLIVER) & (reach > _SLIVER)
        shorter = np.where(sliver, np.minimum(shorter, reach), shorter)
    return shorter


def cell_weights(basis: str, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Values and gradients (1/m) of cells' functions at x (m, d), continued beyond the cells: (m, 1 + d,
    n)."""
    if basis == "bspline":
        line = weights(basis, grid, x, np.zeros_like(x), cells).table  # (m, d, 2, 3)
    else:
        right = grid.local(x) - cells
        slope = np.broadcast_to(1.0 / np.array(grid.cell), x.shape)
        line = np.stack([np.stack([1.0 - right, right], -1), np.stack([-slope, slope], -1)], axis=2)
    dim, slots = grid.dim, line.shape[-1]
    index = np.stack(np.unravel_index(np.arange(slots**dim), (slots,) * dim), axis=-1)

    def product(derivative: int) -> np.ndarray:
        out = np.ones((len(x), len(index)))
        for i in range(dim):
            out *= line[:, i, int(i == derivative)][:, index[:, i]]
        return out

    return np.stack([product(k) for k in (-1, *range(dim))], axis=1)
