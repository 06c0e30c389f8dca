"""Coarser lattices: which lines stay, and from which coarse nodes a node is interpolated.

Lines go where cells are small: where they are equal every second line, of flat cells and between graded
lines first those of the short sides. Relaxation of points leaves errors that vary slowly across short sides
only, and what it leaves is what the coarser lattice takes over. Interpolation is linear between the nodes'
positions, so that translations and rotations are kept exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

PARENTS = 8  # of a node, in space
_SMALL = 3.0  # two cells become one where they are together no longer than so many of the smallest one
_STEEPER = 1.25  # more of them, where that takes too few nodes away
_ENOUGH = 0.8  # of the nodes are left


@dataclass
class Lines:
    """Lines of a lattice along an axis.

    Attributes:
        at: coordinates (lines,) (m).
        between: nodes stand in the middle between two lines, not on them.
    """

    at: np.ndarray
    between: bool

    @property
    def nodes(self) -> np.ndarray:
        """Their positions (m)."""
        found: np.ndarray = 0.5 * (self.at[1:] + self.at[:-1]) if self.between else self.at
        return found

    @property
    def smallest(self) -> float:
        """Size (m) of the smallest cell, of a single line infinite."""
        return float(np.diff(self.at).min(initial=np.inf)) if len(self.nodes) > 1 else np.inf

    def thinned(self, most: float) -> Lines:
        """The lines without those between two cells that are together no longer than `most` (m)."""
        at, kept, i, last = self.at, [float(self.at[0])], 0, len(self.at) - 1
        while i < last:
            step = at[i + 1] - at[i]
            if i + 1 < last and at[i + 2] - at[i] <= most:
                i += 2
                kept.append(float(at[i]))
            elif i + 1 == last and 2.0 * step <= most:
                i += 1
                kept.append(float(at[i] + step))
            else:
                i += 1
                kept.append(float(at[i]))
        if self.between:  # nodes near the ends are between coarse ones, too
            kept = [2 * kept[0] - kept[1], *kept, 2 * kept[-1] - kept[-2]]
        return Lines(np.array(kept), self.between)

    def share(self, coarse: Lines) -> tuple[np.ndarray, np.ndarray]:
        """For each node the coarse node before it, and the part of the next one."""
        if self.between:
            return self._share_of_splines(coarse.at)
        x, nodes = self.nodes, coarse.nodes
        if len(nodes) == 1:
            return np.zeros(len(x), dtype=np.int64), np.zeros(len(x))
        k = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
        t = (x - nodes[k]) / (nodes[k + 1] - nodes[k])
        t = np.where(np.abs(t) < 1e-9, 0.0, np.where(np.abs(t - 1.0) < 1e-9, 1.0, t))
        return k + (t == 1.0), np.where(t == 1.0, 0.0, t)

    def _share_of_splines(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Quadratic splines between the lines T, which are some of the lines here, in terms of those here, by
        their blossoms; linear functions stay linear."""
        low, high = self.at[:-1], self.at[1:]
        k = np.clip(np.searchsorted(T, self.nodes, side="right") - 1, 1, len(T) - 3)
        slack = 1e-9 * (high - low)
        first, last = np.abs(low - T[k]) <= slack, np.abs(high - T[k + 1]) <= slack
        before = (high - T[k - 1]) / (T[k + 1] - T[k - 1])
        after = (low - T[k]) / (T[k + 2] - T[k])
        return k - (first & ~last), np.where(first & last, 0.0, np.where(first, before, after))


@dataclass
class Coarsening:
    """A coarser lattice.

    Attributes:
        lines: of each axis.
        index: of its nodes (m, d), ascending.
        parents, weights: of the finer nodes (n, PARENTS), -1 and zero behind the last one.
        reach: the largest distance of two coarse nodes that are coupled.
    """

    lines: tuple[Lines, ...]
    index: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    reach: int


def coarsened(
    lines: tuple[Lines, ...], index: np.ndarray, reach: int, known: np.ndarray
) -> Coarsening | None:
    """A coarser lattice than that of nodes `index` (n, d), of which no two are coupled that are further apart
    than `reach`; None: there is none. `known` (k, d) are all nodes there are, on any rank."""
    smallest = min(axis.smallest for axis in lines)
    if not np.isfinite(smallest):
        return None
    most, found = _SMALL * (1.0 + 1e-9) * smallest, None
    longest = max(float(axis.at[-1] - axis.at[0]) for axis in lines)
    while True:
        coarse = tuple(axis.thinned(most) for axis in lines)
        found = _onto(lines, coarse, index, reach, known)
        if len(found.index) <= _ENOUGH * len(known):
            return found
        if most > 2.0 * longest:
            return found if len(found.index) < 0.9 * len(known) else None
        most *= _STEEPER


def _onto(
    lines: tuple[Lines, ...], coarse: tuple[Lines, ...], index: np.ndarray, reach: int, known: np.ndarray
) -> Coarsening:
    shares = [fine.share(axis) for fine, axis in zip(lines, coarse, strict=True)]
    numbers = np.array([len(axis.nodes) + 1 for axis in coarse])
    strides = np.array([int(np.prod(numbers[k + 1 :])) for k in range(len(numbers))], dtype=np.int64)
    ids, _ = _parents(shares, known, strides)
    unique = np.unique(ids[ids >= 0])
    ids, weights = _parents(shares, index, strides)
    parents = np.where(ids >= 0, np.searchsorted(unique, ids), -1).astype(np.int32)
    found = np.stack([unique // s % n for s, n in zip(strides, numbers, strict=True)], axis=1)
    coarse_reach = max(_reach(k, t, reach) for k, t in shares)
    low, high = found.min(axis=0), found.max(axis=0)  # lines that no node needs would hinder the next level
    coarse = tuple(
        Lines(axis.at[a : b + 1 + axis.between], axis.between)
        for axis, a, b in zip(coarse, low, high, strict=True)
    )
    return Coarsening(coarse, found - low, parents, weights, coarse_reach)


def _parents(
    shares: list[tuple[np.ndarray, np.ndarray]], index: np.ndarray, strides: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of coarse nodes, and their weights, (n, PARENTS)."""
    ids = np.full((len(index), PARENTS), -1, dtype=np.int64)
    weights = np.zeros((len(index), PARENTS))
    filled = np.zeros(len(index), dtype=np.int64)
    rows = np.arange(len(index))
    first = [k[index[:, a]] for a, (k, _) in enumerate(shares)]
    part = [t[index[:, a]] for a, (_, t) in enumerate(shares)]
    for corner in product((0, 1), repeat=len(shares)):
        weight, number = np.ones(len(index)), np.zeros(len(index), dtype=np.int64)
        for a, upper in enumerate(corner):
            weight *= part[a] if upper else 1.0 - part[a]
            number += (first[a] + upper) * strides[a]
        some = weight != 0.0
        ids[rows[some], filled[some]] = number[some]
        weights[rows[some], filled[some]] = weight[some]
        filled += some
    return ids, weights


def _reach(k: np.ndarray, t: np.ndarray, reach: int) -> int:
    last = k + (t != 0.0)
    found = int((last - k).max(initial=0))
    for step in range(1, min(reach, len(k) - 1) + 1):
        found = max(found, int((last[step:] - k[:-step]).max()))
    return found
