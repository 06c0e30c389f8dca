"""Values at places of a body from those at its points, or nodes: polynomials fitted to the nearest ones.

A place's value is a weighted sum of those of points around it, of stresses of one material; the weights stay,
as long as the points do. Polynomials of degree 2 are met exactly where the points tell them apart, constants
everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, known_anywhere, values_by_number
from ..tools.rows import flat

_FEWEST = 3  # points for each coefficient of a complete polynomial of degree 2
_SAME = 1e-3  # a function that differs by less from those before it, relative to its size, tells nothing more
_AT_ONCE = 4096  # places


@dataclass(frozen=True)
class Stencil:
    """Points around places, by their ids (m, k), and their weights (m, k), zero of those that don't count."""

    ids: np.ndarray
    weights: np.ndarray

    def there(self, points: Any) -> np.ndarray:
        """Which of the points (m, k) are there, or don't count. Collective."""
        wanted, at = np.unique(self.ids, return_inverse=True)
        found = values_by_number(points.comm, points.id, np.ones((len(points), 1)), wanted)[:, 0] > 0.0
        there: np.ndarray = found[at.reshape(self.ids.shape)] | (self.weights == 0.0)
        return there

    def apply(self, points: Any, values: np.ndarray) -> np.ndarray:
        """Values (m, ...) of what the local points have (np, ...); nan where a point that counts is gone.
        Collective."""
        shape, rows = values.shape[1:], flat(values.astype(float))
        rows = np.hstack([rows, np.ones((len(rows), 1))])
        wanted, at = np.unique(self.ids, return_inverse=True)
        found = values_by_number(points.comm, points.id, rows, wanted)[at.reshape(self.ids.shape)]
        out = np.einsum("mk,mkc->mc", self.weights, found)
        out[np.any((found[:, :, -1] == 0) & (self.weights != 0), axis=1)] = np.nan
        values = out[:, :-1].reshape(len(out), *shape)
        return np.asarray(values)


class NodeSites:
    """A mesh's own nodes, in the place of points. Collective.

    Attributes:
        comm, dim, X, id, material, half_length0: as of points; half lengths reach as far as the largest
            element around a node.
        lineage: none.
    """

    lineage = None

    def __init__(self, elements: Any):
        nodes, cells = elements.nodes, elements.cell_nodes
        own = slice(0, nodes.owned)
        self.comm, self.dim = elements.comm, elements.dim
        self.X, self.id = nodes.position[own], nodes.number[own]
        self.material = np.zeros(nodes.owned)
        corners = nodes.position[cells]
        largest = np.zeros(len(nodes))
        size = np.linalg.norm(corners.max(axis=1) - corners.min(axis=1), axis=1)
        np.maximum.at(largest, cells, size[:, None])
        everywhere = np.zeros(nodes.total)
        for number, of_rank in self.comm.allgather((nodes.number, largest)):
            np.maximum.at(everywhere, number, of_rank)
        half = everywhere[self.id] / (2.0 * np.sqrt(self.dim))
        self.half_length0 = np.tile(half[:, None], (1, self.dim))

    def __len__(self) -> int:
        return len(self.id)


class Around:
    """Values at places of a body in the course of a run. Where points are split, or taken out, those that
    there are serve. All methods are collective.

    Args:
        points: material points, or `NodeSites`.
        places: (m, d) in the undeformed body (m), the same on every rank.
        of_nearest: a place has a value only while its nearest point, or a part of it, is there; else nan.
        argument, one_material: see `stencil`.
    """

    def __init__(self, points: Any, places: np.ndarray, *, of_nearest: bool = False, **options: Any):
        self._places, self._of_nearest, self._options = places, of_nearest, options
        self._lineage = points.lineage
        self._stencil = stencil(points, places, **options)
        self._nearest, self._gone = self._stencil.ids[:, 0], np.zeros(len(places), dtype=bool)

    def __call__(self, points: Any, values: np.ndarray) -> np.ndarray:
        """Values (m, ...) of what the local points have (np, ...)."""
        if self._stale(points):
            self._renew(points)
        out = self._stencil.apply(points, values)
        out[self._gone] = np.nan
        return out

    def _stale(self, points: Any) -> bool:
        split = points.lineage is not self._lineage
        return split or not np.all(self._stencil.there(points)[~self._gone])

    def _renew(self, points: Any) -> None:
        self._lineage = lineage = points.lineage
        if self._of_nearest:
            for k in np.flatnonzero(~self._gone):
                one = self._nearest[k : k + 1]
                parts = one if lineage is None else lineage.descendants(one)[0]
                self._gone[k] = not np.any(known_anywhere(points.comm, points.id, parts))
        here = ~self._gone
        if np.any(here):
            found = stencil(points, self._places[here], **self._options)
            ids = np.full((len(here), found.ids.shape[1]), -1)
            weights = np.zeros(ids.shape)
            ids[here], weights[here] = found.ids, found.weights
            self._stencil = Stencil(ids, weights)


@collective("recovery", comm=lambda points, *args, **options: points.comm)
def stencil(points: Any, places: np.ndarray, *, argument: str = "at", one_material: bool = True) -> Stencil:
    """The stencil of this rank's own places (m, d) in the undeformed body (m). Collective.

    Args:
        points: material points, or `NodeSites`.
        argument: of the script's, for messages.
        one_material: values jump from one material to the next, as stresses do: those of the nearest point's
            count.

    Raises:
        InputError: a place outside of the body; on every rank alike.
    """
    from scipy.spatial import cKDTree

    comm, d = points.comm, points.dim
    count = 2 * _FEWEST * (d + 1) * (d + 2) // 2  # twice what is needed, as some may be of another material
    tree = cKDTree(points.X) if len(points) else None
    material = points.material if one_material else np.zeros(len(points))
    rows = np.column_stack([points.X, material, points.half_length0])
    found: tuple[np.ndarray, np.ndarray] | None = None
    for root in range(comm.size):
        asked = comm.bcast(places if comm.rank == root else None, root=root)
        near = np.zeros((len(asked), 0), dtype=int)
        if tree is not None and len(asked):
            near = tree.query(asked, min(count, len(points)))[1].reshape(len(asked), -1)
        parts = comm.gather((points.id[near], rows[near]), root=root)
        if parts is not None:
            found = tuple(np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1))
    assert found is not None
    with errors_on_all_ranks(comm):
        _check_inside(argument, places, *found)
        made = [_fit(places[s], found[0][s], found[1][s], count) for s in _shares(len(places))]
    ids, weights = (np.concatenate([part[k] for part in made]) for k in (0, 1))
    return Stencil(ids, weights)


def _shares(number: int) -> list[slice]:
    return [slice(k, k + _AT_ONCE) for k in range(0, max(number, 1), _AT_ONCE)]


def _fit(places: np.ndarray, ids: np.ndarray, rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ids and weights (m, k) for places (m, d), of candidates (m, n) with X, material and half-length."""
    d = places.shape[1]
    way = rows[:, :, :d] - places[:, None]
    far = np.linalg.norm(way, axis=2)
    order = np.lexsort((ids, far), axis=1)[:, :count]

    def sorted_(a: np.ndarray) -> np.ndarray:
        return np.take_along_axis(a, order.reshape(order.shape + (1,) * (a.ndim - 2)), axis=1)

    ids, way, far, rows = map(sorted_, (ids, way, far, rows))
    same = rows[:, :, d] == rows[:, :1, d]
    same &= np.cumsum(same, axis=1) <= count // 2
    reach = 1.05 * np.max(np.where(same, far, 0.0), axis=1, keepdims=True, initial=0.0)
    reach[reach == 0.0] = 1.0
    weight = np.where(same, (1.0 - np.minimum(far / reach, 1.0)) ** 2 + 1e-3, 0.0)
    return ids, weight * _polynomials(way / reach[:, :, None], weight)


def _check_inside(argument: str, places: np.ndarray, ids: np.ndarray, rows: np.ndarray) -> None:
    """Raise InputError for places that are farther from their nearest points than these reach."""
    d, each = places.shape[1], np.arange(len(places))
    if not len(places):
        return
    far = np.linalg.norm(rows[:, :, :d] - places[:, None], axis=2)
    nearest = rows[each, far.argmin(axis=1)]
    far, size = far.min(axis=1), 2.0 * np.linalg.norm(nearest[:, d + 1 :], axis=1)
    outside = np.flatnonzero((far > size) & (size > 0))
    if len(outside):
        k = outside[0]
        place, near = ("(" + ", ".join(f"{c:.6g}" for c in x) + ")" for x in (places[k], nearest[k, :d]))
        which = f"{place} lies"
        if len(places) > 1:
            which = f"{len(outside)} of {len(places)} places lie"
            place = f"the first one {place}, "
        else:
            place = ""
        raise InputError(
            f"{argument}: {which} outside the undeformed body, {place}{far[k]:.3g} m from the nearest point, "
            f"{near}"
        )


def _polynomials(way: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """What the best polynomial's value at 0 gains from one point's (m, k), but for its weight (m, k).

    The functions 1, x, y, xx, xy, ... at the points are made orthogonal one after the other, so that those
    that say nothing new are left out, and lower ones stay as they are.
    """
    m, k, d = way.shape
    columns = [np.ones((m, k)), *(way[:, :, i] for i in range(d))]
    columns += [way[:, :, i] * way[:, :, j] for i in range(d) for j in range(i, d)]
    out = np.zeros((m, k))
    done: list[tuple[np.ndarray, np.ndarray]] = []
    for number, column in enumerate(columns):
        value = np.full(m, float(number == 0))  # of the function at 0
        size = np.sqrt(np.einsum("mk,mk->m", weight, column**2))
        for _ in range(2):  # once isn't enough for rounding
            for other, at in done:
                share = np.einsum("mk,mk,mk->m", weight, column, other)
                column, value = column - share[:, None] * other, value - share * at
        left = np.sqrt(np.einsum("mk,mk->m", weight, column**2))
        good = left > _SAME * np.where(size > 0, size, 1.0)
        scale = np.where(good, 1.0 / np.where(good, left, 1.0), 0.0)
        column, value = column * scale[:, None], value * scale
        done.append((column, value))
        out += column * value[:, None]
    return out
