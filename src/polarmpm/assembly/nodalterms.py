"""The pieces of terms in a nodal system: their forces and tangents at its nodes (shapes: `terms.base`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import LocalFailure
from ..kernels import native
from ..terms.base import Boxes, BoxPairs, NodeSets, Piece, forces_of, matrices_of, multiply
from .condensed import Condensed, block_diagonal


@dataclass
class _Places:
    """Where a piece's entries go: `kept` ones of (m, n, n, k), in order, to `at[inverse]`."""

    kept: np.ndarray
    at: np.ndarray
    inverse: np.ndarray
    constant: np.ndarray | None = None

    def add(self, piece: Piece, x: np.ndarray, values: np.ndarray) -> None:
        sums = self.constant
        if sums is None:
            entries = np.broadcast_to(matrices_of(piece, x), self.kept.shape)[self.kept]
            sums = np.bincount(self.inverse, entries, minlength=len(self.at))
            self.constant = sums if piece.linear else None
        values[self.at] += sums


class NodalTerms:
    """Pieces of terms on the nodes of a system, and where their tangents stand in the sparse matrix."""

    def __init__(self, nodes: Any, pieces: Sequence[Piece], comm: MPI.Comm):
        self.nodes, self.pieces, self.comm = nodes, list(pieces), comm
        self.rows = [piece.boxes.rows(nodes) for piece in self.pieces]
        self._places: list[_Places] = []
        self._movers = list({id(p.mover): p.mover for p in self.pieces if p.mover is not None}.values())
        self._still = False

    def __len__(self) -> int:
        return len(self.pieces)

    def _parts(self) -> Iterator[tuple[Piece, np.ndarray]]:
        return zip(self.pieces, self.rows, strict=True)

    @property
    def symmetric(self) -> bool:
        """The sum of all tangents is symmetric."""
        return all(piece.symmetric for piece in self.pieces)

    @property
    def external(self) -> bool:
        """Whether there are external forces; the same on all ranks."""
        return any(piece.external for piece in self.pieces)

    @property
    def kinked(self) -> bool:
        """Whether tangents jump; the same on all ranks."""
        return any(piece.kinked for piece in self.pieces)

    # rigid bodies -----------------------------------------------------------------------------------
    def settle(self, x: np.ndarray) -> None:
        """Let rigid bodies go where forces on them are in balance at increments (nodes, b). Collective.

        Raises:
            LocalFailure: there is no such place.
        """
        for mover in () if self._still else self._movers:
            mover.settle(x, self._pushing(mover, x))

    def _pushing(self, mover: Any, x: np.ndarray) -> Iterator[Callable[[np.ndarray], Any]]:
        for piece, rows in self._parts():
            if piece.mover is mover:
                yield piece.pushing(x[rows])  # type: ignore[attr-defined]

    @contextmanager
    def as_they_are(self) -> Iterator[None]:
        """Rigid bodies stay where they are."""
        self._still = True
        try:
            yield
        finally:
            self._still = False

    def condensed(self, x: np.ndarray) -> Condensed | None:
        """What rigid bodies, whose places follow from increments x (nodes, b), add to the tangent.
        Collective."""
        movers = [mover for mover in self._movers if mover.follows]
        if not movers:
            return None
        inverse = block_diagonal([mover.inverse for mover in movers])
        sizes = [len(mover.moved) for mover in movers]
        starts = dict(zip(map(id, movers), np.cumsum([0, *sizes]), strict=False))
        to_nodes, to_bodies = (np.zeros((len(inverse), *x.shape)) for _ in range(2))
        for piece, rows in self._parts():
            if id(piece.mover) in starts:
                first = starts[id(piece.mover)]
                for out, values in zip((to_nodes, to_bodies), piece.coupling(x[rows]), strict=True):  # type: ignore[attr-defined]
                    for k in range(len(values)):
                        out[first + k] += self._scatter(rows, values[k])
        for column in to_nodes:
            self.nodes.add_to_owners(column)
        return Condensed(to_nodes, to_bodies, inverse, self.nodes.owned, self.comm)

    # forces -----------------------------------------------------------------------------------------
    def _scatter(self, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        block = values.shape[2]
        at = (rows[:, :, None] * block + np.arange(block)).ravel()
        sums = np.bincount(at, values.ravel(), minlength=len(self.nodes) * block)
        return sums.astype(float).reshape(-1, block)  # without any pieces they are integers

    def forces(self, x: np.ndarray, which: Callable[[Piece], bool]) -> np.ndarray:
        """Sum (nodes, b) of the forces of some pieces at increments (nodes, b), on this rank."""
        self.settle(x)
        out = np.zeros_like(x)
        for piece, rows in self._parts():
            if which(piece):
                out += self._scatter(rows, forces_of(piece, x[rows]))
        return out

    def work(self, start: np.ndarray, end: np.ndarray) -> dict[str, float]:
        """Work (J) against the forces that don't count as external from one state of increments (nodes, b) to
        another, by the trapezoidal rule, by name. Collective."""
        out: dict[str, float] = {}
        for piece, rows in self._parts():
            if not piece.external:
                mean = 0.5 * (forces_of(piece, start[rows]) + forces_of(piece, end[rows]))
                work = float(np.sum(mean * (end - start)[rows]))
                out[piece.name] = out.get(piece.name, 0.0) + self.comm.allreduce(work)
        return out

    def commit(self, x: np.ndarray) -> None:
        """Tell all pieces the increments (nodes, b) of a converged step. Collective."""
        self.settle(x)
        for piece, rows in self._parts():
            piece.commit(x[rows])

    def check_admitted(self, x: np.ndarray) -> None:
        """Raise LocalFailure if some piece has no forces at increments (nodes, b). Collective."""
        guarded = [(piece, rows) for piece, rows in self._parts() if piece.guarded]
        if not guarded:
            return
        self.settle(x)
        bad = [piece.name for piece, rows in guarded if not piece.admits(x[rows])]
        names = sorted({name for part in self.comm.allgather(bad) for name in part})
        if names:
            raise LocalFailure(f"{names[0]}: a place of the body has gone through it")

    def starts(self, x: np.ndarray) -> None:
        """Tell all pieces the increments (nodes, b) at which a step begins. Local."""
        for piece, rows in self._parts():
            piece.starts(x[rows])

    def balanced(self, x: np.ndarray) -> None:
        """Tell all pieces the increments (nodes, b) at which forces are in balance, before those of the
        step's end. Collective."""
        self.settle(x)
        for piece, rows in self._parts():
            piece.balanced(x[rows])
        for mover in self._movers:
            mover.freeze()

    def refine(self, x: np.ndarray) -> bool:
        """After iterations have converged at increments (nodes, b): whether pieces have improved their
        forces, so that iterations have to go on. Collective.

        Raises:
            LocalFailure: the solution can't be taken.
        """
        refining = [(piece, rows) for piece, rows in self._parts() if piece.refines]
        if not refining:
            return False
        self.settle(x)
        better, reasons = False, []
        for piece, rows in refining:
            try:
                better = piece.refine(x[rows]) or better
            except LocalFailure as e:
                reasons.append(str(e))
        answers = self.comm.allgather((better, reasons))
        reasons = [reason for _, part in answers for reason in part]
        if reasons:
            raise LocalFailure(reasons[0])
        if not any(one for one, _ in answers):
            return False
        for piece, _ in refining:
            piece.refined()
        return True

    # tangent ----------------------------------------------------------------------------------------
    def batches(self) -> list[native.Batch]:
        """The boxes of lattice nodes as `sparsity.build` reads them."""
        return [
            _batch(boxes, rows) for piece, all_rows in self._parts() for boxes, rows in _of(piece, all_rows)
        ]

    def crossing(self) -> np.ndarray:
        """Pairs of local nodes (k, 2) of different bodies that pieces couple, either way."""
        found: list[np.ndarray] = [np.zeros((0, 2), dtype=np.int64)]
        if not self.pieces:
            return found[0]
        for piece, rows in self._parts():
            if isinstance(piece.boxes, BoxPairs):
                n = int(np.prod(piece.boxes.parts[0].count))
                one, other = np.broadcast_arrays(rows[:, :n, None], rows[:, None, n:])
                pairs = np.stack([one.ravel(), other.ravel()], axis=1)
                found += [pairs, pairs[:, ::-1]]
        every: np.ndarray = np.unique(np.concatenate(found), axis=0)
        return every

    def bind(
        self,
        matrix: native.Matrix,
        fixed: np.ndarray,
        block_columns: Callable[[np.ndarray], np.ndarray] | None = None,
        crossing: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    ) -> None:
        """Find the places of all entries in the values of a pattern's matrix.

        Rows and columns of prescribed unknowns, fixed (nodes, b), stay out, but for the diagonal; a symmetric
        matrix holds the upper triangle in the order of global numbers.

        Args:
            block_columns: of sets of nodes (m, n), (m, n, n); None: they are boxes of lattice nodes.
            crossing: block columns of pairs of nodes of different bodies, by their rows.
        """
        held = fixed.astype(bool)
        self._places = []
        for piece, rows in self._parts():
            columns = block_columns(rows) if block_columns else _columns(piece, rows, matrix, crossing)
            self._places.append(self._find(piece, rows, matrix, held, columns))

    def _find(
        self, piece: Piece, rows: np.ndarray, matrix: native.Matrix, fixed: np.ndarray, columns: np.ndarray
    ) -> _Places:
        start, block = matrix.kept["row_start"], fixed.shape[1]
        i, j = piece.pairs.T
        row, column = rows[:, :, None, None], rows[:, None, :, None]
        diagonal = (row == column) & (i == j)
        kept = ~(fixed[row, i] | fixed[column, j]) | diagonal
        if matrix.symmetric:
            number = self.nodes.number
            kept &= (number[row] < number[column]) | ((row == column) & (i <= j))
        at = start[row * block + i] + columns[..., None].astype(np.int64) * block + j
        unique, inverse = np.unique(at[kept], return_inverse=True)
        return _Places(kept, unique, inverse.ravel())

    def add_tangents(self, x: np.ndarray, values: np.ndarray) -> None:
        """Add the tangents at increments (nodes, b) to the values of the bound matrix. Collective."""
        self.settle(x)
        for (piece, rows), places in zip(self._parts(), self._places, strict=True):
            places.add(piece, x[rows], values)

    def dense(self, x: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Local nodes (n,) of each set and its tangent (n b, n b) at increments (nodes, b). Collective."""
        self.settle(x)
        for piece, rows in self._parts():
            matrices = np.broadcast_to(
                matrices_of(piece, x[rows]), (*rows.shape, rows.shape[1], len(piece.pairs))
            )
            m, n, b = len(rows), rows.shape[1], x.shape[1]
            full = np.zeros((m, n, b, n, b))
            for k, (i, j) in enumerate(piece.pairs):
                full[:, :, i, :, j] += matrices[..., k]
            yield from zip(rows, full.reshape(m, n * b, n * b), strict=True)

    def products(
        self, x: np.ndarray, direction: np.ndarray, which: Callable[[Piece], bool] = lambda piece: True
    ) -> np.ndarray:
        """Tangents of some pieces at x times a direction, summed at the nodes of this rank, (nodes, b)."""
        self.settle(x)
        out = np.zeros_like(x)
        for piece, rows in filter(lambda part: which(part[0]), self._parts()):
            out += self._scatter(rows, multiply(piece.pairs, matrices_of(piece, x[rows]), direction[rows]))
        return out


def _of(piece: Piece, rows: np.ndarray) -> list[tuple[NodeSets, np.ndarray]]:
    """Boxes that a piece acts on, with their nodes' rows."""
    if not isinstance(piece.boxes, BoxPairs):
        return [(piece.boxes, rows)]
    n = int(np.prod(piece.boxes.parts[0].count))
    return list(zip(piece.boxes.parts, (rows[:, :n], rows[:, n:]), strict=True))


def _batch(boxes: NodeSets, rows: np.ndarray) -> native.Batch:
    assert isinstance(boxes, Boxes)
    m, n = rows.shape
    batch = native.Batch()
    native.fill(
        batch,
        dim=len(boxes.count),
        ngroups=m,
        count=np.tile(np.array(boxes.count, dtype=np.int32), (m, 1)),
        node_offsets=np.arange(m + 1, dtype=np.int64) * n,
        nodes=rows.astype(np.int32).ravel(),
    )
    return batch


def _columns(
    piece: Piece,
    rows: np.ndarray,
    matrix: native.Matrix,
    crossing: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
) -> np.ndarray:
    parts = _of(piece, rows)
    within = []
    for boxes, some in parts:
        assert isinstance(boxes, Boxes)
        within.append(columns_of_boxes(some, boxes.offsets, matrix))
    if len(parts) == 1:
        return within[0]
    assert crossing is not None
    (_, one), (_, other) = parts
    pair = np.broadcast_arrays(one[:, :, None], other[:, None])
    back = np.broadcast_arrays(other[:, :, None], one[:, None])
    return np.block([[within[0], crossing(*pair)], [crossing(*back), within[1]]])


def columns_of_boxes(rows: np.ndarray, offsets: np.ndarray, matrix: native.Matrix) -> np.ndarray:
    """Block columns (m, n, n), in each other's rows, of the nodes (m, n) of boxes, which stand at lattice
    distances `offsets` (n, d) from the boxes' lowest."""
    place, reach = matrix.kept["place"], matrix.reach
    offset = offsets[None] - offsets[:, None] + reach  # [row][column]
    code = np.ravel_multi_index(tuple(np.moveaxis(offset, -1, 0)), (2 * reach + 1,) * offset.shape[-1])
    columns: np.ndarray = place[rows[:, :, None], code[None]]
    return columns
