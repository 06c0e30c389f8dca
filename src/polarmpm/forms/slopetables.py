"""First and second derivatives of elements' functions by X at points of cells and of their faces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..bodies.elements import Elements
from ..tools import compat
from ..tools.rows import flat


@dataclass
class Table:
    """Points of cells or faces.

    Attributes:
        nodes: local nodes (m, n) that take part; of a face those of both cells.
        rows: derivatives (m, q, r, n) of their functions.
        weight: of the rule (m, q), lengths of the undeformed body.
        normal: of faces, unit, outward from the first cell (m, q, d).
        height: of the cell over the face (m, q).
        cells: to which the material belongs (m,).
    """

    nodes: np.ndarray
    rows: np.ndarray
    weight: np.ndarray
    cells: np.ndarray
    normal: np.ndarray
    height: np.ndarray


def of_cells(elements: Elements) -> Table:
    """Quadrature points of this rank's own cells, with gradients and second gradients."""
    e, cells = elements, np.asarray(elements.body.owned_cells, dtype=np.int64)
    rows, jacobian = derivatives(e, cells, e.reference_points)
    weight = np.abs(np.linalg.det(jacobian)) * compat.quadrature_weights(e.body.cell, e.quadrature_degree)
    none = np.zeros((*weight.shape, 0))
    return Table(e.cell_nodes[cells], rows, weight, cells, none, np.zeros_like(weight))


def derivatives(elements: Elements, cells: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives by X (m, q, d + d (d + 1) / 2, n) at positions xi (q, d) of the reference
    cell in local cells (m,), and Jacobians dX/dxi (m, q, d, d)."""
    body, d = elements.body, elements.dim
    _, jacobian = compat.mesh_geometry(body.mesh, xi, cells)
    n = elements.cell_nodes.shape[1]
    i, j = np.triu_indices(d)
    if not len(cells):
        return np.zeros((0, len(xi), d + len(i), n)), jacobian
    back = np.linalg.inv(jacobian)  # [r, i] = dxi_r/dX_i
    first = np.einsum("cqri,rqn->cqin", back, compat.tabulate(body.cell, elements.degree, xi)[1:])
    x = body.mesh.geometry.x[compat.cell_geometry(body.mesh)[cells]][:, :, :d]
    bent = np.einsum("sqa,cak->cqsk", _second(body.cell, body.degree, xi), x)
    of_reference = _second(body.cell, elements.degree, xi)
    full = of_reference.transpose(1, 0, 2)[None] - np.einsum("cqsk,cqkn->cqsn", bent, first)
    place = np.zeros((d, d), dtype=int)
    place[i, j] = place[j, i] = np.arange(len(i))
    both = np.einsum("cqri,cqsj->cqijrs", back, back)[:, :, i, j]  # (m, q, pairs, r, s)
    second = np.einsum("cqprs,cqrsn->cqpn", both, full[:, :, place])
    return np.concatenate([first, second], axis=2), jacobian


def of_faces(elements: Elements, facets: np.ndarray) -> Iterator[tuple[Table, Table | None]]:
    """Points on local facets: what their first and their second cell see of them, None on the boundary. The
    last row is du/dN, between two cells its jump, the first's less the second's; it is the same for both.
    """
    e, topology = elements, elements.mesh.topology
    links = topology.connectivity(e.dim - 1, e.dim)
    sides = [np.asarray(links.links(f), dtype=np.int64) for f in facets.tolist()]
    listed = np.asarray(topology.connectivity(e.dim, e.dim - 1).array)
    corners = np.array(compat.facet_corners(e.body.cell))
    of_cells = listed.reshape(-1, len(corners))
    vertices = np.asarray(topology.connectivity(e.dim, 0).array)
    vertices = vertices.reshape(len(of_cells), vertices.size // max(1, len(of_cells)))
    kinds: dict[tuple[int, ...], list[int]] = {}
    for row, (facet, cells) in enumerate(zip(facets.tolist(), sides, strict=True)):
        local = int(np.flatnonzero(of_cells[cells[0]] == facet)[0])
        other: list[int] = []
        if len(cells) == 2:
            ends, there = vertices[cells[0]][corners[local]], vertices[cells[1]].tolist()
            other = [there.index(v) for v in ends[: e.dim].tolist()]
        kinds.setdefault((local, *other), []).append(row)
    for (local, *other), rows in sorted(kinds.items()):
        cells = np.array([sides[row] for row in rows])
        yield _faces(e, cells, local, other)


def _faces(e: Elements, cells: np.ndarray, local: int, other: list[int]) -> tuple[Table, Table | None]:
    """Faces that are the same one of the first cell's (m, 1 or 2); `other`: their corners in the second."""
    import basix

    rule = compat.facet_rule(e.body.cell, e.quadrature_degree)
    xi, weight, reference = compat.facet_quadrature(e.body.cell, local, rule)
    first, jacobian = derivatives(e, cells[:, 0], xi)
    area = np.einsum("cqri,r->cqi", np.linalg.inv(jacobian), reference)
    height = 1.0 / np.linalg.norm(area, axis=2)
    normal = area * height[:, :, None]
    size = np.abs(np.linalg.det(jacobian)) / height * weight
    nodes, d = e.cell_nodes[cells], e.dim
    slope = np.einsum("cqin,cqi->cqn", first[:, :, :d], normal)[:, :, None]
    if not other:
        return Table(
            nodes[:, 0], np.concatenate([first, slope], axis=2), size, cells[:, 0], normal, height
        ), None
    places = np.asarray(basix.geometry(getattr(basix.CellType, e.body.cell)))[other]
    there = places[0] + rule[0] @ (places[1:] - places[0])
    second, behind = derivatives(e, cells[:, 1], there)
    # the height of the second cell: its volume over the same area
    beyond = height * np.abs(np.linalg.det(behind) / np.linalg.det(jacobian))
    back = np.einsum("cqin,cqi->cqn", second[:, :, :d], normal)[:, :, None]
    jump, none = np.concatenate([slope, -back], axis=3), np.zeros_like(first)
    both = flat(nodes)
    here = np.concatenate([np.concatenate([first, none], axis=3), jump], axis=2)
    across = np.concatenate([np.concatenate([none, second], axis=3), jump], axis=2)
    return (
        Table(both, here, size, cells[:, 0], normal, height),
        Table(both, across, size, cells[:, 1], normal, beyond),
    )


def _second(cell: str, degree: int, xi: np.ndarray) -> np.ndarray:
    """Second derivatives of Lagrange functions (d (d + 1) / 2, q, nodes) at positions (q, d) of the reference
    cell: by xx, xy, (xz,) yy, (yz, zz)."""
    import basix

    kind = getattr(basix.CellType, cell)
    element = basix.create_element(basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.equispaced)
    return np.asarray(element.tabulate(2, xi))[1 + xi.shape[1] :, :, :, 0]
