"""Which rank has which points: recursive bisection of the cells that contain points.

The ranks are halved, and the cells with them, across the longest side of their box, so that both halves get
work in proportion. Cells of a part are ordered plane by plane across that side, within a plane row by row,
and cut between two of them: all points of a cell go to one rank, few node sets are shared, and shares differ
by no more than a cell. No rank sees more than its own cells and sums over the ranks.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from typing import Any

from mpi4py import MPI

import numpy as np

from ..geometry.grid import Grid
from ..geometry.nodes import ActiveNodes
from ..tools.checks import number
from ..tools.parallel import Route
from .points import Points

_BINS = 32  # of a histogram; a cut among c cells takes log c / log 32 of them
_CELL = 8  # work at the nodes of a cell, over that at an elastic point
_YIELDED = 6  # work at a point that has yielded, which may do so again, over that at an elastic one


def bisect(comm: MPI.Comm, index: np.ndarray, weight: np.ndarray, ranks: int | None = None) -> np.ndarray:
    """Ranks (m,) for cells of lattice index (m, d) and work (m,), whole numbers. Collective.

    A cell may be given by several ranks; its work is summed, and they get the same answer. Cells go to as
    many `ranks` as there are, or to another number.
    """
    part: np.ndarray = np.zeros(len(index), dtype=np.int64)
    start, count = np.array([0]), np.array([ranks or comm.size])  # of each part
    while np.any(count > 1):
        half = count // 2
        key, ends = _order(comm, index, part, len(start))
        cut = _cuts(comm, part, key, weight, ends, half / np.maximum(count, 1))
        part = 2 * part + (key >= cut[part])
        start = np.stack([start, start + half], axis=1).ravel()
        count = np.stack([half, count - half], axis=1).ravel()
    rank: np.ndarray = start[part]
    return rank


def _order(comm: MPI.Comm, index: np.ndarray, part: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Place of each cell in its part, the part's longest side first, and one more than the last (parts,)."""
    dim = index.shape[1]
    ends = np.full((parts, 2 * dim), np.iinfo(np.int64).max // 2)  # lowest indices, and minus the highest
    np.minimum.at(ends, part, np.hstack([index, -index]))
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    low = ends[:, :dim]
    sides = np.where(low + ends[:, dim:] > 0, 1, 1 - low - ends[:, dim:])  # a part may be empty
    axes = np.argsort(-sides, axis=1, kind="stable")
    sides = np.take_along_axis(sides, axes, axis=1)
    at = np.take_along_axis(index - low[part], axes[part], axis=1)
    key: np.ndarray = np.zeros(len(index), dtype=np.int64)
    for i in range(dim):
        key = key * sides[part, i] + at[:, i]
    return key, np.prod(sides, axis=1)


def _cuts(
    comm: MPI.Comm, part: np.ndarray, key: np.ndarray, weight: np.ndarray, ends: np.ndarray, share: np.ndarray
) -> np.ndarray:
    """Places (parts,) such that what lies before them is nearest to the share (parts,) of a part's work."""
    parts = len(ends)
    low: np.ndarray = np.zeros(parts, dtype=np.int64)
    below: np.ndarray = np.zeros(parts)
    high, above, target = ends, below, below
    every, first = np.arange(parts), True
    while first or np.any(high - low > 1):
        width = -(-(high - low) // _BINS)
        within = (key >= low[part]) & (key < high[part])
        bins = part[within] * _BINS + (key[within] - low[part[within]]) // width[part[within]]
        # without any cells bincount gives integers
        sums = np.bincount(bins, weight[within], minlength=parts * _BINS).astype(float)
        comm.Allreduce(MPI.IN_PLACE, sums)
        to = below[:, None] + np.cumsum(sums.reshape(parts, _BINS), axis=1)
        if first:
            target, first = share * to[:, -1], False
        at = np.minimum(np.sum(to <= target[:, None], axis=1), _BINS - 1)
        below, above = np.where(at > 0, to[every, at - 1], below), to[every, at]
        low, high = low + at * width, np.minimum(low + (at + 1) * width, high)
    return np.where(target - below <= above - target, low, high)


def work(points: Points) -> np.ndarray:
    """Work (np,) at the local points, in units of an elastic one."""
    if not points.plastic:
        return np.ones(len(points), dtype=np.int64)
    return np.where(points.hardening > 0, _YIELDED, 1)


def destinations(
    grid: Grid, x: np.ndarray, effort: np.ndarray, cells: np.ndarray | None = None
) -> np.ndarray:
    """Ranks (n,) for points at x (n, d) (m) with work (n,), see `work`. Points stay together that are in one
    cell, or in one of the `cells` of lattice index (n, d). Collective."""
    cells, at = np.unique(grid.cell_number(grid.cells_of(x) if cells is None else cells), return_inverse=True)
    weight = _CELL + np.bincount(at, effort, minlength=len(cells))
    return bisect(grid.comm, grid.node_index(cells), weight)[at]


def distribute(
    grid: Grid, points: Points, x: np.ndarray | None = None, cells: np.ndarray | None = None
) -> Route | None:
    """Distribute the points to the ranks by where they are, or were, at x (np, d) (m), see `destinations`.
    Collective.

    Returns:
        The way of the points, for what else is kept for each of them; None where nothing has moved.
    """
    if grid.comm.size == 1:
        return None
    to = destinations(grid, points.x if x is None else x, work(points), cells)
    if not grid.comm.allreduce(bool(np.any(to != grid.comm.rank)), op=MPI.LOR):
        return None
    return points.migrate(to)


@dataclass
class Shares:
    """How well the points are distributed, at the last reset; zero: not known yet.

    Attributes:
        work: most of a rank, over the mean.
        ghosts: ghost nodes over active nodes; they grow when the ranks' pieces of a body that flows mingle.
        best_work, best_ghosts: at the first reset after the points were distributed.
    """

    work: float = 0.0
    ghosts: float = 0.0
    best_work: float = 0.0
    best_ghosts: float = 0.0


class LoadShares:
    """Tells at a reset whether points are to be distributed afresh.

    Args:
        limit: factor by which a share may grow beyond what it was after the last time; None: never.

    Raises:
        InputError: a limit that isn't greater than one.
    """

    def __init__(self, comm: MPI.Comm, limit: Any):
        if limit is not None:
            limit = number("rebalance", limit, above=1.0, allowed="a number greater than 1, or None")
        self.comm, self.limit = comm, limit
        self.shares = Shares(work=1.0)  # the points haven't been distributed yet

    def due(self) -> bool:
        """Whether to distribute the points."""
        if self.comm.size == 1 or self.limit is None:
            return False
        s = self.shares
        worse: bool = s.work > self.limit * s.best_work or s.ghosts > self.limit * s.best_ghosts
        return worse

    def distributed(self) -> None:
        """Take note that the points have been distributed."""
        self.shares = Shares()

    def built(self, points: Points, nodes: ActiveNodes) -> None:
        """Measure the shares of a reset. Collective."""
        if self.comm.size > 1:
            s, mine = self.shares, int(work(points).sum()) + _CELL * nodes.owned
            sums = self.comm.allreduce(np.array([mine, len(nodes) - nodes.owned]))
            s.work = self.comm.allreduce(mine, op=MPI.MAX) * self.comm.size / max(int(sums[0]), 1)
            s.ghosts = int(sums[1]) / max(nodes.total, 1)
            s.best_work, s.best_ghosts = s.best_work or s.work, s.best_ghosts or s.ghosts

    # restart --------------------------------------------------------------------------------------
    def state(self) -> np.ndarray:
        """The shares as numbers."""
        return np.array(astuple(self.shares))

    def restore(self, state: np.ndarray) -> None:
        """Put in what `state` gave."""
        self.shares = Shares(**dict(zip((f.name for f in fields(Shares)), map(float, state), strict=True)))
