"""Weights of points that are several bodies: each body has a copy of the lattice, and its own slivers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..basis.base import Basis, Chosen, Weights
from ..bodies.points import Points
from ..geometry.grid import Grid
from ..tools import checks
from ..tools.parallel import errors_on_all_ranks


def _bodies(points: Points) -> Iterator[tuple[int, np.ndarray | slice]]:
    """Numbers of the bodies, and which of this rank's points are theirs."""
    if points.bodies == 1:
        yield 0, slice(None)
        return
    for body in range(points.bodies):
        yield body, points.body == body


def weights_of_bodies(
    grid: Grid, basis: Basis, points: Points, x: np.ndarray, half: np.ndarray | None, orders: int
) -> tuple[Weights, np.ndarray | None]:
    """Weights of points at x (n, d) (m), and the cells (n, d) whose functions these are, where the basis
    moves slivers. Lowest nodes are those of the bodies' lattices (`Grid.of_bodies`), cells the grid's.
    Collective.

    Args:
        half: half lengths (n, d) (m) of domains, where the basis uses them.
        orders: as of `Basis.weights`.
    """
    made, cells = [], np.zeros(x.shape, dtype=np.int64) if basis.sliver else None
    for _, rows in _bodies(points):
        own, of_rows = None, basis.of_rows(rows)
        if cells is not None:
            own = cells[rows] = of_rows.supporting_cells(grid, x[rows])
        with errors_on_all_ranks(grid.comm):
            w = of_rows.weights(grid, x[rows], None if half is None else half[rows], own, orders)
            checks.instance(f"basis {basis.name!r}: weights", w, Weights, "Weights are")
        made.append((rows, w))
    if points.bodies == 1:
        return made[0][1], cells
    slots = max(w.table.shape[3] for _, w in made)
    lowest, count = np.zeros(x.shape, dtype=np.int64), np.zeros(x.shape, dtype=np.int32)
    table = np.zeros((*x.shape, orders, slots))
    for rows, w in made:
        lowest[rows], count[rows] = w.lowest, w.count
        table[rows, :, :, : w.table.shape[3]] = w.table
    return Weights(grid.of_bodies(lowest, points.body), count, table), cells


def chosen_of_bodies(
    grid: Grid, basis: Basis, points: Points, x: np.ndarray, half: np.ndarray | None, orders: int
) -> Chosen:
    """What a basis has chosen for points at x (n, d) (m), body by body; arguments as of `weights_of_bodies`.
    Collective."""
    cells, lowest, count = (np.zeros(x.shape, dtype=np.int64) for _ in range(3))
    for _, rows in _bodies(points):
        of = Chosen.by(basis, grid, x[rows], None if half is None else half[rows], orders)
        cells[rows], lowest[rows], count[rows] = of.cells, of.lowest, of.count
    return Chosen(x, half, cells, lowest, count, orders)


def patches_of_bodies(
    grid: Grid, basis: Basis, points: Points, x: np.ndarray, cells: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Patches (n, d) of points at x (n, d) (m), no two bodies' the same, and places in them (n, d).
    Collective."""
    index, places = np.zeros(x.shape, dtype=np.int64), np.zeros(x.shape)
    for _, rows in _bodies(points):
        found = basis.of_rows(rows).patches(grid, x[rows], None if cells is None else cells[rows])
        index[rows], places[rows] = found
    return (index if points.bodies == 1 else grid.of_bodies(index, points.body)), places
