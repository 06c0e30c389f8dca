"""Filling the cells of a mesh with material points."""

from __future__ import annotations

import itertools
import os
from functools import cache
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..materials.base import Material
from ..tools.meetings import collective
from .cutboxes import half_axes
from .partition import distribute
from .points import Points
from .seeding import check_inside


@collective("seed_mesh", comm=lambda grid, *args, **options: grid.comm, compare=True)
def seed_mesh(
    grid: Grid, mesh: Any, *, material: Material, points_per_cell: int = 2, degree: int | None = None
) -> Points:
    """Divide the cells of a mesh into parts, one a point. Collective.

    A quadrilateral or hexahedron is divided along its edges into points_per_cell^d parts, a triangle or
    tetrahedron into as many simplices of equal volume. A point is at its part's centroid and has its volume
    and half axes: those of quadrilaterals and hexahedra lie along the part's edges, those of simplices have
    its second moments. Volume and centroid are the mesh's, also of distorted cells. Ids follow the mesh's
    partition, so they depend on the number of ranks.

    Args:
        mesh: dolfinx mesh of simplices, quadrilaterals or hexahedra, in as many dimensions as the grid; or
            the path of a gmsh file (.msh) whose cells are in a physical group.
        points_per_cell: points in each direction of a cell of the mesh.
        degree: puts points at the positions of the quadrature rule of this degree instead (2 gives 3 points
            in a triangle, 4 in a tetrahedron), which integrates squares itself: they have no half axes, and
            domains are boxes of equal volume.

    Raises:
        InputError: the mesh's dimension is not the grid's; the file can't be read; a number of points that
            isn't positive; the rule of this degree has weights that are not positive.
        PointsOutsideGrid: points lie outside the grid.
    """
    from ..geometry.gmsh import read_gmsh

    whole = isinstance(points_per_cell, (int, np.integer)) and not isinstance(points_per_cell, bool)
    if not whole or points_per_cell < 1:
        raise InputError(f"points_per_cell = {points_per_cell!r}: a positive whole number")
    if isinstance(mesh, str | os.PathLike):
        mesh = read_gmsh(os.fspath(mesh), grid.dim, grid.comm)
    if mesh.topology.dim != grid.dim:
        raise InputError(f"mesh: its cells have {mesh.topology.dim} dimensions, the grid has {grid.dim}")
    if degree is None:
        x, volume, axes = _parts(mesh, int(points_per_cell))
        half = np.sqrt(np.einsum("nki,nki->ni", axes, axes))
    else:
        x, volume = _quadrature(mesh, degree, grid.comm)
        half = np.tile(0.5 * volume[:, None] ** (1.0 / grid.dim), (1, grid.dim))
        axes = np.zeros((len(x), grid.dim, grid.dim))
    points = Points(x, volume, half, material, grid.comm, half_axes=axes)
    check_inside(grid, points)
    distribute(grid, points)
    return points


def _quadrature(mesh: Any, degree: int, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and volumes (n,) of a rule in this rank's cells. Collective."""
    from ..tools.compat import mesh_quadrature

    x, volume = mesh_quadrature(mesh, degree)
    lowest = comm.allreduce(float(volume.min(initial=np.inf)), op=MPI.MIN)
    if not lowest > 0:
        raise InputError(
            f"degree = {degree}: the quadrature rule gives a point the volume {lowest:g}; "
            "points need positive ones, take another degree"
        )
    return x, volume


def _parts(mesh: Any, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids (n, d), volumes (n,) and half axes (n, d, d) of the parts of this rank's cells."""
    from ..tools.compat import cell_geometry, cell_name, tabulate

    dim, name = mesh.topology.dim, cell_name(mesh)
    own = mesh.topology.index_map(dim).size_local
    corner = mesh.geometry.x[cell_geometry(mesh)[:own]][:, :, :dim]
    if name in ("triangle", "tetrahedron"):
        simplices = _simplices(dim, number)
        shape = tabulate(name, 1, simplices.reshape(-1, dim))[0]
        v = np.einsum("pn,cni->cpi", shape, corner).reshape(-1, dim + 1, dim)
        volume = np.abs(np.linalg.det(v[:, 1:] - v[:, :1])) / np.prod(np.arange(1, dim + 1))
        x = v.mean(axis=1)
        from_centre = v - x[:, None]
        covariance = np.einsum("nki,nkj->nij", from_centre, from_centre) / ((dim + 1) * (dim + 2))
        return x, volume, half_axes(covariance)
    # Gauss' rule of two points a direction is exact for the Jacobian, and for it times a position
    parts = box_indices((number,) * dim)
    gauss = (box_indices((2,) * dim) - 0.5) / 3**0.5
    table = tabulate(name, 1, ((parts[:, None] + 0.5 + gauss) / number).reshape(-1, dim))
    at = np.einsum("pn,cni->cpi", table[0], corner)
    jacobian = np.abs(np.linalg.det(np.einsum("jpn,cni->cpij", table[1:], corner)))
    weight = jacobian.reshape(own, len(parts), 2**dim) / (2 * number) ** dim
    volume = weight.sum(axis=2)
    x = np.einsum("cpg,cpgi->cpi", weight, at.reshape(own, len(parts), 2**dim, dim)) / volume[:, :, None]
    slopes = tabulate(name, 1, (parts + 0.5) / number)[1:]
    axes = np.einsum("jpn,cni->cpji", slopes, corner) / (2 * number)
    return x.reshape(-1, dim), volume.ravel(), axes.reshape(-1, dim, dim)


@cache
def _simplices(dim: int, number: int) -> np.ndarray:
    """The reference simplex divided into number^d simplices of equal volume: vertices (m, d + 1, d).

    The simplex number >= y_1 >= .. >= y_d >= 0 is a union of those into which the paths along the axes, in
    any order, divide the unit cubes.
    """
    steps = [
        np.cumsum(np.eye(dim, dtype=np.int64)[list(p)], axis=0) for p in itertools.permutations(range(dim))
    ]
    paths = np.stack([np.vstack([np.zeros((1, dim), dtype=np.int64), s]) for s in steps])
    y: np.ndarray = (box_indices((number,) * dim)[:, None, None] + paths).reshape(-1, dim + 1, dim)
    y = y[np.all(np.diff(y, axis=2) <= 0, axis=(1, 2))]
    # y_k = x_k + .. + x_d
    x: np.ndarray = (y - np.concatenate([y[:, :, 1:], np.zeros_like(y[:, :, :1])], axis=2)) / number
    return x
