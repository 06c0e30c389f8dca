"""Inertia of the points: forces on the nodes, and the consistent mass matrix as entries of a pattern.

Each point has a mass for the displacements and one for the rotations. The matrix, sum of m N_i N_j, is
constant between two resets and summed once; a step scales it, and forces are its products with increments.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..geometry.grid import box_indices
from ..kernels import native
from ..kernels.kernel import Kernel
from .nodalterms import columns_of_boxes

_CHUNK = 1 << 21  # entries of products of weighting functions that are made at a time


class MassSets(NamedTuple):
    """Sets of nodes of the same size whose points have their weights there.

    Attributes:
        rows: local nodes (m, n).
        columns: block columns of the nodes in each other's rows (m, n, n).
        matrices: sums of the points' masses, or other values, times two functions, (k, m, n, n).
    """

    rows: np.ndarray
    columns: np.ndarray
    matrices: np.ndarray


class Inertia:
    """Inertia of a system's points in a step.

    Args:
        mass: masses (kg) and moments of inertia (kg m^2) of this rank's points (np, block).
        kernels: `gyration_kernel` and `momentum_kernel` of `forms.gyration`, of points whose inertia isn't
            alike in all directions.

    Attributes:
        tensors: their moments of inertia (np, 3, 3) at the beginning of the step, in space.
        scale: by which masses are multiplied (1/s^2), c of `kinematics.timesteps`.
        start: values (np, block) of the increments at the points when the step begins.
    """

    def __init__(self, mass: np.ndarray, kernels: tuple[Kernel, Kernel] | None = None):
        self.mass, self.scale, self.theta = mass, 0.0, 1.0
        self.kernels, self.tensors = kernels, np.zeros((len(mass), 3, 3))
        self.start = np.zeros_like(mass)
        self._matrix: NodalMasses | None = None
        self._entries: np.ndarray | None = None
        # increments (nodes, block), which are never written to: when the step began, and the last ones at
        # which something was asked for
        self._began: np.ndarray | None = None
        self._values: tuple[np.ndarray, np.ndarray] | None = None
        self._forces: tuple[np.ndarray, np.ndarray] | None = None

    def begin(self, system: Any, scale: float, theta: float = 1.0, tensors: np.ndarray | None = None) -> None:
        """A step begins at the system's increments; theta: where in it forces are in balance."""
        if tensors is not None:
            self.tensors, self.theta = tensors, theta
        self.scale, self._began = scale, system.x
        self.start = self._at_points(system)
        self._forces = system.x, np.zeros_like(system.x)

    def _at_points(self, system: Any) -> np.ndarray:
        """The increments at the points (np, block)."""
        if self._values is None or self._values[0] is not system.x:
            self._values = system.x, system.at_points(system.x)
        return self._values[1]

    def moved(self, system: Any) -> np.ndarray:
        """What the points' increments (np, block) have gained since the start of the step."""
        gained: np.ndarray = self._at_points(system) - self.start
        return gained

    def gained(self, system: Any) -> np.ndarray:
        """What the nodes' increments (nodes, block) have gained since the start of the step."""
        assert self._began is not None
        gained: np.ndarray = system.x - self._began
        return gained

    def forces(self, system: Any) -> np.ndarray:
        """Forces (nodes, block) in which the increments since the start of the step take part, complete on
        owned rows. Collective."""
        if self._forces is None or self._forces[0] is not system.x:
            turned = None if self.kernels is None else self._turning(system)[0]
            self._forces = system.x, self._times(system, self.gained(system), turned)
        return self._forces[1]

    def products(self, system: Any, direction: np.ndarray) -> np.ndarray:
        """The matrix times a direction (nodes, block), complete on owned rows. Collective."""
        turned = None
        if self.kernels is not None:
            at_points = system.at_points(direction)
            turned = np.einsum("nij,nj->ni", self._turning(system)[1], at_points[:, -3:])
        return self._times(system, direction, turned)

    def _times(self, system: Any, direction: np.ndarray, turned: np.ndarray | None) -> np.ndarray:
        """The matrix times a direction (nodes, block); couples of points whose inertia isn't alike in all
        directions are `turned` (np, 3). Collective."""
        out: np.ndarray = self.scale * self._masses(system).times(direction, system.layout.dim)
        system.nodes.add_to_owners(out)
        if turned is not None:
            values = np.zeros_like(self.mass)
            values[:, -3:] = turned
            out[:, -3:] = system.from_points(values)[:, -3:]
        return out

    def _masses(self, system: Any) -> NodalMasses:
        if self._matrix is None:
            d, block = system.layout.dim, system.layout.block
            some = 1 if self.kernels is not None or block == d else 2
            self._matrix = NodalMasses.of(system, self.mass[:, [0, block - 1]][:, :some])
        return self._matrix

    def _turning(self, system: Any) -> tuple[np.ndarray, np.ndarray]:
        """What the inertia of the points' turns in the step does (np, 3), and its derivative (np, 3, 3)."""
        assert self.kernels is not None
        n = len(self.mass)
        numbers = np.tile((self.scale, self.theta), (n, 1))
        out = np.zeros((0, 12))
        if n:
            out = self.kernels[0](self.moved(system)[:, -3:], self.tensors.reshape(n, 9), numbers)
        return out[:, :3], out[:, 3:].reshape(n, 3, 3)

    def summed(self, turn: np.ndarray) -> np.ndarray:
        """Integrals (np, 3) of the momenta of points' spins over a step in which they turn by vectors (np,
        3), where inertia isn't alike in all directions."""
        assert self.kernels is not None
        if not len(turn):
            return np.zeros((0, 3))
        found: np.ndarray = self.kernels[1](turn, self.tensors.reshape(-1, 9))[:, :3]
        return found

    def add_tangent(self, system: Any) -> None:
        """Add the matrix to the entries of the system's pattern."""
        d, block = system.layout.dim, system.layout.block
        if self._entries is None:
            kinds = [[(i, i) for i in range(d)], [(i, i) for i in range(d, block)]]
            masses = self._masses(system)
            self._entries = masses.entries(system, kinds[: len(masses.sums)])
        system.pattern.values += self.scale * self._entries
        if self.kernels is not None:
            pairs = [[(d + i, d + j)] for i in range(3) for j in range(3)]
            slopes = self._turning(system)[1]
            turning = NodalMasses.of(system, slopes.reshape(len(slopes), 9))
            system.pattern.values += turning.entries(system, pairs)


class NodalMasses(NamedTuple):
    """Sums of points' masses, or other values, times two functions, for pairs of this rank's nodes; for half
    of them where the pattern is symmetric. This rank's part.

    Attributes:
        row, column: local nodes (n,).
        place: entries between the beginning of the row and the block of the pair in the pattern (n,).
        sums: (k, n).
        symmetric: the other half isn't there.
        matrices: from the first product on, the first sums as a sparse matrix, and the last ones, or their
            share of the first.
    """

    row: np.ndarray
    column: np.ndarray
    place: np.ndarray
    sums: np.ndarray
    symmetric: bool
    matrices: list[Any]

    @classmethod
    def of(cls, system: Any, values: np.ndarray) -> NodalMasses:
        """Of the values (np, k) of a system's points."""
        pattern, block = system.pattern, system.layout.block
        number, size = system.nodes.number, len(pattern.values)
        first = np.asarray(pattern.matrix.kept["row_start"][::block])
        # sums where the block of a pair begins, and its nodes
        sums, nodes = np.zeros((values.shape[1], size)), np.zeros((2, size), dtype=np.int32)
        for rows, columns, matrices in system.mass_sets(values):
            row, column = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
            kept = columns >= 0
            if pattern.symmetric:
                kept &= number[row] <= number[column]
            row, column = row[kept], column[kept]
            at = first[row] + columns[kept].astype(np.int64) * block
            for k in range(len(sums)):
                sums[k] += np.bincount(at, matrices[k][kept], minlength=size)
            nodes[:, at] = row, column
        at = np.flatnonzero(np.any(sums, axis=0))
        row, column = nodes[:, at]
        return cls(row, column, at - first[row], sums[:, at], bool(pattern.symmetric), [])

    def times(self, x: np.ndarray, dim: int) -> np.ndarray:
        """Products with nodal values (nodes, block): the first sums with displacements, the second ones with
        rotations, if there are any."""
        if not self.matrices:
            self.matrices.extend(self._sparse(len(x), self.sums[:1]))
            share = self.sums[-1].sum() / self.sums[0].sum() if self.sums.size else 1.0
            if np.allclose(self.sums[-1], share * self.sums[0], rtol=1e-14, atol=0.0):
                self.matrices.append(share)  # one product does
            else:
                self.matrices.extend(self._sparse(len(x), self.sums[1:]))
        first, second = self.matrices
        if isinstance(second, float):
            out = np.asarray(first @ x)
            out[:, dim:] *= second
            return out
        return np.hstack([first @ x[:, :dim], second @ x[:, dim:]])

    def _sparse(self, nodes: int, sums: np.ndarray) -> Iterator[Any]:
        """Sums (k, n) as sparse matrices of both halves."""
        from scipy.sparse import csr_matrix

        other = self.row != self.column
        for value in sums:
            row, column = self.row, self.column
            if self.symmetric:
                row, column = np.append(row, column[other]), np.append(column, row[other])
                value = np.append(value, value[other])
            yield csr_matrix((value, (row, column)), shape=(nodes, nodes))

    def entries(self, system: Any, pairs: list[list[tuple[int, int]]]) -> np.ndarray:
        """As the values of a system's pattern, without rows and columns of prescribed unknowns, but for the
        diagonal: sums of number k count for its pairs of components. Rows of ghosts are still to be
        collected."""
        pattern, block, fixed = system.pattern, system.layout.block, system.prescribed.fixed
        start, (row, column) = pattern.matrix.kept["row_start"], (self.row, self.column)
        out = np.zeros(len(pattern.values))
        for k, (i, j) in ((k, pair) for k, some in enumerate(pairs) for pair in some):
            kept = ~(fixed[row, i] | fixed[column, j]) | ((row == column) & (i == j))
            if pattern.symmetric:
                kept &= (row != column) | (i <= j)
            out[(start[row * block + i] + self.place + j)[kept]] = self.sums[k][kept]
        return out


def point_sets(batch: Any, mass: np.ndarray, matrix: native.Matrix) -> Iterator[MassSets]:
    """Of the points of a batch, in its order, with masses, or other values, (n, k)."""
    kept = batch.batch.kept
    counts, first, begin = kept["count"], kept["node_offsets"], kept["offsets"]
    shapes, shape_of = np.unique(counts, axis=0, return_inverse=True)
    for k, count in enumerate(shapes):
        groups, index = np.flatnonzero(shape_of.ravel() == k), box_indices(tuple(int(c) for c in count))
        n = len(index)
        most = max(1, _CHUNK // (n * n * 8))
        for part in range(0, len(groups), most):
            some = groups[part : part + most]
            rows = kept["nodes"][first[some][:, None] + np.arange(n)].astype(np.int64)
            matrices = _sums(kept["weights"], mass, begin[some], begin[some + 1], index)
            yield MassSets(rows, columns_of_boxes(rows, index, matrix), matrices)


def _sums(
    weights: np.ndarray, mass: np.ndarray, begin: np.ndarray, end: np.ndarray, index: np.ndarray
) -> np.ndarray:
    """Matrices (k, m, n, n) of groups of points, by rows of the first and after the last one."""
    sizes = end - begin
    group = np.repeat(np.arange(len(begin)), sizes)
    at = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    points, n = begin[group] + at, len(index)
    value = np.ones((len(points), n))
    for i in range(index.shape[1]):
        value *= weights[points, i, 0][:, index[:, i]]
    most = int(sizes.max(initial=1))
    table, masses = np.zeros((len(begin), most, n)), np.zeros((len(begin), most, mass.shape[1]))
    table[group, at], masses[group, at] = value, mass[points]
    turned = np.swapaxes(table, 1, 2)
    return np.stack([turned @ (masses[:, :, k, None] * table) for k in range(mass.shape[1])])
