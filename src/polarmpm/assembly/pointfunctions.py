"""Weighting functions of a batch's points on their own: nodal values to the points, forces to the nodes.

As of the sums over points (`_native.c`), but in parts, for the tangent-linear run, in which the functions
change: gradients are those in the lattice's axes, and what does work on them is given.
"""

from __future__ import annotations

import ctypes

import numpy as np

from ..kernels import native
from ..kinematics.layout import Layout
from .interpolation import PointBatch, _gather


class Functions:
    """Weighting functions of a batch's points, by which nodal values are gathered and forces spread.

    Args:
        nodes: how many there are.
        axes: half axes (n, d, d) of the points' boxes; None: there are none.
        weights: in the place of the batch's own.
    """

    def __init__(
        self, batch: PointBatch, nodes: int, axes: np.ndarray | None, weights: np.ndarray | None = None
    ):
        b, n, d = batch.batch, len(batch.rows), batch.batch.dim
        self.layout, self._nodes, self._own = batch.form.layout, nodes, native.Batch()
        for each in native.Batch._fields_:
            setattr(self._own, each[0], getattr(b, each[0]))
        self._own.kept.update(b.kept)
        still = np.zeros_like(b.kept["state"])
        still[:, : d * d] = np.eye(d).ravel()
        native.fill(self._own, state=still)
        if weights is not None:
            native.fill(self._own, weights=np.ascontiguousarray(weights))
        self._kernels, self._boxes = native.PointKernels(), axes is not None
        if axes is not None:
            lean = np.ascontiguousarray(axes) if self.layout.rotations else None
            native.fill(self._kernels, box_axes=np.ascontiguousarray(axes), box_lean=lean)
        group = np.repeat(np.arange(b.ngroups), np.diff(b.kept["offsets"]))
        self._sums = native.Patches()  # one patch of all nodes
        native.fill(
            self._sums,
            npatches=1,
            functions=1,
            scalars=1,
            modes=1,
            offsets=np.array([0, nodes], dtype=np.int64),
            nodes=np.arange(nodes, dtype=np.int32),
            patch=np.zeros(n, dtype=np.int32),
            map_of=np.ascontiguousarray(b.kept["node_offsets"][group], dtype=np.int64),
            maps=np.ascontiguousarray(b.kept["nodes"], dtype=np.int32),
            values=np.ones((n, 1)),
        )

    def gather(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """z (n, nz), and its derivatives along the half axes (n, d, nz), of nodal values (nodes, block)."""
        n, nz = self._own.npoints, self.layout.unknowns
        z = np.empty((n, nz))
        if not self._boxes:
            _gather(self._own, x, 0, z, None)
            return z, None
        zk = np.empty((n, self.layout.dim, nz))
        gather = native.library().polarmpm_gather_boxes
        if gather(ctypes.byref(self._own), ctypes.byref(self._kernels), x, z, zk, None):
            raise MemoryError("no memory for the points' boxes")
        return z, zk

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (n, block) at the points."""
        n = self._own.npoints
        z, value = np.empty((n, self.layout.unknowns)), np.empty((n, self.layout.block))
        _gather(self._own, x, 0, z, value)
        return value

    def spread(self, work: np.ndarray, sides: np.ndarray | None) -> np.ndarray:
        """Forces (nodes, block) on this rank's nodes of what does work on z (n, nz), per volume, and on its
        derivatives along the half axes (n, d, nz)."""
        out = np.zeros(self._nodes * self.layout.block)
        own = ctypes.byref(self._own), ctypes.byref(self._kernels), ctypes.byref(self._sums), 1
        flat = None if sides is None else np.ascontiguousarray(sides)
        if native.library().polarmpm_patch_vectors(*own, *native.rows([work]), flat, None, out):
            raise MemoryError("no memory for the sums over material points")
        return np.ascontiguousarray(out.reshape(self.layout.block, self._nodes).T)

    def loads(self, values: np.ndarray) -> np.ndarray:
        """Forces (nodes, block) of point values (n, block)."""
        out = np.zeros((self._nodes, values.shape[1]))
        given = np.ascontiguousarray(values)
        native.library().polarmpm_spread(ctypes.byref(self._own), given, values.shape[1], out)
        return out


def framed(layout: Layout, a: np.ndarray, frames: np.ndarray, *, values: bool = True) -> np.ndarray:
    """Gradients among unknowns (n, ..., nz) times frames (n, d, d); without values these are zero."""
    out, d = a.copy() if values else np.zeros_like(a), layout.dim
    if d == 2:
        _framed_in_plane(layout, a, frames.reshape(len(frames), *[1] * (a.ndim - 2), d, d), out)
        return out
    frames = frames.reshape(len(frames), *[1] * (a.ndim - 2), d, d)
    for name in ("displacement", "rotation")[: 1 + bool(layout.rotations)]:
        at = layout.where(name, 1)
        rows = a[..., at].reshape(*a.shape[:-1], (at.stop - at.start) // d, d)
        out[..., at] = (rows @ frames).reshape(*a.shape[:-1], at.stop - at.start)
    return out


def _framed_in_plane(layout: Layout, a: np.ndarray, frames: np.ndarray, out: np.ndarray) -> None:
    """The same with tensors (n, ..., 2, 2), column by column: products of many small matrices are slow."""
    for name in ("displacement", "rotation")[: 1 + bool(layout.rotations)]:
        at = layout.where(name, 1)
        for first in range(at.start, at.stop, 2):
            x, y = a[..., first], a[..., first + 1]
            for j in range(2):
                np.add(x * frames[..., 0, j], y * frames[..., 1, j], out=out[..., first + j])
