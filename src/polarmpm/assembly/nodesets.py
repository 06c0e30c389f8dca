"""Groups of points that share a set of nodes, and the nodes that they reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..basis.base import Basis, Weights
from ..geometry.grid import Grid, box_indices

# cost of putting a group's sums into the matrix, over that of a point; both go with its nodes squared
_FLUSH = 4


@dataclass
class Groups:
    """Point groups that share a node set: material, lowest lattice node, nodes in each direction,
    and where each group's points begin (groups + 1)."""

    material: np.ndarray
    node: np.ndarray
    count: np.ndarray
    offsets: np.ndarray


def group_points(material: np.ndarray, w: Weights) -> tuple[np.ndarray, Groups]:
    """Sort points by material, lowest node and node count."""
    n, dim = w.lowest.shape
    # neighbours next to each other: their groups share rows of the matrix, which then stay in the cache
    order, new = _sorted([material, *w.lowest.T, *w.count.T[::-1]])
    first = order[new]
    heads = np.column_stack([material[first], w.lowest[first], w.count[first]])
    offsets = np.append(np.flatnonzero(new), n)
    heads, offsets = _merged(heads, offsets, 1 + dim)
    return order, Groups(heads[:, 0], heads[:, 1 : 1 + dim], heads[:, 1 + dim :], offsets)


def _sorted(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The order of rows (n,) whose columns are whole numbers, the first column before all others, and which
    of them differ from the one before."""
    n = len(columns[0])
    new = np.ones(n, dtype=bool)
    key: np.ndarray = np.zeros(n, dtype=np.int64)
    numbers = 1
    for column in columns if n else ():
        low, high = int(column.min()), int(column.max())
        if high == low:
            continue
        numbers *= high - low + 1
        key = key * (high - low + 1) + (column - low)
    if numbers > 2**62:  # no number is large enough for all columns
        order = np.lexsort(columns[::-1])
        table = np.column_stack(columns)[order]
        new[1:] = np.any(table[1:] != table[:-1], axis=1)
        return order, new
    order = np.argsort(key, kind="stable")
    key = key[order]
    np.not_equal(key[1:], key[:-1], out=new[1:])
    return order, new


def _merged(heads: np.ndarray, offsets: np.ndarray, same: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups (g, columns) that begin at `offsets` (g + 1), those of one material and lowest node, which the
    first columns are, merged into the largest of them where that is cheaper: weights beyond a point's own are
    zero. The largest has all nodes of the others, or they aren't merged."""
    new = np.ones(len(heads), dtype=bool)
    new[1:] = np.any(heads[1:, :same] != heads[:-1, :same], axis=1)
    first, family = np.flatnonzero(new), np.cumsum(new) - 1
    if len(first) == len(heads):
        return heads, offsets
    counts, points = heads[:, same:], np.diff(offsets)
    largest = np.maximum.reduceat(counts, first)
    has_it = np.logical_or.reduceat(np.all(counts == largest[family], axis=1), first)
    apart = np.add.reduceat(np.prod(counts, axis=1) ** 2 * (points + _FLUSH), first)
    together = np.prod(largest, axis=1) ** 2 * (np.add.reduceat(points, first) + _FLUSH)
    merge = has_it & (together < apart)
    kept = new | ~merge[family]
    heads = heads.copy()
    heads[:, same:] = np.where(merge[family, None], largest[family], counts)
    return heads[kept], np.append(offsets[:-1][kept], offsets[-1])


def boxes_of(grid: Grid, sizes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each different size (n, d) of boxes of nodes: which rows have it, and its nodes' distances from the
    lowest one, as lattice numbers."""
    if len(sizes) and np.array_equal(sizes.min(axis=0), sizes.max(axis=0)):  # as of standard points
        return [(np.arange(len(sizes)), box_indices(sizes[0]) @ grid.strides)]
    different, kind = np.unique(sizes, axis=0, return_inverse=True)
    out = []
    for k, size in enumerate(different):
        out.append((np.flatnonzero(kind.ravel() == k), box_indices(size) @ grid.strides))
    return out


def reached_cells(grid: Grid, groups: Groups, basis: Basis) -> np.ndarray:
    """Lattice numbers, ascending, of the cells on which the groups' functions are weights."""
    lowest = grid.node_number(groups.node.reshape(-1, grid.dim))
    boxes = boxes_of(grid, basis.cells_of_groups(groups.count))
    cells = [(lowest[g][:, None] + box).ravel() for g, box in boxes]
    reached: np.ndarray = np.unique(np.concatenate([lowest[:0], *cells]))
    return reached


def ownership_priorities(grid: Grid, groups: Groups, touched: np.ndarray) -> np.ndarray:
    """This rank's priority to own each touched node: how many of its points have it as their lowest one. A
    piece of the body that is cut between cells then owns the lower corners of its cells, and no rank more
    nodes than its share."""
    lowest = grid.node_number(groups.node.reshape(-1, grid.dim))
    at = np.searchsorted(touched, lowest)
    return np.bincount(at, np.diff(groups.offsets), minlength=len(touched)).astype(np.int64)


def node_sets_of(
    grid: Grid, groups: Groups, more: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All lattice numbers touched, those in `more` too, ascending; the places among them of the groups'
    nodes, one group after the other; and where each group's begin (groups + 1)."""
    base = grid.node_number(groups.node.reshape(-1, grid.dim))
    offsets = np.concatenate([[0], np.cumsum(np.prod(groups.count, axis=1))]).astype(np.int64)
    numbers = np.empty(offsets[-1], dtype=np.int64)
    for g, box in boxes_of(grid, groups.count):
        numbers[offsets[g][:, None] + np.arange(len(box))] = base[g][:, None] + box
    touched, inverse = np.unique(np.concatenate([numbers, *more]), return_inverse=True)
    return touched, inverse[: len(numbers)], offsets
