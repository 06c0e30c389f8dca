"""A hierarchy of lattices as a preconditioner: one cycle of multigrid.

Coarse operators are P' A P, whatever A holds. On several ranks the finest level is shared, and each rank
relaxes its own rows; the coarser ones, an eighth of the unknowns in space, are the same on all of them. Nodes
at which there is hardly any of the body are solved for before and after the coarser levels, in double
precision: there are motions among them that hardly anything resists, and relaxation doesn't reduce.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from mpi4py import MPI

import numpy as np

from ..kernels import native
from .coarsening import PARENTS, Coarsening, Lines, coarsened
from .levels import BACKWARD, FORWARD, FROM_ZERO, LIFT, LINE, REST, Halo, Level, Part
from .linear import LatticeRows, SingularTangent

_COARSEST, _FEW = 8000, 500  # unknowns that are factored: at most, and such as aren't worth a coarser level
_THICK = 8  # nodes across a body: half of them still see it bend
_SHARED = 30_000  # unknowns of weak nodes that every rank factors; else each of its own ones
_ENCLOSED = 0.33  # share of the next nodes that are weak: a layer behind faces
_SHIFT = 1e-11  # of the coarsest diagonal


class Lattices:
    """A hierarchy of lattices; see `multigrid.Hierarchy`.

    Attributes:
        sweeps: of relaxation before and after coarser levels.
    """

    def __init__(self, lattice: LatticeRows, symmetric: bool):
        self._symmetric, self.sweeps = symmetric, 1
        self._comm = lattice.comm if lattice.comm.size > 1 else None
        self.weight = np.tile(lattice.as_force, len(lattice.nodes))
        self.halo: Halo | None = None
        offsets, cols = self._block_rows(lattice)
        owned, b = len(lattice.nodes), lattice.block
        rows = native.BlockRows()
        native.fill(
            rows,
            block=b,
            half=int(lattice.half),
            symmetric=int(symmetric),
            nodes=owned,
            offsets=offsets,
            cols=cols,
            row_start=np.ascontiguousarray(lattice.row_start),
            values=lattice.values,
        )
        columns = owned + (len(self.halo.numbers) if self.halo else 0)
        self.levels = [Level(rows, columns)]
        self._index: np.ndarray = lattice.nodes
        self._bring(lattice)
        self._find_weak(lattice)
        self._coarsest: Part | None = None
        self._product, self._factor = np.zeros(owned * b + LINE), np.zeros(columns * b + LINE)

    @property
    def finest(self) -> Level:
        return self.levels[0]

    def _block_rows(self, lattice: LatticeRows) -> tuple[np.ndarray, np.ndarray]:
        cols = lattice.columns
        if self._comm is not None:
            owned = len(lattice.nodes)
            start = self._comm.exscan(owned) or 0
            self.halo = Halo(self._comm, start, owned, cols)
            cols = self.halo.local
        return lattice.offsets, np.ascontiguousarray(cols, dtype=np.int32)

    def _bring(self, lattice: LatticeRows) -> None:
        """Coarser levels, without entries."""
        lines = tuple(Lines(a, lattice.between) for a in lattice.lines)
        index = np.ascontiguousarray(lattice.nodes, dtype=np.int64)
        known, reach, comm = index, lattice.reach, self._comm
        if comm is not None and self.halo is not None:
            known = np.concatenate(comm.allgather(index))
            index = np.concatenate([index, np.zeros((len(self.halo.numbers), index.shape[1]), np.int64)])
            self.halo.fill(index)
        self._index = index
        unknowns = len(known) * lattice.block
        most = min(_COARSEST, max(_FEW, unknowns // 4))
        while unknowns > most or comm is not None or (unknowns > _FEW and _thickness(index) >= _THICK):
            found = coarsened(lines, index, reach, known)
            if found is None and comm is not None:
                found = _same(lines, index, known, reach)
            if found is None:
                break
            self.levels.append(self.levels[-1].couple(found, comm))
            lines, index, reach, comm = found.lines, found.index, found.reach, None
            known = index
            unknowns = len(index) * lattice.block
        for level in self.levels:
            level.find_runs()
            if level is not self.levels[-1]:
                level.prepare()

    # weak nodes -------------------------------------------------------------------------------------
    def _find_weak(self, lattice: LatticeRows) -> None:
        level, weak = self.finest, lattice.weak()
        count = int(weak.sum())
        self._weak: Part | None = None
        total = self._comm.allreduce(count) if self._comm is not None else count
        self.any_weak = bool(total) and len(self.levels) > 1
        if not self.any_weak:
            return
        marked = np.zeros(level.columns, dtype=np.uint8)
        marked[: level.nodes] = weak
        if self.halo is not None:
            self.halo.fill(marked)
        cols, (row, _) = level.rows.kept["cols"], level.pairs
        if not lattice.equal:
            self._add_enclosed(marked, row, cols)
            weak = marked[: level.nodes] > 0
            count = int(weak.sum())
            total = self._comm.allreduce(count) if self._comm is not None else count
        near = marked[: level.nodes].astype(bool)
        near[row[marked[cols] > 0]] = True
        back = cols[(marked[row] > 0) & (cols < level.nodes)]
        near[back] = True
        self._near = np.flatnonzero(near).astype(np.int64)
        level.prepare_rest(near)
        self._rows = np.flatnonzero(weak).astype(np.int64)
        if self.halo is not None and total * level.block <= _SHARED:
            self._weak = Part(level, self._rows, self._symmetric, self.halo)
        elif count:
            self._weak = Part(level, self._rows, self._symmetric)

    def _add_enclosed(self, marked: np.ndarray, row: np.ndarray, cols: np.ndarray) -> None:
        """Mark (columns,) nodes of which a third of the next ones are weak, the second layer at faces: there
        splines of long cells oscillate, which relaxation hardly reduces. Collective."""
        next_ones = np.all(np.abs(self._index[row] - self._index[cols]) <= 1, axis=1) & (row != cols)
        a, b = row[next_ones], cols[next_ones]
        if self.finest.rows.half:  # of one rank
            a, b = np.concatenate([a, b]), np.concatenate([b, a])
        own = self.finest.nodes
        count = np.bincount(a, marked[b], len(marked))[:own]
        marked[:own] |= count > _ENCLOSED * (3 ** self._index.shape[1] - 1)
        if self.halo is not None:
            self.halo.fill(marked)

    def keep(self) -> None:
        """Take the rows as they are into the finest level and the weak nodes' part; coarser levels stay.

        Raises:
            SingularTangent: they have entries that are not finite, or the part can't be factored; on every
                rank.
        """
        self._on_all_ranks(self._renew_finest)
        self._on_all_ranks(lambda: None if self._weak is None else self._weak.renew(LIFT))

    def _on_all_ranks(self, work: Callable[[], None]) -> None:
        problem = ""
        try:
            work()
        except SingularTangent as e:
            problem = str(e)
        if self._comm is not None:
            problem = next((p for p in self._comm.allgather(problem) if p), "")
        if problem:
            raise SingularTangent(problem)

    def _correct_weak(self, b: np.ndarray) -> None:
        if not self.any_weak:
            return
        level = self.finest
        level.rest_of(self._rows, b, level.rest)
        if self._weak is not None:
            level.x[self._rows] += self._weak.solve(level.rest[self._rows])
        self._exchange(level)

    # entries ----------------------------------------------------------------------------------------
    def renew(self) -> None:
        """Take the rows as they are.

        Raises:
            SingularTangent: no hierarchy can be made of them; on every rank.
        """
        self.keep()
        comm = self._comm
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            fine.find_free(comm, self.halo if comm is not None else None)
            fine.coarsen(coarse, comm)
            if coarse is not self.levels[-1]:
                coarse.relaxation.kept["added"][:] = 0.0
                coarse.renew()
            comm = None
        self._renew_coarsest()

    def _renew_finest(self) -> None:
        level = self.finest
        if len(self.levels) == 1:
            return
        added = level.relaxation.kept["added"]
        added[:] = 0.0
        if self.halo is not None:
            size = np.zeros((level.columns, level.block))
            size[: level.nodes] = np.sqrt(np.abs(self.diagonal()))
            self.halo.fill(size)
            native.library().polarmpm_damp(ctypes.byref(level.rows), size, added)
        level.renew()

    def diagonal(self) -> np.ndarray:
        """Of the finest rows (nodes, block)."""
        level = self.finest
        kept, b = level.rows.kept, level.block
        own = level.relaxation.kept["own"].astype(np.int64)[:, None] * b + np.arange(b)
        found: np.ndarray = kept["values"][kept["row_start"].reshape(-1, b) + own]
        return found

    def _renew_coarsest(self) -> None:
        level = self.levels[-1]
        if self._coarsest is None:
            self._coarsest = Part(level, np.arange(level.nodes), self._symmetric)
        self._coarsest.renew(_SHIFT)

    def strengthen(self) -> None:
        """Relax twice."""
        self.sweeps = 2

    # cycle ------------------------------------------------------------------------------------------
    def _exchange(self, level: Level) -> None:
        if self.halo is not None and level is self.finest:
            self.halo.fill(level.x)

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """One cycle for the owned unknowns (n,); the next one overwrites what it returns. Collective."""
        level = self.finest
        self._cycle(0, np.ascontiguousarray(right).reshape(-1, level.block))
        found: np.ndarray = level.x[: level.nodes].reshape(-1)  # rows at the beginning: no copy
        return found

    def _cycle(self, number: int, b: np.ndarray) -> None:
        level = self.levels[number]
        if number == len(self.levels) - 1:
            assert self._coarsest is not None
            level.x[:] = self._coarsest.solve(b)
            return
        coarse, finest = self.levels[number + 1], number == 0
        level.relax(FROM_ZERO, b)
        self._exchange(level)
        for _ in range(self.sweeps - 1):
            level.relax(BACKWARD, b)
            self._exchange(level)
        if self.sweeps == 1:
            level.relax(REST, level.rest)
        else:
            level.product(level.x, level.rest)
            np.subtract(b, level.rest, out=level.rest)
        if finest and self.any_weak:
            kept = level.rest
            self._correct_weak(b)
            level.rest_of(self._near, b, kept)
        coarse.b[:] = 0.0
        transfer = level.nodes, level.block, ctypes.byref(level.transfer)
        native.library().polarmpm_restrict(*transfer, level.rest, coarse.b)
        if finest and self._comm is not None:
            self._comm.Allreduce(MPI.IN_PLACE, coarse.b)
        self._cycle(number + 1, coarse.b)
        native.library().polarmpm_prolong(*transfer, coarse.x, level.x)
        self._exchange(level)
        if finest:
            self._correct_weak(b)
        for k in range(self.sweeps):
            level.relax(FORWARD, b)
            if k < self.sweeps - 1:
                self._exchange(level)

    def product(self, x: np.ndarray) -> np.ndarray:
        """The finest rows times the owned unknowns (n,); the next product overwrites what it returns.
        Collective."""
        level = self.finest
        if self.halo is None:
            level.product(x, self._product)
        else:
            level.product(self._with_others(x), self._product)
        return self._product[: x.size]

    def quick_product(self, x: np.ndarray) -> np.ndarray:
        """The same with the rows in single precision, in half of the time."""
        if len(self.levels) == 1:
            return self.product(x)
        self.finest.quick_product(self._with_others(x), self._product)
        return self._product[: x.size]

    def _with_others(self, x: np.ndarray) -> np.ndarray:
        """Owned unknowns (n,) with those of other ranks behind them, and room for a vector. Collective."""
        self._factor[: x.size] = x
        if self.halo is not None:
            level = self.finest
            self.halo.fill(self._factor[: level.columns * level.block].reshape(level.columns, level.block))
        return self._factor

    def destroy(self) -> None:
        """Release PETSc's objects."""
        for part in (self._weak, self._coarsest):
            if part is not None:
                part.destroy()
        self._weak = self._coarsest = None


def _thickness(index: np.ndarray) -> float:
    """How many nodes (n, d), on the mean, follow one another along the axis along which these are fewest."""
    numbers = index.max(axis=0) + 2
    strides = np.array([int(np.prod(numbers[k + 1 :])) for k in range(len(numbers))], dtype=np.int64)
    known = np.sort((index + 1) @ strides)
    first = [int(np.isin(known - step, known, assume_unique=True, invert=True).sum()) for step in strides]
    return len(index) / max(first)


def _same(lines: tuple[Lines, ...], index: np.ndarray, known: np.ndarray, reach: int) -> Coarsening:
    """The same lattice once more, so that several ranks have a level that is the same on all of them."""
    strides = np.array(
        [int(np.prod([len(a.nodes) for a in lines[k + 1 :]])) for k in range(len(lines))], dtype=np.int64
    )
    unique = np.unique(known @ strides)
    found = np.stack([unique // s % len(a.nodes) for s, a in zip(strides, lines, strict=True)], axis=1)
    parents = np.full((len(index), PARENTS), -1, dtype=np.int32)
    parents[:, 0] = np.searchsorted(unique, index @ strides)
    weights = np.zeros((len(index), PARENTS))
    weights[:, 0] = 1.0
    return Coarsening(lines, found, parents, weights, reach)
