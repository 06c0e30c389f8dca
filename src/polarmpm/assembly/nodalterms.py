"""Contributions to the nodal system that don't come from material points.

A term belongs to the time between two resets. It acts on boxes of lattice nodes, all of the same size: its
forces depend on the increments of a box's nodes, and its tangent is a dense matrix for each box. Node pairs
of a box are coupled in the sparse matrix. A box is on one rank.

Shapes: m boxes on this rank, n nodes in a box (the last axis runs fastest), b unknowns of a node, k coupled
pairs of components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.nodes import ActiveNodes
from ..kernels import native
from ..terms.base import Boxes, Term, multiply


@dataclass
class _Places:
    """Where a term's entries go: `kept` ones of (m, n, n, k), in order, to `at[inverse]`."""

    kept: np.ndarray
    at: np.ndarray
    inverse: np.ndarray
    constant: np.ndarray | None = None

    def add(self, term: Term, x: np.ndarray, values: np.ndarray) -> None:
        sums = self.constant
        if sums is None:
            entries = np.broadcast_to(term.matrices(x), self.kept.shape)[self.kept]
            sums = np.bincount(self.inverse, entries, minlength=len(self.at))
            self.constant = sums if term.linear else None
        values[self.at] += sums


class NodalTerms:
    """Terms on the active nodes, and where their tangents stand in the sparse matrix."""

    def __init__(self, nodes: ActiveNodes, terms: Sequence[Term]):
        self.nodes, self.terms = nodes, list(terms)
        self.rows = []
        for term in self.terms:
            numbers = term.boxes.numbers(nodes.grid)
            self.rows.append(nodes.local(numbers.ravel()).reshape(numbers.shape))
        self._places: list[_Places] = []

    def __len__(self) -> int:
        return len(self.terms)

    @property
    def symmetric(self) -> bool:
        """The sum of all tangents is symmetric."""
        return all(t.symmetric for t in self.terms)

    def batches(self) -> list[native.Batch]:
        """The node sets as `sparsity.build` reads them."""
        return [self._batch(t.boxes, rows) for t, rows in zip(self.terms, self.rows, strict=True)]

    def _batch(self, boxes: Boxes, rows: np.ndarray) -> native.Batch:
        m, n = rows.shape
        batch = native.Batch()
        native.fill(
            batch,
            dim=len(boxes.count),
            ngroups=m,
            count=np.tile(np.array(boxes.count, dtype=np.int32), (m, 1)),
            node_first=np.arange(m + 1, dtype=np.int64) * n,
            nodes=rows.astype(np.int32).ravel(),
        )
        return batch

    # forces -----------------------------------------------------------------------------------------
    def _scatter(self, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        block = values.shape[2]
        at = (rows[:, :, None] * block + np.arange(block)).ravel()
        sums = np.bincount(at, values.ravel(), minlength=len(self.nodes) * block)
        return sums.astype(float).reshape(-1, block)  # of nothing at all they are whole numbers

    def forces(self, x: np.ndarray, external: bool) -> np.ndarray:
        """Sum (nodes, b) of the forces that count as external, or of the others, on this rank."""
        out = np.zeros_like(x)
        for term, rows in zip(self.terms, self.rows, strict=True):
            if term.external == external:
                out += self._scatter(rows, term.forces(x[rows]))
        return out

    @property
    def external(self) -> bool:
        """Whether there are external forces; the same on all ranks."""
        return any(t.external for t in self.terms)

    def work(self, start: np.ndarray, end: np.ndarray) -> dict[str, float]:
        """Work (J) against the forces that don't count as external from one state of increments (nodes, b) to
        another, by the trapezoidal rule, by name. Collective."""
        out: dict[str, float] = {}
        for term, rows in zip(self.terms, self.rows, strict=True):
            if term.external:
                continue
            mean = 0.5 * (term.forces(start[rows]) + term.forces(end[rows]))
            work = float(np.sum(mean * (end - start)[rows]))
            out[term.name] = out.get(term.name, 0.0) + self.nodes.grid.comm.allreduce(work)
        return out

    def commit(self, x: np.ndarray) -> None:
        """Tell all terms the increments (nodes, b) of a converged step. Collective."""
        for term, rows in zip(self.terms, self.rows, strict=True):
            term.commit(x[rows])

    # tangent ----------------------------------------------------------------------------------------
    def bind(self, matrix: native.Matrix, fixed: np.ndarray) -> None:
        """Find the places of all entries in the values of a pattern's matrix.

        Rows and columns of prescribed unknowns, fixed (nodes, b), stay out, but for the diagonal; a symmetric
        matrix holds the upper triangle in the order of global numbers.
        """
        pairs = zip(self.terms, self.rows, strict=True)
        self._places = [self._find(term, rows, matrix, fixed.astype(bool)) for term, rows in pairs]

    def _find(self, term: Term, rows: np.ndarray, matrix: native.Matrix, fixed: np.ndarray) -> _Places:
        place, start = matrix.kept["place"], matrix.kept["row_start"]
        block, reach = fixed.shape[1], matrix.reach
        offset = term.boxes.offsets[None] - term.boxes.offsets[:, None] + reach  # [row][column]
        code = np.ravel_multi_index(tuple(np.moveaxis(offset, -1, 0)), (2 * reach + 1,) * offset.shape[-1])
        i, j = term.pairs.T
        row, column = rows[:, :, None, None], rows[:, None, :, None]
        diagonal = (row == column) & (i == j)
        kept = ~(fixed[row, i] | fixed[column, j]) | diagonal
        if matrix.symmetric:
            number = self.nodes.number
            kept &= (number[row] < number[column]) | ((row == column) & (i <= j))
        at = start[row * block + i] + place[row, code[None, :, :, None]].astype(np.int64) * block + j
        unique, inverse = np.unique(at[kept], return_inverse=True)
        return _Places(kept, unique, inverse.ravel())

    def add_tangents(self, x: np.ndarray, values: np.ndarray) -> None:
        """Add the tangents at increments (nodes, b) to the values of the bound matrix."""
        for term, rows, places in zip(self.terms, self.rows, self._places, strict=True):
            places.add(term, x[rows], values)

    def products(self, x: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Tangents at x times a direction, summed at the nodes of this rank, (nodes, b)."""
        out = np.zeros_like(x)
        for term, rows in zip(self.terms, self.rows, strict=True):
            out += self._scatter(rows, multiply(term.pairs, term.matrices(x[rows]), direction[rows]))
        return out
