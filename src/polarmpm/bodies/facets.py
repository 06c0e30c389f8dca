"""Groups of boundary facets, and facets as points with areas and normals for terms that act on surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..geometry.meshes import BodyMesh
from ..geometry.surfaces import Surface
from ..tools import compat


@dataclass(frozen=True, eq=False)
class Facets:
    """A group of boundary facets.

    Attributes:
        name: for messages.
        facets: local numbers on this rank, ascending.
        weights: integral (m^2; m in plane strain) of each node's shape function over the group (nodes,),
            complete on owned nodes.
        area: of the undeformed group (m^2; m in plane strain), all ranks together.
        nodes: which nodes lie on the group (nodes,), bool.
        body: the mesh of the body to which they belong.
    """

    name: str
    facets: np.ndarray
    weights: np.ndarray
    area: float
    nodes: np.ndarray
    body: BodyMesh

    def mask(self, nodes: Any) -> np.ndarray:
        """Which nodes are meant (n,), as of a `Support`."""
        return self.nodes


class Meshed(Protocol):
    """A body meshed with finite elements, as far as its surface is concerned."""

    comm: MPI.Comm
    body: BodyMesh
    mesh: Any
    dim: int
    degree: int
    quadrature_degree: int
    cell_nodes: np.ndarray
    live: np.ndarray


class FacetSurface(Surface):
    """Quadrature points of boundary facets; made by `Elements.surface`. As of any surface, every rank has all
    of the points; each is on the rank that owns its cell.

    Attributes:
        elements: the body.
        rows: which of the points are on this rank (m,).
        cells: their local cells (m,).
        nodes: local nodes of these (m, n).
        table: values of the nodes' functions, and gradients by X (1/m), (m, 1 + d, n).
    """

    def __init__(self, elements: Meshed, facets: Facets):
        self.elements = elements
        self.rows, parts = _gathered(elements.comm, self._own(facets.facets))
        super().__init__(*parts)

    def _own(self, facets: np.ndarray) -> _Points:
        """Positions, areas and normals on this rank's facets; and numbers, the same on any number of ranks,
        by which the points are told apart: of the cell, its facet and the point."""
        e = self.elements
        cells, sides = attached(e.mesh, e.dim, facets)
        mine = cells < len(e.body.owned_cells)
        cells, sides = cells[mine], sides[mine]
        rule = compat.facet_rule(e.body.cell, e.quadrature_degree)
        d, found, nodes, tables, behind = e.dim, [], [], [], []
        for side in np.unique(sides):
            here = cells[sides == side]
            *points, xi, back = _on_side(e.body, here, int(side), rule)
            functions = compat.tabulate(e.body.cell, e.degree, xi)
            table = np.empty((len(here), len(xi), 1 + d, functions.shape[2]))
            table[:, :, 0] = functions[0]
            table[:, :, 1:] = np.einsum("cqji,jqn->cqin", back, functions[1:])
            found.append(points)
            behind.append(np.repeat(here, len(xi)))
            nodes.append(np.repeat(e.cell_nodes[here], len(xi), axis=0))
            tables.append(table.reshape(-1, *table.shape[2:]))
        count = e.cell_nodes.shape[1]
        self.cells = np.concatenate([np.zeros(0, dtype=np.int64), *behind])
        self.nodes = np.concatenate([np.zeros((0, count), dtype=np.int32), *nodes])
        self.table = np.concatenate([np.zeros((0, 1 + d, count)), *tables])
        return _flat(found, d)


# positions, areas, normals, and keys by which points are told apart: numbers of cell, facet and point
_Points = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _on_side(body: BodyMesh, cells: np.ndarray, side: int, rule: tuple[np.ndarray, np.ndarray]) -> Any:
    """Points of a rule on one side of cells: `_Points` with two axes, of cells and points; positions in the
    reference cell (q, d), inverse Jacobians (m, q, d, d)."""
    xi, weight, reference = compat.facet_quadrature(body.cell, side, rule)
    x, jacobian = compat.mesh_geometry(body.mesh, xi, cells)
    # Nanson's formula: the reference facet's normal, of the length of its area, turned and stretched
    back = np.linalg.inv(jacobian)
    size = np.abs(np.linalg.det(jacobian))[:, :, None]
    area = size * np.einsum("cqji,j->cqi", back, reference)
    length = np.linalg.norm(area, axis=2)
    numbers = np.broadcast_to(body.original_cells[cells][:, None], length.shape)
    key = np.stack([numbers, np.full_like(numbers, side), np.arange(len(xi)) + 0 * numbers], axis=-1)
    return x, length * weight, area / length[:, :, None], key, xi, back


def _flat(found: list[Any], dim: int) -> _Points:
    """Points on all sides, one after the other."""
    empty = np.zeros((0, dim)), np.zeros(0), np.zeros((0, dim)), np.zeros((0, 3), dtype=np.int64)
    flat = [tuple(a.reshape(-1, *a.shape[2:]) for a in part) for part in found]
    return tuple(np.concatenate(column) for column in zip(empty, *flat, strict=True))


def _gathered(comm: MPI.Comm, own: _Points) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Rows of this rank's points among all of them, and all positions, areas and normals. Collective."""
    gathered = comm.allgather(own)
    order = np.lexsort(np.concatenate([k for *_, k in gathered]).T[::-1])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    first = sum(len(k) for *_, k in gathered[: comm.rank])
    columns = zip(*(points[:3] for points in gathered), strict=True)
    return place[first : first + len(own[3])], tuple(np.concatenate(c)[order] for c in columns)


def group_surfaces(
    body: BodyMesh, rule: Callable[[float], tuple[np.ndarray, np.ndarray]]
) -> dict[str | int, Surface]:
    """Each group of facets on the boundary as a surface, by its name and its tag. Collective.

    Args:
        rule: of the reference facet, for a group whose longest edge is given (m).
    """
    from dolfinx import mesh as dmesh

    if body.facets is None:
        return {}
    mesh, comm = body.mesh, body.mesh.comm
    mesh.topology.create_connectivity(body.dim - 1, body.dim)
    outer = np.asarray(dmesh.exterior_facet_indices(mesh.topology))
    tagged, values = np.asarray(body.facets.indices), np.asarray(body.facets.values)
    corners = compat.facet_corners(body.cell)
    made: dict[str | int, Surface] = {}
    for tag in sorted(set().union(*comm.allgather(np.unique(values).tolist()))):
        cells, sides = attached(mesh, body.dim, np.intersect1d(tagged[values == tag], outer))
        mine = cells < len(body.owned_cells)
        cells, sides = cells[mine], sides[mine]
        nodes = compat.cell_geometry(mesh)[cells[:, None], np.array(corners)[sides]] if len(cells) else None
        x = mesh.geometry.x[nodes] if nodes is not None else np.zeros((0, 1, 3))
        edge = np.linalg.norm(x[:, :, None] - x[:, None], axis=3).max(initial=0.0)
        edge = comm.allreduce(float(edge), op=MPI.MAX)
        found = [_on_side(body, cells[sides == s], int(s), rule(edge))[:4] for s in np.unique(sides)]
        _, parts = _gathered(comm, _flat(found, body.dim))
        if len(parts[0]):
            made[tag] = Surface(*parts)
    named = {name: tag for (d, name), tag in body.names.items() if d == body.dim - 1}
    return {**made, **{name: made[tag] for name, tag in named.items() if tag in made}}


def attached(mesh: Any, dim: int, facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local cell of each boundary facet, and which of its facets it is."""
    topology = mesh.topology
    topology.create_connectivity(dim - 1, dim)
    topology.create_connectivity(dim, dim - 1)
    of_facets, of_cells = topology.connectivity(dim - 1, dim), topology.connectivity(dim, dim - 1)
    cells = np.array([of_facets.links(f)[0] for f in facets], dtype=np.int64)
    found = [int(np.flatnonzero(of_cells.links(c) == f)[0]) for c, f in zip(cells, facets, strict=True)]
    return cells, np.array(found, dtype=np.int64)
