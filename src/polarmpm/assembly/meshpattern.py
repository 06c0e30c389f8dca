"""Sparsity pattern of a mesh's tangent: where the blocks of each element's nodes stand."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..geometry.nodes import Nodes
from ..kernels import native
from . import sparsity


class MeshPattern:
    """The pattern of the nodes that elements, or terms, couple. Collective.

    Args:
        cells: nodes of this rank's own elements (m, n), local rows.
        sets: of other sets of nodes that are coupled, (m', n') each.
        symmetric: the sums over the elements are; rows hold their upper triangle only, unless `whole`. Then
            `Pattern.mirror` has to be called once they are made.

    Attributes:
        pattern: see `sparsity.Pattern`.
        columns: block column of node b in the row of node a, for each element, (m, n, n); of symmetric
            matrices where b has the larger global number.
    """

    def __init__(
        self,
        nodes: Nodes,
        cells: np.ndarray,
        sets: Sequence[np.ndarray],
        block: int,
        symmetric: bool,
        whole: bool,
    ):
        self.nodes, half = nodes, symmetric
        symmetric = half and not whole
        code, most = _codes(nodes, cells, symmetric)
        table = np.full((len(nodes), most), -1, dtype=np.int32)
        there = code >= 0
        row = np.broadcast_to(cells[:, :, None], code.shape)[there]
        table[row, code[there]] = np.broadcast_to(cells[:, None], code.shape)[there]
        row, own = np.nonzero(table >= 0)
        pairs = _with(nodes, (row, own, table[row, own].astype(np.int64)), sets, symmetric)
        self._pairs = pairs
        codes = int(pairs[1].max(initial=0)) + 1
        self.pattern = sparsity.of_pairs(nodes, block, symmetric, 0, codes, pairs)
        native.fill(self.pattern.matrix, half=int(half))
        place = self.pattern.matrix.kept["place"]
        columns = place[cells[:, :, None], np.maximum(code, 0)]
        self.columns: np.ndarray = np.where(there, columns, -1).astype(np.int32)
        if half and whole:
            row, own, col = pairs
            later = nodes.number[row] <= nodes.number[col]
            row, own, col = row[later], own[later], col[later]
            back = self.block_columns(np.stack([col, row], axis=1))[:, 0, 1]
            halves = row, col, place[row, own], back
            self.pattern.halves = tuple(a.astype(np.int32) for a in halves)

    @cached_property
    def _known(self) -> tuple[np.ndarray, np.ndarray]:
        """Keys of this rank's pairs, ascending, and their block columns."""
        row, code, col = self._pairs
        keys = row * len(self.nodes) + col
        order = np.argsort(keys)
        return keys[order], self.pattern.matrix.kept["place"][row, code][order]

    def block_columns(self, rows: np.ndarray) -> np.ndarray:
        """Block columns (m, n, n) of sets of nodes (m, n) that the pattern couples; -1: it doesn't, as of a
        symmetric matrix' lower triangle."""
        keys, columns = self._known
        wanted = rows[:, :, None].astype(np.int64) * len(self.nodes) + rows[:, None]
        at = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        found: np.ndarray = np.full(wanted.shape, -1, dtype=np.int64)
        if len(keys):
            found = np.where(keys[at] == wanted, columns[at], -1)
        return found

    def entries(self, indptr: np.ndarray, indices: np.ndarray) -> np.ndarray:
        """Where entries of compressed sparse rows of the owned unknowns, with global columns, stand in the
        values of the pattern; -1: it hasn't got them."""
        p, size = self.pattern, self.nodes.total * self.pattern.block

        def keys(ends: np.ndarray, columns: np.ndarray) -> np.ndarray:
            found: np.ndarray = np.repeat(np.arange(len(ends) - 1), np.diff(ends)) * size + columns
            return found

        known, wanted = keys(p.indptr, p.indices), keys(indptr, indices)
        at = np.searchsorted(known, wanted)
        there = at < len(known)
        there[there] = known[at[there]] == wanted[there]
        return np.where(there, at, -1)


def _codes(nodes: Nodes, cells: np.ndarray, half: bool) -> tuple[np.ndarray, int]:
    """Number (m, n, n) of node b of an element among the neighbours of its node a, -1: the other half of the
    pairs; and how many numbers there are."""
    code = np.full((*cells.shape, cells.shape[1]), -1, dtype=np.int32)
    flat = np.ascontiguousarray(cells, dtype=np.int32).ravel()
    incident = np.argsort(flat, kind="stable").astype(np.int64)
    start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=len(nodes)))]).astype(np.int64)
    couple = native.library().polarmpm_couple_elements
    most = couple(len(nodes), cells.shape[1], flat, nodes.number, int(half), start, incident, code)
    if most < 0:
        raise MemoryError("no memory for the pattern of the elements")
    return code, most


def _with(
    nodes: Nodes, pairs: tuple[np.ndarray, ...], sets: Sequence[np.ndarray], symmetric: bool
) -> tuple[np.ndarray, ...]:
    """The pairs (row, code, column), and those of more sets of nodes; each owned node with itself, too."""
    row, code, col = pairs
    n, own = len(nodes), np.arange(nodes.owned)
    keys, more = row * n + col, [own * n + own]
    for rows in sets:
        first, second = np.broadcast_arrays(rows[:, :, None].astype(np.int64), rows[:, None])
        first, second = first.ravel(), second.ravel()
        if symmetric:
            keep = nodes.number[first] <= nodes.number[second]
            first, second = first[keep], second[keep]
        more.append(first * n + second)
    missing = np.setdiff1d(np.concatenate(more), keys)
    if not len(missing):
        return pairs
    first, second = np.divmod(missing, n)
    further = np.bincount(row, minlength=n)[first] + np.arange(len(first)) - np.searchsorted(first, first)
    row, code = np.concatenate([row, first]), np.concatenate([code, further])
    order = np.argsort(row, kind="stable")
    return row[order], code[order], np.concatenate([col, second])[order]
