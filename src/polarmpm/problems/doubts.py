"""Estimates from a converged step of how far an answer is off, besides the work inside the points' boxes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..geometry.grid import box_indices
from ..kernels import native
from ..tools.parallel import sums_by_number
from ..tools.rows import flat

ROUNDING = 1e-10  # root mean square strain that may be no more than rounding


def strains(system: LoadedPoints, start: np.ndarray) -> np.ndarray:
    """Green's strain increments of the points (np, d, d) since nodal increments `start` (nodes, block)."""
    i = system.interpolation
    eye = np.eye(i.layout.dim)
    change = eye + i.gather(system.x).gradient
    if start.any():
        change = change @ np.linalg.inv(eye + i.gather(start).gradient)
    green: np.ndarray = 0.5 * (np.swapaxes(change, 1, 2) @ change - eye)
    return green


def missed(system: LoadedPoints) -> float:
    """Share of the strains' squares since the last reset that a sum over the points misses, as they vary over
    what the points stand for; of splines without boxes. Collective.

    Points without half axes are taken for cubes of their volumes, except in cells that they fill: there their
    own second moments tell.
    """
    i, d = system.interpolation, system.interpolation.layout.dim
    axes, volume = _axes(system), i.points.volume0
    F = np.eye(d) + i.gather(system.x).gradient
    along = np.einsum("pijk,plk->plij", _second_gradients(system), axes)
    varying = np.einsum("pai,plaj->plij", F, along)
    varying = 0.5 * (varying + np.swapaxes(varying, 2, 3))
    seen = strains(system, np.zeros_like(system.x))
    sums = [np.einsum("p,plij->", volume, varying**2) / 3.0, np.einsum("p,pij->", volume, seen**2)]
    inside, outside, whole = i.grid.comm.allreduce(np.array([*sums, volume.sum()]))
    strained = inside + outside > ROUNDING**2 * whole  # a body that falls or turns freely isn't
    return float(inside / (inside + outside)) if strained else 0.0


def _axes(system: LoadedPoints) -> np.ndarray:
    """Half axes (np, d, d) of what points stand for that have none."""
    i, d = system.interpolation, system.interpolation.layout.dim
    grid, volume, r = i.grid, i.points.volume0, i.reference
    if i.points.half_axes0.any():
        moved: np.ndarray = np.einsum("pij,pkj->pki", r.F[:, :d, :d], i.points.half_axes0)
        return moved
    axes = 0.5 * volume[:, None, None] ** (1.0 / d) * np.eye(d)
    cells = grid.cells_of(r.x)  # all points of a cell are on one rank
    _, at = np.unique(grid.cell_number(cells), return_inverse=True)
    size, filled = grid.sizes(cells), np.bincount(at, volume)[at]
    away = grid.within(r.x, cells) - 0.5
    lack = np.empty_like(away)
    for k in range(d):
        lack[:, k] = 1.0 - 12.0 * (np.bincount(at, volume * away[:, k] ** 2)[at] / filled)
    full = filled > (1.0 - 1e-6) * np.prod(size, axis=1)
    known = 0.5 * size * np.sqrt(np.maximum(lack, 0.0))
    axes[full] = known[full][:, None, :] * np.eye(d)
    return axes


def _second_gradients(system: LoadedPoints) -> np.ndarray:
    """Second gradients of the displacement increments at the points (np, d, d, d). Collective."""
    i, d = system.interpolation, system.interpolation.layout.dim
    cells = i.basis.supporting_cells(i.grid, i.reference.x)
    table = i.basis.derivatives(i.grid, i.reference.x, cells, 3)
    index = box_indices((table.shape[3],) * d)
    numbers = i.grid.node_number(cells)[:, None] + index @ i.grid.strides
    u = system.x[i.nodes.local(numbers.ravel()), :d].reshape(*numbers.shape, d)
    out = np.empty((len(cells), d, d, d))
    for j in range(d):
        for k in range(d):
            order = np.bincount([j, k], minlength=d)
            weight = np.prod([table[:, a, order[a]][:, index[:, a]] for a in range(d)], axis=0)
            out[:, :, j, k] = np.einsum("pn,pni->pi", weight, u)
    return out


def roughness(system: LoadedPoints, start: np.ndarray) -> tuple[float, float]:
    """How far strain increments are from smooth ones, squared, over their own squares; and their root mean
    square. Collective.

    The smooth ones are, around each corner of the cells, the linear function that is nearest to those of the
    points in the cells there; at a point the means of those of its cell's corners (Zienkiewicz and Zhu's
    recovery). Bending is met exactly, whatever the number of cells.
    """
    i, d = system.interpolation, system.interpolation.layout.dim
    grid, volume, x = i.grid, i.points.volume0, i.reference.x
    upper = np.triu_indices(d)
    strain = np.ascontiguousarray(strains(system, start)[:, upper[0], upper[1]])
    times = np.where(upper[0] == upper[1], 1.0, 2.0)
    cells, corners = grid.cells_of(x), box_indices((2,) * d)
    _, first, cell = np.unique(grid.cell_number(cells), return_index=True, return_inverse=True)
    numbers = np.stack([grid.node_number(cells[first] + corner) for corner in corners], axis=1)
    known, at = np.unique(numbers, return_inverse=True)
    at = at.reshape(numbers.shape)
    # over each cell, about its first corner; around a node each cell has another corner there
    library, parts = native.library(), len(times)
    own = len(x), d, parts, cell, volume, np.ascontiguousarray(grid.within(x, cells)), strain
    of_cells = np.zeros((len(first), d + 1, d + 1 + parts))
    library.polarmpm_fit_sums(*own, of_cells)
    shifts = np.tile(np.eye(d + 1), (len(corners), 1, 1))
    shifts[:, 1:, 0] = -corners
    moments = np.zeros((len(known), *of_cells.shape[1:]))
    for shift, nodes in zip(shifts, at.T, strict=True):
        shifted = shift @ of_cells
        shifted[:, :, : d + 1] = shifted[:, :, : d + 1] @ shift.T
        moments[nodes] += shifted
    shape = moments.shape
    moments = sums_by_number(grid.comm, known, flat(moments)).reshape(shape)
    matrix, right = moments[:, :, : d + 1], moments[:, :, d + 1 :]
    matrix = matrix + 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(d + 1)
    fitted, sums = np.linalg.solve(matrix, right), np.array([0.0, 0.0, volume.sum()])
    library.polarmpm_fit_rest(*own, corners.astype(np.int64), at, fitted, times, sums)
    grid.comm.Allreduce(MPI.IN_PLACE, sums)
    return float(sums[0] / max(sums[1], np.finfo(float).tiny)), float(np.sqrt(sums[1] / sums[2]))
