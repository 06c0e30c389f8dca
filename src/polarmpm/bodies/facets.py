"""Groups of boundary facets, and facets as points with areas and normals for terms that act on surfaces."""

from __future__ import annotations

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


class FacetSurface(Surface):
    """Quadrature points of boundary facets; made by `Elements.surface`. As of any surface, every rank has all
    of the points; each is on the rank that owns its cell.

    Attributes:
        elements: the body.
        rows: which of the points are on this rank (m,).
        nodes: local nodes of their cells (m, n).
        table: values of the nodes' functions, and gradients by X (1/m), (m, 1 + d, n).
    """

    def __init__(self, elements: Meshed, facets: Facets):
        self.elements = elements
        x, area, normal, key = self._own(facets.facets)
        gathered = elements.comm.allgather((x, area, normal, key))
        keys = np.concatenate([k for *_, k in gathered])
        order = np.lexsort(keys.T[::-1])
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        first = sum(len(k) for *_, k in gathered[: elements.comm.rank])
        self.rows = place[first : first + len(key)]
        by_rank = zip(*((x, area, normal) for x, area, normal, _ in gathered), strict=True)
        super().__init__(*(np.concatenate(parts)[order] for parts in by_rank))

    def _own(self, facets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions, areas and normals on this rank's facets; and numbers, the same on any number of ranks,
        by which the points are told apart: of the cell, its facet and the point."""
        e = self.elements
        cells, sides = _attached(e.mesh, e.dim, facets)
        mine = cells < len(e.body.owned_cells)
        cells, sides = cells[mine], sides[mine]
        d, geometry = e.dim, compat.cell_geometry(e.mesh)
        found, nodes, tables = [], [], []
        for side in np.unique(sides):
            xi, weight, reference = compat.facet_quadrature(e.body.cell, int(side), e.quadrature_degree)
            here = cells[sides == side]
            corner = e.mesh.geometry.x[geometry[here]][:, :, :d]
            shape = compat.tabulate(e.body.cell, e.mesh.geometry.cmap.degree, xi)
            jacobian = np.einsum("jqn,cni->cqij", shape[1:], corner)
            # Nanson's formula: the reference facet's normal, of the length of its area, turned and stretched
            back = np.linalg.inv(jacobian)
            size = np.abs(np.linalg.det(jacobian))[:, :, None]
            area = size * np.einsum("cqji,j->cqi", back, reference)
            length = np.linalg.norm(area, axis=2)
            functions = compat.tabulate(e.body.cell, e.degree, xi)
            table = np.empty((len(here), len(xi), 1 + d, functions.shape[2]))
            table[:, :, 0] = functions[0]
            table[:, :, 1:] = np.einsum("cqji,jqn->cqin", back, functions[1:])
            numbers = np.broadcast_to(e.body.original_cells[here][:, None], length.shape)
            key = np.stack([numbers, np.full_like(numbers, side), np.arange(len(xi)) + 0 * numbers], axis=-1)
            x = np.einsum("qn,cni->cqi", shape[0], corner)
            found.append((x, length * weight, area / length[:, :, None], key))
            nodes.append(np.repeat(e.cell_nodes[here], len(xi), axis=0))
            tables.append(table.reshape(-1, *table.shape[2:]))
        count = e.cell_nodes.shape[1]
        self.nodes = np.concatenate([np.zeros((0, count), dtype=np.int32), *nodes])
        self.table = np.concatenate([np.zeros((0, 1 + d, count)), *tables])
        empty = np.zeros((0, d)), np.zeros(0), np.zeros((0, d)), np.zeros((0, 3), dtype=np.int64)
        flat = [tuple(a.reshape(-1, *a.shape[2:]) for a in part) for part in found]
        return tuple(np.concatenate(column) for column in zip(empty, *flat, strict=True))  # type: ignore[return-value]


def _attached(mesh: Any, dim: int, facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local cell of each boundary facet, and which of its facets it is."""
    topology = mesh.topology
    topology.create_connectivity(dim - 1, dim)
    topology.create_connectivity(dim, dim - 1)
    of_facets, of_cells = topology.connectivity(dim - 1, dim), topology.connectivity(dim, dim - 1)
    cells = np.array([of_facets.links(f)[0] for f in facets], dtype=np.int64)
    found = [int(np.flatnonzero(of_cells.links(c) == f)[0]) for c, f in zip(cells, facets, strict=True)]
    return cells, np.array(found, dtype=np.int64)
