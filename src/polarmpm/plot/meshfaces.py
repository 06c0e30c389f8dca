"""The faces of a mesh that a figure shows: all cells in the plane, the outer faces in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..bodies.elements import Elements
from ..tools import compat

_MIDDLE = {"triangle": (1 / 3, 1 / 3), "quadrilateral": (1 / 2, 1 / 2)}  # of the reference cell


@dataclass
class Faces:
    """Polygons through the nodes of faces; k nodes go round each of them.

    Attributes:
        before, now: undeformed and current positions (n, k, d) (m).
        outward: normals of the undeformed faces in space (n, 3); not of unit length.
        values: of the faces (n,): means over the nodes, or the cells' values; None without values.
        middle, of_nodes: in the plane with nodal values: current middle (n, 2), and values at the k nodes and
            the middle (n, k + 1).
    """

    before: np.ndarray
    now: np.ndarray
    outward: np.ndarray
    values: np.ndarray | None = None
    middle: np.ndarray | None = None
    of_nodes: np.ndarray | None = None

    @property
    def dim(self) -> int:
        return int(self.now.shape[2])

    @property
    def shown(self) -> np.ndarray | None:
        """The values that have colours."""
        return self.values if self.of_nodes is None else self.of_nodes

    def positions(self, undeformed: bool) -> list[np.ndarray]:
        """Nodes (n, d) of what is drawn."""
        both = [self.now, self.before] if undeformed else [self.now]
        return [a.reshape(-1, self.dim) for a in both]

    @property
    def span(self) -> np.ndarray:
        """Size of the space that both states take."""
        size: np.ndarray = np.ptp(np.concatenate(self.positions(True)), axis=0)
        return size

    def scale(self, factor: float) -> None:
        """Change the unit of length."""
        self.before, self.now = factor * self.before, factor * self.now
        self.middle = None if self.middle is None else factor * self.middle


def gather_faces(elements: Elements, values: np.ndarray | None, nodal: bool) -> Faces | None:
    """Faces of all ranks, on rank 0; None elsewhere. Collective.

    Args:
        values: of the local nodes, or of the own cells.
    """
    e = elements
    cells = e.live_nodes
    corners, rings = _rings(e.body.cell, e.degree)
    cell, face = (a.ravel() for a in np.indices((len(cells), len(rings))))
    if e.dim == 3:
        numbers = _global_numbers(e.space, len(e.nodes))[cells]
        outer = _alone(numbers[cell[:, None], corners[face]])
        cell, face = cell[outer], face[outer]
    nodes = cells[cell[:, None], rings[face]]
    before = e.nodes.position[nodes]
    data: dict[str, Any] = {"before": before, "now": before + e.moved[nodes]}
    data["outward"] = _outward(before, e.nodes.position[cells].mean(axis=1)[cell])
    if values is not None:
        data["values"] = values[nodes].mean(axis=1) if nodal else values[cell]
    if values is not None and nodal and e.dim == 2:
        shape = compat.tabulate(e.body.cell, e.degree, np.array([_MIDDLE[e.body.cell]]))[0, 0]
        data["middle"] = np.einsum("k,nkd->nd", shape, (e.nodes.position + e.moved)[cells])
        data["of_nodes"] = np.column_stack([values[nodes], values[cells] @ shape])
    key = _global_numbers(e.space, len(e.nodes))[nodes]
    parts = e.comm.gather((data, key))
    if parts is None:
        return None
    whole = {name: np.concatenate([part[name] for part, _ in parts]) for name in data}
    if e.dim == 3:  # faces between two ranks
        outer = _alone(np.concatenate([key for _, key in parts]))
        whole = {name: a[outer] for name, a in whole.items()}
    return Faces(**whole)


def _rings(cell: str, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each face of a cell, or of a cell in the plane itself: corners, and all nodes on its edges as they
    go round."""
    import basix

    topology = basix.topology(getattr(basix.CellType, cell))
    corners = [[face[k] for k in ([0, 1, 3, 2] if len(face) == 4 else [0, 1, 2])] for face in topology[2]]
    if degree == 1:
        return np.array(corners), np.array(corners)
    # the edges' nodes follow the corners, each edge's from its lower corner on
    inner = degree - 1
    first = {tuple(sorted(edge)): len(topology[0]) + k * inner for k, edge in enumerate(topology[1])}
    rings = []
    for face in corners:
        ring = []
        for a, b in zip(face, [*face[1:], face[0]], strict=True):
            along = [first[min(a, b), max(a, b)] + k for k in range(inner)]
            ring += [a, *(along if a < b else along[::-1])]
        rings.append(ring)
    return np.array(corners), np.array(rings)


def _global_numbers(space: Any, count: int) -> np.ndarray:
    return np.asarray(space.dofmap.index_map.local_to_global(np.arange(count, dtype=np.int32)))


def _alone(nodes: np.ndarray) -> np.ndarray:
    """Rows of faces (n, k) whose nodes, in any order, no other face has."""
    _, inverse, count = np.unique(np.sort(nodes, axis=1), axis=0, return_inverse=True, return_counts=True)
    return np.flatnonzero(count[inverse.ravel()] == 1)


def _outward(faces: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Area vectors of faces (n, k, 3) that point away from positions inside (n, 3); zeros in the plane."""
    if faces.shape[2] == 2:
        return np.zeros((len(faces), 3))
    normal = np.cross(faces, np.roll(faces, -1, axis=1)).sum(axis=1)
    away = np.einsum("ni,ni->n", normal, faces.mean(axis=1) - inside)
    outward: np.ndarray = normal * np.sign(away)[:, None]
    return outward
