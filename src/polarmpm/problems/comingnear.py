"""What a body in motion comes to, between two resets: supports, and other pieces of itself.

Nodes go along with the points that they carry, and rigid motions distort no cell: a body that flies would go
on with its nodes through supports that are there, which hold other nodes; and pieces that share nodes would
move as one.
"""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..conditions.supports import Support
from ..geometry.grid import Grid, box_indices
from ..tools.parallel import errors_on_all_ranks

_APART = 4  # cells within which pieces may share nodes
_CLOSE = 1e-6  # of a cell: points so close to a side may count to the cell beyond


class CellsThen:
    """Cells in which this rank's points were at the last reset, and in which nothing has been found since.

    Args:
        x: their positions then (np, d).
    """

    def __init__(self, grid: Grid, x: np.ndarray):
        self.index = grid.cells_of(x)
        self._lower, self._upper = np.zeros_like(x), np.zeros_like(x)
        self.now_in(grid, np.arange(len(x)), self.index)

    def now_in(self, grid: Grid, rows: np.ndarray, index: np.ndarray) -> None:
        """Rows of points are in cells (n, d) that needn't be looked at again."""
        lower, upper = grid.corners(index), grid.corners(index + 1)
        slack = _CLOSE * (upper - lower)
        self._lower[rows], self._upper[rows] = lower + slack, upper - slack

    def left(self, grid: Grid, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of points that may be in other cells now, at positions x (np, d), and these (n, d)."""
        left = (x < self._lower) | (x > self._upper)
        if not left.any():
            return np.zeros(0, dtype=np.int64), np.zeros((0, grid.dim), dtype=np.int64)
        out = np.flatnonzero(left.any(axis=1))
        return out, grid.cells_of(x[out])


def meets_supports(
    grid: Grid,
    comm: MPI.Comm,
    supports: Sequence[Support],
    x: np.ndarray,
    then: CellsThen,
    body: np.ndarray,
) -> bool:
    """Whether points have come into cells with nodes that supports hold, other than those of the cells in
    which they were at the last reset. Collective.

    Args:
        x: positions of this rank's points (np, d).
        body: number of the body of each (np,).
    """
    found = False
    rows, now = np.zeros(0, dtype=np.int64), np.zeros((0, grid.dim), dtype=np.int64)
    with errors_on_all_ranks(comm, "supports"):
        if supports:
            rows, now = then.left(grid, x)
        if len(rows):
            before = then.index[rows, None]
            index = now[:, None] + box_indices((2,) * grid.dim)
            new = np.any((index < before) | (index > before + 1), axis=2)
            of = np.broadcast_to(body[rows, None], new.shape)[new]
            numbers = np.unique(grid.node_number(grid.of_bodies(index[new], of)))
            places = _Places(grid.node_position(numbers), numbers // grid.numbers)
            found = bool(len(places)) and any(bool(np.any(s.mask(places))) for s in supports)
    found = bool(comm.allreduce(found, op=MPI.LOR))
    if len(rows) and not found:
        then.now_in(grid, rows, now)
    return found


class _Places:
    """Positions as supports ask for them."""

    def __init__(self, position: np.ndarray, body: np.ndarray):
        self.position, self.body = position, body

    def __len__(self) -> int:
        return len(self.position)


def pieces_meet(grid: Grid, comm: MPI.Comm, x: np.ndarray, piece: np.ndarray, body: np.ndarray) -> bool:
    """Whether pieces of one body may share nodes. Collective.

    Args:
        x: positions (np, d) of this rank's points; piece, body: their numbers (np,).
    """
    d = grid.dim
    index = grid.cells_of(x)
    here = np.unique(np.stack([body, piece], axis=1), axis=0)
    pairs = np.unique(np.concatenate(comm.allgather(here)), axis=0)
    ends = np.full((len(pairs), 2, d), np.iinfo(np.int64).max)
    for k, (b, one) in enumerate(pairs):
        of = index[(body == b) & (piece == one)]
        if len(of):
            ends[k] = of.min(axis=0), -of.max(axis=0)
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    low, high = ends[:, 0] - _APART, -ends[:, 1] + _APART
    seen = np.zeros(len(x), dtype=bool)
    for k in range(len(pairs)):
        others = (pairs[:, 0] == pairs[k, 0]) & (np.arange(len(pairs)) != k)
        for o in np.flatnonzero(others & np.all((low <= high[k]) & (low[k] <= high), axis=1)):
            mine = (body == pairs[k, 0]) & (piece == pairs[k, 1])
            seen |= mine & np.all((index >= low[o]) & (index <= high[o]), axis=1)
    reach = index[seen, None] + box_indices((4,) * d) - 1  # of quadratic functions, the cells beside
    numbers = _keys(reach)
    own = np.repeat(np.stack([body, piece], axis=1)[seen], 4**d, axis=0)
    mine = np.unique(np.column_stack([own[:, 0], numbers, own[:, 1]]), axis=0)
    every = np.unique(np.concatenate(comm.allgather(mine)), axis=0)
    return len(every) > len(np.unique(every[:, :2], axis=0))


def _keys(index: np.ndarray) -> np.ndarray:
    """One number for each lattice index (n, m, d), flat."""
    flat = index.reshape(-1, index.shape[-1]).astype(np.int64) + (1 << 19)
    keys: np.ndarray = np.zeros(len(flat), dtype=np.int64)
    for i in range(flat.shape[1]):
        keys = (keys << 20) + flat[:, i]
    return keys
