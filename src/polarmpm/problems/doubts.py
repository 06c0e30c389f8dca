"""Estimates from a converged step of how far an answer is off, besides the work inside the points' boxes."""

from __future__ import annotations

from collections.abc import Iterator

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
    change = eye + (i.gather(system.x).gradient if gradient is None else gradient)
    if start.any():
        change = change @ np.linalg.inv(eye + i.gather(start).gradient)
    green: np.ndarray = 0.5 * (np.swapaxes(change, 1, 2) @ change - eye)
    return green


def missed(system: LoadedPoints) -> float:
    """Share of the strains' squares since the last reset that a sum over the points misses, as they vary over
    what the points stand for. Collective.

    Points without half axes are taken for cubes of their volumes, except in cells that they fill: there their
    own second moments tell.
    """
    i, d = system.interpolation, system.interpolation.layout.dim
    axes, volume = _axes(system), i.points.volume0
    F, inside = np.eye(d) + i.gather(system.x).gradient, 0.0
    cells = i.basis.supporting_cells(i.grid, i.reference.x)
    for some in _parts(len(volume)):
        along = np.einsum("pijk,plk->plij", _second_gradients(system, cells[some], some), axes[some])
        varying = np.einsum("pai,plaj->plij", F[some], along)
        varying = 0.5 * (varying + np.swapaxes(varying, 2, 3))
        inside += np.einsum("p,plij->", volume[some], varying**2) / 3.0
    seen = strains(system, np.zeros_like(system.x))
    sums = [inside, np.einsum("p,pij->", volume, seen**2)]
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


_AT_ONCE = 100_000  # points, so that it takes no memory


def _parts(number: int) -> Iterator[slice]:
    for begin in range(0, number, _AT_ONCE):
        yield slice(begin, begin + _AT_ONCE)


def _second_gradients(system: LoadedPoints, cells: np.ndarray, some: slice) -> np.ndarray:
    """Second gradients of the displacement increments at points (n, d, d, d) of cells (n, d); of functions
    without second derivatives the mixed ones of what is linear in each direction of a cell."""
    i, d = system.interpolation, system.interpolation.layout.dim
    grid, x = i.grid, i.reference.x[some]
    if i.basis.fills_boxes:
        table = i.basis.derivatives(grid, x, cells, 3)
    else:
        table = _linear(grid.within(x, cells), grid.sizes(cells))
    index = box_indices((table.shape[3],) * d)
    numbers = grid.node_number(cells)[:, None] + index @ grid.strides
    u = system.x[i.nodes.local(numbers.ravel()), :d].reshape(*numbers.shape, d)
    out = np.empty((len(cells), d, d, d))
    for j in range(d):
        for k in range(d):
            order = np.bincount([j, k], minlength=d)
            weight = np.prod([table[:, a, order[a]][:, index[:, a]] for a in range(d)], axis=0)
            out[:, :, j, k] = np.einsum("pn,pni->pi", weight, u)
    return out


def _linear(within: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Values and two derivatives (n, d, 3, 2) of linear functions at places in cells (n, d)."""
    slope = np.stack([-1.0 / size, 1.0 / size], axis=2)
    values = np.stack([1.0 - within, within], axis=2)
    return np.stack([values, slope, np.zeros_like(slope)], axis=2)


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
        shifts = np.tile(np.eye(d + 1), (len(self._corners), 1, 1))
        shifts[:, 1:, 0] = -self._corners
        moments = np.zeros((len(known), *of_cells.shape[1:]))
        for shift, nodes in zip(shifts, self._at.T, strict=True):
            shifted = shift @ of_cells
            shifted[:, :, : d + 1] = shifted[:, :, : d + 1] @ shift.T
            moments[nodes] += shifted
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
