"""Points that are put where others are already: the body would be there twice."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import TrustWarning
from ..geometry.grid import box_indices
from ..tools.parallel import warn_on_one_rank

_ROUNDING = 1e-6
_WHOLE = 0.5  # of the median volume: smaller points are cut ones, whose boxes stand for second moments
# alone and may reach over faces
_NEAREST = 4  # boxes that may hold a place
_MOST = 25_000  # points that are looked at together


def warn_of_overlap(comm: MPI.Comm, points: Any, first: int) -> None:
    """Warn where points with ids from `first` on lie in the boxes of others. Collective."""
    d, old, new = points.dim, points.id < first, points.id >= first
    axes = np.einsum("pij,pkj->pki", points.F[:, :d, :d], points.half_axes0)
    low, high = _bounds(comm, points.x[old], axes[old])
    near = new & np.all((points.x > low) & (points.x < high), axis=1)
    parts = comm.allgather((points.x[near], axes[near], points.volume0[near], points.volume0[new]))
    x, own, volume, every = (np.concatenate(part) for part in zip(*parts, strict=True))
    whole = volume > _WHOLE * np.median(every) if len(every) else np.zeros(0, dtype=bool)
    x, own = x[whole], own[whole]
    there = np.flatnonzero(old)[np.abs(np.linalg.det(axes[old])) > 0.0]
    boxes = _Boxes(points.x[there], axes[there])
    parts_of_x = (slice(k, k + _MOST) for k in range(0, len(x), _MOST))
    found = (_first_twice(comm, boxes, x[part], own[part]) for part in parts_of_x)
    twice = next((place for place in found if place is not None), None)
    if twice is not None:
        place = tuple(float(round(c, 9)) for c in twice)
        warn_on_one_rank(
            comm,
            f"points that join lie where points are already, such as at {place}: the body is there twice, "
            "with twice the stiffness and the weight. Leave a hole for them, or give points that are there "
            "another material (assign)",
            TrustWarning,
        )


def _bounds(comm: MPI.Comm, x: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around the boxes of points x (n, d) with half axes (n, d, d), of all ranks."""
    reach = np.abs(axes).sum(axis=1)
    low = (x - reach).min(axis=0, initial=np.inf)
    high = (x + reach).max(axis=0, initial=-np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    return low, high


def _first_twice(comm: MPI.Comm, boxes: _Boxes, x: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """The first of some points (n, d) with half axes (n, d, d) whose middle and half of whose box are in
    boxes of all ranks; None where there is none. Collective."""
    d = x.shape[1]
    middle = _in_any(comm, boxes, x)
    x, axes = x[middle], axes[middle]
    if not len(x):
        return None
    places = x[:, None] + np.einsum("ck,pki->pci", box_indices((2,) * d) - 0.5, axes)
    inside = _in_any(comm, boxes, places.reshape(-1, d)).reshape(places.shape[:2])
    twice = np.flatnonzero(inside.all(axis=1))
    return x[twice[0]] if len(twice) else None


def _in_any(comm: MPI.Comm, boxes: _Boxes, places: np.ndarray) -> np.ndarray:
    """Which of some places (m, d) lie in one of the boxes of all ranks. Collective."""
    inside = boxes.contain(places).astype(np.int64)
    comm.Allreduce(MPI.IN_PLACE, inside, op=MPI.MAX)
    return inside > 0


class _Boxes:
    """Boxes about x (n, d) with half axes (n, d, d)."""

    def __init__(self, x: np.ndarray, axes: np.ndarray):
        from scipy.spatial import cKDTree  # takes a while to import

        self.x, self.axes = x, np.swapaxes(axes, 1, 2)
        self._tree = cKDTree(x) if len(x) else None

    def contain(self, places: np.ndarray) -> np.ndarray:
        """Which of some places (m, d) lie in one of them."""
        if self._tree is None:
            return np.zeros(len(places), dtype=bool)
        count = min(_NEAREST, len(self.x))
        near = self._tree.query(places, k=count)[1].reshape(len(places), count)
        xi = np.linalg.solve(self.axes[near], (places[:, None] - self.x[near])[..., None])[..., 0]
        found: np.ndarray = np.any(np.all(np.abs(xi) < 1.0 + _ROUNDING, axis=2), axis=1)
        return found
