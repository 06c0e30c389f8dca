"""The material point that is nearest to a place, on any rank."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..geometry.grid import box_indices


def of_nearest(
    comm: MPI.Comm, points: np.ndarray, values: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m) (n,) of places x (n, d), the same on every rank, to the nearest point, and that point's
    values (n, k), of this rank's points (np, d) and values (np, k). Collective."""
    row, distance = _nearest(points, x)
    least = distance.copy()
    comm.Allreduce(MPI.IN_PLACE, least, op=MPI.MIN)
    owner = np.where(distance == least, comm.rank, comm.size)
    comm.Allreduce(MPI.IN_PLACE, owner, op=MPI.MIN)
    found, mine = np.zeros((len(x), values.shape[1])), owner == comm.rank
    if len(points):
        found[mine] = values[row[mine]]
    comm.Allreduce(MPI.IN_PLACE, found)
    return least, found


def behind(
    comm: MPI.Comm,
    points: np.ndarray,
    body: np.ndarray,
    values: np.ndarray,
    x: np.ndarray,
    normal: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of places x (n, d) on surfaces with outward normals (n, d): distance (m) (n,) to the nearest point of
    the body that is behind them, that point's values (n, k), and the body's number (n,). `body` (np,) are the
    numbers of this rank's points. Collective."""
    numbers = sorted(set().union(*comm.allgather(set(np.unique(body).tolist()))))
    out: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    most = np.full(len(x), np.inf)
    for one in numbers:
        mine = body == one
        distance, found = of_nearest(comm, points[mine], np.hstack([values, points])[mine], x)
        away = np.sum((found[:, values.shape[1] :] - x) * normal, axis=1)
        order = np.where(away > 0.0, 1e3, 1.0) * distance  # in front of the surface: of another body
        if out is None:
            out = distance, found[:, : values.shape[1]], np.full(len(x), one)
        else:
            nearer = order < most
            out = tuple(  # type: ignore[assignment]
                np.where(nearer.reshape(-1, *[1] * (old.ndim - 1)), new, old)
                for old, new in zip(out, (distance, found[:, : values.shape[1]], one), strict=True)
            )
        most = np.minimum(most, order)
    assert out is not None
    return out


def _nearest(points: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of the nearest point (n,), and its distance; infinite without points."""
    row, distance = np.zeros(len(x), dtype=np.int64), np.full(len(x), np.inf)
    if not len(points) or not len(x):
        return row, distance
    size = float(np.ptp(points, axis=0).max()) or 1.0
    extent = float(np.ptp(np.concatenate([points, x]), axis=0).max())
    reach = max(size / len(points) ** (1.0 / points.shape[1]), 1e-5 * extent)
    left = np.arange(len(x))
    while len(left):
        found, far = _within(points, x[left], reach)
        sure = far <= reach  # what lies in no bin around may be nearer than the others in the corners
        row[left[sure]], distance[left[sure]] = found[sure], far[sure]
        left, reach = left[~sure], 4.0 * reach
    return row, distance


def _within(points: np.ndarray, x: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point among those in bins of this size around each place."""
    low = np.minimum(points.min(axis=0), x.min(axis=0)) - 2 * reach
    high = np.maximum(points.max(axis=0), x.max(axis=0)) + 2 * reach
    shape = tuple(int(n) + 1 for n in np.ceil((high - low) / reach))

    def code(index: np.ndarray) -> np.ndarray:
        numbers: np.ndarray = np.ravel_multi_index(tuple(index.T), shape)
        return numbers

    codes = code(np.floor((points - low) / reach).astype(np.int64))
    order = np.argsort(codes, kind="stable")
    codes, at = codes[order], np.floor((x - low) / reach).astype(np.int64)
    row, distance = np.zeros(len(x), dtype=np.int64), np.full(len(x), np.inf)
    for offset in box_indices((3,) * x.shape[1]) - 1:
        here = code(at + offset)
        first, last = np.searchsorted(codes, here, "left"), np.searchsorted(codes, here, "right")
        count = last - first
        place = np.repeat(np.arange(len(x)), count)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        candidate = order[np.repeat(first, count) + within]
        far = np.linalg.norm(points[candidate] - x[place], axis=1)
        best = np.lexsort((far, place))
        which, start = np.unique(place[best], return_index=True)
        pick = best[start]
        nearer = far[pick] < distance[which]
        row[which[nearer]], distance[which[nearer]] = candidate[pick[nearer]], far[pick[nearer]]
    return row, distance
