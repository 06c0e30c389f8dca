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
_MOST = 25_000  # points that are looked at: of more, some


def warn_of_overlap(comm: MPI.Comm, points: Any, first: int) -> None:
    """Warn where points with ids from `first` on lie in the boxes of others. Collective."""
    d, old, new = points.dim, points.id < first, points.id >= first
    axes = np.einsum("pij,pkj->pki", points.F[:, :d, :d], points.half_axes0)
    low, high = _bounds(comm, points.x[old], axes[old])
    near = new & np.all((points.x > low) & (points.x < high), axis=1)
    parts = comm.allgather((points.x[near], axes[near], points.volume0[near], points.volume0[new]))
    x, own, volume, every = (np.concatenate(part) for part in zip(*parts, strict=True))
    whole = volume > _WHOLE * np.median(every) if len(every) else np.zeros(0, dtype=bool)
    step = 1 + len(x) // _MOST
    x, own = x[whole][::step], own[whole][::step]
    corners = box_indices((2,) * d) - 0.5
    places = x[:, None] + np.einsum("ck,pki->pci", corners, own)
    inside = np.zeros(places.shape[:2], dtype=np.int64)
    there = np.flatnonzero(old)[np.abs(np.linalg.det(axes[old])) > 0.0]
    if len(x) and len(there):
        inside[:] = _within(places.reshape(-1, d), points.x[there], axes[there]).reshape(inside.shape)
    comm.Allreduce(MPI.IN_PLACE, inside, op=MPI.MAX)
    twice = np.flatnonzero(inside.all(axis=1))
    if len(twice):
        place = tuple(float(round(c, 9)) for c in x[twice[0]])
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


def _within(places: np.ndarray, x: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Which of some places (m, d) lie in one of the boxes about x (n, d) with half axes (n, d, d)."""
    from scipy.spatial import cKDTree  # takes a while to import

    count = min(_NEAREST, len(x))
    _, near = cKDTree(x).query(places, k=count)
    near = near.reshape(len(places), count)
    xi = np.linalg.solve(np.swapaxes(axes, 1, 2)[near], (places[:, None] - x[near])[..., None])[..., 0]
    found: np.ndarray = np.any(np.all(np.abs(xi) < 1.0 + _ROUNDING, axis=2), axis=1)
    return found
