"""Boxes that the surface of a body cuts: volume, centroid and second moments of what lies inside.

The body is known by a predicate of positions only. Samples, corners included, tell which
boxes are cut, and which of their sub-cells, three or more a direction. Those are divided into simplices
around their centres; where the surface crosses the edges of a simplex is found by bisection, and a plane
through the crossings cuts it. Sub-cells in which the surface is far from plane are halved first. That is
exact for plane surfaces at any angle, of second order where the surface is curved or has an edge, and
commutes with the symmetries of the lattice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from ..geometry.grid import box_indices

Test = Callable[[np.ndarray], np.ndarray]
Ask = Callable[[np.ndarray, np.ndarray], np.ndarray]  # the same for rows of cells and positions in them

_PARTS = 3  # sub-cells a direction, at least
_PULL = 1.0 - 1e-9  # samples on a box's faces lie just inside, whichever side the predicate counts a face to
_STEPS = 14  # of bisection
# Where an interval is divided, from the end inside the body: not in its middle, so that surfaces at a simple
# fraction of a box don't pass exactly through a sample, where rounding would decide.
_SPLIT = 0.5132
_BLOCK = 8000  # sub-cells treated at once
_LEVELS = 2  # how often a sub-cell in which the surface has an edge is halved
_FLAT = 0.03  # how far, of a sub-cell's half side, a surface without edges is away from a plane
_NEGLIGIBLE = 1e-6  # share of a box that is nothing, or that a whole box may lack: what bisection can't tell


@dataclass
class InsidePart:
    """What lies inside of some boxes, of which it is the rows `kept` (n,).

    Attributes:
        share: of the box's volume, (n,).
        centre: centroid (m), (n, d).
        covariance: second moments about the centroid over the volume (m^2), (n, d, d).
        cut: whether that is less than the box, (n,).
    """

    kept: np.ndarray
    share: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray
    cut: np.ndarray


def inside_parts(x: np.ndarray, half: np.ndarray, test: Test, parts: int = _PARTS) -> InsidePart:
    """What lies inside the body of boxes around x (n, d) (m) with half lengths (n, d) (m).

    Args:
        parts: sub-cells a direction.
        test: positions (m, d) -> whether they are inside the body (m,); not asked about no positions.
    """
    d = x.shape[1]
    corners = box_indices((parts + 1,) * d)
    unit = (2.0 * corners / parts - 1.0) * _PULL
    state = test((x[:, None] + unit * half[:, None]).reshape(-1, d)).reshape(len(x), len(corners))
    share, centre = np.all(state, axis=1).astype(float), x.copy()
    covariance = half[:, :, None] ** 2 / 3.0 * np.eye(d)
    cut = np.flatnonzero(np.any(state, axis=1) & (share == 0))
    if len(cut):
        volume, first, second = _moments(x[cut], half[cut], state[cut], test, parts)
        part = volume / 2.0**d
        some, whole = part > _NEGLIGIBLE, part > 1.0 - _NEGLIGIBLE
        share[cut] = np.where(whole, 1.0, np.where(some, part, 0.0))
        cut, volume, first, second = (a[some & ~whole] for a in (cut, volume, first, second))
        mean = first / volume[:, None]
        spread = second / volume[:, None, None] - mean[:, :, None] * mean[:, None, :]
        centre[cut] += half[cut] * mean
        covariance[cut] = half[cut][:, :, None] * half[cut][:, None, :] * spread
    kept = np.flatnonzero(share > 0)
    return InsidePart(kept, share[kept], centre[kept], covariance[kept], share[kept] < 1.0)


def half_axes(covariance: np.ndarray) -> np.ndarray:
    """Half axes (n, d, d) of boxes with these second moments (n, d, d): the symmetric root of three times
    them, the only one that needs no order of the eigenvectors."""
    value, vector = np.linalg.eigh(3.0 * covariance)
    root: np.ndarray = (vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ np.swapaxes(vector, 1, 2)
    return root


# the cut boxes, with coordinates from -1 to 1 -----------------------------------------------------
@dataclass
class _Division:
    """A cell from -1 to 1 divided into simplices.

    Attributes:
        vertices: (v, d), the corners first, in the order of `box_indices`.
        simplices: rows of their vertices (s, d + 1).
        edges: rows of their ends (e, 2).
        number: edge between two vertices (v, v).
    """

    vertices: np.ndarray
    simplices: np.ndarray
    edges: np.ndarray
    number: np.ndarray


@cache
def _division(dim: int) -> _Division:
    corners = 2.0 * box_indices((2,) * dim) - 1.0
    faces = np.vstack([np.eye(dim), -np.eye(dim)]) if dim == 3 else np.zeros((0, dim))
    vertices = np.vstack([corners, faces, np.zeros((1, dim))])
    centre = len(vertices) - 1
    simplices: list[tuple[int, ...]] = []
    for a, b in itertools.combinations(range(2**dim), 2):
        if np.abs(corners[a] - corners[b]).sum() > 2.5:
            continue
        around = [2**dim + f for f, n in enumerate(faces) if min(n @ corners[a], n @ corners[b]) > 0.5]
        simplices += [(a, b, f, centre) for f in around] if dim == 3 else [(a, b, centre)]
    rows = np.array(simplices)
    pairs = {tuple(sorted(p)) for s in simplices for p in itertools.combinations(s, 2)}
    edges = np.array(sorted(pairs))
    number = np.zeros((len(vertices), len(vertices)), dtype=np.int64)
    number[edges[:, 0], edges[:, 1]] = number[edges[:, 1], edges[:, 0]] = np.arange(len(edges))
    return _Division(vertices, rows, edges, number)


def _moments(
    x: np.ndarray, half: np.ndarray, state: np.ndarray, test: Test, parts: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Volume (n,), first (n, d) and second moments (n, d, d) of cut boxes, from the states
    (n, (parts + 1)^d) of their samples."""
    n, d = x.shape
    sums = _Sums(n, d)
    whole = _Cells(np.arange(n), np.zeros((n, d)), 1.0, np.zeros((n, 0), dtype=bool))
    waiting = [(whole.divided(parts, state, sums), _LEVELS)]
    while waiting:
        cells, levels = waiting.pop()
        for begin in range(0, len(cells.box), _BLOCK):
            c = cells.rows(slice(begin, begin + _BLOCK))

            def inside(row: np.ndarray, at: np.ndarray, c: _Cells = c) -> np.ndarray:
                box = c.box[row]
                return test(x[box] + (c.centre[row] + c.half * at) * _PULL * half[box])

            flat = c.add_simplices(sums, inside, levels > 0)
            c = c.rows(np.flatnonzero(~flat))
            if len(c.box):
                samples = box_indices((3,) * d) - 1.0
                row = np.repeat(np.arange(len(c.box)), len(samples))
                states = inside(row, np.tile(samples, (len(c.box), 1)), c).reshape(len(c.box), -1)
                waiting.append((c.divided(2, states, sums), levels - 1))
    return sums.volume, sums.first, sums.second


class _Sums:
    """Volume (n,), first (n, d) and second moments (n, d, d) of boxes, summed up from parts."""

    def __init__(self, n: int, dim: int):
        self.volume, self.first, self.second = np.zeros(n), np.zeros((n, dim)), np.zeros((n, dim, dim))

    def add(self, box: np.ndarray, volume: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
        n, dim = self.first.shape
        self.volume += np.bincount(box, volume, minlength=n)
        for i in range(dim):
            self.first[:, i] += np.bincount(box, first[:, i], minlength=n)
            for j in range(dim):
                self.second[:, i, j] += np.bincount(box, second[:, i, j], minlength=n)


@dataclass
class _Cells:
    """Parts of boxes: rows of the boxes (m,), centres (m, d) and half the side in the boxes' coordinates, and
    the states (m, 2^d) of the corners."""

    box: np.ndarray
    centre: np.ndarray
    half: float
    corners: np.ndarray

    def rows(self, rows: Any) -> _Cells:
        return _Cells(self.box[rows], self.centre[rows], self.half, self.corners[rows])

    def divided(self, number: int, states: np.ndarray, sums: _Sums) -> _Cells:
        """The cut ones of number^d parts of each, from the states (m, (number + 1)^d) of the corners of all;
        those that are inside are added to the sums."""
        d = self.centre.shape[1]
        index, half = box_indices((number,) * d), self.half / number
        stride = (number + 1) ** np.arange(d - 1, -1, -1)
        corners = states[:, (index[:, None] + box_indices((2,) * d)) @ stride]  # (m, parts, corners)
        full = np.all(corners, axis=2)
        cell, part = np.nonzero(full)
        at = self.centre[cell] + (2.0 * index[part] + 1.0 - number) * half
        volume = np.full(len(at), (2.0 * half) ** d)
        square = at[:, :, None] * at[:, None, :] + np.eye(d) * half**2 / 3.0
        sums.add(self.box[cell], volume, volume[:, None] * at, volume[:, None, None] * square)
        cell, part = np.nonzero(np.any(corners, axis=2) & ~full)
        at = self.centre[cell] + (2.0 * index[part] + 1.0 - number) * half
        return _Cells(self.box[cell], at, half, corners[cell, part])

    def add_simplices(self, sums: _Sums, inside: Ask, choose: bool) -> np.ndarray:
        """Add what is inside to the sums; with `choose` only of parts in which the surface is nearly plane,
        and tell (m,) which are."""
        d, m = self.centre.shape[1], len(self.box)
        cell = _division(d)
        more = cell.vertices[2**d :]
        asked = inside(np.repeat(np.arange(m), len(more)), np.tile(more, (m, 1)))
        state = np.hstack([self.corners, asked.reshape(m, -1)])
        row, edge, at = _crossings(cell, state, inside)
        flat = _flat(row, at, m) if choose else np.ones(m, dtype=bool)
        crossing = np.zeros((m, len(cell.edges), d))
        crossing[row, edge] = at
        v, of, weight = _simplices_inside(cell, state[flat], crossing[flat])
        of = np.flatnonzero(flat)[of]
        v = self.centre[of][:, None] + self.half * v
        volume = weight * np.abs(np.linalg.det(v[:, 1:] - v[:, :1])) / math.factorial(d)
        total = v.sum(axis=1)
        square = np.swapaxes(v, 1, 2) @ v + total[:, :, None] * total[:, None, :]
        square *= (volume / ((d + 1) * (d + 2)))[:, None, None]
        sums.add(self.box[of], volume, total * (volume / (d + 1))[:, None], square)
        return flat


def _flat(row: np.ndarray, at: np.ndarray, m: int) -> np.ndarray:
    """Whether the points `at` (k, d), of the cells `row`, nearly lie in a plane, for m cells."""
    d = at.shape[1]
    count = np.maximum(np.bincount(row, minlength=m), 1)
    mean = np.stack([np.bincount(row, at[:, i], minlength=m) for i in range(d)], axis=1) / count[:, None]
    away, spread = at - mean[row], np.empty((m, d, d))
    for i in range(d):
        for j in range(d):
            spread[:, i, j] = np.bincount(row, away[:, i] * away[:, j], minlength=m) / count
    flat: np.ndarray = np.linalg.eigvalsh(spread)[:, 0] < _FLAT**2
    return flat


def _simplices_inside(
    cell: _Division, state: np.ndarray, crossing: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simplices that make up what is inside of cells with these states (m, v) of their vertices and crossings
    (m, e, d) on their edges: vertices (k, d + 1, d), rows of the cells (k,) and weights (k,), negative where
    one is taken away."""
    dim = crossing.shape[2]
    states = state[:, cell.simplices]
    count = states.sum(axis=2)
    vertices, of, weights = [], [], []
    for k in range(1, dim + 2):
        row, which = np.nonzero(count == k)
        # those inside come first
        order = np.argsort(~states[row, which], axis=1, kind="stable")
        corner = np.take_along_axis(cell.simplices[which], order, axis=1)
        for weight, ends in _pieces(dim, k):
            made = np.empty((len(row), dim + 1, dim))
            for place, (i, j) in enumerate(ends):
                if i == j:
                    made[:, place] = cell.vertices[corner[:, i]]
                else:
                    made[:, place] = crossing[row, cell.number[corner[:, i], corner[:, j]]]
            vertices.append(made)
            of.append(row)
            weights.append(np.full(len(row), weight))
    return np.concatenate(vertices), np.concatenate(of), np.concatenate(weights)


def _crossings(cell: _Division, state: np.ndarray, inside: Ask) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the surface crosses the edges of cells with these states (m, v) of their vertices: rows of the
    cells and edges, and positions (k, d)."""
    row, edge = np.nonzero(state[:, cell.edges[:, 0]] != state[:, cell.edges[:, 1]])
    first = state[row, cell.edges[edge, 0]]
    start, end = (cell.vertices[cell.edges[edge, np.where(first, k, 1 - k)]] for k in (0, 1))
    low: np.ndarray = np.zeros(len(row))
    high: np.ndarray = np.ones(len(row))
    for _ in range(_STEPS):
        t = low + _SPLIT * (high - low)
        yes = inside(row, start + t[:, None] * (end - start))
        low, high = np.where(yes, t, low), np.where(yes, high, t)
    # a surface through a vertex is found at the vertex, whichever side that was taken for
    t = np.where(low == 0.0, 0.0, np.where(high == 1.0, 1.0, 0.5 * (low + high)))
    return row, edge, start + t[:, None] * (end - start)


@cache
def _pieces(dim: int, count: int) -> list[tuple[float, list[tuple[int, int]]]]:
    """Simplices that make up the part of a simplex whose first `count` vertices are inside: weights, and
    vertices as pairs (i, j): the crossing of that edge, or a vertex where i = j."""
    whole = [(i, i) for i in range(dim + 1)]
    if count == dim + 1:
        return [(1.0, whole)]
    if count == 1:
        return [(1.0, [(0, i) for i in range(dim + 1)])]
    if count == dim:
        return [(1.0, whole), (-1.0, [(dim, i) for i in range(dim, -1, -1)])]
    # two of four: a wedge, whose quadrilateral on the surface is divided both ways
    pieces = []
    for c, d in ((2, 3), (3, 2)):
        pieces.append((0.5, [(0, 0), (0, c), (0, d), (1, 1)]))
        pieces.append((0.5, [(0, c), (0, d), (1, 1), (1, c)]))
        pieces.append((0.5, [(0, d), (1, 1), (1, c), (1, d)]))
    return pieces
