"""Quadratic B-splines averaged over the points' boxes.

A point that crosses a plane of the grid sees the splines' second derivatives jump; a sum over points then
has an error that no finer grid makes smaller. Means over boxes, of half length l_i along the grid, change
smoothly. But a box that has turned isn't along the grid, and means over one that is spoil bodies that turn:
the half lengths fade out with the off-diagonal entries of F, and reach zero, which is the splines themselves,
at `_TURNED`.

A box may reach into one cell more in each direction. Where that cell supports no point its functions have no
stiffness to speak of, and where the box hardly reaches it, it isn't worth its nodes: the mean is then that of
the own cell's polynomials, continued.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.grid import Grid, box_indices
from ..tools.parallel import known_anywhere
from .base import Weights
from .bspline import QuadraticSplines

_TURNED = 0.25
_REACH = 0.0195  # cells; unlike where boxes of fresh bodies end, a simple fraction
_GAUSS = 3.0**-0.5


class AveragedSplines(QuadraticSplines):
    """Quadratic B-splines for points, averaged over boxes along the grid; surfaces, which have none, take the
    splines themselves."""

    name = "bspline-averaged"
    uses_domains = True

    def domains(self, F: np.ndarray, half_length0: np.ndarray) -> np.ndarray:
        """l_i = |F_ii| l_i0 max(0, 1 - max_(j /= i) |F_ij| / 0.25)."""
        dim = half_length0.shape[1]
        size = np.abs(F[:, :dim, :dim])
        stretch = np.einsum("nii->ni", size).copy()
        size[:, np.arange(dim), np.arange(dim)] = 0.0
        half: np.ndarray = stretch * half_length0 * np.maximum(0.0, 1.0 - size.max(axis=2) / _TURNED)
        return half

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        """Boxes longer than a cell are taken to be as long as one."""
        assert half_length is not None
        cells = grid.cells_of(x) if cells is None else cells
        half = np.minimum(half_length, 0.5 * grid.sizes(cells))
        step = _steps(grid, x, half, cells)
        low, high, lower = x - half, x + half, grid.corners(cells)
        plane = np.where(step < 0, lower, lower + grid.sizes(cells))
        # in its own cell, and in the one that it reaches
        begin, end = np.where(step < 0, plane, low), np.where(step > 0, plane, high)
        mine = self._means(grid, begin, end, cells, orders)
        parts = Parts(cells, step, 1.0 - (end - begin) / np.where(step != 0, high - low, np.inf))
        far = parts.far
        begin, end = np.where(step > 0, plane, low)[far], np.where(step < 0, plane, high)[far]
        other = self._means(grid, begin, end, (cells + step)[far], orders)
        lowest, count = cells + np.minimum(step, 0), (self.functions + np.abs(step)).astype(np.int32)
        return Weights(lowest, count, parts.joined(mine, other))

    def _means(
        self, grid: Grid, low: np.ndarray, high: np.ndarray, cells: np.ndarray, orders: int
    ) -> np.ndarray:
        """Means of what `derivatives` gives over the intervals from low to high (n, d) (m), by Gauss' rule of
        two points, which is exact."""
        centre, away = 0.5 * (low + high), 0.5 * _GAUSS * (high - low)
        means = self.derivatives(grid, centre - away, cells, orders)
        means += self.derivatives(grid, centre + away, cells, orders)
        means *= 0.5
        return means


@dataclass
class Parts:
    """The parts of boxes in the cells that they are in and beside them.

    Attributes:
        cells: lattice index of the own cells (n, d).
        step: from there to the other cell that the box reaches in a direction, -1, 0 or 1, (n, d).
        share: of the box's length in the other cell (n, d), where there is one.
        far: rows of the boxes that reach another cell.
    """

    cells: np.ndarray
    step: np.ndarray
    share: np.ndarray

    @property
    def far(self) -> np.ndarray:
        return np.flatnonzero(np.any(self.step, axis=1))

    def joined(self, mine: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Means over the boxes, from those over the parts in the own cell, (n, d, .., functions), and in the
        other one, of the rows `far` alone: values of all functions of both, the lowest first."""
        far, functions = self.far, mine.shape[-1]
        if not len(far):
            return mine
        table = np.zeros((*mine.shape[:-1], functions + 1))
        table[..., :-1] = mine
        step = self.step[far].reshape(-1, mine.shape[1], *(1,) * (mine.ndim - 2))
        share = np.where(step, self.share[far].reshape(step.shape), 0.0)
        other, mine = share * other, (1.0 - share) * mine[far]
        joined = np.zeros((len(far), *table.shape[1:]))
        joined[..., :-1] = np.where(step < 0, other, mine)
        joined[..., 1:] += np.where(step < 0, mine, other)
        table[far] = joined
        return table


def _steps(grid: Grid, x: np.ndarray, half: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Which cell beside its own (n, d) a box reaches in each direction: -1, 0 or 1. Collective.

    All cells that the box reaches, in several directions at once, support points.
    """
    lower, size = grid.corners(cells), grid.sizes(cells)
    below, above = lower - (x - half), x + half - (lower + size)
    step: np.ndarray = np.where(above > below, 1, -1) * (np.maximum(below, above) > _REACH * size)
    # points that lean on another cell have its polynomials, whose continuation goes on into their own
    step[np.any(cells != grid.cells_of(x), axis=1)] = 0
    step[(cells + step < 0) | (cells + step >= np.array(grid.shape))] = 0
    numbers = grid.cell_number(cells)
    known = np.unique(numbers)
    # first each direction for itself, then all together
    for alone, combinations in (
        (True, np.eye(grid.dim, dtype=np.int64)),
        (False, box_indices((2,) * grid.dim)),
    ):
        # many points ask for the same
        reaching = np.flatnonzero(np.any(step, axis=1))
        code = (step[reaching] + 1) @ 3 ** np.arange(grid.dim)
        asked = np.searchsorted(known, numbers[reaching]) * 3**grid.dim + code
        _, first, at = np.unique(asked, return_index=True, return_inverse=True)
        there = numbers[reaching[first], None] + (step[reaching[first], None] * combinations) @ grid.strides
        found = known_anywhere(grid.comm, known, there.ravel()).reshape(there.shape)
        step[reaching] *= found[at] if alone else np.all(found, axis=1)[at, None]
    return step
