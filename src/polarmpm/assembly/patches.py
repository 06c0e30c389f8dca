"""Patches of points: few functions of a patch stand for the stiff scalars of its points (docs/theory.md).

The functions phi_a of a patch, 1 or 1 and the coordinates, are orthonormal over its points, sum V0 phi_a
phi_b = delta_ab. The projection of values f at the points is sum_a phi_a sum V0 phi_a f. With it come, beside
the sums over points, vectors of the patch's nodes for each mode (a function times a scalar), whose products
g b^T + b h^T are added to the tangent:

    b = sum V0 phi B^T e_z,          g = sum V0 phi B^T L_zt,
    h = sum V0 phi B^T L_tz + c b,   c = sum V0 phi phi L_tt.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ..geometry.grid import Grid
from ..geometry.nodes import ActiveNodes
from ..kernels import native

_FLAT = 1e-3  # variance of the points' places over the square of the patch's size: no function along it


class Patches:
    """Patches of a batch's points between two resets.

    Args:
        cells: lattice index (n, d) of the patch of each point, in patches.
        places: of the points (n, d), over the sizes of their patches.
        linear: the coordinates are functions, too.
        scalars: of each point.

    Attributes:
        reach: lattice nodes between the first and the last of a patch, at most.
    """

    def __init__(
        self,
        batch: native.Batch,
        grid: Grid,
        nodes: ActiveNodes,
        cells: np.ndarray,
        places: np.ndarray,
        *,
        linear: bool,
        scalars: int,
    ):
        self.batch, self.dim, self.scalars = batch, grid.dim, scalars
        self.block = batch.dim + batch.rot
        self.volume: np.ndarray = batch.kept["volume"]
        _, self.patch = np.unique(grid.cell_number(cells), return_inverse=True)
        self.count = int(self.patch.max(initial=-1)) + 1
        self._order = np.argsort(self.patch, kind="stable")
        self._starts = np.searchsorted(self.patch[self._order], np.arange(self.count))
        self.values = self._functions(places, linear)
        self._structure = native.Patches()
        self.reach = self._find_nodes(grid, nodes)

    # functions ------------------------------------------------------------------------------------
    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums (patches, ...) of values (n, ...) over each patch."""
        if not self.count:
            return np.zeros((0, *values.shape[1:]))
        found: np.ndarray = np.add.reduceat(values[self._order], self._starts, axis=0)
        return found

    def largest(self, values: np.ndarray) -> np.ndarray:
        """Largest (patches,) of values (n,) in each patch."""
        if not self.count:
            return np.zeros(0)
        found: np.ndarray = np.maximum.reduceat(values[self._order], self._starts)
        return found

    def _functions(self, places: np.ndarray, linear: bool) -> np.ndarray:
        """phi (n, 1 or 1 + d) at the points; zero where the points are too few for one."""
        n, d = places.shape
        volume = self.sums(self.volume)
        out = np.zeros((n, 1 + d if linear else 1))
        out[:, 0] = 1.0 / np.sqrt(volume[self.patch])
        if linear and n:
            share = self.volume / volume[self.patch]
            away = places - self.sums(share[:, None] * places)[self.patch]
            moments = self.sums(share[:, None, None] * away[:, :, None] * away[:, None])
            variance, axes = np.linalg.eigh(moments)
            scale = np.where(variance > _FLAT, 1.0 / np.sqrt(np.maximum(variance, _FLAT)), 0.0)
            along = np.einsum("ni,nia->na", away, axes[self.patch]) * scale[self.patch]
            out[:, 1:] = along / np.sqrt(volume[self.patch])[:, None]
            self._slopes = axes * (scale / np.sqrt(volume)[:, None])[:, None]  # of the functions by places
            self._principal = variance, axes, share, away
        return np.ascontiguousarray(out)

    def moments(self, values: np.ndarray, functions: np.ndarray | None = None) -> np.ndarray:
        """sum V0 phi_a f_c over each patch (patches, functions, c) of values (n, c); with other functions at
        the points (n, functions) if they are given."""
        phi = self.values if functions is None else np.ascontiguousarray(functions)
        out = np.zeros((self.count, phi.shape[1], values.shape[1]))
        of = (*self._of(phi), self.volume, phi, values.shape[1])
        native.library().polarmpm_patch_moments(*of, np.ascontiguousarray(values), out)
        return out

    def at_points(self, moments: np.ndarray, functions: np.ndarray | None = None) -> np.ndarray:
        """Values (n, c) of the functions, or of others (n, functions), with factors (patches, functions,
        c)."""
        phi = self.values if functions is None else np.ascontiguousarray(functions)
        out = np.empty((len(phi), moments.shape[2]))
        of = (*self._of(phi), phi, moments.shape[2])
        native.library().polarmpm_patch_values(*of, np.ascontiguousarray(moments), out)
        return out

    def _of(self, phi: np.ndarray) -> tuple[Any, int, int]:
        return ctypes.byref(self._structure), len(phi), phi.shape[1]

    def moved(self, places: np.ndarray) -> np.ndarray:
        """Changes (n, functions) of functions that stay orthonormal and span what they have to, as the
        points' places change by so much (n, d)."""
        if self.values.shape[1] == 1 or not len(places):
            return np.zeros_like(self.values)
        variance, axes, share, away = self._principal
        out = np.zeros_like(self.values)
        out[:, 1:] = np.einsum("ni,nia->na", places, self._slopes[self.patch])
        # where the body is flat there is no function along an axis, and the others turn with it
        left_out = ~np.any(self._slopes, axis=1, keepdims=True)
        if np.any(left_out):
            moved = places - self.sums(share[:, None] * places)[self.patch]
            half = self.sums(share[:, None, None] * moved[:, :, None] * away[:, None])
            change = np.swapaxes(axes, 1, 2) @ (half + np.swapaxes(half, 1, 2)) @ axes
            apart = variance[:, None, :] - variance[:, :, None]
            turned = np.where(
                np.swapaxes(left_out, 1, 2) & ~left_out, change / np.where(apart == 0.0, 1.0, apart), 0.0
            )
            size = np.linalg.norm(self._slopes, axis=1)
            slopes = (axes @ turned) * size[:, None]
            out[:, 1:] += np.einsum("ni,nia->na", away, slopes[self.patch])
        out -= self.at_points(self.moments(out))
        return out

    def products(self, matrices: np.ndarray) -> np.ndarray:
        """sum V0 phi_a phi_b M_cd over each patch, (patches, modes, modes), of matrices (n, c, c)."""
        out = np.zeros((self.count, self.modes, self.modes))
        flat = np.ascontiguousarray(matrices)
        own = ctypes.byref(self._structure), len(self.values), self.volume
        native.library().polarmpm_patch_matrices(*own, flat, out)
        return out

    @property
    def modes(self) -> int:
        """Functions times scalars."""
        functions: int = self.values.shape[1]
        return functions * self.scalars

    # nodes ----------------------------------------------------------------------------------------
    def _find_nodes(self, grid: Grid, active: ActiveNodes) -> int:
        """The patches' nodes, those of the groups of their points; the reach."""
        b = self.batch
        offsets, node_offsets = b.kept["offsets"], b.kept["node_offsets"]
        group = np.repeat(np.arange(b.ngroups), np.diff(offsets))
        pairs, pair = np.unique(
            np.stack([self.patch, group], axis=1).reshape(-1, 2), axis=0, return_inverse=True
        )
        length = np.diff(node_offsets)[pairs[:, 1]]
        map_offsets = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
        at = np.arange(map_offsets[-1]) - np.repeat(map_offsets[:-1] - node_offsets[pairs[:, 1]], length)
        local = b.kept["nodes"][at].astype(np.int64)
        of, total = np.repeat(pairs[:, 0], length), max(len(active), 1)
        rank: np.ndarray = np.empty(len(active), dtype=np.int64)  # in the order of the lattice
        rank[np.argsort(active.lattice)] = np.arange(len(active))
        keys, first, place = np.unique(of * total + rank[local], return_index=True, return_inverse=True)
        patch = keys // total
        starts = np.searchsorted(patch, np.arange(self.count + 1)).astype(np.int64)
        index = grid.node_index(active.lattice[local[first]])
        self._away = index - (np.minimum.reduceat(index, starts[:-1], axis=0)[patch] if len(index) else index)
        native.fill(
            self._structure,
            npatches=self.count,
            functions=self.values.shape[1],
            scalars=self.scalars,
            modes=self.modes,
            offsets=starts,
            nodes=local[first].astype(np.int32),
            patch=self.patch.astype(np.int32),
            map_of=map_offsets[pair.ravel()],
            maps=(place.ravel() - starts[of]).astype(np.int32),
            values=self.values,
        )
        self._length = int(starts[-1]) * self.block * self.modes
        reach: int = int(self._away.max(initial=0))
        return reach

    def put_codes(self, reach: int) -> None:
        """Let the patches know the reach of the matrix."""
        side, code = 2 * reach + 1, np.zeros(len(self._away), dtype=np.int64)
        for i in range(self.dim):
            code = code * side + self._away[:, i]
        native.fill(self._structure, codes=code.astype(np.int32))

    def couple(self, reach: int, mark: np.ndarray) -> None:
        """Mark the lattice neighbours that share a patch, see `sparsity.build`."""
        self.put_codes(reach)
        native.library().polarmpm_couple_patches(ctypes.byref(self._structure), self.dim, reach, mark)

    # sums -----------------------------------------------------------------------------------------
    def vectors(
        self,
        kernels: native.PointKernels,
        work: Sequence[np.ndarray],
        sides: np.ndarray | None = None,
        both: np.ndarray | None = None,
    ) -> np.ndarray:
        """Vectors (kinds, :) of the modes from several kinds of work on z per volume, each (n, scalars nz),
        and on its derivatives along the points' half axes (kinds, n, d, scalars, nz), of which the kernels
        know the axes; `both`: of bodies of revolution, on what values have on both sides (kinds, n, d,
        scalars, values)."""
        out: np.ndarray = np.zeros((len(work), self._length))
        own = ctypes.byref(self.batch), ctypes.byref(kernels), ctypes.byref(self._structure), len(work)
        flat = None if sides is None else np.ascontiguousarray(sides)
        if both is not None:  # room for all values that there may be
            both = np.concatenate([both, np.zeros_like(both)], axis=-1)[..., :2].copy()
        rows, step = native.rows(work)
        if native.library().polarmpm_patch_vectors(*own, rows, step, flat, both, out):
            raise MemoryError("no memory for the sums over patches")
        return out

    def add_forces(self, vectors: np.ndarray, factors: np.ndarray, force: np.ndarray) -> None:
        """Add the modes' vectors times factors (patches, modes) to nodal forces (nodes, block)."""
        flat = np.ascontiguousarray(factors)
        native.library().polarmpm_patch_forces(
            ctypes.byref(self._structure), self.block, vectors, flat, force
        )

    def times(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Products (patches, modes) of the modes' vectors with nodal values (nodes, block)."""
        out = np.zeros((self.count, self.modes))
        native.library().polarmpm_patch_products(ctypes.byref(self._structure), self.block, vectors, x, out)
        return out

    @cached_property
    def _by_size(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Patches of one number of nodes, and where their vectors stand, for each number."""
        starts, length = self._structure.kept["offsets"], self.block * self.modes
        sizes = np.diff(starts)
        rows = [np.flatnonzero(sizes == size) for size in np.unique(sizes)]
        return [(r, starts[r][:, None] * length + np.arange(sizes[r[0]] * length)) for r in rows]

    def combined(self, matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Vectors sum_b c_ab b_b of matrices (patches, modes, modes)."""
        modes = self.modes
        if len(self._by_size) == 1:
            found: np.ndarray = matrices @ vectors.reshape(self.count, modes, -1)
            return found.ravel()
        out = np.zeros_like(vectors)
        for rows, at in self._by_size:
            own = vectors[at].reshape(len(rows), modes, -1)
            out[at] = (matrices[rows] @ own).reshape(len(rows), -1)
        return out

    def add_tangent(
        self,
        b: np.ndarray,
        g: np.ndarray,
        h: np.ndarray,
        matrix: native.Matrix,
        lifted: np.ndarray | None,
        row: np.ndarray | None = None,
    ) -> None:
        """Add sum g b^T + b h^T over all modes to a matrix; with a `row` g row^T in the place of g b^T."""
        if row is None:
            self._add_products(b, g, h, matrix, lifted)
        else:
            none = np.zeros_like(b)
            self._add_products(row, g, none, matrix, lifted)
            self._add_products(b, none, h, matrix, lifted)

    def _add_products(
        self, b: np.ndarray, g: np.ndarray, h: np.ndarray, matrix: native.Matrix, lifted: np.ndarray | None
    ) -> None:
        own = ctypes.byref(self._structure), self.dim, self.block, b, g, h, ctypes.byref(matrix), lifted
        if native.library().polarmpm_add_patches(*own):
            raise MemoryError("no memory for the sums over patches")
