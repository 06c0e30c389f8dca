"""Estimates from a converged step of how far an answer is off, besides the work inside the points' boxes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..geometry.grid import box_indices
from ..tools.parallel import sums_by_number
from ..tools.rows import flat

ROUNDING = 1e-10  # root mean square strain that may be no more than rounding


def strains(system: LoadedPoints, start: np.ndarray) -> np.ndarray:
    """Green's strain increments of the points (np, d, d) since nodal increments `start` (nodes, block)."""
    i = system.interpolation
    eye = np.eye(i.layout.dim)
    before, now = (eye + i.gather(x).gradient for x in (start, system.x))
    change = now @ np.linalg.inv(before)
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
    strain = strains(system, start).reshape(len(x), d * d)
    cells, corners = grid.cells_of(x), box_indices((2,) * d)
    within = grid.within(x, cells)
    rows = np.tile(np.arange(len(x)), len(corners))
    corner = np.repeat(corners, len(x), axis=0)
    numbers = grid.node_number(cells[rows] + corner)
    linear = np.hstack([np.ones((len(rows), 1)), within[rows] - corner])
    known, at = np.unique(numbers, return_inverse=True)
    both = np.hstack([linear, strain[rows]])
    moments = np.empty((len(known), d + 1, both.shape[1]))
    for a in range(d + 1):
        for b in range(both.shape[1]):
            moments[:, a, b] = np.bincount(at, volume[rows] * linear[:, a] * both[:, b], minlength=len(known))
    shape = moments.shape
    moments = sums_by_number(grid.comm, known, flat(moments)).reshape(shape)
    matrix, right = moments[:, :, : d + 1], moments[:, :, d + 1 :]
    matrix = matrix + 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(d + 1)
    fitted = np.linalg.solve(matrix, right)
    share = np.prod(np.where(corner > 0, within[rows], 1.0 - within[rows]), axis=1)
    smooth = np.zeros_like(strain)
    np.add.at(smooth, rows, share[:, None] * np.einsum("ra,rak->rk", linear, fitted[at]))
    squares = (np.sum((strain - smooth) ** 2, axis=1), np.sum(strain**2, axis=1), np.ones(len(x)))
    sums = np.array([volume @ of for of in squares])
    grid.comm.Allreduce(MPI.IN_PLACE, sums)
    return float(sums[0] / max(sums[1], np.finfo(float).tiny)), float(np.sqrt(sums[1] / sums[2]))
