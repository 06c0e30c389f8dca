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
from ..bodies.points import Points
from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..kinematics.layout import Layout
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
        owner, cells = self._find(places)
        rows = np.flatnonzero(owner == self.comm.rank)
        x = places.surface.x[rows] + places.displacement[rows]
        count = (self.basis.functions,) * self.grid.dim
        table = self.basis.at(self.grid, x, cells[rows])
        return Carried(rows, Boxes(count, self.grid.node_number(cells[rows])), table)

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
        at, here = self._rows_of(parents)
        if not np.all(self.comm.allreduce(here.astype(int))):
            raise InputError(
                f"{name}: material points that carry its sites have left the body: release it, add it again"
            )
        rows = np.flatnonzero(here)
        at, w, x = at[rows], self.weights, x[rows]
        # of the cells that weight a point its own, or the next to that: others may have no nodes
        last = np.maximum(w.lowest[at], w.lowest[at] + w.count[at] - self.basis.functions)
        cells = np.clip(self.grid.cells_of(self._x[at]), w.lowest[at], last)
        boxes = Boxes((self.basis.functions,) * self.grid.dim, self.grid.node_number(cells))
        return Carried(rows, boxes, self.basis.at(self.grid, x, cells))

    def _find(self, places: Places) -> tuple[np.ndarray, np.ndarray]:
        """Rank (n,) and lattice index (n, d) of the cell that weights each place: the nearest of those that
        material points reach."""
        grid, size, x = self.grid, self.comm.size, places.surface.x + places.displacement
        normal = places.surface.normal[:, :, None]
        turned = np.linalg.solve(np.swapaxes(places.deformation, 1, 2), normal)[:, :, 0]
        xi = grid.local(x) - _INWARD * turned / np.linalg.norm(turned, axis=1, keepdims=True)
        around = box_indices((3,) * grid.dim) - 1
        index = np.floor(xi).astype(np.int64)[:, None] + around
        inside = np.all((index >= 0) & (index < np.array(grid.shape)), axis=2)
        here = inside & np.isin(grid.cell_number(index), self.reached)
        lowest = np.where(here, self.comm.rank, size)
        self.comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        beyond = np.maximum(np.maximum(index - xi[:, None], xi[:, None] - index - 1), 0.0)
        distance = np.where(lowest < size, np.linalg.norm(beyond, axis=2), np.inf)
        nearest = np.argmin(distance, axis=1)
        every = np.arange(len(x))
        owner, cells = lowest[every, nearest], index[every, nearest]
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
