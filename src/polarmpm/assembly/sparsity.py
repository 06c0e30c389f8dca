"""Sparsity pattern of the tangent: which node pairs are coupled and where their blocks stand."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

from petsc4py import PETSc

import numpy as np

from ..geometry.grid import box_indices
from ..geometry.nodes import ActiveNodes, Nodes
from ..kernels import native
from ..solvers.linear import Rows
from ..tools.parallel import Route
from .patches import Patches

_CROSSING = -1  # code of a pair of nodes that no lattice distance tells


@dataclass
class Pattern:
    """Compressed sparse rows of the owned unknowns, and a buffer for rows of ghost nodes.

    Attributes:
        block: unknowns of a node.
        symmetric: rows hold their upper triangle only.
        indptr: where scalar rows of this rank begin.
        offsets, columns: of its block rows: where they begin, and their global block columns, ascending.
        values: entries of the owned rows, then the blocks of ghost rows.
        diagonal: positions of the diagonal entries.
    """

    nodes: Nodes
    block: int
    symmetric: bool
    indptr: np.ndarray
    offsets: np.ndarray
    columns: np.ndarray
    values: np.ndarray
    diagonal: np.ndarray
    matrix: native.Matrix
    route: Route | None = None
    ghost_order: np.ndarray | None = None  # entries of each ghost block in the buffer
    received_at: np.ndarray | None = None  # where entries of received blocks go; -1: nowhere
    halves: tuple[np.ndarray, ...] | None = None  # pairs of nodes, and their blocks in either's rows
    early: int = 0  # of these, the first ones that are mirrored at once; the others when they are asked for
    crossing: np.ndarray | None = None  # pairs of local nodes of different bodies, (k, 2), ascending
    crossing_columns: np.ndarray | None = None  # their block columns (k,)
    reached: np.ndarray | None = None  # nodes (nodes,) that something of this rank reaches; None: all
    _partial: bool = False

    def crossing_column(self, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        """Block columns of pairs of local nodes of different bodies, in the rows of the first ones; -1 where
        there are none."""
        count = max(len(self.nodes), 1)
        if self.crossing is None or self.crossing_columns is None or not len(self.crossing):
            return np.full(np.shape(row), -1, dtype=np.int64)
        keys, wanted = self.crossing @ np.array([count, 1]), row.astype(np.int64) * count + col
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        found: np.ndarray = np.where(keys[at] == wanted, self.crossing_columns[at], -1)
        return found

    @cached_property
    def indices(self) -> np.ndarray:
        """Columns of the scalar rows; multigrid on a lattice doesn't need them."""
        columns, block = np.empty(self.owned_entries, dtype=np.int32), self.block
        native.library().polarmpm_scalar_columns(
            len(self.offsets) - 1, self.offsets, self.columns, block, int(self.symmetric), columns
        )
        return columns

    @property
    def owned_entries(self) -> int:
        return int(self.indptr[-1])

    def petsc_matrix(self) -> PETSc.Mat:
        """Matrix of the owned rows; on one rank it uses the arrays of the pattern."""
        comm, kind = self.nodes.comm, ("SBAIJ" if self.symmetric else "AIJ")
        local, total = self.nodes.owned * self.block, self.nodes.total * self.block
        sizes = ((local, total), (local, total))
        rows = self.indptr.astype(np.int32), self.indices, self.values[: self.owned_entries]
        if not self.shared:
            return getattr(PETSc.Mat(), f"create{kind}")(sizes, 1, csr=rows, comm=comm)
        matrix = PETSc.Mat().create(comm)
        matrix.setSizes(sizes)
        _use_arrays(matrix, kind, rows)
        matrix.setAttr("rows", rows)  # to live as long
        return matrix

    def rows(self, matrix: Callable[[], PETSc.Mat]) -> Rows:
        """What they are on one rank; `matrix`: what `petsc_matrix` has made."""
        return Rows(self.block, self.indptr, lambda: self.indices, self.values, lambda: self.put(matrix()))

    @property
    def shared(self) -> bool:
        """Whether the matrix uses the entries of the pattern: on several ranks it keeps rows in two parts."""
        return self.nodes.comm.size == 1 and self._usual

    @property
    def _usual(self) -> bool:
        """Whether PETSc's numbers are those of the arrays."""
        return bool(PETSc.ScalarType == self.values.dtype and PETSc.IntType == np.int32)

    def put(self, matrix: PETSc.Mat) -> None:
        """Let the matrix that `petsc_matrix` has made have the entries as they are now. Collective."""
        self.complete()
        if matrix.getType() == "mpiaij" and self._usual:
            # what setValuesCSR does, without a search for each entry
            arguments = map(ctypes.c_void_p, (matrix.handle, self.values.ctypes.data))
            if _petsc().MatUpdateMPIAIJWithArray(*arguments):
                raise MemoryError("the matrix doesn't take the entries")
        elif not self.shared:
            rows = self.indptr.astype(np.int32), self.indices
            matrix.setValuesCSR(*rows, self.values[: self.owned_entries])
        matrix.assemble()
        matrix.stateIncrease()

    def release(self) -> None:
        """Give the memory of the entries back; there is no matrix any more."""
        self.values, self.columns = np.zeros(0), np.zeros(0, dtype=np.int64)
        vars(self).pop("indices", None)
        self.matrix.kept.clear()

    def mirror(self, whole: bool = True) -> None:
        """Complete whole rows by the half of the symmetric sums that hasn't been made; unless `whole`, only
        pairs with a ghost: blocks of owned pairs are the transposed ones of those behind the diagonal."""
        self._mirror(slice(0, None if whole else self.early))
        self._partial = not whole

    def complete(self) -> None:
        """What `mirror` has left out, of rows that have been collected."""
        if self._partial:
            self._mirror(slice(self.early, None))
            self._partial = False

    def _mirror(self, some: slice) -> None:
        if self.halves is not None:
            pairs = [a[some] for a in self.halves]
            native.library().polarmpm_mirror(ctypes.byref(self.matrix), self.block, len(pairs[0]), *pairs)

    def collect(self) -> None:
        """Add the rows of ghost nodes to their owners' rows. Collective."""
        if self.route is None or self.ghost_order is None or self.received_at is None:
            return
        received = self.route.forward(self.values[self.owned_entries :][self.ghost_order])
        end = 0
        for count in self.route.received:  # of a rank, which sends an entry once: no need for np.add.at
            rows, end = slice(end, end + int(count)), end + int(count)
            at, entries = self.received_at[rows], received[rows]
            if self.symmetric:
                at, entries = at[at >= 0], entries[at >= 0]
            self.values[at] += entries


@cache
def _petsc() -> ctypes.CDLL:
    """PETSc's own functions, for what petsc4py has none."""
    return ctypes.CDLL(PETSc.__file__)


def _use_arrays(matrix: PETSc.Mat, kind: str, rows: tuple[np.ndarray, ...]) -> None:
    """Make an empty matrix on one rank one whose pointers, columns and entries are `rows`."""
    petsc = _petsc()
    handle, comm, made = (ctypes.c_void_p(h) for h in (matrix.handle, 0, 0))
    sizes = [ctypes.c_int32(n) for n in matrix.getLocalSize()]
    if kind == "SBAIJ":
        sizes = [ctypes.c_int32(1), *sizes]
    failed = petsc.PetscObjectGetComm(handle, ctypes.byref(comm)) or getattr(
        petsc, f"MatCreateSeq{kind}WithArrays"
    )(comm, *sizes, *(ctypes.c_void_p(a.ctypes.data) for a in rows), ctypes.byref(made))
    if failed or petsc.MatHeaderReplace(handle, ctypes.byref(made)):
        raise MemoryError("PETSc can't make a matrix of arrays")


def build(
    nodes: ActiveNodes,
    batches: Sequence[native.Batch],
    block: int,
    symmetric: bool,
    reach: int,
    whole: bool = False,
    patches: Sequence[Patches] = (),
    crossing: np.ndarray | None = None,
) -> Pattern:
    """Pattern of the node sets of all batches and patches. Collective.

    Args:
        symmetric: the sums over the points are; rows hold their upper triangle only, unless `whole`. Then
            `Pattern.mirror` has to be called once they are made.
        reach: the largest lattice distance of two nodes of one set.
        crossing: pairs of local nodes (k, 2) of different bodies that are coupled, too, ascending.
    """
    half, symmetric = symmetric, symmetric and not whole
    grid, side = nodes.grid, 2 * reach + 1
    codes = side**grid.dim
    mark = np.zeros((len(nodes), codes), dtype=np.uint8)
    for batch in batches:
        native.library().polarmpm_couple_nodes(ctypes.byref(batch), reach, mark)
    for patch in patches:
        patch.couple(reach, mark)
    reached: np.ndarray = np.any(mark, axis=1)
    mark[: nodes.owned, codes // 2] = 1  # nodes of a term that is gone have no more than themselves
    alone = nodes.comm.size == 1  # then numbers ascend with the lattice's
    if symmetric and alone:
        mark[:, : codes // 2] = 0
    row, code = np.divmod(np.flatnonzero(mark), codes)
    offset = box_indices((side,) * grid.dim) - reach
    col = nodes.local(nodes.lattice[row] + (offset @ grid.strides)[code])
    if symmetric and not alone:
        keep = nodes.number[row] <= nodes.number[col]
        row, code, col = row[keep], code[keep], col[keep]
    pairs: tuple[np.ndarray, ...] = row, code, col
    if crossing is not None and len(crossing):
        a, b = crossing.T
        if symmetric:
            a, b = crossing[nodes.number[a] <= nodes.number[b]].T
        pairs = tuple(map(np.concatenate, ((row, a), (code, np.full(len(a), _CROSSING)), (col, b))))
        order = np.argsort(pairs[0], kind="stable")
        pairs = tuple(p[order] for p in pairs)
    pattern = of_pairs(nodes, block, symmetric, reach, codes, pairs)
    native.fill(pattern.matrix, half=int(half))
    pattern.reached = reached
    if half and whole:
        later = np.flatnonzero(code >= codes // 2)  # in the order of a group's nodes, or the same node
        inside = (row[later] < nodes.owned) & (col[later] < nodes.owned) & (row[later] != col[later])
        later = np.concatenate([later[~inside], later[inside]])
        pattern.early = len(later) - int(inside.sum())
        row, code, col = (a[later].astype(np.int32) for a in (row, code, col))
        place = pattern.matrix.kept["place"]
        pattern.halves = row, col, place[row, code], place[col, codes - 1 - code]
    return pattern


def of_pairs(
    nodes: Nodes, block: int, symmetric: bool, reach: int, codes: int, local: tuple[np.ndarray, ...]
) -> Pattern:
    """Pattern of the pairs of nodes of all ranks. Collective.

    Args:
        symmetric: rows hold their upper triangle only.
        codes: by how many numbers a node's neighbours are told apart.
        local: this rank's pairs: row, code of the column in it, column; sorted by row.
    """
    row, code, col = local
    if nodes.comm.size == 1 and code.min(initial=0) != _CROSSING and _in_order(row, col):
        return _alone(nodes, block, symmetric, reach, codes, local)
    mine = row < nodes.owned
    pairs = np.stack([nodes.number[row[mine]], nodes.number[col[mine]]], axis=1)
    route, ghost_pairs = None, np.zeros((0, 2), dtype=np.int64)
    if nodes.comm.size > 1:
        route = Route(nodes.comm, nodes.owner[row[~mine]])
        sent = np.stack([nodes.number[row[~mine]], nodes.number[col[~mine]]], axis=1)
        ghost_pairs = route.forward(sent)
        pairs = np.concatenate([pairs, ghost_pairs])
    total = max(nodes.total, 1)
    pairs = np.stack(np.divmod(np.unique(pairs[:, 0] * total + pairs[:, 1]), total), axis=1)
    return _assemble_pattern(
        nodes, block, symmetric, reach, codes, (row, code, col, mine), pairs, route, ghost_pairs
    )


def _in_order(row: np.ndarray, col: np.ndarray) -> bool:
    """Whether pairs of nodes, sorted by row, ascend."""
    return bool(np.all((col[1:] > col[:-1]) | (row[1:] > row[:-1])))


def _alone(
    nodes: Nodes, block: int, symmetric: bool, reach: int, codes: int, local: tuple[np.ndarray, ...]
) -> Pattern:
    """The same on one rank, of pairs that are in order."""
    row, code, col = local
    offsets = np.zeros(len(nodes) + 1, dtype=np.int64)
    np.cumsum(np.bincount(row, minlength=len(nodes)), out=offsets[1:])
    indptr = _scalar_rows(offsets, block, symmetric)
    starts = indptr[:-1]
    if symmetric:  # see `_assemble_pattern`
        starts = (starts.reshape(-1, block) - np.arange(block)).ravel()
    column = np.arange(len(row)) - offsets[row]
    if symmetric:
        diagonal = indptr[:-1].copy()
    else:
        own = column[row == col] * block
        diagonal = (indptr[:-1].reshape(-1, block) + own[:, None] + np.arange(block)).ravel()
    place = np.full((len(nodes), codes), -1, dtype=np.int32)
    place[row, code] = column
    values = np.zeros(int(indptr[-1]))
    cols = np.ascontiguousarray(col, dtype=np.int64)
    pattern = Pattern(nodes, block, symmetric, indptr, offsets, cols, values, diagonal, native.Matrix())
    _bind(pattern, reach, place, starts)
    return pattern


def _assemble_pattern(
    nodes: Nodes,
    block: int,
    symmetric: bool,
    reach: int,
    codes: int,
    local: tuple[np.ndarray, ...],
    pairs: np.ndarray,
    route: Route | None,
    ghost_pairs: np.ndarray,
) -> Pattern:
    row, code, col, mine = local
    total = max(nodes.total, 1)
    keys = pairs[:, 0] * total + pairs[:, 1]
    offsets = np.searchsorted(pairs[:, 0], nodes.start + np.arange(nodes.owned + 1)).astype(np.int64)
    indptr = _scalar_rows(offsets, block, symmetric)
    # owned rows: block column k of node I starts at indptr of its scalar row, less the part below the
    # diagonal that the upper triangle leaves out
    trim = np.tile(np.arange(block) if symmetric else np.zeros(block, dtype=np.int64), nodes.owned)
    starts = np.zeros(len(nodes) * block, dtype=np.int64)
    starts[: nodes.owned * block] = indptr[:-1] - trim
    place = np.full((len(nodes), codes), -1, dtype=np.int32)
    at = np.searchsorted(keys, nodes.number[row[mine]] * total + nodes.number[col[mine]])
    column = np.zeros(len(row), dtype=np.int64)
    column[mine] = at - offsets[row[mine]]
    # ghost rows: full blocks, each contiguous, in the order in which they are listed
    ghosts = np.flatnonzero(~mine)
    count = len(ghosts)
    values = np.zeros(int(indptr[-1]) + count * block * block)
    pattern = Pattern(
        nodes,
        block,
        symmetric,
        indptr,
        offsets,
        np.ascontiguousarray(pairs[:, 1], dtype=np.int64),
        values,
        _diagonal(offsets, pairs, nodes, indptr, block, symmetric),
        native.Matrix(),
    )
    if route is not None:
        pattern.route = route
        pattern.ghost_order, column[ghosts] = _place_ghosts(pattern, row[ghosts], starts)
        pattern.received_at = _received_positions(pattern, ghost_pairs, keys, offsets, total)
    near, far = code != _CROSSING, code == _CROSSING
    place[row[near], code[near]] = column[near]
    apart = np.stack([row[far], col[far]], axis=1)
    order = np.lexsort(apart.T[::-1])
    pattern.crossing, pattern.crossing_columns = apart[order], column[far][order]
    _bind(pattern, reach, place, starts)
    return pattern


def _bind(pattern: Pattern, reach: int, place: np.ndarray, starts: np.ndarray) -> None:
    """Tell the compiled sums where a pattern's entries are."""
    native.fill(
        pattern.matrix,
        symmetric=int(pattern.symmetric),
        reach=reach,
        place=place,
        row_start=starts,
        number=np.ascontiguousarray(pattern.nodes.number, dtype=np.int64),
        values=pattern.values,
    )


def _scalar_rows(offsets: np.ndarray, block: int, symmetric: bool) -> np.ndarray:
    """Where scalar rows of block rows begin, in symmetric ones with the diagonal first."""
    nodes = len(offsets) - 1
    lengths = np.empty((nodes, block), dtype=np.int64)
    lengths[:] = (np.diff(offsets) * block)[:, None]
    if symmetric:
        lengths -= np.arange(block)
    indptr = np.zeros(nodes * block + 1, dtype=np.int64)
    np.cumsum(lengths.ravel(), out=indptr[1:])
    return indptr


def _diagonal(
    offsets: np.ndarray,
    pairs: np.ndarray,
    nodes: Nodes,
    indptr: np.ndarray,
    block: int,
    symmetric: bool,
) -> np.ndarray:
    if symmetric:
        return indptr[:-1].copy()
    own = np.flatnonzero(pairs[:, 0] == pairs[:, 1])
    k = own - offsets[:-1]
    component = np.tile(np.arange(block), nodes.owned)
    at: np.ndarray = indptr[:-1] + np.repeat(k * block, block) + component
    return at


def _place_ghosts(pattern: Pattern, row: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Address the blocks of ghost rows; a node's row of k blocks is an array [component][k][component].

    Returns the positions in the buffer of each block's entries, (blocks, block * block), and the block
    columns.
    """
    block, base = pattern.block, pattern.owned_entries
    unique, begin, count = np.unique(row, return_index=True, return_counts=True)
    k = np.arange(len(row)) - np.repeat(begin, count)
    for c in range(block):
        starts[unique * block + c] = base + begin * block * block + c * count * block
    start = np.repeat(begin * block * block, count) + k * block
    length = np.repeat(count * block, count)
    i, j = np.divmod(np.arange(block * block), block)
    positions: np.ndarray = start[:, None] + length[:, None] * i + j
    return positions, k


def _received_positions(
    pattern: Pattern, pairs: np.ndarray, keys: np.ndarray, offsets: np.ndarray, total: int
) -> np.ndarray:
    """Where entries of received blocks go in the owned rows, (blocks, block * block); -1: left out."""
    block, nodes = pattern.block, pattern.nodes
    row = pairs[:, 0] - nodes.start
    k = np.searchsorted(keys, pairs[:, 0] * total + pairs[:, 1]) - offsets[row]
    i, j = np.divmod(np.arange(block * block), block)
    at: np.ndarray = pattern.indptr[(row[:, None] * block + i)] + k[:, None] * block + j
    if pattern.symmetric:
        at = np.where((pairs[:, 0] == pairs[:, 1])[:, None] & (j < i), -1, at - i)
    return at
