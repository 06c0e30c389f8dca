"""Checks that no point is lost between ranks, and that grid and points stay together.

In quasi-statics the reference volume stands for the mass, its first moment for the momentum. Weighting
functions sum up to one and reproduce linear fields, so that the volumes that the points give to the nodes
have the points' sum and the points' first moment, at the reset and after each step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np

from ..assembly.interpolation import Interpolation
from ..bodies.points import Points
from ..errors import NotConserved
from ..geometry.grid import Grid
from ..tools.parallel import reduce_in_place

_ROUNDING = 1e-11
_SNAPPED = 2e-8  # of a cell: domains that end so close to a plane are put on it


@dataclass
class Totals:
    """Number of points, volume (m^3), its first moment about the grid's lower corner (m^4), (d,), and the sum
    of the moment's absolute values."""

    count: float
    volume: float
    moment: np.ndarray
    size: float

    @classmethod
    def numbers(cls, points: Points, grid: Grid) -> np.ndarray:
        """Sums over this rank's points, (3 + d,)."""
        v, x = points.volume0, points.x - np.array(grid.lower)
        return np.array([len(v), v.sum(), (v @ np.abs(x)).sum(), *(v @ x)])

    @classmethod
    def of(cls, numbers: np.ndarray) -> Totals:
        return cls(numbers[0], numbers[1], numbers[3:], numbers[2])


class Conservation:
    """What has to stay the same in a run. All methods are collective."""

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._start: Totals | None = None  # at the first reset
        self._volumes: np.ndarray | None = None  # of the nodes (nodes,)

    def moved(self, before: np.ndarray, points: Points, grid: Grid) -> None:
        """Compare the points with the `Totals.numbers` from before they have moved between ranks.

        Raises:
            NotConserved: points, volume or its moment are not what they were.
        """
        both = np.concatenate([before, Totals.numbers(points, grid)])
        self.comm.Allreduce(MPI.IN_PLACE, both)
        old, new = (Totals.of(numbers) for numbers in np.split(both, 2))
        _compare("points have moved between ranks", old, new, 0.0)

    def points_joined(self, number: int) -> None:
        """There are so many more points of the same body, as some have been split."""
        if self._start is not None:
            self._start = replace(self._start, count=self._start.count + number)

    def reset(self, interpolation: Interpolation) -> None:
        """Take the volumes to the nodes of a new interpolation."""
        volume = interpolation.points.volume0[:, None]
        self._volumes = interpolation.spread(volume)[: interpolation.nodes.owned, 0]

    def check(self, interpolation: Interpolation, x: np.ndarray) -> None:
        """Compare the grid with the points after a step of nodal increments x (nodes, block).

        Raises:
            NotConserved: they have drifted apart, or the body isn't what it was at the start.
        """
        points, nodes, grid = interpolation.points, interpolation.nodes, interpolation.grid
        assert self._volumes is not None
        own, d = nodes.owned, grid.dim
        at = nodes.position[:own] - np.array(grid.lower) + x[:own, :d]
        mine = Totals.numbers(points, grid)
        sums = np.array([*mine, self._volumes.sum(), *(self._volumes @ at)])
        reduce_in_place(self.comm, sums)
        now = Totals.of(sums[: len(mine)])
        on_grid = Totals(now.count, sums[len(mine)], sums[len(mine) + 1 :], now.size)
        _compare("a step: grid instead of points", now, on_grid, _SNAPPED * max(grid.largest) * now.volume)
        if self._start is None:
            self._start = now
        start = Totals(self._start.count, self._start.volume, now.moment, now.size)
        _compare("a step: body instead of the one of the first step", start, now, 0.0)


def _compare(when: str, expected: Totals, found: Totals, slack: float) -> None:
    """Raise NotConserved where totals differ; moments may by `slack`."""
    if found.count != expected.count:
        raise NotConserved(f"{when}: {found.count:.0f} material points, {expected.count:.0f} are right")
    if not abs(found.volume - expected.volume) <= _ROUNDING * expected.volume:
        raise NotConserved(f"{when}: the volume is {found.volume:.12g}, {expected.volume:.12g} is right")
    off = np.abs(found.moment - expected.moment).max()
    if not off <= _ROUNDING * expected.size + slack:
        shown = tuple(tuple(float(f"{c:.12g}") for c in t.moment) for t in (found, expected))
        raise NotConserved(f"{when}: the first moment of the volume is {shown[0]}, {shown[1]} is right")
