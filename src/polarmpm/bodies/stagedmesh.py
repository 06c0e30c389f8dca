"""Which elements of a mesh are in a body: an excavation takes some out, a fill puts some in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..kinematics import rotations
from ..tools import compat
from .facets import attached

if TYPE_CHECKING:
    from ..geometry.meshes import BodyMesh
    from ..geometry.spacenodes import SpaceNodes
    from .points import Points

_OF_MESH = ("id", "material", "X", "volume0", "half_length0", "half_axes0")


class StagedMesh:
    """What `Elements` has of stages. Nodes that no element of the body touches stay where they are.

    Attributes:
        live: which of this rank's own cells are in the body, ascending.
        placed: dX/dx0 (np, d, d) at the quadrature points: of elements that were put in where the mesh had
            moved to, x0, which counts as their undeformed state; None: the mesh's own is that of all.
    """

    mesh: Any
    dim: int
    degree: int
    axisymmetric: bool
    body: BodyMesh
    nodes: SpaceNodes
    cell_nodes: np.ndarray
    points: Points
    moved: np.ndarray
    live: np.ndarray
    placed: np.ndarray | None = None
    _of_mesh: dict[str, np.ndarray] | None = None  # of the points of all own cells, once some are out

    @property
    def reference_points(self) -> np.ndarray:
        """Quadrature positions in the reference cell (nq, d)."""
        raise NotImplementedError

    @property
    def staged(self) -> bool:
        """Elements have been taken out, or put in, on whatever rank."""
        return self._of_mesh is not None

    @property
    def live_nodes(self) -> np.ndarray:
        """Local nodes (m, n) of the elements that are in the body."""
        nodes: np.ndarray = self.cell_nodes[self.live]
        return nodes

    @property
    def mesh_volume(self) -> np.ndarray:
        """Volumes (np,) that the quadrature points stand for in the undeformed mesh."""
        if self._of_mesh is None:
            return self.points.volume0
        found: np.ndarray = self._of_mesh["volume0"][self._rows(self.live)]
        return found

    def reached(self) -> np.ndarray:
        """Nodes (nodes,) that elements of the body touch, on any rank, bool. Collective."""
        count = np.zeros((len(self.nodes), self.nodes.block))
        count[self.live_nodes.ravel()] = 1.0
        self.nodes.add_to_owners(count)
        self.nodes.update_ghosts(count)
        mask: np.ndarray = count[:, 0] > 0.0
        return mask

    def live_facets(self, facets: np.ndarray) -> np.ndarray:
        """Those of local boundary facets whose elements are in the body."""
        if not self.staged:
            return facets
        cells, own = attached(self.mesh, self.dim, facets)[0], len(self.body.owned_cells)
        left: np.ndarray = facets[(cells >= own) | np.isin(cells, self.live)]
        return left

    def cells_of(self, ids: np.ndarray) -> np.ndarray:
        """Own cells, ascending, to which quadrature points of these ids belong, in the body or not."""
        cells = np.flatnonzero(np.isin(self.body.original_cells, ids // len(self.reference_points)))
        return cells.astype(np.int64)

    def _rows(self, cells: np.ndarray) -> np.ndarray:
        """Rows of the quadrature points of cells, among those of all own ones."""
        count = len(self.reference_points)
        rows: np.ndarray = (np.asarray(cells, dtype=np.int64)[:, None] * count + np.arange(count)).ravel()
        return rows

    # stages ---------------------------------------------------------------------------------------
    def take_out(self, cells: np.ndarray) -> np.ndarray:
        """Take own cells out of the body; which of the points (np,) are left, bool. Collective."""
        p = self.points
        if self._of_mesh is None:
            self._of_mesh = {name: getattr(p, name) for name in _OF_MESH}
        stays = ~np.isin(self.live, cells)
        left: np.ndarray = np.repeat(stays, len(self.reference_points))
        p.replace({name: a[left] for name, a in p.arrays().items()}, same=True)
        self.live = self.live[stays]
        self.placed = None if self.placed is None else self.placed[left]
        return left

    def put_in(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Put own cells that had been taken out into the body, undeformed where their nodes are now; rows of
        the points that were there, and of the new ones. Collective."""
        p, every = self.points, np.sort(np.concatenate([self.live, cells]))
        count = len(self.reference_points)
        old, new = (
            (np.searchsorted(every, some)[:, None] * count + np.arange(count)).ravel()
            for some in (self.live, cells)
        )
        known, fresh = p.arrays(), self._undeformed(cells)
        placed = np.tile(np.eye(self.dim), (len(p), 1, 1)) if self.placed is None else self.placed

        def merged(before: np.ndarray, joining: np.ndarray) -> np.ndarray:
            out = np.empty((len(every) * count, *before.shape[1:]), dtype=before.dtype)
            out[old], out[new] = before, joining
            return out

        p.replace({name: merged(a, fresh[name]) for name, a in known.items()}, same=True)
        self.placed, self.live = merged(placed, fresh["placed"]), every
        return old, new

    def start_gradient(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the quadrature points of own cells are (n, d), and dx/dX (n, d, d) there, by the nodes."""
        xi, d = self.reference_points, self.dim
        table = compat.tabulate(self.body.cell, self.degree, xi)
        x, jacobian = compat.mesh_geometry(self.mesh, xi, cells)
        u = self.moved[self.cell_nodes[cells]]
        by_axes = np.einsum("jqn,mnk->mqkj", table[1:], u) @ np.linalg.inv(jacobian)
        now = x + np.einsum("qn,mnk->mqk", table[0], u)
        n = len(cells) * len(xi)
        return now.reshape(n, d), np.eye(d) + by_axes.reshape(n, d, d)

    def _undeformed(self, cells: np.ndarray) -> dict[str, np.ndarray]:
        """State of the quadrature points of cells that are put in, by name, with `placed`."""
        assert self._of_mesh is not None
        p, rows = self.points, self._rows(cells)
        x, gradient = self.start_gradient(cells)
        of_mesh = {name: a[rows] for name, a in self._of_mesh.items()}
        volume = of_mesh["volume0"] * rotations.determinant(gradient)
        if self.axisymmetric:
            volume = volume * x[:, 0] / of_mesh["X"][:, 0]
        out = {name: np.zeros((len(rows), *a.shape[1:])) for name, a in p.arrays().items()}
        for name in ("F", "plastic_F"):
            out[name] = np.tile(np.eye(3), (len(rows), 1, 1))
        out |= of_mesh | {"X": x, "x": x, "counted_from": x, "volume0": volume}
        return out | {"q": rotations.identity(len(rows)), "placed": np.linalg.inv(gradient)}

    def restore_stage(self, placed: np.ndarray | None, volume: np.ndarray | None) -> None:
        """Put in `placed` and reference volumes (np,) of a saved state of the same elements."""
        self.placed = placed
        if volume is not None:
            self.points.volume0 = volume


def refuse_inverted(elements: StagedMesh, cells: np.ndarray) -> None:
    """Raise InputError where own cells are turned inside out by what their nodes have moved. Local."""
    inverted = rotations.determinant(elements.start_gradient(cells)[1]) <= 0.0
    bad = np.unique(np.repeat(elements.body.original_cells[cells], len(elements.reference_points))[inverted])
    if len(bad):
        raise InputError(
            f"add: element(s) {', '.join(map(str, bad[:10]))}: where the mesh has moved to they are turned "
            "inside out"
        )
