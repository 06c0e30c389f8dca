"""Inertia of the points: forces on the nodes, and the consistent mass matrix as entries of a pattern.

Each point has a mass for the displacements and one for the rotations. The matrix, sum of m N_i N_j, is
constant between two resets and summed once; a step scales it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..geometry.grid import box_indices
from ..kernels import native
from .nodalterms import columns_of_boxes

_CHUNK = 1 << 21  # entries of products of weighting functions that are made at a time


class MassSets(NamedTuple):
    """Sets of nodes of the same size whose points have their weights there.

    Attributes:
        rows: local nodes (m, n).
        columns: block columns of the nodes in each other's rows (m, n, n).
        matrices: sums of the points' masses times two functions, for displacements and for rotations,
            (2, m, n, n).
    """

    rows: np.ndarray
    columns: np.ndarray
    matrices: np.ndarray


class Inertia:
    """Inertia of a system's points in a step.

    Args:
        mass: masses (kg) and moments of inertia (kg m^2) of this rank's points (np, block).

    Attributes:
        scale: by which masses are multiplied (1/s^2), c of `kinematics.timesteps`.
        start: values (np, block) of the increments at the points when the step begins.
    """

    def __init__(self, mass: np.ndarray):
        self.mass, self.scale = mass, 0.0
        self.start = np.zeros_like(mass)
        self._entries: np.ndarray | None = None
        # at the last increments (nodes, block) that were asked for, which are never written to
        self._moved: tuple[np.ndarray, np.ndarray] | None = None
        self._forces: tuple[np.ndarray, np.ndarray] | None = None

    def begin(self, system: Any, scale: float) -> None:
        """A step begins at the system's increments."""
        self.scale, self.start = scale, system.at_points(system.x)
        self._moved = system.x, np.zeros_like(self.mass)
        self._forces = system.x, np.zeros_like(system.x)

    def moved(self, system: Any) -> np.ndarray:
        """What the points' increments (np, block) have gained since the start of the step."""
        if self._moved is None or self._moved[0] is not system.x:
            self._moved = system.x, system.at_points(system.x) - self.start
        return self._moved[1]

    def forces(self, system: Any) -> np.ndarray:
        """Forces (nodes, block) in which the increments since the start of the step take part, complete on
        owned rows. Collective."""
        if self._forces is None or self._forces[0] is not system.x:
            self._forces = system.x, system.from_points(self.scale * self.mass * self.moved(system))
        return self._forces[1]

    def products(self, system: Any, direction: np.ndarray) -> np.ndarray:
        """The matrix times a direction (nodes, block), complete on owned rows. Collective."""
        found: np.ndarray = system.from_points(self.scale * self.mass * system.at_points(direction))
        return found

    def add_tangent(self, system: Any) -> None:
        """Add the matrix to the entries of the system's pattern."""
        if self._entries is None:
            self._entries = mass_entries(system, self.mass)
        system.pattern.values += self.scale * self._entries


def mass_entries(system: Any, mass: np.ndarray) -> np.ndarray:
    """The mass matrix, as the values of a system's pattern, without rows and columns of prescribed unknowns,
    but for the diagonal. This rank's part: rows of ghosts are still to be collected."""
    pattern, d, block = system.pattern, system.layout.dim, system.layout.block
    fixed, number = system.prescribed.fixed, system.nodes.number
    start, size = pattern.matrix.kept["row_start"], len(pattern.values)
    first = np.asarray(start[::block])
    # sums for displacements and rotations where a block begins, and the nodes of the block
    sums, nodes = np.zeros((2, size)), np.zeros((2, size), dtype=np.int32)
    for rows, columns, matrices in system.mass_sets(mass[:, [0, block - 1]]):
        row, column = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
        kept = columns >= 0
        if pattern.symmetric:
            kept &= number[row] <= number[column]
        row, column = row[kept], column[kept]
        at = first[row] + columns[kept].astype(np.int64) * block
        for k in range(1 + (block > d)):
            sums[k] += np.bincount(at, matrices[k][kept], minlength=size)
        nodes[:, at] = row, column
    at = np.flatnonzero(sums[0])
    row, column = nodes[:, at]
    out, place = np.zeros(size), at - first[row]
    for i in range(block):
        free = ~(fixed[row, i] | fixed[column, i]) | (row == column)
        out[(start[row * block + i] + place + i)[free]] = sums[int(i >= d)][at][free]
    return out


def point_sets(batch: Any, mass: np.ndarray, matrix: native.Matrix) -> Iterator[MassSets]:
    """Of the points of a batch, in its order, with masses (n, 2)."""
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
    """Matrices (2, m, n, n) of groups of points, by rows of the first and after the last one."""
    sizes = end - begin
    group = np.repeat(np.arange(len(begin)), sizes)
    at = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    points, n = begin[group] + at, len(index)
    value = np.ones((len(points), n))
    for i in range(index.shape[1]):
        value *= weights[points, i, 0][:, index[:, i]]
    most = int(sizes.max(initial=1))
    table, masses = np.zeros((len(begin), most, n)), np.zeros((len(begin), most, 2))
    table[group, at], masses[group, at] = value, mass[points]
    turned = np.swapaxes(table, 1, 2)
    return np.stack([turned @ (masses[:, :, k, None] * table) for k in range(2)])
