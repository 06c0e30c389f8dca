"""The nonlinear system of the active nodes, assembled by dolfinx from the points' projected moments.

Stress and tangent moduli of a point, times its volume, are put on the quadrature points of its cell such that
every multiquadratic function integrates to its sum over the points. Products of gradients of two multilinear
functions are multiquadratic: residual and tangent equal the sums over standard material points, whatever the
number of points in a cell (docs/theory.md). A cell is on the lowest of the ranks that have points in it; the
others send their points' moments there.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..errors import InputError
from ..forms.numbers import QuadratureForms, tangent_size
from ..geometry.cells import cell_mesh, occupied_cells
from ..geometry.grid import Grid, snap
from ..geometry.nodes import ActiveNodes
from ..geometry.spacenodes import SpaceNodes
from ..kernels import native
from ..kernels.kernel import Kernel
from ..solvers.linear import NearNullSpace
from ..terms.base import Boxes
from ..tools import compat
from ..tools.disposal import dispose_with, weakly
from ..tools.parallel import Route, values_by_number
from ..tools.timing import Timer
from .formmatrix import FormMatrix
from .interpolation import Interpolation
from .loadedpoints import LoadedPoints
from .stepstate import Assembled

DEGREE = 5  # three Gauss points in each direction: their Lagrange polynomials are all multiquadratics


def lagrange(cell: str, xi: np.ndarray) -> np.ndarray:
    """Lagrange polynomials of the quadrature points of a box at xi (n, d) in [0, 1], (n, 3^d)."""
    positions = compat.quadrature_positions(cell, DEGREE)
    out = np.ones((len(xi), len(positions)))
    for axis in range(xi.shape[1]):
        gauss = np.unique(np.round(positions[:, axis], 12))
        which = np.argmin(np.abs(positions[:, axis, None] - gauss), axis=1)
        gauss = np.array([positions[which == k, axis][0] for k in range(3)])
        for k in range(3):
            for other in {0, 1, 2} - {k}:
                factor = (xi[:, axis] - gauss[other]) / (gauss[k] - gauss[other])
                out[:, which == k] *= factor[:, None]
    return out


class CellProjection:
    """The cells that contain points as a dolfinx mesh, and moments on their quadrature points. Collective.

    Args:
        x: positions (n, d) (m) of this rank's points.
        block: unknowns of a node.

    Attributes:
        space: multilinear functions of `block` components on the mesh.
        lattice: lattice numbers of its nodes on this rank, in dolfinx' order.
    """

    def __init__(self, grid: Grid, x: np.ndarray, block: int):
        self.grid = grid
        self.mesh = cell_mesh(grid, occupied_cells(grid, x)).mesh
        self.space = compat.function_space(self.mesh, block, 1)
        self.nodes = SpaceNodes(self.space, grid.dim)
        self.lattice = grid.node_number(np.rint(grid.local(self.nodes.position)).astype(np.int64))
        self._send_points(x)

    def _send_points(self, x: np.ndarray) -> None:
        """Tell the owners of the cells which points they have, and where."""
        comm, grid = self.grid.comm, self.grid
        own = self.mesh.topology.index_map(grid.dim).size_local
        cells = self.lattice[compat.cell_dofs(self.space)[:own]].min(
            axis=1
        )  # a cell's number: its lowest node
        address = np.column_stack([np.full(own, comm.rank), np.arange(own)])
        index = grid.cells_of(x)
        at = values_by_number(comm, cells, address.astype(float), grid.cell_number(index)).astype(np.int64)
        self._route = Route(comm, at[:, 0])
        self._cells = self._route.forward(at[:, 1])
        name = compat.cell_name(self.mesh)
        size = np.prod(self._route.forward(np.ascontiguousarray(grid.sizes(index))), axis=1)
        volume = compat.quadrature_weights(name, DEGREE) * size[:, None]
        self._weights = lagrange(name, self._route.forward(snap(grid.within(x, index)))) / volume

    def project(self, moments: np.ndarray, function: Any) -> None:
        """Set a quadrature function from moments (n, c) of this rank's points. Collective."""
        out = function.x.array
        out[:] = 0.0
        sent = self._route.forward(moments) if self.grid.comm.size > 1 else moments
        place = compat.cell_dofs(function.function_space)[self._cells].astype(np.int32)
        native.library().polarmpm_project(
            len(sent),
            self._weights.shape[1],
            moments.shape[1],
            place,
            self._weights,
            sent,
            out,
        )


class NodeExchange:
    """Nodal values between the points' and the mesh's order of the same nodes. All methods are collective."""

    def __init__(self, nodes: ActiveNodes, cells: CellProjection):
        comm = nodes.grid.comm
        self.nodes, self.mesh_nodes = nodes, cells.nodes
        address = np.column_stack([np.full(nodes.owned, comm.rank), np.arange(nodes.owned)]).astype(float)
        wanted = cells.lattice[: cells.nodes.owned]
        at = values_by_number(comm, nodes.lattice[: nodes.owned], address, wanted).astype(np.int64)
        self._route = Route(comm, at[:, 0])
        self._rows = self._route.forward(at[:, 1])

    def to_points(self, values: np.ndarray) -> np.ndarray:
        """Owned rows of active nodes from owned rows of the mesh."""
        out = np.zeros((self.nodes.owned, *values.shape[1:]))
        out[self._rows] = self._route.forward(values)
        return out

    def to_mesh(self, values: np.ndarray) -> np.ndarray:
        """All rows of the mesh from owned rows of active nodes."""
        out = np.zeros((len(self.mesh_nodes), *values.shape[1:]))
        out[: self.mesh_nodes.owned] = self._route.backward(values[self._rows])
        self.mesh_nodes.update_ghosts(out)
        return out


class ProjectedSystem(LoadedPoints):
    """Residual and tangent as integrals over the occupied cells. The unknowns are those of `PointSystem`."""

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
        solver: str = "auto",
    ):
        super().__init__(interpolation, kernels, couple_kernel, prescribed, timer)
        rows = [b.rows for b in interpolation.batches]
        self._ends = np.cumsum([len(r) for r in rows])[:-1]
        with timer("pattern"):
            x = interpolation.reference.x[np.concatenate(rows)]
            self.cells = CellProjection(interpolation.grid, x, self.layout.block)
            self.exchange = NodeExchange(self.nodes, self.cells)
            fixed = self.exchange.to_mesh(prescribed.fixed[: self.nodes.owned].astype(float)) > 0.5
            self._numbers = self._numbers_on_mesh()
        with timer("compile"):
            self.forms = QuadratureForms(self.cells.space, self.layout, DEGREE, self.symmetric)
        with timer("pattern"):
            plastic = any(m is not None for m in self.mappings)
            self.matrix = FormMatrix(
                [self.forms.tangent],
                fixed,
                self.symmetric,
                self.cells.nodes.owned,
                plastic,
                solver,
                self.is_large(),
                weakly(self._near_null_space_on_mesh),
            )
            self._dispose = dispose_with(self, self.comm, self.matrix.destroy)

    def _numbers_on_mesh(self) -> np.ndarray:
        """Global numbers of the nodes (n,) in the mesh's matrix; only terms ask for them. Collective.

        Raises:
            InputError: a term couples nodes of several cells.
        """
        if not len(self.terms):
            return np.zeros(0, dtype=np.int64)
        for piece in self.terms.pieces:
            if not isinstance(piece.boxes, Boxes) or max(piece.boxes.count) > 2:
                raise InputError(
                    f"{piece.name}: couples nodes of several cells, for which assembly = 'projection' has no "
                    "room; allowed is 'direct'"
                )
        own = self.cells.nodes.owned
        numbers = self.cells.nodes.number[:own, None].astype(float)
        lattice = self.cells.lattice[:own]
        return values_by_number(self.comm, lattice, numbers, self.nodes.lattice)[:, 0].astype(np.int64)

    def _near_null_space_on_mesh(self) -> NearNullSpace:
        """In the mesh's order."""
        own, space = self.cells.nodes.owned, self.near_null_space()
        whole = np.repeat(space.weak[:, None].astype(float), self.layout.block, axis=1)
        on_mesh = np.stack([self.exchange.to_mesh(v)[:own] for v in (*space.motions, whole)])
        return NearNullSpace(on_mesh[:-1], on_mesh[-1, :, 0] > 0.5, space.as_force)

    # assembly ---------------------------------------------------------------------------------------
    def assemble(self, tangent: bool, lift: np.ndarray | None = None) -> Assembled:
        self._project([self._point_kernels(k, tangent) for k in range(len(self.kernels))], tangent)
        mesh_nodes, own = self.cells.nodes, self.nodes.owned
        forces = compat.assemble_vector(self.forms.residual, len(mesh_nodes))
        forces = forces.reshape(-1, self.layout.block)
        mesh_nodes.add_to_owners(forces)
        internal, lifted = np.zeros_like(self.x), None
        internal[:own] = self.exchange.to_points(forces[: mesh_nodes.owned])
        if tangent:
            on_mesh = None if lift is None else self.exchange.to_mesh(lift[:own])
            product = self.matrix.assemble(on_mesh, self._dense_terms())
            if product is not None:
                lifted = np.zeros_like(self.x)
                lifted[:own] = self.exchange.to_points(product[: mesh_nodes.owned])
        self.external = self.loads
        if len(self.terms):
            internal += self.term_forces()
        return Assembled(internal - self._dead_forces(), lifted)

    def _dense_terms(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Global numbers of the mesh's nodes of each of the terms' sets, and its tangent."""
        for rows, matrix in self.terms.dense(self.x):
            yield self._numbers[rows], matrix

    def assemble_moduli(self, blocks: Sequence[np.ndarray], shift: float) -> None:
        self._project([self._given(b) for b in blocks], True)
        self.matrix.assemble(None)
        if shift:
            most = self.comm.allreduce(float(self.matrix.diagonal.max(initial=0.0)), op=MPI.MAX)
            self.matrix.matrix.shift(shift * most)

    def _project(self, kernels: Sequence[native.PointKernels], tangent: bool) -> None:
        """Put stresses, and moduli if asked, at the present increments on the quadrature points."""
        n = len(self.interpolation.points)
        stress = np.empty((n, self.layout.unknowns))
        moduli = np.empty((n if tangent else 0, tangent_size(self.layout, self.symmetric)))
        starts = [0, *self._ends]
        for k, batch in enumerate(self.interpolation.batches):
            failed = native.library().polarmpm_moments(
                ctypes.byref(batch.batch),
                ctypes.byref(kernels[k]),
                self.x,
                int(self.symmetric),
                stress[starts[k] :],
                moduli[starts[k] :] if tangent else None,
            )
            if failed:
                raise MemoryError("no memory for the material points' moments")
        self.cells.project(stress, self.forms.residual_values)
        if tangent:
            self.cells.project(moduli, self.forms.tangent_values)

    @property
    def tangent(self) -> None:
        return None  # in the order of the cells' mesh

    def diagonal(self) -> np.ndarray:
        return self.exchange.to_points(self.matrix.diagonal)

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        own = self.cells.nodes.owned
        if fresh:
            with self.timer("factor"):
                self.matrix.solver.factor()
        with self.timer("solve"):
            mine = self.exchange.to_mesh(right)[:own]
            solution = self.matrix.solver.solve(mine.ravel(), accuracy).reshape(mine.shape)
            return self.exchange.to_points(solution)

    def destroy(self) -> None:
        self._dispose()
