"""Points that belong to two cells in a direction: their weights are means of both cells' polynomials."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..geometry.grid import Grid, box_indices, snap
from ..tools.parallel import known_anywhere
from .base import Weights


def on_planes(grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Whether points at x (n, d) (m) are on the lower planes of the cells of lattice index (n, d) that weight
    them, are in these, and not on the grid's boundary: 0 or 1, (n, d). They are as much in the cell below."""
    on = (snap(grid.within(x, cells)) == 0.0) & (cells > 0) & (cells == grid.cells_of(x))
    return np.where(on, 1, 0)


def supported(grid: Grid, cells: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Steps (n, d), -1, 0 or 1, from points' cells of lattice index (n, d) to other ones, without those to
    cells that support no point. Collective.

    Several steps of a point are left out all together if one of the cells that they lead to supports none.
    """
    numbers = grid.cell_number(cells)
    known = np.unique(numbers)
    # first each direction for itself, then all together
    for alone, combinations in (
        (True, np.eye(grid.dim, dtype=np.int64)),
        (False, box_indices((2,) * grid.dim)),
    ):
        reaching = np.flatnonzero(np.any(step, axis=1))
        # many points ask for the same
        code = (step[reaching] + 1) @ 3 ** np.arange(grid.dim)
        asked = np.searchsorted(known, numbers[reaching]) * 3**grid.dim + code
        _, first, at = np.unique(asked, return_index=True, return_inverse=True)
        there = numbers[reaching[first], None] + (step[reaching[first], None] * combinations) @ grid.strides
        found = known_anywhere(grid.comm, known, there.ravel()).reshape(there.shape)
        step = step.copy()
        step[reaching] *= found[at] if alone else np.all(found, axis=1)[at, None]
    return step


def joined(
    cells: np.ndarray,
    step: np.ndarray,
    share: np.ndarray,
    mine: np.ndarray,
    other: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Weights:
    """Weights of points from tables (n, d, orders, functions) of their own cells (n, d).

    Args:
        step: to the other cell of a point in each direction, or 0 (n, d).
        share: of the other cell (n, d), where there is one.
        other: rows of points and their other cells -> the same tables of those.
    """
    functions = mine.shape[3]
    lowest, count = cells + np.minimum(step, 0), (functions + np.abs(step)).astype(np.int32)
    far = np.flatnonzero(np.any(step, axis=1))
    if not len(far):
        return Weights(lowest, count, mine)
    below = (step[far] < 0)[:, :, None, None]
    there = np.where(step[far], share[far], 0.0)[:, :, None, None]
    own, others = (1.0 - there) * mine[far], there * other(far, cells[far] + step[far])
    table = np.zeros((*mine.shape[:3], functions + 1))
    table[:, :, :, :-1] = mine
    table[far] = 0.0
    # the lowest functions first
    table[far, :, :, :-1] = np.where(below, others, own)
    table[far, :, :, 1:] += np.where(below, own, others)
    return Weights(lowest, count, table)
