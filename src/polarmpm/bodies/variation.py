"""How fast the deformation gradient of a body of points changes from cell to cell."""

from __future__ import annotations

import numpy as np

from ..geometry.grid import Grid


def cell_means(
    grid: Grid, x: np.ndarray, F: np.ndarray, X: np.ndarray, volume: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lattice numbers, ascending, of the cells that have points at x (np, d), and the means there of F
    (np, 3, 3) and X (np, d), (m, 9 + d), of points that count by their volumes (np,); the same on every
    rank. Collective."""
    cells = grid.cell_number(grid.cells_of(x))
    own, at = np.unique(cells, return_inverse=True)
    rows = np.hstack([np.ones((len(x), 1)), F.reshape(len(x), 9), X]) * volume[:, None]
    sums = np.stack([np.bincount(at.ravel(), c, minlength=len(own)) for c in rows.T], axis=1)
    numbers = np.concatenate(grid.comm.allgather(own))
    every = np.concatenate(grid.comm.allgather(sums))
    found, at = np.unique(numbers, return_inverse=True)
    total = np.stack([np.bincount(at.ravel(), c, minlength=len(found)) for c in every.T], axis=1)
    return found, total[:, 1:] / total[:, :1]


def largest_changes(
    grid: Grid, x: np.ndarray, F: np.ndarray, X: np.ndarray, volume: np.ndarray
) -> list[np.ndarray]:
    """For each axis the largest |dF/dX_i| (1/m) in the whole row of cells around each of its lines (n,): of
    means in cells of points at x, see `cell_means`, from a cell to the next one over the distance of their
    centroids. The same on every rank. Collective."""
    number, means = cell_means(grid, x, F, X, volume)
    F, X = means[:, : -grid.dim], means[:, -grid.dim :]
    index, found = grid.node_index(number), []
    for axis in range(grid.dim):
        value = np.zeros(grid.shape[axis] + 1)
        at = np.searchsorted(number, number + grid.strides[axis])
        at = np.minimum(at, len(number) - 1)
        pair = np.flatnonzero(number[at] == number + grid.strides[axis])
        change = np.linalg.norm(F[at[pair]] - F[pair], axis=1) / np.abs(X[at[pair], axis] - X[pair, axis])
        np.maximum.at(value, index[pair, axis] + 1, change)
        value[0], value[-1] = value[1], value[-2]
        found.append(value)
    return found
