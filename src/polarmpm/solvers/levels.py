"""The levels of multigrid on a lattice: rows, their relaxation, and what leads to the next coarser one."""

from __future__ import annotations

import ctypes
from typing import Any

from mpi4py import MPI

import numpy as np

from ..kernels import native, structures
from ..tools.parallel import Route
from .coarsening import Coarsening
from .factors import Factor
from .linear import SingularTangent

LIFT = 1e-6  # of blocks' diagonals that are inverted, and of weak nodes', which may be singular
LINE = structures.constant("_rows.h", "LINE")  # numbers of a vector in single precision
PIECE = structures.constant("_rows.h", "PIECE")  # in double precision
INVERSE = structures.constant("_rows.h", "INVERSE_MAX")  # numbers of a padded column of a block's inverse
FROM_ZERO, BACKWARD, FORWARD, REST = range(4)  # kinds of sweeps


def _aligned(n: int) -> np.ndarray:
    """Memory for n numbers in single precision, from a cache line's beginning."""
    whole: np.ndarray = np.empty(n + 16, dtype=np.float32)
    start = (-whole.ctypes.data // 4) % 16
    return whole[start : start + n]


class Halo:
    """Columns of other ranks. Collective."""

    def __init__(self, comm: MPI.Comm, start: int, owned: int, columns: np.ndarray):
        self.comm, self.owned = comm, owned
        starts = np.array(comm.allgather(start + owned))
        other = columns[(columns < start) | (columns >= start + owned)]
        self.numbers = np.unique(other)
        self._route = Route(comm, np.searchsorted(starts, self.numbers, side="right"))
        self._rows = self._route.forward(self.numbers) - start
        self.local = np.where(
            (columns >= start) & (columns < start + owned),
            columns - start,
            owned + np.searchsorted(self.numbers, columns),
        )

    def fill(self, values: np.ndarray) -> None:
        """Rows of other ranks behind the owned ones, (nodes, ...). Collective."""
        values[self.owned :] = self._route.backward(values[self._rows])


class Level:
    """A matrix on a lattice, its relaxation, and what leads to the next coarser one."""

    def __init__(self, rows: native.BlockRows, columns: int):
        self.rows, self.columns, self.block = rows, columns, int(rows.block)
        self.nodes = int(rows.nodes)
        self.relaxation, self.transfer = native.Relaxation(), native.Transfer()
        self.x, self.b = np.zeros((columns, self.block)), np.zeros((self.nodes, self.block))
        self.rest = np.zeros((self.nodes, self.block))
        self.free = np.ones((columns, self.block), dtype=np.uint8)

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each block its row, and which one of the row's it is."""
        offsets = self.rows.kept["offsets"]
        row = np.repeat(np.arange(self.nodes), np.diff(offsets))
        return row, (np.arange(len(row)) - offsets[row]).astype(np.int32)

    # relaxation -----------------------------------------------------------------------------------
    def find_runs(self) -> None:
        """Find the neighbours before and after each node, by runs of columns; products need no more."""
        rows, library = ctypes.byref(self.rows), native.library()
        own = np.empty(self.nodes, dtype=np.int32)
        library.polarmpm_own_blocks(rows, own)
        native.fill(self.relaxation, symmetric=int(self.rows.symmetric), own=own)
        for side, behind in (("up", 1), ("low", 0)):
            first, start = (np.empty(self.nodes + 1, dtype=np.int64) for _ in range(2))
            library.polarmpm_runs(rows, behind, first, start, None, None, None)
            of_runs = [np.empty(int(first[-1]), dtype=np.int32) for _ in range(3)]
            library.polarmpm_runs(rows, behind, first, start, *of_runs)
            names = ("", "_start", "_cols", "_at", "_long")
            found = zip(names, (first, start, *of_runs), strict=True)
            native.fill(self.relaxation, **{side + name: values for name, values in found})

    def prepare(self) -> None:
        """Make room for the rows of relaxation; after `find_runs`."""
        b, kept = self.block, self.relaxation.kept
        given = self.nodes * b + LINE if self.rows.symmetric else 0
        line = INVERSE if b > PIECE else PIECE
        native.fill(
            self.relaxation,
            up_rows=_aligned(int(kept["up_start"][-1])),
            low_rows=_aligned(int(kept["low_start"][-1])),
            given=np.zeros(given, dtype=np.float32),
            single=np.zeros(self.columns * b + LINE, dtype=np.float32),
            own_rows=np.zeros(self.nodes * b * line, dtype=np.float32),
            inverse=np.zeros(self.nodes * b * line, dtype=np.float32),
            added=np.zeros(self.nodes * b),
        )

    def prepare_rest(self, wanted: np.ndarray) -> None:
        """Find what `rest_of` needs of symmetric rows, in those (nodes,) bool that it is asked for; others
        have all."""
        if not self.rows.symmetric:
            return
        cols, (row, at) = self.rows.kept["cols"], self.pairs
        early = np.flatnonzero((cols > row) & (cols < self.nodes))
        early = early[wanted[cols[early]]]
        early = early[np.argsort(cols[early], kind="stable")]
        counts = np.bincount(cols[early], minlength=self.nodes)
        native.fill(
            self.relaxation,
            early=np.concatenate([[0], np.cumsum(counts)]),
            early_cols=row[early].astype(np.int32),
            early_at=np.ascontiguousarray(at[early]),
        )

    @property
    def _both(self) -> tuple[Any, Any]:
        return ctypes.byref(self.rows), ctypes.byref(self.relaxation)

    def renew(self) -> None:
        """Take the rows as they are.

        Raises:
            SingularTangent: they have entries that are not finite.
        """
        if native.library().polarmpm_relaxation(*self._both, LIFT):
            raise SingularTangent("the tangent has entries that are not finite")

    def relax(self, how: int, b: np.ndarray) -> None:
        """A sweep over x for b (nodes, block); `REST` writes what is left into b."""
        native.library().polarmpm_relax(*self._both, how, self.columns, b, self.x)

    def rest_of(self, rows: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
        """b - A x in some rows, in double precision; of symmetric ones in those of `prepare_rest`."""
        native.library().polarmpm_rest(*self._both, len(rows), rows, b, self.x, out)

    def product(self, x: np.ndarray, out: np.ndarray) -> None:
        """A x; x with the columns of other ranks."""
        native.library().polarmpm_block_product(*self._both, x, out)

    def quick_product(self, x: np.ndarray, out: np.ndarray) -> None:
        """The same with the rows of relaxation, in single precision. Behind x and `out` there is room for
        LINE numbers."""
        native.library().polarmpm_quick_product(*self._both, x, out)

    # coarser --------------------------------------------------------------------------------------
    def couple(self, to: Coarsening, comm: MPI.Comm | None) -> Level:
        """The coarser level, without entries. Collective where there is `comm`."""
        dim, count = to.index.shape[1], len(to.index)
        side = 2 * to.reach + 1
        steps = np.array([side ** (dim - 1 - k) for k in range(dim)], dtype=np.int64)
        lin = to.index.astype(np.int64) @ steps
        codes, centre = side**dim, int(to.reach * steps.sum())
        native.fill(
            self.transfer,
            parents=np.ascontiguousarray(to.parents),
            weights=np.ascontiguousarray(to.weights),
            free=self.free,
            lin=lin,
            codes=codes,
            centre=centre,
        )
        mark = np.zeros((count, codes), dtype=np.uint8)
        native.library().polarmpm_couple_parents(ctypes.byref(self.rows), ctypes.byref(self.transfer), mark)
        mark[:, centre] = 1
        if comm is not None:
            comm.Allreduce(MPI.IN_PLACE, mark, op=MPI.MAX)
        row, code = np.nonzero(mark)
        counts = np.bincount(row, minlength=count)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        at = np.arange(len(row)) - offsets[row]
        place = np.full((count, codes), -1, dtype=np.int32)
        place[row, code] = at
        native.fill(self.transfer, place=place)
        away = np.stack([code // s % side for s in steps], axis=1) - to.reach
        other = to.index[row] + away
        strides = np.array(
            [int(np.prod(to.index.max(axis=0)[k + 1 :] + 1)) for k in range(dim)], dtype=np.int64
        )
        cols = np.searchsorted(to.index @ strides, other @ strides).astype(np.int32)
        b, rows = self.block, native.BlockRows()
        line = np.repeat(counts, b) * b
        start = np.concatenate([[0], np.cumsum(line)])
        native.fill(
            rows,
            block=b,
            half=int(self.rows.symmetric),
            symmetric=int(self.rows.symmetric),
            nodes=count,
            offsets=offsets,
            cols=cols,
            row_start=start[:-1].copy(),
            values=np.zeros(int(start[-1])),
        )
        return Level(rows, count)

    def find_free(self, comm: MPI.Comm | None, halo: Halo | None) -> None:
        """Unknowns that are coupled with others: what isn't, as prescribed ones, needs no coarser level."""
        self.free[...] = 0
        native.library().polarmpm_coupled(ctypes.byref(self.rows), self.free)
        if halo is not None:
            halo.fill(self.free)

    def coarsen(self, coarse: Level, comm: MPI.Comm | None) -> None:
        """Entries of the coarser level. Collective where there is `comm`."""
        values = coarse.rows.kept["values"]
        values[:] = 0.0
        arguments = (ctypes.byref(a) for a in (self.rows, self.transfer, coarse.rows))
        if native.library().polarmpm_coarsen(*arguments):
            raise MemoryError("no memory for coarser levels")
        if comm is not None:
            comm.Allreduce(MPI.IN_PLACE, values)


class Part:
    """Some nodes' own part of a level's matrix, factored; with a halo those of all ranks, on each of them.

    Args:
        chosen: the nodes of this rank (m,), ascending.
        halo: of the columns, where the part is that of all ranks together. Collective then.
    """

    def __init__(self, level: Level, chosen: np.ndarray, symmetric: bool, halo: Halo | None = None):
        kept, b = level.rows.kept, level.block
        self._values, self._comm = kept["values"], None if halo is None else halo.comm
        self._first, self._own = 0, len(chosen) * b
        number = np.full(level.columns, -1, dtype=np.int64)
        if halo is not None:
            self._first = halo.comm.exscan(len(chosen)) or 0
        number[chosen] = self._first + np.arange(len(chosen))
        if halo is not None:
            halo.fill(number)
        row, at = level.pairs
        cols = kept["cols"]
        inside = (number[row] >= 0) & (number[cols] >= (number[row] if symmetric else 0))
        row, at, cols = (a[inside][:, None] for a in (row, at, cols))
        i, j = (a.ravel() for a in np.divmod(np.arange(b * b), b))
        where = kept["row_start"][row * b + i] + at.astype(np.int64) * b + j
        r, c = number[row] * b + i, number[cols] * b + j
        keep = (c >= r) if symmetric else np.ones(c.shape, dtype=bool)
        self._where, r, c = where[keep], r[keep], c[keep]
        size = self._own
        if self._comm is not None:
            r, c = (np.concatenate(self._comm.allgather(a)) for a in (r, c))
            size = self._comm.allreduce(size)
        self._order = np.lexsort((c, r))
        r, c = r[self._order], c[self._order]
        self._diagonal, self._entries = np.flatnonzero(r == c), np.zeros(len(c))
        counts = np.bincount(r, minlength=size)
        self._factor = Factor(np.concatenate([[0], np.cumsum(counts)]), c, self._entries, symmetric)

    def _all(self, values: np.ndarray) -> np.ndarray:
        """Values (n,) of all ranks."""
        if self._comm is None:
            return values
        counts = self._comm.allgather(len(values))
        out = np.empty(sum(counts))
        self._comm.Allgatherv(np.ascontiguousarray(values), [out, counts])
        return out

    def renew(self, lift: float) -> None:
        """Factor the entries as they are, the diagonal raised by `lift` of it.

        Raises:
            SingularTangent: that is not possible.
        """
        np.take(self._all(self._values[self._where]), self._order, out=self._entries)
        own = self._entries[self._diagonal]
        self._entries[self._diagonal] = np.where(own == 0.0, 1.0, own * (1.0 + lift))
        self._factor.renew()

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution (m, block) for (m, block)."""
        found = self._factor.solve(self._all(right.ravel()))
        first = self._first * right.shape[1]
        return found[first : first + self._own].reshape(right.shape)

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._factor.destroy()
