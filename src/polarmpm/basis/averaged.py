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

import numpy as np

from ..geometry.grid import Grid
from .base import Chosen, Weights
from .bspline import QuadraticSplines
from .parts import joined, on_planes, supported

_TURNED = 0.25
_REACH = 0.0095  # cells; unlike where boxes of fresh bodies end, a simple fraction
_GAUSS = 3.0**-0.5
_LEAST = 1e-4  # of a cell: shorter boxes see no kink


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
        """Boxes longer than a cell are taken to be as long as one, and not to reach through the next one."""
        assert half_length is not None
        cells = grid.cells_of(x) if cells is None else cells
        half = np.minimum(half_length, 0.5 * grid.sizes(cells))
        if not grid.equal:
            half = _within_next(grid, x, half, cells)
        return self._joined_means(grid, x, half, cells, _steps(grid, x, half, cells), orders)

    def _joined_means(
        self,
        grid: Grid,
        x: np.ndarray,
        half: np.ndarray,
        cells: np.ndarray,
        step: np.ndarray,
        orders: int,
    ) -> Weights:
        """Means over boxes that reach into the cells that are `step` (n, d) from their own."""
        low, high, lower = x - half, x + half, grid.corners(cells)
        plane = np.where(step < 0, lower, lower + grid.sizes(cells))
        # in its own cell, and in the one that it reaches
        begin, end = np.where(step < 0, plane, low), np.where(step > 0, plane, high)
        mine = self._means(grid, begin, end, cells, orders)
        if orders > 2:
            self._put_slopes(mine, grid, (x, half, step), begin, end, cells)
        length = high - low
        share = np.where(length > 0, 1.0 - (end - begin) / np.where(length > 0, length, 1.0), 0.5)

        def other(rows: np.ndarray, there: np.ndarray) -> np.ndarray:
            begin = np.where(step > 0, plane, low)[rows]
            end = np.where(step < 0, plane, high)[rows]
            means = self._means(grid, begin, end, there, orders)
            if orders > 2:
                self._put_slopes(means, grid, (x[rows], half[rows], step[rows]), begin, end, there)
            return means

        return joined(cells, step, share, mine, other)

    def continued(self, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, like: Chosen) -> Weights:
        assert half_length is not None
        cells = like.cells
        half = np.minimum(half_length, 0.5 * grid.sizes(cells))
        if not grid.equal:
            half = _within_next(grid, x, half, cells)
        more = like.count - self.functions
        step = np.where(like.lowest < cells, -more, more)
        return self._joined_means(grid, x, half, cells, step, like.orders)

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

    def _put_slopes(
        self,
        means: np.ndarray,
        grid: Grid,
        boxes: tuple[np.ndarray, np.ndarray, np.ndarray],
        low: np.ndarray,
        high: np.ndarray,
        cells: np.ndarray,
    ) -> None:
        """Of boxes (x, half length, step) that reach another cell, let second derivatives be the slopes of
        the lines that fit the first ones best, with their kink: 3 / l^2 times the mean of xi N' over the box,
        here over the parts from low to high (n, d) (m). Stresses that are linear in boxes are then in balance
        with what acts on them wherever the cells are."""
        x, half, step = boxes
        centre, away = 0.5 * (low + high), 0.5 * _GAUSS * (high - low)
        moment = np.zeros(means[:, :, 1].shape)
        for at in (centre - away, centre + away):
            moment += 0.5 * (at - x)[:, :, None] * self.derivatives(grid, at, cells, 2)[:, :, 1]
        reaching = (step != 0) & (half > _LEAST * grid.sizes(cells))
        square = np.where(reaching, half, 1.0) ** 2
        means[:, :, 2] = np.where(reaching[:, :, None], 3.0 * moment / square[:, :, None], means[:, :, 2])


def _within_next(grid: Grid, x: np.ndarray, half: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Half lengths (n, d) (m) that end in the cells beside those that the points are in."""
    below, above = x - grid.corners(cells - 1), grid.corners(cells + 2) - x
    limited: np.ndarray = np.minimum(half, np.maximum(np.minimum(below, above), 0.0))
    return limited


def _steps(grid: Grid, x: np.ndarray, half: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Which cell beside its own (n, d) a box reaches in each direction: -1, 0 or 1. Collective."""
    lower, size = grid.corners(cells), grid.sizes(cells)
    below, above = lower - (x - half), x + half - (lower + size)
    step: np.ndarray = np.where(above > below, 1, -1) * (np.maximum(below, above) > _REACH * size)
    # points that lean on another cell have its polynomials, whose continuation goes on into their own
    step[cells != grid.cells_of(x)] = 0
    step[(cells + step < 0) | (cells + step >= np.array(grid.shape))] = 0
    return supported(grid, cells, np.where(step == 0, -on_planes(grid, x, cells), step))
