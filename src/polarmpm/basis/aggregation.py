"""Slivers: cells of which the body only fills a thin layer at a face.

A B-spline of which the body fills only the tail has hardly any stiffness: its weight goes with a power of the
layer's thickness, in each direction. The points of such a layer are weighted instead with the polynomials of
the cell behind the face, continued through it (cell aggregation). Then every function that is left reaches
well into the body. Polynomials of the splines' degree are still represented exactly.

A point on a plane is in the cells on both sides, or a mirrored body would have other slivers. How thin a
sliver is must not be decided by rounding, or a body that is moved by whole cells has another answer. So the
limits are as far as can be (.0045 and .006 cells) from where points of fresh bodies lie: at the centres and
faces of up to twelve equal boxes a cell, at Gauss positions, at multiples of a fortieth, where the
centroids of boxes cut at simple places are.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..geometry.grid import Grid, box_indices, snap
from ..tools.parallel import Route, values_by_number


def supporting_cells(grid: Grid, x: np.ndarray, thickness: float) -> np.ndarray:
    """Lattice index (n, d) of the cell whose polynomials weight each point at x (n, d) (m). Collective.

    That is the cell that the point is in, or for slivers the cell behind the face, if there are points in it.

    Args:
        thickness: the largest one of a sliver, in cells.
    """
    comm, dim = grid.comm, grid.dim
    index = grid.cells_of(x)
    members, right = _members(grid, x, index)
    own, at = np.unique(grid.cell_number(members), return_inverse=True)
    depth = np.zeros((len(own), 2 * dim))  # how far the points reach from the lower and the upper faces
    np.maximum.at(depth, at, np.hstack([right, 1.0 - right]))
    # each cell has one rank that knows all of its points
    book = Route(comm, own % comm.size)
    cells, place = np.unique(book.forward(own), return_inverse=True)
    deepest = np.zeros((len(cells), 2 * dim))
    np.maximum.at(deepest, place, book.forward(depth))
    thin = deepest < thickness
    step = thin[:, dim:].astype(np.int64) - thin[:, :dim]

    def at_target() -> np.ndarray:
        """The steps of the cells behind the faces, and whether there are points in them."""
        known = np.hstack([step, np.ones((len(step), 1), dtype=np.int64)])
        wanted = cells + step @ grid.strides
        return values_by_number(comm, cells, known.astype(float), wanted).astype(np.int64)

    # where all cells are slivers, as with one point a cell near a plane, none can be moved to another one
    target = at_target()
    leans = (target[:, -1] > 0) & np.all((step == 0) | (target[:, :-1] == 0), axis=1) & np.any(step, axis=1)
    alone = np.any(step, axis=1) & ~leans
    if comm.allreduce(int(np.any(alone))):  # but the body's last ones, whose tails no other point reaches
        ends = _ends(comm, grid, cells, step * alone[:, None])
        step = np.where(leans[:, None], step, ends)
        target = at_target()
        leans = (
            (target[:, -1] > 0) & np.all((step == 0) | (target[:, :-1] == 0), axis=1) & np.any(step, axis=1)
        )
    step *= leans[:, None]
    # the cell behind the face may be a sliver in another direction
    step += at_target()[:, :-1] * leans[:, None]
    moved = values_by_number(comm, cells, step.astype(float), own).astype(np.int64)
    supporting: np.ndarray = index + moved[at[: len(x)]]
    return supporting


def _ends(comm: MPI.Comm, grid: Grid, cells: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Steps (m, d) of cells (numbers, (m,)) along the axes on whose other side no cell has points.

    Collective."""
    out, one = np.zeros_like(step), np.ones((len(cells), 1))
    for i, stride in enumerate(grid.strides):
        across = values_by_number(comm, cells, one, cells - step[:, i] * stride)[:, 0]
        out[:, i] = np.where(across > 0, 0, step[:, i])
    return out


def _members(grid: Grid, x: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lattice indices (m, d) of the cells that points at x (n, d) (m) are in, and coordinates (m, d) in them:
    first those of `index` (n, d), then those below the planes that points are on."""
    right = grid.within(x, index)
    on = (snap(right) == 0.0) & (index > 0)
    members, coordinates = [index], [right]
    for below in box_indices((2,) * grid.dim)[1:]:
        rows = np.all(on | (below == 0), axis=1)
        members.append(index[rows] - below)
        coordinates.append(right[rows] + below)
    return np.concatenate(members), np.concatenate(coordinates)
