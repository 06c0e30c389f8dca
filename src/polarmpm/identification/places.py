"""Displacements and rotations of a body at given places, as cameras see them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.elements import Elements
from ..bodies.points import Points
from ..errors import InputError
from ..tools import checks
from ..tools.meetings import collective
from ..tools.rows import flat

_NEIGHBOURS = {
    2: 16,
    3: 40,
}  # points that a local polynomial of degree 2 is fitted to, twice its numbers or more
_OUTSIDE = 1.5  # distances between points that a place may lie beyond the nearest one
_GONE = 1e-9  # of the sum of weights, which is 1
_SINGULAR = 1e-6  # singular values below this part of the largest: the points don't show such a polynomial


class Places:
    """Places in the undeformed body, at which its displacements are interpolated. Collective.

    At each place a polynomial of degree 2 is fitted to the nearest points, or nodes, weighted by their
    distance in the undeformed body; where these don't span one, of degree 1, or the nearest point is taken.
    Linear displacement fields are met exactly, others to the third power of the distance between points.
    Where points have been split, or taken out, those that are left serve. All results are the same on all
    ranks.

    Args:
        body: material points, or a meshed body.
        X: places (n, d) in the undeformed body (m).

    Raises:
        InputError: a place that isn't in the body; the message tells the first one.
    """

    def __init__(self, body: Points | Elements, X: Any):
        kinds = (Points, Elements)
        self.body: Any = checks.instance("body", body, kinds, "material points or a meshed body are")
        self.X = checks.array("X", X, (None, body.dim), f"places in the body, {body.dim} coordinates each")
        self.comm: MPI.Intracomm = body.comm
        self._owned: int | None = None  # nodes of a mesh, and the number of the first one
        self._first = 0
        self._lineage: Any = None
        self._ids, self._weights = _made(self)

    def __len__(self) -> int:
        return len(self.X)

    def displacement(self) -> np.ndarray:
        """Displacements (n, d) at the places (m). Collective."""
        own = self.body.displacement
        return self._at(own[: self._owned] if self._owned is not None else own)

    def rotation(self) -> np.ndarray:
        """Vectors of the microrotation (n, 3) at the places (rad). Collective."""
        own = self.body.rotation_vector
        return self._at(np.asarray(own)[: self._owned] if self._owned is not None else np.asarray(own))

    def values(self, values: Any) -> np.ndarray:
        """Other values of this rank's points, or of its own nodes (n, ...), at the places. Collective."""
        return self._at(checks.numeric("values", values, "one row for each local point, or own node"))

    def _at(self, own: np.ndarray) -> np.ndarray:
        return _interpolated(self, own)


@collective("Places")
def _made(places: Places) -> tuple[np.ndarray, np.ndarray]:
    """Points by their ids, or nodes by their number over all ranks (n, k); their weights at each place."""
    body, comm = places.body, places.comm
    if isinstance(body, Points):
        places._lineage = body.lineage
        x, ids = body.X, np.asarray(body.id)
    else:
        owned = places._owned = int(body.nodes.owned)
        x = body.nodes.position[:owned, : body.dim]
        places._first = comm.exscan(owned) or 0
        ids = places._first + np.arange(owned)
    every, all_ids = np.concatenate(comm.allgather(x)), np.concatenate(comm.allgather(ids))
    order = np.argsort(all_ids, kind="stable")
    return _weights(every[order], all_ids[order], places.X)


@collective("displacement at places")
def _interpolated(places: Places, own: np.ndarray) -> np.ndarray:
    body = places.body
    here = np.asarray(body.id if isinstance(body, Points) else places._first + np.arange(places._owned or 0))
    if len(own) != len(here):
        raise InputError(
            f"values: {len(here)} rows are needed, one for each local point or own node, not {len(own)}"
        )
    values = np.hstack([flat(own), np.ones((len(own), 1))])
    split = isinstance(body, Points) and body.lineage is not places._lineage
    out = None if split else _summed(places, here, values)
    if out is None:  # points have been split, or taken out: with those that there are
        places._ids, places._weights = _made(places)
        out = _summed(places, here, values)
    assert out is not None
    return out.reshape(len(places), *own.shape[1:])


def _summed(places: Places, here: np.ndarray, values: np.ndarray) -> np.ndarray | None:
    """Values (n, k) of points or nodes with these numbers, ones in the last column, at the places (n, k - 1);
    None where some are gone. Collective."""
    order = np.argsort(here, kind="stable")
    row = np.searchsorted(here[order], places._ids)
    row = np.minimum(row, max(len(here) - 1, 0))
    out = np.zeros((len(places), values.shape[1]))
    if len(here):
        mine = here[order][row] == places._ids
        out = np.einsum("nk,nkc->nc", np.where(mine, places._weights, 0.0), values[order[row]])
    if places.comm.size > 1:
        places.comm.Allreduce(MPI.IN_PLACE, out)
    whole = np.abs(out[:, -1] - places._weights.sum(axis=1)) < _GONE
    return np.ascontiguousarray(out[:, :-1]) if np.all(whole) else None


def _weights(x: np.ndarray, ids: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ids (n, k) and weights (n, k) of the points for each place."""
    from scipy.spatial import cKDTree  # takes a while to import

    d = X.shape[1]
    k = min(_NEIGHBOURS[d], len(x))
    tree = cKDTree(x)
    distance, near = tree.query(X, k=k)
    distance, near = distance.reshape(len(X), k), near.reshape(len(X), k)
    apart = tree.query(x, k=min(2, len(x)))[0].reshape(len(x), -1)[:, -1]
    spacing = float(np.median(apart)) or 1.0
    outside = np.flatnonzero(distance[:, 0] > _OUTSIDE * np.maximum(apart[near[:, 0]], spacing))
    if len(outside):
        at = ", ".join(f"{c:.6g}" for c in X[outside[0]])
        raise InputError(
            f"X: {len(outside)} of {len(X)} places lie outside the undeformed body, the first one ({at}), "
            f"{distance[outside[0], 0]:.3g} from the nearest point"
        )
    weights = np.array([_polynomial((x[near[i]] - X[i]), distance[i]) for i in range(len(X))])
    return ids[near], weights.reshape(len(X), k)


def _polynomial(offset: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Weights (k,) with which values at offsets (k, d) give that at 0."""
    k, d = offset.shape
    reach = 1.05 * float(distance.max()) or 1.0
    z = offset / reach
    root = np.sqrt(np.maximum(1 - (distance / reach) ** 2, 0.0) ** 2 / ((distance / reach) ** 2 + 1e-4))
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    columns = [np.ones((k, 1)), z, np.stack([z[:, i] * z[:, j] for i, j in pairs], axis=1)]
    for degree in (2, 1):
        basis = np.concatenate(columns[: degree + 1], axis=1)
        if basis.shape[1] > k:
            continue
        u, s, vt = np.linalg.svd(root[:, None] * basis, full_matrices=False)
        if s[-1] > _SINGULAR * s[0]:
            found: np.ndarray = (vt[:, 0] / s) @ u.T * root
            return found
    nearest = np.zeros(k)
    nearest[int(distance.argmin())] = 1.0
    return nearest
