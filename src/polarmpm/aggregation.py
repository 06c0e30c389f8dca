"""Slivers: cells of which the body only fills a thin layer at a face.

A B-spline that reaches the body with its tail only has next to no stiffness: its weight goes with the square
of the layer's thickness, in each direction. The points of such a layer are weighted instead with the
polynomials of the cell behind the face, continued through it (cell aggregation). Then every function that is
left reaches well into the body. Quadratic fields are still represented exactly.
"""

from __future__ import annotations

import numpy as np

from .grid import Grid
from .parallel import Route, look_up

_THIN = 0.1  # largest thickness of a sliver, in cells


def supporting_cells(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Lattice index (n, d) of the cell whose polynomials weight each point at x (n, d) (m). Collective.

    That is the cell that the point is in, or for slivers the cell behind the face, if there are points in it.
    """
    comm, dim = grid.comm, grid.dim
    index = grid.cells_of(x)
    right = grid.local(x) - index
    own, at = np.unique(grid.cell_number(index), return_inverse=True)
    depth = np.zeros((len(own), 2 * dim))  # how far the points reach from the lower and the upper faces
    np.maximum.at(depth, at, np.hstack([right, 1.0 - right]))
    # each cell has one rank that knows all of its points
    book = Route(comm, own % comm.size)
    cells, place = np.unique(book.forward(own), return_inverse=True)
    deepest = np.zeros((len(cells), 2 * dim))
    np.maximum.at(deepest, place, book.forward(depth))
    thin = deepest < _THIN
    step = thin[:, dim:].astype(np.int64) - thin[:, :dim]

    def among_cells(numbers: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Steps of cells, and whether they have points."""
        known = np.hstack([step, np.ones((len(step), 1), dtype=np.int64)])
        return look_up(comm, numbers, known.astype(float), wanted).astype(np.int64)

    step *= among_cells(cells, cells + step @ grid.strides)[:, -1:]
    # the cell behind the face may be a sliver in another direction
    step += among_cells(cells, cells + step @ grid.strides)[:, :-1] * np.any(step, axis=1)[:, None]
    return index + among_cells(cells, own)[at, :-1]
