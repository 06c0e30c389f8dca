"""Points that are split into parts, where their boxes are too large for the cells of a new grid.

A box is cut into equal boxes along its half axes. All parts have the deformation, the rotation and the
history of their point, so that energy, volume, its first moment and the second moments of the boxes stay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..tools.machine import check_memory
from ..tools.parallel import errors_on_all_ranks
from .lineage import Lineage
from .points import Points

LARGE = 0.75  # of a cell: boxes from there on come to lie in two of them
_SLACK = 0.25  # of a part, by which boxes may be too large
_SAME = 0.02  # of a ratio: it is a whole number
_SMALLER = 0.99  # sizes of cells over those of before from which on they are smaller
_BYTES = 3000  # of a point in a problem
_BOX = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])  # where the cells around a box are looked at


@dataclass
class Split:
    """How local points have been split.

    Attributes:
        rows: row of the point of which each part is (m,); points that stay whole are there once.
        number: of parts of that point (m,).
    """

    rows: np.ndarray
    number: np.ndarray

    def copied(self, values: np.ndarray) -> np.ndarray:
        """Rows (m, ...) of parts that have what their point has (n, ...)."""
        out: np.ndarray = values[self.rows]
        return out

    def shared(self, values: np.ndarray) -> np.ndarray:
        """Rows (m, ...) of parts that share what their point has (n, ...)."""
        out: np.ndarray = values[self.rows] / self.number.reshape(-1, *[1] * (values.ndim - 1))
        return out


def check_splittable(points: Points) -> None:
    """Raise InputError for points that can't be split. Collective."""
    with errors_on_all_ranks(points.comm):
        if points.axisymmetric:
            raise InputError(
                "regrid: points of a body of revolution can't be split, as the parts of a ring aren't equal"
            )
        if len(points) and not np.all(np.any(points.half_axes0, axis=(1, 2))):
            raise InputError(
                "regrid: some points have no boxes that could be split (layout='gauss' seeds such points, "
                "and Points(...) without half axes and half lengths)"
            )


def points_per_cell(points: Points, grid: Grid) -> np.ndarray:
    """How many points the body has along each axis of a cell (d,), as a rule. Collective."""
    half = np.maximum(points.half_length0, 1e-300)
    ratio = 0.5 * grid.sizes(grid.cells_of(points.x)) / half
    v = points.volume0
    sums = points.comm.allreduce(np.append(v @ ratio, v.sum()))
    number: np.ndarray = np.maximum(1, np.rint(sums[:-1] / sums[-1])).astype(np.int64)
    return number


def parts_for(points: Points, before: Grid, grid: Grid, per_cell: np.ndarray) -> np.ndarray:
    """Into how many parts (np, d) along their half axes boxes are to be cut, so that cells of a grid that are
    smaller than those of `before` have about so many points (d,) along each axis."""
    d = points.dim
    axes = np.einsum("pij,pkj->pki", points.F[:, :d, :d], points.half_axes0)
    size = np.full((len(points), d), np.inf)
    old = size.copy()
    reach = np.abs(axes).sum(axis=1)
    low, high = np.array(grid.lower), np.array(grid.upper)
    for s in _BOX:
        x = np.clip(points.x + s * reach, low, high)
        size = np.minimum(size, grid.sizes(grid.cells_of(x)))
        old = np.minimum(old, before.sizes(before.cells_of(x)))
    wanted = np.where(size < _SMALLER * old, size / per_cell, np.inf)
    ratio = np.max(2.0 * np.abs(axes) / wanted[:, None, :], axis=2, initial=0.0)
    with errors_on_all_ranks(points.comm):
        number = float(np.prod(np.maximum(1.0, ratio), axis=1).sum())
        check_memory("regrid", list(grid.shape), int(min(number, 1e15)) * _BYTES)
        return _numbers(ratio)


def parts_of_large(points: Points, grid: Grid) -> np.ndarray:
    """Into how many parts (np, d) along their half axes boxes are to be cut that were seeded about as large
    as cells of the grid, or larger, so that parts are half a cell. Boxes of 2 points a cell stay."""
    sizes = grid.sizes(grid.cells_of(points.X))
    ratio = 2.0 * np.linalg.norm(points.half_axes0 / sizes[:, None, :], axis=2)
    number: np.ndarray = np.where(ratio > LARGE, np.ceil(2.0 * ratio - _SLACK), 1.0).astype(np.int64)
    return number


def _numbers(ratio: np.ndarray) -> np.ndarray:
    """Numbers of parts for ratios of sizes: the whole number that a ratio is, else a power of two, so that
    parts of points that are split again and again fit together."""
    near = np.rint(ratio)
    whole = np.abs(ratio - near) <= _SAME * ratio
    power = np.exp2(np.ceil(np.log2(np.maximum(ratio - _SLACK, 1.0))))
    number: np.ndarray = np.maximum(1, np.where(whole, near, power)).astype(np.int64)
    return number


def split(points: Points, parts: np.ndarray, grid: Grid) -> Split:
    """Cut the points' boxes into parts (np, d) along their half axes; parts get new ids, in the order of
    their points' ids. Points of which a part would lie outside the grid stay whole. Collective."""
    d, comm = points.dim, points.comm
    made, offset = _parts(points, parts)
    moved = np.einsum("pij,pj->pi", points.F[made.rows, :d, :d], offset)
    outside = ~grid.inside(points.x[made.rows] + moved)
    if np.any(outside):
        parts = parts.copy()
        parts[np.unique(made.rows[outside])] = 1
        made, offset = _parts(points, parts)
        moved = np.einsum("pij,pj->pi", points.F[made.rows, :d, :d], offset)
    number = np.prod(parts, axis=1)
    mine = np.stack([points.id[number > 1], number[number > 1]], axis=1)
    every = np.concatenate(comm.allgather(mine))
    if not len(every):
        return made
    every = every[np.argsort(every[:, 0])]
    points.remember_ids()
    first = points._last_id + 1
    lineage = (points.lineage or Lineage.none()).with_split(every[:, 0], every[:, 1], first)
    arrays = {name: made.copied(a) for name, a in points.arrays().items()}
    arrays["volume0"] = made.shared(points.volume0)
    arrays["X"], arrays["x"] = arrays["X"] + offset, arrays["x"] + moved
    if "counted_from" in arrays:
        arrays["counted_from"] = arrays["counted_from"] + moved  # displacements stay
    axes = arrays["half_axes0"] / parts[made.rows][:, :, None]
    arrays["half_length0"] = arrays["half_length0"] * _shorter(arrays["half_axes0"], axes)
    arrays["half_axes0"] = axes
    for name in {"side_F", "side_gradients"} & arrays.keys():
        arrays[name] = arrays[name] / parts[made.rows][:, :, None, None]
    arrays["id"] = _ids(points.id, made, every, lineage.first[len(lineage.first) - len(every) :])
    known = points.fingerprints()
    points.replace(arrays)
    points.lineage = lineage
    points._last_id = int(lineage.first[-1] + lineage.count[-1] - 1)
    points._fingerprints = (*points.fingerprints(), *known)  # selections of before stay valid
    return made


def _parts(points: Points, parts: np.ndarray) -> tuple[Split, np.ndarray]:
    """The parts, and where they are from the middle of their boxes (m, d), undeformed."""
    number = np.prod(parts, axis=1)
    rows = np.repeat(np.arange(len(points)), number)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
    offset = np.zeros((len(rows), points.dim))
    for k in range(points.dim):
        n = parts[rows, k]
        share = (2.0 * (within % n) + 1.0 - n) / n
        within = within // n
        offset += share[:, None] * points.half_axes0[rows, k]
    return Split(rows, number[rows]), offset


def _shorter(before: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """By what factor the extents along the coordinates of boxes with half axes (m, d, d) have shrunk."""
    old, new = (np.sqrt(np.einsum("pki,pki->pi", a, a)) for a in (before, axes))
    ratio: np.ndarray = new / np.where(old > 0.0, old, 1.0)
    return np.where(old > 0.0, ratio, 1.0)


def _ids(ids: np.ndarray, made: Split, every: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Ids of parts (m,), of points that have been split (k, 2), all of them, with ids of their first
    parts."""
    mine = ids[made.rows]
    at = np.minimum(np.searchsorted(every[:, 0], mine), len(every) - 1)
    new = np.r_[True, made.rows[1:] != made.rows[:-1]] if len(mine) else np.zeros(0, dtype=bool)
    start = np.maximum.accumulate(np.where(new, np.arange(len(mine)), 0)) if len(mine) else new
    within = np.arange(len(mine)) - start
    found: np.ndarray = np.where(made.number > 1, first[at] + within, mine)
    return found
