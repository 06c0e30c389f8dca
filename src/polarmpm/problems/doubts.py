"""Estimates from a converged step of how far an answer is off, besides the work inside the points' boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..geometry.grid import box_indices
from ..kernels import native
from ..tools.parallel import sums_by_number
from ..tools.rows import flat

ROUNDING = 1e-10  # root mean square strain that may be no more than rounding
PRESSURE = 0.002  # share of the squares of stresses that counts beside that of their deviators
THIN = 0.03  # variance of positions, in cells: changes across half a cell are doubtful


def strains(system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None) -> np.ndarray:
    """Green's strain increments of the points (np, d, d) since nodal increments `start` (nodes, block);
    `gradient`: of the present increments at the points (np, d, d), where it is known."""
    i = system.interpolation
    eye = np.eye(i.layout.dim)
    change = i.gather(system.x).gradient if gradient is None else gradient
    if start.any():
        change = (eye + change) @ np.linalg.inv(eye + i.gather(start).gradient) - eye
    green = np.empty_like(change)
    for some in _parts(len(change)):
        green[some] = 0.5 * np.moveaxis(_twice_green(_last(change[some])), -1, 0)
    return green


def _twice_green(gradient: np.ndarray) -> np.ndarray:
    """F^T F - I of gradients F - I (d, d, n), which keeps small ones' digits."""
    twice: np.ndarray = np.einsum("aip,ajp->ijp", gradient, gradient)
    twice += gradient + np.swapaxes(gradient, 0, 1)
    return twice


def missed(system: LoadedPoints, present: np.ndarray | None = None) -> float:
    """Share of the strains' squares since the last reset that a sum over the points misses, as they vary over
    what the points stand for; `present`: `gradient` of `strains`. Collective.

    Points without half axes are taken for cubes of their volumes, except in cells that they fill: there their
    own second moments tell.
    """
    i, d = system.interpolation, system.interpolation.layout.dim
    axes, volume = _axes(system), i.points.volume0
    change, eye = i.gather(system.x).gradient if present is None else present, np.eye(d)[:, :, None]
    cells = i.basis.supporting_cells(i.grid, i.reference.x)
    inside = outside = 0.0
    for some in _parts(len(volume)):
        second, gradient = _second_gradients(system, cells[some], some), _last(change[some])
        along = np.einsum("ijkp,lkp->lijp", second, _last(axes[some]))
        varying = np.einsum("aip,lajp->lijp", gradient + eye, along)
        varying = varying + np.swapaxes(varying, 1, 2)  # twice the strain's derivatives
        seen = _twice_green(gradient)
        inside += volume[some] @ np.einsum("lijp,lijp->p", varying, varying) / 12.0
        outside += volume[some] @ np.einsum("ijp,ijp->p", seen, seen) / 4.0
    inside, outside, whole = i.grid.comm.allreduce(np.array([inside, outside, volume.sum()]))
    strained = inside + outside > ROUNDING**2 * whole  # a body that falls or turns freely isn't
    return float(inside / (inside + outside)) if strained else 0.0


def _last(rows: np.ndarray) -> np.ndarray:
    """Points along the last axis instead of the first: sums over components are then loops over points."""
    return np.ascontiguousarray(np.moveaxis(rows, 0, -1))


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


_AT_ONCE = 4096  # points, so that it takes no memory but a cache's


def _parts(number: int) -> Iterator[slice]:
    for begin in range(0, number, _AT_ONCE):
        yield slice(begin, begin + _AT_ONCE)


def _second_gradients(system: LoadedPoints, cells: np.ndarray, some: slice) -> np.ndarray:
    """Second gradients of the displacement increments at points of cells (n, d), (d, d, d, n); of functions
    without second derivatives the mixed ones of what is linear in each direction of a cell."""
    i, d = system.interpolation, system.interpolation.layout.dim
    grid, x = i.grid, i.reference.x[some]
    if i.basis.fills_boxes:
        table = i.basis.derivatives(grid, x, cells, 3)
    else:
        table = _linear(grid.within(x, cells), grid.sizes(cells))
    width = (table.shape[3],) * d
    numbers = grid.node_number(cells)[:, None] + box_indices(width) @ grid.strides
    at, table = i.nodes.local(numbers.T.ravel()), _last(table)
    u = np.ascontiguousarray(system.x[at, :d].T).reshape(d, *width, len(cells))
    out = np.zeros((d, d, d, len(cells)))
    for j in range(d):
        for k in range(j, d):
            orders = np.bincount([j, k], minlength=d)
            if i.basis.fills_boxes or j != k:
                out[:, j, k] = out[:, k, j] = _summed(u, [table[a, order] for a, order in enumerate(orders)])
    return out


def _summed(u: np.ndarray, weights: Sequence[np.ndarray]) -> np.ndarray:
    """Sums of nodal values (c, w, ..., w, n), with weights (w, n) along each axis of the nodes."""
    for weight in weights:
        u = np.einsum("cw...p,wp->c...p", u, weight)
    return u


def _linear(within: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Values and derivatives (n, d, 2, 2) of linear functions at places in cells (n, d)."""
    slope = np.stack([-1.0 / size, 1.0 / size], axis=2)
    values = np.stack([1.0 - within, within], axis=2)
    return np.stack([values, slope], axis=2)


def _shifted(of_cells: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Moments (m, 1 + d, 1 + d + c) about the corners that lie one cell further along some axes."""
    out = of_cells.copy()
    for axis in axes:
        out[:, axis] -= out[:, 0]
    for axis in axes:
        out[:, :, axis] -= out[:, :, 0]
    return out


class Recovery:
    """Functions that are linear around each corner of the cells, and nearest to the values of the points in
    the cells there (Zienkiewicz and Zhu's recovery). Collective.

    Attributes:
        smooth: values (np, c) at the points: the means of those of their cells' corners. A function that is
            linear over two cells is met exactly.
    """

    def __init__(self, system: LoadedPoints, values: np.ndarray):
        i, d = system.interpolation, system.interpolation.layout.dim
        grid, x = i.grid, i.reference.x
        cells, self._corners = grid.cells_of(x), box_indices((2,) * d)
        self._within = np.ascontiguousarray(grid.within(x, cells))
        _, first, self._cell = np.unique(grid.cell_number(cells), return_index=True, return_inverse=True)
        numbers = np.stack([grid.node_number(cells[first] + corner) for corner in self._corners], axis=1)
        known, at = np.unique(numbers, return_inverse=True)
        self._at = at.reshape(numbers.shape)
        # over each cell, about its first corner; around a node each cell has another corner there
        values, parts = np.ascontiguousarray(values), values.shape[1]
        of_cells = np.zeros((len(first), d + 1, d + 1 + parts))
        native.library().polarmpm_fit_sums(
            len(x), d, parts, self._cell, i.points.volume0, self._within, values, of_cells
        )
        moments = np.zeros((len(known), *of_cells.shape[1:]))
        for corner, nodes in zip(self._corners, self._at.T, strict=True):
            moments[nodes] += _shifted(of_cells, np.flatnonzero(corner) + 1)
        shape = moments.shape
        moments = sums_by_number(grid.comm, known, flat(moments)).reshape(shape)
        self._matrix, self._right = moments[:, :, : d + 1], moments[:, :, d + 1 :]

    @property
    def smooth(self) -> np.ndarray:
        n, d = self._within.shape
        matrix, parts = self._matrix, self._right.shape[2]
        matrix = matrix + 1e-9 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(d + 1)
        fitted = np.ascontiguousarray(np.linalg.solve(matrix, self._right))
        out = np.empty((n, parts))
        native.library().polarmpm_fit_values(
            n, d, parts, self._cell, self._within, self._corners.astype(np.int64), self._at, fitted, out
        )
        return out

    def _share(self, corner: np.ndarray) -> np.ndarray:
        """Weights of a corner at the points (np,)."""
        share: np.ndarray = np.prod(np.where(corner > 0, self._within, 1.0 - self._within), axis=1)
        return share

    def changes(self) -> tuple[np.ndarray, np.ndarray]:
        """Means (m, c), and changes (m, d, c) over a cell, of the functions around the corners of cells; none
        in directions in which the body is too thin for them."""
        volume = self._matrix[:, 0, :1, None]
        mean, middle = self._right[:, :1] / volume, self._matrix[:, :1, 1:] / volume
        spread = self._matrix[:, 1:, 1:] / volume - np.swapaxes(middle, 1, 2) * middle
        along = self._right[:, 1:] / volume - np.swapaxes(middle, 1, 2) * mean
        size, axes = np.linalg.eigh(spread)
        inverse = np.where(size > THIN, 1.0 / np.maximum(size, THIN), 0.0)
        changes: np.ndarray = (axes * inverse[:, None, :]) @ (np.swapaxes(axes, 1, 2) @ along)
        return np.asarray(mean[:, 0]), changes

    def at_points(self, of_corners: np.ndarray) -> np.ndarray:
        """Values (m,) around the corners at the points (np,)."""
        out = np.zeros(len(self._within))
        for corner, nodes in zip(self._corners, self._at.T, strict=True):
            out += self._share(corner) * of_corners[nodes][self._cell]
        return out


def _sums(system: LoadedPoints, *squares: np.ndarray) -> np.ndarray:
    """Sums of values (np,) by volumes. Collective."""
    volume = system.interpolation.points.volume0
    sums = np.array([volume @ of for of in squares])
    system.comm.Allreduce(MPI.IN_PLACE, sums)
    return sums


def roughness(
    system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None
) -> tuple[float, float]:
    """How far strain increments are from smooth ones (`Recovery`), squared, over their own squares; and their
    root mean square. Collective."""
    upper = np.triu_indices(system.interpolation.layout.dim)
    strain = strains(system, start, gradient)[:, upper[0], upper[1]]
    times = np.where(upper[0] == upper[1], 1.0, 2.0)
    smooth = Recovery(system, strain).smooth
    sums = _sums(system, (strain - smooth) ** 2 @ times, strain**2 @ times, np.ones(len(strain)))
    return float(sums[0] / max(sums[1], np.finfo(float).tiny)), float(np.sqrt(sums[1] / sums[2]))


def excess(
    system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None
) -> tuple[float, float]:
    """By how much deviators of strain increments are larger, on the whole, than smooth ones (`Recovery`),
    over these; and their root mean square. Collective.

    A body that flows dissipates in proportion to them, and what it dissipates its loads have to do.
    """
    d = system.interpolation.layout.dim
    upper = np.triu_indices(d)
    strain = strains(system, start, gradient)[:, upper[0], upper[1]]
    sizes = [_deviators(e, upper) for e in (strain, Recovery(system, strain).smooth)]
    sums = _sums(system, *sizes, sizes[0] ** 2, np.ones(len(strain)))
    more = sums[0] / max(sums[1], np.finfo(float).tiny) - 1.0
    return float(more), float(np.sqrt(sums[2] / sums[3]))


def _deviators(strain: np.ndarray, upper: tuple[np.ndarray, ...]) -> np.ndarray:
    """Norms of the deviators (np,) of plane or spatial strains."""
    normal = upper[0] == upper[1]
    squares = strain**2 @ np.where(normal, 1.0, 2.0) - strain[:, normal].sum(axis=1) ** 2 / 3.0
    norms: np.ndarray = np.sqrt(np.maximum(squares, 0.0))
    return norms


def imbalance(system: LoadedPoints, stress: np.ndarray) -> float:
    """Forces that smooth stresses leave in a cell, over its size: squared, over the squares of the stresses'
    deviators. Collective.

    What a cell can't show, such as the shear in a layer as thick as it, isn't rough; but its stresses aren't
    in equilibrium. Pressures, which bodies may have anywhere, count for little.

    Args:
        stress: Cauchy stresses (np, 3, 3).
    """
    i, d = system.interpolation, system.interpolation.layout.dim
    forces = system.point_forces / i.points.volume0[:, None]
    if i.layout.axial:  # what the hoop's stresses and the ring's growing leave
        radius = i.reference.x[:, :1]
        forces = forces + (stress[:, :d, 0] - np.stack([stress[:, 2, 2], np.zeros(len(stress))], 1)) / radius
    sizes = i.grid.sizes(i.grid.cells_of(i.reference.x))
    recovery = Recovery(system, np.hstack([flat(stress[:, :d, :d]), forces, sizes]))
    mean, changes = recovery.changes()
    force, size = mean[:, d * d : -d], mean[:, -d:]
    gradient = (changes[:, :, : d * d] / size[:, :, None]).reshape(len(mean), d, d, d)
    left = (np.einsum("njij->ni", gradient) + force) * size
    pressure = np.trace(stress, axis1=1, axis2=2) / 3.0
    deviator = stress - pressure[:, None, None] * np.eye(3)
    squares = [np.einsum("nij,nij->n", a, a) for a in (deviator, stress)]
    sums = _sums(system, recovery.at_points((left**2).sum(axis=1)), *squares)
    return float(sums[0] / max(sums[1] + PRESSURE * sums[2], np.finfo(float).tiny))
