"""Filling a body with material points."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, PointsOutsideGrid
from ..geometry.grid import Grid
from ..materials.base import Material
from ..tools.parallel import raise_on_all_ranks
from .partition import distribute
from .points import Points

_CHUNK = 200_000  # candidate points tested at once

Inside = Callable[[np.ndarray], np.ndarray]


def seed(
    grid: Grid,
    inside: Inside | None = None,
    *,
    material: Material,
    points_per_cell: int | Sequence[int] = 2,
    bounds: tuple[Sequence[float], Sequence[float]] | None = None,
    layout: str = "uniform",
) -> Points:
    """Seed lattice cells with points and keep those inside the body. Collective.

    Args:
        grid: background grid.
        inside: predicate of positions (n, d) -> (n,) bool; None keeps all points within `bounds`.
        material: of all these points.
        points_per_cell: points in each direction of a cell, one number or one for each axis.
        bounds: lower and upper corner (m) of a box around the body; only its cells are searched. Default: the
            attribute `bounds` of `inside` where it has one, else the whole grid.
        layout: "uniform" (equally spaced) or "gauss" (Gauss-Legendre positions and volumes).

    Raises:
        InputError: an argument is out of range, or no point lies inside the body.
    """
    per_cell = _points_per_cell(points_per_cell, grid.dim)
    xi, share = _cell_layout(layout, per_cell)
    if inside is not None and not callable(inside):
        raise InputError(f"inside = {inside!r} is not a predicate of positions")
    lower, upper = _bounds(grid, bounds if bounds is not None else getattr(inside, "bounds", None))
    searched = grid.part(lower, np.maximum(upper, lower))
    span = np.array(searched.shape)
    axes = np.argsort(-span, kind="stable")  # the longest axis varies slowest: ranks get slices of it
    cells = int(np.prod(span))
    start, stop = (cells * r // grid.comm.size for r in (grid.comm.rank, grid.comm.rank + 1))
    step = max(1, _CHUNK // len(xi))
    found, volumes, halves, error = [], [], [], None
    try:
        for begin in range(start, stop, step):
            number = np.arange(begin, min(begin + step, stop))
            index = np.stack(np.unravel_index(number, span[axes]), axis=1)[:, np.argsort(axes)]
            x = searched.position(index[:, None, :] + xi[None]).reshape(-1, grid.dim)
            keep = np.flatnonzero(_keep(x, inside, bounds))
            cell, place = np.divmod(keep, len(xi))
            sizes = searched.sizes(index[cell])
            found.append(x[keep])
            volumes.append(share[place] * np.prod(sizes, axis=1))
            halves.append(0.5 * sizes / per_cell)
    except InputError as e:
        error = e
    raise_on_all_ranks(grid.comm, error)
    none = np.zeros((0, grid.dim))
    x, half = np.concatenate([none, *found]), np.concatenate([none, *halves])
    volume = np.concatenate([none[:, 0], *volumes])
    points = Points(x, volume, half, material, grid.comm)
    if points.total == 0:
        raise InputError(
            f"inside: none of the candidate points between {grid.lower} and {grid.upper} is in the body"
        )
    distribute(grid, points)
    return points


def _points_per_cell(value: int | Sequence[int], dim: int) -> np.ndarray:
    number = np.asarray(value)
    if number.shape not in ((), (dim,)) or number.dtype.kind not in "iu" or np.any(number < 1):
        raise InputError(f"points_per_cell = {value!r}: a positive whole number, or {dim} of them")
    return np.broadcast_to(number, (dim,)).astype(np.int64)


def _cell_layout(layout: str, per_cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the unit cell (n, d) and shares of its volume (n,)."""
    if layout == "uniform":
        rules = [((np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)) for n in per_cell]
    elif layout == "gauss":
        raw = [np.polynomial.legendre.leggauss(int(n)) for n in per_cell]
        rules = [((1.0 + a) / 2.0, w / 2.0) for a, w in raw]
    else:
        raise InputError(f"layout = {layout!r}: allowed are uniform, gauss")
    xi = np.stack(np.meshgrid(*(r[0] for r in rules), indexing="ij"), axis=-1).reshape(-1, len(rules))
    share: np.ndarray = np.ones(())
    for _, w in rules:
        share = np.multiply.outer(share, w)
    return xi, share.ravel()


def _bounds(grid: Grid, bounds: Any) -> tuple[np.ndarray, np.ndarray]:
    """First and last cell (exclusive) of a box, cut to the grid."""
    shape = np.array(grid.shape)
    if bounds is None:
        return np.zeros(grid.dim, dtype=np.int64), shape
    lower, upper = (np.asarray(b, float) for b in bounds)
    if lower.shape != (grid.dim,) or upper.shape != (grid.dim,) or np.any(upper <= lower):
        raise InputError(
            f"bounds = {bounds!r}: two corners of {grid.dim} coordinates, the second above the first"
        )
    if not np.all(grid.inside(np.stack([lower, upper]))):
        raise InputError(f"bounds = {bounds!r} reach outside the grid from {grid.lower} to {grid.upper}")
    low = np.floor(grid.local(lower[None])[0] + 1e-9).astype(np.int64)
    high = np.ceil(grid.local(upper[None])[0] - 1e-9).astype(np.int64)
    return np.clip(low, 0, shape), np.clip(high, 0, shape)


def _keep(x: np.ndarray, inside: Inside | None, bounds: Any) -> np.ndarray:
    if inside is None:
        if bounds is None:
            return np.ones(len(x), dtype=bool)
        within: np.ndarray = np.all((x >= np.asarray(bounds[0])) & (x <= np.asarray(bounds[1])), axis=1)
        return within
    mask = np.asarray(inside(x))
    if mask.shape != (len(x),) or mask.dtype != bool:
        raise InputError(f"inside: returned {mask.dtype} {mask.shape}; a bool for each point is needed")
    return mask


def seed_mesh(grid: Grid, mesh: Any, *, material: Material, degree: int = 2) -> Points:
    """Put points at the quadrature positions of a mesh's cells. Collective.

    The points' volumes add up to the mesh's volume exactly; domains are boxes of equal volume. Ids follow the
    mesh's partition, so they depend on the number of ranks.

    Args:
        mesh: dolfinx mesh of simplices, quadrilaterals or hexahedra, in as many dimensions as the grid; or
            the path of a gmsh file (.msh) whose cells are in a physical group.
        degree: of the quadrature rule; 2 gives 3 points in a triangle, 4 in a tetrahedron.

    Raises:
        InputError: the mesh's dimension is not the grid's; the file can't be read; the rule of this degree
            has weights that are not positive.
        PointsOutsideGrid: points lie outside the grid.
    """
    from ..geometry.gmsh import read_gmsh
    from ..tools.compat import mesh_quadrature

    if isinstance(mesh, str | os.PathLike):
        mesh = read_gmsh(os.fspath(mesh), grid.dim, grid.comm)
    if mesh.topology.dim != grid.dim:
        raise InputError(f"mesh: its cells have {mesh.topology.dim} dimensions, the grid has {grid.dim}")
    x, volume = mesh_quadrature(mesh, degree)
    lowest = grid.comm.allreduce(float(volume.min(initial=np.inf)), op=MPI.MIN)
    if not lowest > 0:
        raise InputError(
            f"degree = {degree}: the quadrature rule gives a point the volume {lowest:g}; "
            "points need positive ones, take another degree"
        )
    side = volume ** (1.0 / grid.dim)
    points = Points(x, volume, np.tile(0.5 * side[:, None], (1, grid.dim)), material, grid.comm)
    check_inside(grid, points)
    distribute(grid, points)
    return points


def check_inside(grid: Grid, points: Points) -> None:
    """Raise PointsOutsideGrid, on every rank, unless all points lie in the grid."""
    outside = ~grid.inside(points.x)
    count = grid.comm.allreduce(int(outside.sum()))
    if count:
        ids = np.concatenate(grid.comm.allgather(points.id[outside][:20]))
        lower, upper = (tuple(round(v, 9) for v in c) for c in (grid.lower, grid.upper))
        raise PointsOutsideGrid(np.sort(ids).tolist(), count, f"from {lower} to {upper} m")
