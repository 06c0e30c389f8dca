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


def meets_supports(
    grid: Grid,
    comm: MPI.Comm,
    supports: Sequence[Support],
    x: np.ndarray,
    before: np.ndarray,
    body: np.ndarray,
) -> bool:
    """Whether points have come into cells with nodes that supports hold, other than those of the cells in
    which they were at the last reset. Collective.

    Args:
        x, before: positions of this rank's points (np, d), and those then (m).
        body: number of the body of each (np,).
    """
    found = False
    with errors_on_all_ranks(comm, "supports"):
        if supports:
            now, then = grid.cells_of(x), grid.cells_of(before)
            went = np.flatnonzero(np.any(now != then, axis=1))
            index = now[went, None] + box_indices((2,) * grid.dim)
            new = np.any((index < then[went, None]) | (index > then[went, None] + 1), axis=2)
            of = np.broadcast_to(body[went, None], new.shape)[new]
            numbers = np.unique(grid.node_number(grid.of_bodies(index[new], of)))
            places = _Places(grid.node_position(numbers), numbers // grid.numbers)
            found = bool(len(places)) and any(bool(np.any(s.mask(places))) for s in supports)
    return bool(comm.allreduce(found, op=MPI.LOR))


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
