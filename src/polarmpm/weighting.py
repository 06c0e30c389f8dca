"""Weighting functions of material points on the lattice: standard MPM and GIMPM (T 2.3.2).

The GIMPM weight T (2.26) is the mean of the tent function over the point's interval. The interval is cut
by grid planes; on each part the tent is linear, so its mean is its value at the part's centre. That is
exact, has no case distinction, and tends to the standard weight as the interval shrinks.

An interval that reaches less than `_SLIVER` of a cell across a plane would hang nodes on the body by a
thread: their
stiffness is that of the sliver squared. Such an interval is shortened on both sides, so that it ends on the
plane and keeps its centre; linear fields are still weighted exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .errors import InputError
from .grid import MARGIN, Grid, snap

BASES = ("gimpm", "mpm")
_SLIVER = 1e-4


@dataclass
class Weights:
    """Weights of points in each direction; the weighting function is their product, T (2.28)-(2.30).

    Attributes:
        first: lattice index of the first node (n, d).
        count: number of nodes in each direction (n, d).
        table: values and gradients (1/m), (n, d, 2, slots); unused slots are zero.
    """

    first: np.ndarray
    count: np.ndarray
    table: np.ndarray


def check_basis(basis: str) -> str:
    """Raise InputError for an unknown basis."""
    if basis not in BASES:
        raise InputError(f"basis = {basis!r}: allowed are {', '.join(BASES)}")
    return basis


def weights(basis: str, grid: Grid, x: np.ndarray, half_length: np.ndarray) -> Weights:
    """Weights of points at x (n, d) with domains of half-lengths (n, d), both in m."""
    xi, cell = grid.local(x), np.array(grid.cell)
    if check_basis(basis) == "mpm":
        half_length = np.zeros_like(half_length)
    half = _without_slivers(xi, half_length / cell)
    low, high = snap(xi - half), snap(xi + half)
    inner = np.array(grid.shape)
    # a domain that ends on a plane doesn't touch the next cell; one of no length takes the cell above,
    # except on the upper boundary of the grid
    first = np.floor(low).astype(np.int64)
    first = np.where((high <= low) & (first >= inner), inner - 1, first)
    last = np.maximum(np.ceil(high).astype(np.int64), first + 1)
    beyond = (first < -MARGIN) | (last > inner + MARGIN)
    if np.any(beyond):
        raise InputError(f"point domains reach more than {MARGIN} cells beyond the grid")
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


def _without_slivers(xi: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Half-lengths (in cells) of intervals around xi that don't reach just across a plane."""
    plane_below, plane_above = np.ceil(xi - half), np.floor(xi + half)
    to_below, to_above = xi - plane_below, plane_above - xi
    shorter = half.copy()
    for reach in (to_below, to_above):
        sliver = (half - reach < _SLIVER) & (reach > _SLIVER)
        shorter = np.where(sliver, np.minimum(shorter, reach), shorter)
    return shorter
