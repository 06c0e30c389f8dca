"""Finite elements with second gradients: sums over cells and faces as numbers, see `interiorpenalty`.

Cells and faces see the same second derivatives of the displacement itself, `total + x`: there is no history
of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import ufl

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..errors import InputError
from ..kernels.kernel import Kernel
from ..materials.base import parameter_values
from ..tools import compat
from ..tools.parallel import errors_on_all_ranks
from . import slopetables
from .elements import ElementForms
from .interiorpenalty import CellPotential, FacePotential
from .slopestiffness import slope_stiffness
from .slopetables import Table

_CHUNK = 2**22  # entries of tangents that are at hand at a time


@dataclass
class Patch:
    """Points of one material with the same potential.

    Attributes:
        data: inputs of the kernels after y (m, q, k).
    """

    table: Table
    data: np.ndarray
    potential: CellPotential

    def part(self, at: slice) -> Patch:
        t = self.table
        cut = Table(t.nodes[at], t.rows[at], t.weight[at], t.cells[at], t.normal[at], t.height[at])
        return replace(self, table=cut, data=self.data[at])

    def chunks(self) -> Iterator[Patch]:
        m, n = self.table.nodes.shape
        per = self.table.weight.shape[1] * self.potential.size**2 + (n * self.potential.dim) ** 2
        step = max(1, _CHUNK // per)
        return (self.part(slice(k, k + step)) for k in range(0, m, step))

    def unknowns(self, displacement: np.ndarray) -> np.ndarray:
        """y (m q, size) of nodal displacements (nodes, d)."""
        of_cells = displacement[self.table.nodes]
        y: np.ndarray = np.matmul(self.table.rows, of_cells[:, None]).reshape(-1, self.potential.size)
        return y

    def _inputs(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.unknowns(displacement), self.data.reshape(-1, self.data.shape[2])

    def energy(self, kernel: Kernel, displacement: np.ndarray) -> float:
        """J."""
        return float(self.table.weight.ravel() @ kernel(*self._inputs(displacement))[:, 0])

    def forces(self, kernel: Kernel, displacement: np.ndarray) -> np.ndarray:
        """At the nodes of each cell or face (m, n, d)."""
        m, q, r, n = self.table.rows.shape
        work = kernel(*self._inputs(displacement))
        s = work.reshape(m, q, work.shape[1]) * self.table.weight[:, :, None]
        flat = self.table.rows.reshape(m, q * r, n)
        found: np.ndarray = np.matmul(flat.transpose(0, 2, 1), s.reshape(m, q * r, self.potential.dim))
        return found

    def matrices(self, kernel: Kernel, displacement: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Second derivatives by the nodes' unknowns (m, n d, n d)."""
        (m, q, r, n), d, size = self.table.rows.shape, self.potential.dim, self.potential.size
        more = (self.unknowns(before),) if self.potential.predicts else ()
        rows = kernel(*self._inputs(displacement), *more)
        upper = rows.reshape(m, q, rows.shape[1]) * self.table.weight[:, :, None]
        a, (i, j) = np.empty((m, q, size, size)), np.triu_indices(size)
        a[:, :, i, j] = a[:, :, j, i] = upper
        a = a.reshape(m, q, r * d, r, d).transpose(0, 1, 2, 4, 3).reshape(m, q, r * d * d, r)
        half = np.matmul(a, self.table.rows).reshape(m, q * r, d * d * n)
        flat = self.table.rows.reshape(m, q * r, n)
        full = np.matmul(flat.transpose(0, 2, 1), half).reshape(m, n, d, d, n)
        found: np.ndarray = full.transpose(0, 1, 2, 4, 3).reshape(m, n * d, n * d)
        return found


class HeldSlopes:
    """What a support does that holds slopes on facets, counted from a displacement on.

    Attributes:
        base: that displacement of the nodes (m), (nodes, d).
    """

    def __init__(self, patches: list[Patch], base: np.ndarray):
        self.patches = patches
        self.count_from(base)

    def count_from(self, base: np.ndarray) -> None:
        """Hold the slopes that a displacement (nodes, d) has."""
        self.base = base
        for patch in self.patches:
            d = patch.potential.dim
            m, q = patch.table.weight.shape
            patch.data[:, :, 2 * d : 3 * d] = patch.unknowns(base)[:, -d:].reshape(m, q, d)


class GradientForms(ElementForms):
    """As `ElementForms`, for bodies in which a material has second gradients.

    Args:
        penalty: eta of the interior penalty, of degree 2; multiplied by (degree - 1)^2.

    Raises:
        InputError: a material that yields; see `slope_stiffness` and `inner_faces`.
    """

    takes_numbers = False  # their moduli are in the penalty of the faces

    def __init__(self, elements: Elements, penalty: float):
        super().__init__(elements)
        materials, dim = elements.points.materials, elements.dim
        if elements.points.plastic:
            raise InputError(
                "materials: a body can't have materials that yield beside ones with second gradients"
            )
        with errors_on_all_ranks(elements.comm):
            stiffness = [slope_stiffness(m, dim) if m.second_gradient else 0.0 for m in materials]
        # second derivatives are of degree - 2: a face sees (degree - 1)^2 times their mean square over a cell
        self._penalties = penalty * (elements.degree - 1) ** 2 * np.array(stiffness)
        self._cells = [CellPotential(m, dim) for m in materials]
        self._faces = [FacePotential(m, dim) if m.second_gradient else None for m in materials]
        self._row = _rows_of_cells(elements)
        self._inner = inner_faces(elements, self._row, np.array([m.second_gradient for m in materials]))
        self._kernels: dict[tuple[str, Any], Any] = {}
        self._values = np.zeros((0, dim))

    @property
    def residual_form(self) -> None:
        """UFL of all potentials; what is assembled are numbers."""
        for potential in (*self._cells, *self._faces):
            if potential is not None:
                _ = potential.tangent

    # points -----------------------------------------------------------------------------------------
    @cached_property
    def _of_cells(self) -> Table:
        return slopetables.of_cells(self.elements)

    @cached_property
    def _patches(self) -> list[Patch]:
        """Of cells and inner faces."""
        cells = [self._patch(self._of_cells, row) for row in range(len(self._cells))]
        sides = [
            side
            for pair in slopetables.of_faces(self.elements, self._inner)
            for side in pair
            if side is not None
        ]
        return [p for p in [*cells, *self._on_faces(sides, 0.5)] if len(p.table.nodes)]

    def _patch(self, table: Table, row: int, of_face: np.ndarray | None = None) -> Patch:
        """The points of a table that are of one material; those of a face with its data."""
        at = np.flatnonzero(self._row[table.cells] == row)
        cut = Table(*(getattr(table, name)[at] for name in Table.__dataclass_fields__))
        values = parameter_values(self._cells[row].material)
        data = np.broadcast_to(values, (*cut.weight.shape, len(values)))
        if of_face is None:
            return Patch(cut, data, self._cells[row])
        potential = self._faces[row]
        assert potential is not None
        return Patch(cut, np.concatenate([of_face[at], data], axis=2), potential)

    def _on_faces(
        self, tables: Sequence[Table], share: float, held: Sequence[int] | None = None
    ) -> list[Patch]:
        """Faces by material.

        Args:
            share: of the double traction, one half of the mean of two.
            held: components.
        """
        d, found = self.elements.dim, []
        mask = np.array([1.0 if held is None or i in held else 0.0 for i in range(d)])
        for table in tables:
            for row in range(len(self._cells)):
                if self._faces[row] is None:
                    continue
                shape = table.weight.shape
                data = np.zeros((*shape, 3 * d + 2))
                data[:, :, :d], data[:, :, d : 2 * d], data[:, :, 3 * d] = table.normal, mask, share
                data[:, :, 3 * d + 1] = share * self._penalties[row] / _length(table, d)
                found.append(self._patch(table, row, data))
        return [p for p in found if len(p.table.nodes)]

    def slopes(self, facets: Facets, columns: Sequence[int]) -> HeldSlopes:
        """What holds du/dN of some components on facets of the boundary. Collective.

        Raises:
            InputError: no cell at these facets has second gradients.
        """
        own = facets.facets[
            facets.facets < self.elements.mesh.topology.index_map(self.elements.dim - 1).size_local
        ]
        tables = [table for table, _ in slopetables.of_faces(self.elements, own)]
        patches = self._on_faces(tables, 1.0, columns)
        if not self.elements.comm.allreduce(len(patches)):
            raise InputError(
                f"{facets.name}: no material there has second gradients; its slope can't be held"
            )
        return HeldSlopes(patches, np.zeros((len(self.elements.nodes), self.elements.dim)))

    # sums -------------------------------------------------------------------------------------------
    def _kernel(self, potential: CellPotential, what: str) -> Any:
        """Compiled when it is needed first; on all ranks alike. Collective."""
        key = what, potential
        if key not in self._kernels:
            made = potential.compile_energy if what == "energy" else potential.compile
            self._kernels[key] = made(self.elements.comm)
        return self._kernels[key]

    def _compile(self, what: str = "tangent") -> None:
        """The kernels of all materials, as ranks may have points of some of them only. Collective."""
        for potential in (*(self._cells if what != "energy" else []), *self._faces):
            if potential is not None:
                self._kernel(potential, what)

    @property
    def displacement(self) -> np.ndarray:
        """Of the nodes (m), (nodes, d), increments included."""
        found: np.ndarray = (self.total.x.array + self.x.x.array).reshape(-1, self.elements.dim)
        return found

    def _forces(self, patches: Sequence[Patch]) -> np.ndarray:
        d, out = self.elements.dim, np.zeros((len(self.elements.nodes), self.elements.dim))
        for patch in (chunk for whole in patches for chunk in whole.chunks()):
            forces = patch.forces(self._kernel(patch.potential, "tangent")[0], self.displacement)
            at = (patch.table.nodes[:, :, None] * d + np.arange(d)).ravel()
            out += np.bincount(at, forces.ravel(), minlength=out.size).reshape(out.shape)
        return out

    def own_forces(self) -> np.ndarray:
        """Internal forces (nodes, d), on this rank. Collective."""
        self._compile()
        held = [patch for one in self.held.values() for patch in one.patches]
        return self._forces([*self._patches, *held])

    def held_forces(self, held: HeldSlopes) -> np.ndarray:
        """Of what holds slopes (nodes, d), on this rank."""
        return self._forces(held.patches)

    def dense(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Local nodes (n,) of each cell and face, and their part of the tangent (n d, n d)."""
        held = [patch for one in self.held.values() for patch in one.patches]
        before = (self.total.x.array + self.before.x.array).reshape(-1, self.elements.dim)
        for patch in (chunk for whole in (*self._patches, *held) for chunk in whole.chunks()):
            kernel = self._kernel(patch.potential, "tangent")[1]
            yield from zip(patch.table.nodes, patch.matrices(kernel, self.displacement, before), strict=True)

    def face_energy(self) -> float:
        """Energy (J) of inner faces and of held slopes at the last converged state. Collective."""
        self._compile("energy")
        held = [patch for one in self.held.values() for patch in one.patches]
        faces = [p for p in (*self._patches, *held) if isinstance(p.potential, FacePotential)]
        total = self.total.x.array.reshape(-1, self.elements.dim)
        energy = sum(p.energy(self._kernel(p.potential, "energy"), total) for p in faces)
        return float(self.elements.comm.allreduce(energy))

    def second_gradient(self) -> np.ndarray:
        d, table = self.elements.dim, self._of_cells
        u = self.total.x.array.reshape(-1, d)[table.nodes]
        known = np.matmul(table.rows[:, :, d:], u[:, None]).reshape(-1, table.rows.shape[2] - d, d)
        out = np.zeros((len(known), 3, 3, 3))
        for k, (i, j) in enumerate(combinations_with_replacement(range(d), 2)):
            out[:, :d, i, j] = out[:, :d, j, i] = known[:, k]
        has = np.array([m.second_gradient for m in self.elements.points.materials])
        out[~has[self.elements.points.material]] = 0.0
        return out

    # dolfinx ----------------------------------------------------------------------------------------
    @property
    def residuals(self) -> list[Any]:
        return []

    @property
    def tangents(self) -> list[Any]:
        return [self.tangent]

    @cached_property
    def tangent_form(self) -> ufl.Form:
        """Zero, with the pattern of the tangent."""
        from dolfinx import fem
        from dolfinx import mesh as dmesh

        mesh, u, v = self.elements.mesh, self.trial, self.test
        tags = dmesh.meshtags(
            mesh, self.elements.dim - 1, self._inner, np.ones(len(self._inner), dtype=np.int32)
        )
        self._zero = fem.Constant(mesh, 0.0)
        one = {"quadrature_degree": 1}
        dS = ufl.Measure("dS", domain=mesh, subdomain_data=tags, metadata=one)
        faces = self._zero * (u[0]("+") * v[0]("-") + u[0]("-") * v[0]("+")) * dS(1)
        return self._zero * u[0] * v[0] * ufl.Measure("dx", domain=mesh, metadata=one) + faces


def _length(table: Table, dim: int) -> np.ndarray:
    """h of the penalty (m, q): the size of the face, not less than the height of the cell over it, nor more
    than twice that, by which the penalty stays large enough."""
    size = table.weight.sum(axis=1, keepdims=True) ** (1 / (dim - 1))
    found: np.ndarray = np.clip(size, table.height, 2 * table.height)
    return found


def _rows_of_cells(elements: Elements) -> np.ndarray:
    """Row of the material of each local cell, ghosts too (cells,). Collective."""
    from dolfinx import fem

    space = compat.quadrature_space(elements.mesh, 1, 1)  # one point a cell
    row, own = fem.Function(space), len(elements.body.owned_cells)
    dofs = compat.cell_dofs(space)[:, 0]
    row.x.array[dofs[:own]] = elements.points.material[:: len(elements.reference_points)]
    row.x.scatter_forward()
    found: np.ndarray = np.rint(row.x.array[dofs]).astype(np.int64)
    return found


def inner_faces(elements: Elements, rows: np.ndarray, has: np.ndarray) -> np.ndarray:
    """This rank's own faces between two cells whose materials have second gradients, ascending. Between one
    that has and one that hasn't there is nothing to be done: double tractions vanish there by themselves.
    Collective.

    Raises:
        InputError: ranks don't know the cells on the other side of their faces.
    """
    from dolfinx import mesh as dmesh

    mesh, dim, comm = elements.mesh, elements.dim, elements.comm
    mesh.topology.create_entities(dim - 1)
    mesh.topology.create_connectivity(dim - 1, dim)
    mesh.topology.create_connectivity(dim, dim - 1)
    mesh.topology.create_connectivity(dim, 0)
    cells, faces = mesh.topology.connectivity(dim - 1, dim), mesh.topology.index_map(dim - 1)
    ends = np.asarray(cells.offsets)[: faces.size_local + 1]
    inner = np.flatnonzero(np.diff(ends) == 2).astype(np.int32)
    outer = len(dmesh.exterior_facet_indices(mesh.topology))
    known, total = comm.allreduce(len(inner) + outer), faces.size_global
    if known != total:
        raise InputError(
            f"mesh: of {total - known} faces between two ranks the cell on the other side isn't known, which "
            "materials with second gradients need; make the mesh with ghost_mode = "
            "dolfinx.mesh.GhostMode.shared_facet"
        )
    sides = np.asarray(cells.array)[ends[inner][:, None] + np.arange(2)]
    found: np.ndarray = inner[has[rows[sides]].all(axis=1)]
    return found
