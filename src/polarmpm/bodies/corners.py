"""The outside of a body of material points: the corners of their domains at which faces are free."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import box_indices
from .points import Points
from .revolution import turned

_NEAR = 1e-3  # of a half-length: corners that are nearer to each other are one place
_SHIFT = 0.318309886  # of that: so that lattices of round numbers don't lie on the borders of bins


def outer_corners(points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Corners of the points' domains, as they are now, at which faces are free. Collective.

    Area and normal are those of the sum of a point's shares of its free faces: where two of them meet it is
    aslant. A corner of several points is there once for each. A point without a domain stands for itself. Of
    a body of revolution they are those of its section.

    Returns:
        Positions (n, d) (m), undeformed areas (n,) (m^2; m in the plane), outward normals (n, d) and ids of
        the points (n,); the same on all ranks, in the order of the ids.
    """
    d = points.dim
    number, _, place, vector, at, volume, alone = _corners(points)
    vector[alone[at]] = (volume[at] ** ((d - 1) / d))[alone[at], None] * np.eye(d)[-1]
    area = np.linalg.norm(vector, axis=1)
    return place, area, vector / area[:, None], number[at]


def outer_faces(points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The same of each free face at a corner by itself: normals are along the axes. A point without a domain
    has no face. Collective.

    Returns:
        Positions, undeformed areas, outward normals, ids of the points, and numbers of their bodies (n,).
    """
    number, body, place, vector, at, _, _ = _corners(points)
    corner, axis = np.nonzero(vector)
    area = np.abs(vector[corner, axis])
    normal = np.sign(vector[corner, axis])[:, None] * np.eye(points.dim)[axis]
    return place[corner], area, normal, number[at][corner], body[at][corner]


def _corners(points: Points) -> tuple[np.ndarray, ...]:
    """Of all points, in the order of their ids: ids and bodies; of the corners at which faces are free their
    places, the areas of the faces across each axis, with signs, and which points' they are; of all points the
    volume of the section, and whether they have no domain. Collective."""
    d, comm = points.dim, points.comm
    body = points.body if points.bodies > 1 else np.zeros(len(points), dtype=np.int32)
    rows = [points.id, body, points.X, points.x, points.F[:, :d, :d], points.half_length0, points.volume0]
    every = [np.concatenate(parts) for parts in zip(*comm.allgather(rows), strict=True)]
    order = np.argsort(every[0], kind="stable")
    number, body, X, x, F, half, volume = (a[order] for a in every)
    if points.axisymmetric:
        volume = volume / turned(np.ones(len(X)), X)
    signs = 2.0 * box_indices((2,) * d) - 1.0
    arms = signs[None] * half[:, None]
    alone = np.any(half <= 0.0, axis=1)
    directions = _outward(X, arms, alone, signs, body)
    kept = np.any(directions != 0.0, axis=2)
    kept[alone] = np.arange(len(signs)) == 0
    if points.axisymmetric:  # nothing is free on the axis, whose rings have no length
        kept &= (X[:, None] + arms)[:, :, 0] > _NEAR * half[:, :1]
    at, corner = np.nonzero(kept)
    place = x[at] + np.einsum("nij,nj->ni", F[at], arms[at, corner])
    d_area = volume[:, None] / np.where(half > 0.0, 2.0 * half, 1.0) / 2 ** (d - 1)  # of a corner, by axis
    return number, body, place, directions[at, corner] * d_area[at], at, volume, alone


def _outward(
    X: np.ndarray, arms: np.ndarray, alone: np.ndarray, signs: np.ndarray, body: np.ndarray
) -> np.ndarray:
    """Along which axes the points' faces are free at their corners, with the sign (n, 2^d, d); zero where
    none is. Points of other bodies cover none."""
    n, corners, d = arms.shape
    low = float(arms[~alone].__abs__().min(initial=np.inf))
    if not np.isfinite(low):
        return np.zeros(arms.shape)
    bins = np.floor((X[:, None] + arms) / (_NEAR * low) + _SHIFT).astype(np.int64).reshape(-1, d)
    bins = np.hstack([bins, np.repeat(body, corners)[:, None]])
    _, place = np.unique(bins, axis=0, return_inverse=True)
    place, seen = place.ravel(), np.tile(np.arange(corners), n)
    around = np.zeros((int(place.max()) + 1, corners), dtype=bool)
    around[place, seen] = True  # on which sides of a place there are points
    directions: np.ndarray = np.zeros((n * corners, d))
    for axis in range(d):
        # the point's face across the axis is free at this corner if no point lies beyond it there
        beyond = np.argmax(np.all(signs[:, None] * _flip(axis, d) == signs[None], axis=2), axis=1)
        directions[:, axis] = np.where(around[place, beyond[seen]], 0.0, signs[seen, axis])
    directions = directions.reshape(n, corners, d)
    directions[alone] = 0.0
    return directions


def _flip(axis: int, dim: int) -> np.ndarray:
    flip: np.ndarray = np.where(np.arange(dim) == axis, -1.0, 1.0)
    return flip
