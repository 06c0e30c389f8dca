"""GIMPM: the mean of the tent functions over a point's domain (T 2.3.2).

The weight T (2.26) is the mean of the tent function over the point's interval. The interval is cut by grid
planes; on each part the tent is linear, so its mean is its value at the part's centre. That is exact, has no
case distinction, and tends to the standard weight as the interval shrinks.

Nodes that an interval reaches by less than `_SLIVER` of a cell across a plane would have a tiny stiffness,
that of the sliver squared. Such an interval is shortened on both sides, so that it ends on the plane and
keeps its centre; linear fields are still weighted exactly.
"""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid, snap
from .base import Chosen, Weights, check_margin
from .tents import Tents

_SLIVER = 1e-4


class Gimpm(Tents):
    """Tents averaged over the points' domains; surfaces, which have none, take the tents themselves."""

    name = "gimpm"
    no_projection = (
        "the internal force would be exact, as a domain is a sum of parts in one cell each, but the "
        "tangent couples the parts and is no sum of integrals over cells"
    )
    uses_domains = True
    thin_reach = True

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        assert half_length is not None
        low, high = _intervals(grid, x, half_length)  # in lattice coordinates
        inner = np.array(grid.shape)
        # a domain that ends on a plane doesn't touch the next cell; one of no length takes the cell above,
        # except on the upper boundary of the grid
        lowest = np.floor(low).astype(np.int64)
        lowest = np.where((high <= low) & (lowest >= inner), inner - 1, lowest)
        last = np.maximum(np.ceil(high).astype(np.int64), lowest + 1)
        check_margin(grid, lowest, last)
        count = (last - lowest + 1).astype(np.int32)
        return Weights(lowest, count, _means(grid, low, high, lowest, count))

    def continued(self, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, like: Chosen) -> Weights:
        """The same parts of the domains, cut by the same planes, and shortened to the same ones."""
        assert half_length is not None
        assert like.half_length is not None
        low, high = (_continued_end(grid, x, half_length, like, side) for side in (-1, 1))
        table = _means(grid, low, high, like.lowest, like.count, like)
        return Weights(like.lowest, like.count, table)


def _continued_end(grid: Grid, x: np.ndarray, half_length: np.ndarray, like: Chosen, side: int) -> np.ndarray:
    """An end (n, d) of domains in lattice coordinates, the lower (-1) or upper one (1): where those of `like`
    have been shortened, so that they end on a plane, that far from x too."""
    assert like.half_length is not None
    if grid.equal:
        xi, half = grid.local(like.x), like.half_length / np.array(grid.smallest)
        shorter, now = _without_slivers(xi, half), grid.local(x)
        below, above = np.ceil(xi - half), np.floor(xi + half)
        nearer = np.abs(xi - below - shorter) < np.abs(above - xi - shorter)
        reach = np.where(nearer, now - below, above - now)
        moved = side * np.where(shorter < half, reach, half_length / np.array(grid.smallest))
        end: np.ndarray = now + moved
        return end
    shorter = _without_slivers_in_metres(grid, like.x, like.half_length)
    low, high = snap(grid.local(like.x - like.half_length)), snap(grid.local(like.x + like.half_length))
    below, above = (grid.corners(plane.astype(np.int64)) for plane in (np.ceil(low), np.floor(high)))
    nearer = np.abs(like.x - below - shorter) < np.abs(above - like.x - shorter)
    reach = np.where(nearer, x - below, above - x)
    position = x + side * np.where(shorter < like.half_length, reach, half_length)
    # in the cell in which that is: lattice coordinates are linear in it
    cell = (like.lowest if side < 0 else like.lowest + like.count - 2).astype(np.int64)
    continued: np.ndarray = cell + (position - grid.corners(cell)) / grid.sizes(cell)
    return continued


def _means(
    grid: Grid,
    low: np.ndarray,
    high: np.ndarray,
    lowest: np.ndarray,
    count: np.ndarray,
    like: Chosen | None = None,
) -> np.ndarray:
    """Means over intervals (n, d) of lattice coordinates of the tents of `count` nodes from `lowest` on, and
    of their gradients (1/m): (n, d, 2, slots). Parts in different cells count by their lengths in metres.

    With `like` the parts are those of its intervals, their ends in the first and the last cell however they
    have moved.
    """
    slots = int(count.max(initial=2))
    table = np.zeros((*low.shape, 2, slots))
    length = high - low if grid.equal else _lengths(grid, low, high, lowest, count, like)
    for k in range(slots - 1):  # the part of the domain in cell lowest + k
        left, right = _part(low, high, lowest, count, k, like)
        own = right - left if grid.equal else (right - left) * grid.sizes(lowest + k)
        part = np.where(length > 0, own / np.where(length > 0, length, 1.0), float(k == 0))
        part = np.where(k < count - 1, np.maximum(part, 0.0) if like is None else part, 0.0)
        centre = 0.5 * (left + right) - (lowest + k)
        slope = part / grid.sizes(lowest + k)
        table[:, :, 0, k] += part * (1.0 - centre)
        table[:, :, 0, k + 1] += part * centre
        table[:, :, 1, k] -= slope
        table[:, :, 1, k + 1] += slope
    return table


def _part(
    low: np.ndarray, high: np.ndarray, lowest: np.ndarray, count: np.ndarray, k: int, like: Chosen | None
) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n, d) of the part of intervals in cells lowest + k."""
    if like is None:
        return np.maximum(low, lowest + k), np.minimum(high, lowest + k + 1)
    return low if k == 0 else lowest + float(k), np.where(count - 2 == k, high, lowest + k + 1.0)


def _intervals(grid: Grid, x: np.ndarray, half_length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the domains (n, d) in lattice coordinates; in metres they are x -+ half_length, whatever the
    cells, so that a domain's mean position is the point's."""
    if not grid.equal:
        half = _without_slivers_in_metres(grid, x, half_length)
        return snap(grid.local(x - half)), snap(grid.local(x + half))
    xi = grid.local(x)
    half = _without_slivers(xi, half_length / np.array(grid.smallest))
    return snap(xi - half), snap(xi + half)


def _without_slivers(xi: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Half-lengths (in cells) of intervals around xi that don't reach just across a plane."""
    plane_below, plane_above = np.ceil(xi - half), np.floor(xi + half)
    to_below, to_above = xi - plane_below, plane_above - xi
    shorter = half.copy()
    for reach in (to_below, to_above):
        sliver = (half - reach < _SLIVER) & (reach > _SLIVER)
        shorter = np.where(sliver, np.minimum(shorter, reach), shorter)
    return shorter


def _lengths(
    grid: Grid,
    low: np.ndarray,
    high: np.ndarray,
    lowest: np.ndarray,
    count: np.ndarray,
    like: Chosen | None,
) -> np.ndarray:
    """Lengths (m), (n, d), of intervals of lattice coordinates over the cells of `count` nodes from `lowest`
    on."""
    total = np.zeros(low.shape)
    for k in range(int(count.max(initial=2)) - 1):
        left, right = _part(low, high, lowest, count, k, like)
        part = right - left if like is not None else np.maximum(right - left, 0.0)
        total += np.where(k < count - 1, part * grid.sizes(lowest + k), 0.0)
    return total


def _without_slivers_in_metres(grid: Grid, x: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Half lengths (m) of intervals around x that don't reach just across a plane, in sizes of the cell that
    they hardly enter."""
    low, high = snap(grid.local(x - half)), snap(grid.local(x + half))
    plane_below, plane_above = np.ceil(low).astype(np.int64), np.floor(high).astype(np.int64)
    shorter = half.copy()
    for reach, over, there in (
        (x - grid.corners(plane_below), plane_below - low, plane_below - 1),
        (grid.corners(plane_above) - x, high - plane_above, plane_above),
    ):
        sliver = (over > 0.0) & (over < _SLIVER) & (reach > _SLIVER * grid.sizes(there))
        shorter = np.where(sliver, np.minimum(shorter, reach), shorter)
    return shorter
