"""What terms are handed when increments begin to count: the functions of a grid, or of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np

from ..basis.base import Basis, Weights
from ..bodies.elements import Elements
from ..bodies.facets import FacetSurface
from ..bodies.nearby import behind
from ..bodies.points import Points
from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..kinematics.layout import Layout
from ..tools.parallel import known_anywhere
from .base import Boxes, Carried, Places, Setting

_INWARD = 1e-6  # cells: a point on a plane of the grid belongs to the cell behind it, against its normal
# cells by which a face may lie ahead of those that material points reach: at first, later
_AHEAD = (0.5, 1.0)


class GridSetting(Setting):
    """A reset of the grid.

    Args:
        reached: gives the lattice numbers, ascending, of the cells that this rank's points reach.
        x: where the points were at the last reset (m), (np, d).

    Attributes:
        grid, basis: the lattice, and its functions.
        points: the body.
        weights: of the points.
    """

    def __init__(
        self,
        grid: Grid,
        basis: Basis,
        layout: Layout,
        points: Points,
        weights: Weights,
        reached: Callable[[], np.ndarray],
        x: np.ndarray,
    ):
        self.grid, self.basis, self.layout, self.comm = grid, basis, layout, grid.comm
        self.points, self.weights, self._reached, self._x = points, weights, reached, x

    @cached_property
    def reached(self) -> np.ndarray:
        """Lattice numbers, ascending, of the cells that this rank's points reach."""
        return self._reached()

    def node_volumes(self) -> tuple[np.ndarray, np.ndarray]:
        numbers, weight = self.weights.products(self.grid)
        nodes, at = np.unique(numbers, return_inverse=True)
        shares = (weight * self.points.volume0[:, None]).ravel()
        volumes = np.bincount(at.ravel(), shares, minlength=len(nodes)).astype(float)
        return nodes[volumes != 0.0], volumes[volumes != 0.0]

    def alone(self, nodes: np.ndarray) -> Boxes:
        return Boxes((1,) * self.grid.dim, nodes)

    def carry(self, places: Places) -> Carried:
        owner, cells = self.basis.carriers(places.name) or self._find(places)
        rows = np.flatnonzero(owner == self.comm.rank)
        x = places.surface.x[rows] + places.displacement[rows]
        return Carried(rows, self.boxes(cells[rows]), self.at(x, cells[rows]))

    def deformations(self, parents: np.ndarray) -> np.ndarray:
        """Deformation gradients (n, d, d) of material points of given ids (n,). Collective."""
        d = self.grid.dim
        at, here = self._rows_of(parents)
        found = np.zeros((len(parents), d, d))
        found[here] = self.points.F[at[here], :d, :d]
        self.comm.Allreduce(MPI.IN_PLACE, found)
        return found

    def _rows_of(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the material points of these ids, and which of them are on this rank."""
        known = self.points.id
        if not len(known):
            return np.zeros(len(ids), dtype=int), np.zeros(len(ids), dtype=bool)
        order = np.argsort(known, kind="stable")
        at = order[np.minimum(np.searchsorted(known, ids, sorter=order), len(order) - 1)]
        return at, known[at] == ids

    def beside(self, name: str, parents: np.ndarray, x: np.ndarray) -> Carried:
        """The functions that carry places x (n, d) (m) beside material points of given ids (n,): those of the
        points' cells, continued beyond them where a place lies there. Collective.

        Raises:
            InputError: a point isn't there.
        """
        rows, cells = self._cells_beside(name, parents)
        return Carried(rows, self.boxes(cells), self.at(x[rows], cells))

    def _cells_beside(self, name: str, parents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of some points, by ids (n,), are on this rank, and the lattice index of a cell of each; the
        body's, see `Grid.of_bodies`. Collective."""
        at, here = self._rows_of(parents)
        if not np.all(self.comm.allreduce(here.astype(int))):
            raise InputError(
                f"{name}: material points that carry its sites have left the body: release it, add it again"
            )
        rows = np.flatnonzero(here)
        at, w = at[rows], self.weights
        own = self.grid.cells_of(self._x[at])
        if self.points.bodies > 1:
            own = self.grid.of_bodies(own, self.points.body[at])
        # of the cells that weight a point its own, or the next to that: others may have no nodes
        last = np.maximum(w.lowest[at], w.lowest[at] + w.count[at] - self.basis.functions)
        return rows, np.clip(own, w.lowest[at], last)

    def cells_behind(
        self, name: str, parents: np.ndarray, body: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lattice index (n, d) of the cells whose functions carry places beside points of given ids (n,), and
        of the cells of bodies (n,) that places x (n, d) (m) are in: the same where the bodies don't reach
        these, or they are no neighbours. Of any rank; the bodies', see `Grid.of_bodies`. Collective."""
        rows, cells = self._cells_beside(name, parents)
        every = np.zeros((len(parents), self.grid.dim), dtype=np.int64)
        every[rows] = cells
        self.comm.Allreduce(MPI.IN_PLACE, every)
        wanted = self.grid.of_bodies(self.grid.cells_of(x), body)
        known = known_anywhere(self.comm, self.reached, self.grid.cell_number(wanted))
        known &= np.all(np.abs(wanted - every) <= 1, axis=1)
        return every, np.where(known[:, None], wanted, every)

    def within(self, table: np.ndarray, cells: np.ndarray, lowest: np.ndarray) -> np.ndarray:
        """What `at` gives for cells (n, d), on boxes of one node more in each direction from the functions of
        cells `lowest` (n, d) on, which begin there or at the next ones."""
        d, f = self.grid.dim, self.basis.functions
        out = np.zeros((*table.shape[:2], *(f + 1,) * d))
        parts = table.reshape(*table.shape[:2], *(f,) * d)
        for step in box_indices((2,) * d):
            rows = np.all(cells - lowest == step, axis=1)
            out[(rows, slice(None), *(slice(k, k + f) for k in step))] = parts[rows]
        return out.reshape(*table.shape[:2], (f + 1) ** d)

    def boxes(self, cells: np.ndarray, more: int = 0) -> Boxes:
        """Nodes of the functions of cells (n, d), and so many more in each direction."""
        return Boxes((self.basis.functions + more,) * self.grid.dim, self.grid.node_number(cells))

    def at(self, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """`Basis.at` of cells (n, d) of whatever body."""
        return self.basis.at(self.grid, x, self.grid.node_index(self.grid.node_number(cells)))

    def _bodies_at(self, x: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Numbers (n,) of the bodies behind places (n, d) (m) on surfaces. Collective."""
        if self.points.bodies == 1:
            return np.zeros(len(x), dtype=np.int64)
        return behind(self.comm, self._x, self.points.body, np.zeros((len(self._x), 0)), x, normal)[2]

    def _find(self, places: Places) -> tuple[np.ndarray, np.ndarray]:
        """Rank (n,) and lattice index (n, d) of the cell that weights each place: the nearest of those that
        material points reach."""
        grid, size, x = self.grid, self.comm.size, places.surface.x + places.displacement
        normal = places.surface.normal[:, :, None]
        turned = np.linalg.solve(np.swapaxes(places.deformation, 1, 2), normal)[:, :, 0]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        xi = grid.local(x) - _INWARD * turned
        around = box_indices((3,) * grid.dim) - 1
        index = np.floor(xi).astype(np.int64)[:, None] + around
        inside = np.all((index >= 0) & (index < np.array(grid.shape)), axis=2)
        body = self._bodies_at(x, turned)
        of_body = grid.of_bodies(index.reshape(-1, grid.dim), np.repeat(body, index.shape[1]))
        here = inside & np.isin(grid.cell_number(of_body).reshape(inside.shape), self.reached)
        lowest = np.where(here, self.comm.rank, size)
        self.comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        beyond = np.maximum(np.maximum(index - xi[:, None], xi[:, None] - index - 1), 0.0)
        distance = np.where(lowest < size, np.linalg.norm(beyond, axis=2), np.inf)
        nearest = np.argmin(distance, axis=1)
        every = np.arange(len(x))
        owner, cells = lowest[every, nearest], grid.of_bodies(index[every, nearest], body)
        limit = _AHEAD[places.committed]
        owner[distance[every, nearest] > limit] = size
        if np.any(owner == size):
            at = int(np.argmax(owner == size))
            raise InputError(
                f"{places.name}: surface point {at} at {tuple(float(round(c, 9)) for c in x[at])} lies "
                f"outside of the body ({np.sum(owner == size)} in all): no material point reaches a cell "
                f"that is less than {limit:g} cells away"
            )
        return owner, cells


def check_facets(places: Places, elements: Elements) -> FacetSurface:
    """The surface of places on a mesh.

    Raises:
        InputError: it isn't made of facets of the mesh.
    """
    surface = places.surface
    if not isinstance(surface, FacetSurface) or surface.elements is not elements:
        raise InputError(
            f"{places.name}: the surface is not made of facets of this mesh; use elements.surface(...)"
        )
    return surface


@dataclass(frozen=True)
class MeshNodes:
    """Sets of a mesh's nodes.

    Attributes:
        table: local rows (m, n).
    """

    table: np.ndarray

    def rows(self, nodes: object) -> np.ndarray:
        """Local rows of the nodes (m, n)."""
        return self.table


class MeshSetting(Setting):
    """The start of a load step of finite elements, whose increments count from the last converged state.

    Attributes:
        elements: the body.
    """

    def __init__(self, elements: Elements):
        self.elements, self.layout, self.comm = elements, elements.layout, elements.comm
        self.points = elements.points

    def node_volumes(self) -> tuple[np.ndarray, np.ndarray]:
        volumes = self.elements.node_volumes()
        at = np.flatnonzero(volumes)
        return at, volumes[at]

    def alone(self, nodes: np.ndarray) -> MeshNodes:
        return MeshNodes(nodes[:, None])

    def carry(self, places: Places) -> Carried:
        surface = check_facets(places, self.elements)
        rows, table = surface.rows, surface.table.copy()
        # d(.)/dX -> d(.)/dx~
        back = np.linalg.inv(places.deformation[rows])
        table[:, 1:] = np.einsum("mjn,mji->min", surface.table[:, 1:], back)
        return Carried(rows, MeshNodes(surface.nodes), table)
