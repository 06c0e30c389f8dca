"""Tied unknowns in a sparse matrix: their rows and columns are added to those of the unknowns they follow.

With x = T y, where y has the free unknowns only, the matrix of the free ones is T' K T. Whatever is coupled
with a tied unknown is coupled with its master, too (`conditions.ties`), so that the pattern holds the result,
and each rank folds what it has summed before rows of ghosts are sent to their owners.
"""

from __future__ import annotations

import numpy as np

from ..conditions.ties import Ties
from ..errors import InputError
from ..geometry.grid import box_indices
from ..geometry.nodes import ActiveNodes
from .sparsity import Pattern


class Folding:
    """Where the entries of tied unknowns are in the values of a pattern, and where they go.

    Raises:
        InputError: a term couples tied nodes with others that no point sees together with their masters.
    """

    def __init__(self, pattern: Pattern, ties: Ties):
        nodes, block = ties.nodes, pattern.block
        row, place, col = _pairs(pattern, nodes, np.any(ties.tied, axis=1))
        i, j = (a.ravel() for a in np.divmod(np.arange(block * block), block))
        row, col, place = (a[:, None] for a in (row, col, place))
        source = self._position(pattern, row, place, i, j)
        involved = ties.tied[row, i] | ties.tied[col, j]
        if pattern.symmetric:
            involved &= (row != col) | (i <= j)
        weight = ties.factor[row, i] * ties.factor[col, j]
        r, c, p, q = (np.broadcast_to(a, involved.shape)[involved] for a in (row, col, i, j))
        source, weight = source[involved], weight[involved]
        a, b = ties.master[r, p], ties.master[c, q]
        if pattern.symmetric:
            number = nodes.number
            swap = (number[a] > number[b]) | ((a == b) & (p > q))
            once = (r == c) & (p == q)  # else it stands for two, which both go to a diagonal
            weight = np.where((a == b) & (p == q) & ~once, 2.0, 1.0) * weight
            a, b, p, q = np.where(swap, (b, a, q, p), (a, b, p, q))
        to = _places(pattern, nodes, a, b)
        if not np.all(to >= 0):
            raise InputError(
                "a term acts on nodes at a plane with a slope or symmetry support without those of the next "
                "layer; its boxes have to reach into the body by as many nodes as the basis has in a cell"
            )
        self._source, self._weight = source, weight
        self._target, self._which = np.unique(self._position(pattern, a, to, p, q), return_inverse=True)

    @staticmethod
    def _position(
        pattern: Pattern, row: np.ndarray, place: np.ndarray, i: np.ndarray, j: np.ndarray
    ) -> np.ndarray:
        """Of entries (i, j) of the blocks at places in the nodes' rows in the values."""
        start = pattern.matrix.kept["row_start"][row * pattern.block + i]
        position: np.ndarray = start + place.astype(np.int64) * pattern.block + j
        return position

    def fold(self, values: np.ndarray) -> None:
        """Fold the values of the pattern as they are on this rank."""
        moved = self._weight * values[self._source]
        values[self._target] += np.bincount(self._which.ravel(), moved, minlength=len(self._target))
        values[self._source] = 0.0


def _places(pattern: Pattern, nodes: ActiveNodes, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Where the blocks of pairs of nodes (n,) stand in the first ones' rows; -1: nowhere."""
    index, reach = nodes.grid.node_index(nodes.lattice), pattern.matrix.reach
    body = nodes.lattice // nodes.grid.numbers
    away = index[col] - index[row] + reach
    inside = np.all((away >= 0) & (away <= 2 * reach), axis=1) & (body[col] == body[row])
    sides = (2 * reach + 1,) * index.shape[1]
    to = np.ravel_multi_index(tuple(np.where(inside[:, None], away, 0).T), sides)
    found: np.ndarray = np.where(
        inside, pattern.matrix.kept["place"][row, to], pattern.crossing_column(row, col)
    )
    return found


def _pairs(
    pattern: Pattern, nodes: ActiveNodes, tied: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of all blocks of a pattern that a tied node (nodes,) has a part in, their places, and columns."""
    reach = pattern.matrix.reach
    side = 2 * reach + 1
    steps = (box_indices((side,) * nodes.grid.dim) - reach) @ nodes.grid.strides
    near = nodes.find((nodes.lattice[tied][:, None] + steps).ravel())
    rows = np.unique(near[near >= 0])
    at, code = np.nonzero(pattern.matrix.kept["place"][rows] >= 0)
    row = rows[at]
    col, place = nodes.find(nodes.lattice[row] + steps[code]), pattern.matrix.kept["place"][row, code]
    if pattern.crossing is not None and pattern.crossing_columns is not None:
        row, col = (np.concatenate(two) for two in zip((row, col), pattern.crossing.T, strict=True))
        place = np.concatenate([place, pattern.crossing_columns])
    which = tied[row] | tied[col]
    return row[which], place[which], col[which]
