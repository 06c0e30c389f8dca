"""Filling the cells of a mesh with material points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from functools import cache, partial
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..geometry.meshes import BodyMesh
from ..materials.base import Material
from ..tools import checks, compat
from ..tools.checks import instance, whole
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .cutboxes import half_axes
from .facets import group_surfaces
from .partition import distribute
from .points import Points
from .regions import Regions, materials_of
from .revolution import check_axisymmetric, turned
from .seeding import check_inside


@collective("seed_mesh", comm=lambda grid, *args, **options: grid.comm)  # the mesh may be rank 0's alone
def seed_mesh(
    grid: Grid,
    mesh: Any,
    *,
    material: Material | Mapping[str | int, Material],
    points_per_cell: int = 2,
    degree: int | None = None,
    cells: Any = None,
    facets: Any = None,
    axisymmetric: bool = False,
) -> Points:
    """Divide the cells of a mesh into parts, one a point. Collective.

    A quadrilateral or hexahedron is divided along its edges into points_per_cell^d parts, a triangle or
    tetrahedron into as many simplices, of equal volume in its own coordinates. A point is at its part's
    centroid and has its volume and half axes: those of quadrilaterals and hexahedra lie along the part's
    edges, those of simplices have its second moments. Volume and centroid are the mesh's, also of distorted
    and curved cells. Ids follow the cells in the order of the mesh's input, on any number of ranks.

    The mesh's physical groups are kept: `points.region(name)` selects the points of cells,
    `points.surface(name)` is a surface of boundary facets with at least two points in a cell of the grid.

    Args:
        mesh: dolfinx mesh of simplices, quadrilaterals or hexahedra, in as many dimensions as the grid and of
            degree 1 or 2; path of a .msh file; or a gmsh model (on rank 0, None elsewhere). Of files and
            models the cells in physical groups.
        material: of all points, or for each region (physical name or tag of cells) its own.
        points_per_cell: points in each direction of a cell of the mesh.
        degree: puts points at the positions of the quadrature rule of this degree instead (2 gives 3 points
            in a triangle, 4 in a tetrahedron), which integrates squares itself: they have no half axes, and
            domains are boxes of equal volume.
        cells, facets: tags (dolfinx MeshTags) of a dolfinx mesh.
        axisymmetric: as of `seed`; the mesh is the section.

    Raises:
        InputError: a mesh that can't be used, see `geometry.meshes.BodyMesh`; its dimension is not the
            grid's; regions and materials that don't match; the rule of this degree has weights that are not
            positive.
        PointsOutsideGrid: points lie outside the grid.
    """
    instance("grid", grid, Grid, "a grid, as pm.Grid.box makes it, is")
    number = whole("points_per_cell", points_per_cell, least=1, allowed="a positive whole number")
    if degree is not None:
        degree = whole("degree", degree, least=0, most=30)
    body = BodyMesh.of(mesh, grid.comm, cells=cells, facets=facets)
    if body.dim != grid.dim:
        raise InputError(f"mesh: its cells have {body.dim} dimensions, the grid has {grid.dim}")
    axisymmetric = checks.flag("axisymmetric", axisymmetric)
    points = _points(body, grid, material, number, degree, axisymmetric)
    points.surfaces = group_surfaces(body, partial(_facet_rule, body.cell, min(grid.smallest)))
    check_inside(grid, points)
    distribute(grid, points)
    return points


def _points(
    body: BodyMesh, grid: Grid, material: Any, number: int, degree: int | None, axisymmetric: bool
) -> Points:
    """Points in this rank's cells, with their materials and regions. Collective."""
    materials, of_cell = materials_of(body, material)
    if degree is None:
        x, volume, axes = _parts(body, number)
        half = np.sqrt(np.einsum("nki,nki->ni", axes, axes))
    else:
        x, volume = _quadrature(body.mesh, degree, grid.comm)
        half = np.tile(0.5 * volume[:, None] ** (1.0 / grid.dim), (1, grid.dim))
        axes = np.zeros((len(x), grid.dim, grid.dim))
    if axisymmetric:
        with errors_on_all_ranks(grid.comm):
            check_axisymmetric(x, materials[0])
        volume = turned(volume, x)
    points = Points(x, volume, half, materials[0], grid.comm, half_axes=axes, axisymmetric=axisymmetric)
    parts = len(x) // max(len(of_cell), 1)
    points.put_materials(materials, np.repeat(of_cell, parts))
    points.id = (body.original_cells[:, None] * parts + np.arange(parts)).ravel()
    per_cell = grid.comm.allreduce(parts, op=MPI.MAX)  # a rank may have no cells
    points.regions = tuple(r for r in (Regions.of(body, per_cell),) if r is not None)
    return points


def _facet_rule(cell: str, size: float, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """A rule of the reference facet, in parts that are no longer than a size where an edge is the longest."""
    number = max(1, math.ceil(edge / size * (1 - 1e-9)))
    if cell == "tetrahedron":
        return _on_simplices(_simplices(2, number), *compat.facet_rule(cell, 2))
    xi, weight = compat.facet_rule(cell, 3)
    parts = box_indices((number,) * xi.shape[1])
    return ((parts[:, None] + xi) / number).reshape(-1, xi.shape[1]), np.tile(weight, len(parts)) / len(parts)


def _on_simplices(simplices: np.ndarray, xi: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A rule of the reference simplex in each of those into which it is divided equally."""
    first, edges = simplices[:, :1], simplices[:, 1:] - simplices[:, :1]
    at = (first + xi @ edges).reshape(-1, xi.shape[1])
    return at, np.tile(weight, len(simplices)) / len(simplices)


def _quadrature(mesh: Any, degree: int, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and volumes (n,) of a rule in this rank's cells. Collective."""
    x, volume = compat.mesh_quadrature(mesh, degree)
    lowest = comm.allreduce(float(volume.min(initial=np.inf)), op=MPI.MIN)
    if not lowest > 0:
        raise InputError(
            f"degree = {degree}: the quadrature rule gives a point the volume {lowest:g}; "
            "points need positive ones, take another degree"
        )
    return x, volume


def _parts(body: BodyMesh, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids (n, d), volumes (n,) and half axes (n, d, d) of the parts of this rank's cells."""
    dim = body.dim
    if body.cell in ("triangle", "tetrahedron"):
        simplices = _simplices(dim, number)
        # of straight cells the Jacobian is constant, of curved ones of degree d; with two positions 2 more
        # of the geometry's degree each
        xi, weight = compat.quadrature(body.cell, 2 if body.degree == 1 else 4 + dim)
        at, weights = _on_simplices(simplices, xi, weight)
        x, volume, share, positions = _sums(body, at, weights, len(simplices))
        from_centre = positions - x[:, None]
        return x, volume, half_axes(np.einsum("ng,ngi,ngj->nij", share, from_centre, from_centre))
    # Gauss' rule of so many points a direction is exact for the Jacobian and for it times a position, of
    # curved cells times two
    count = 2 if body.degree == 1 else dim + 2
    parts = box_indices((number,) * dim)
    node, line = np.polynomial.legendre.leggauss(count)
    which = box_indices((count,) * dim)
    at = (parts[:, None] + 0.5 + 0.5 * node[which]) / number
    weights = np.tile(np.prod(0.5 * line[which], axis=1), len(parts)) / len(parts)
    x, volume, share, positions = _sums(body, at.reshape(-1, dim), weights, len(parts))
    slopes = compat.mesh_geometry(body.mesh, (parts + 0.5) / number)[1]
    axes = np.swapaxes(slopes, 2, 3).reshape(-1, dim, dim) / (2 * number)
    if body.degree == 1:
        return x, volume, axes
    from_centre = positions - x[:, None]
    return x, volume, _with_moments(axes, np.einsum("ng,ngi,ngj->nij", share, from_centre, from_centre))


def _with_moments(axes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Half axes (n, d, d) with these second moments (n, d, d), turned and stretched as little as possible."""
    root = half_axes(np.swapaxes(axes, 1, 2) @ axes / 3.0)
    back = np.linalg.inv(root)
    changed: np.ndarray = axes @ back @ half_axes(root @ covariance @ root) @ back
    return changed


def _sums(body: BodyMesh, at: np.ndarray, weights: np.ndarray, parts: int) -> tuple[np.ndarray, ...]:
    """Centroids (n, d) and volumes (n,) of parts with quadrature points; these' shares (n, q), positions."""
    positions, jacobian = compat.mesh_geometry(body.mesh, at)
    weight = (np.abs(np.linalg.det(jacobian)) * weights).reshape(-1, len(weights) // parts)
    positions = positions.reshape(*weight.shape, body.dim)
    volume = weight.sum(axis=1)
    share = weight / volume[:, None]
    return np.einsum("ng,ngi->ni", share, positions), volume, share, positions


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
