"""Second gradients W(F, H) on elements whose functions are continuous but not their slopes.

C0 interior penalty (Engel et al. 2002; Hansbo, Larson 2002) from one potential, in the undeformed body:

    cells   int W(F, H) dV
    faces   int [-{t} . [du/dN] + eta/2 {k/h} |[du/dN]|^2] dA,   t_i = dW/dH_iJK N_J N_K

with the jump [.] and the mean {.} of the two sides. Faces of the boundary where the slope is held have the same
with du/dN less what it is held at in the place of the jump. k is the largest stiffness of the material at rest
against second gradients a N N, h the height of the cell over the face.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from functools import cached_property
from typing import Any


import numpy as np
import ufl

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..errors import InputError
from ..kinematics import tensors as kin
from ..materials.base import Material, evaluate_measures
from ..tools import compat
from ..tools.parallel import errors_on_all_ranks
from .elements import ElementForms
from .slopestiffness import slope_stiffness
from .strains import motion, stresses


class GradientForms(ElementForms):
    """As `ElementForms`, for bodies in which a material has second gradients.

    H is that of the displacement itself, `total + x`, in cells and on faces; so there is no history of it.

    Args:
        penalty: eta.
    """

    def __init__(self, elements: Elements, penalty: float):
        from dolfinx import fem

        super().__init__(elements)
        materials = elements.points.materials
        with errors_on_all_ranks(elements.comm):
            found = [slope_stiffness(m, elements.dim) if m.second_gradient else 0.0 for m in materials]
        self._penalties = [fem.Constant(elements.mesh, penalty * k) for k in found]
        self._zero = fem.Constant(elements.mesh, 0.0)
        self._row = _rows_of_cells(elements)
        self._pairs = _pairs_of_faces(elements, self._row)

    # cells ----------------------------------------------------------------------------------------
    def _strains(self, material: Material, x: Any) -> tuple[Any, ...]:
        if not material.second_gradient:
            return super()._strains(material, x)
        z = self.layout.scalars(x, ufl.grad(x))
        now = motion(self.layout, z, self.state, rotated=False)
        return evaluate_measures(material, now.F, self.second_gradient(x))

    def second_gradient(self, x: Any, side: str | None = None) -> Any:
        """H, 3 x 3 x 3, of the last converged state and increments x; on faces on one side of them."""
        h, d = ufl.grad(ufl.grad(self.total)) + ufl.grad(ufl.grad(x)), self.layout.dim
        return _in_space(h if side is None else h(side), d)

    # faces ----------------------------------------------------------------------------------------
    def _state(self, side: str | None) -> tuple[Any, Any, Any, Any]:
        """F, H, the normal and k's divisor h on a face, F and H of three rows."""
        mesh, d = self.elements.mesh, self.layout.dim
        f, h = self._deformation(), abs(ufl.JacobianDeterminant(mesh)) / abs(ufl.classes.FacetJacobianDeterminant(mesh))
        n = ufl.FacetNormal(mesh)
        if side is not None:
            f, h, n = f(side), h(side), n(side)
        f = f if d == 3 else kin.plane_tensor(f)
        return f, self.second_gradient(self.x, side), n, h

    def _double_work(self, row: int, F: Any, H: Any, n: Any, jump: Any) -> Any:
        """t . jump of a material: the derivative of its energy by second gradients jump N N."""
        material, d = self.elements.points.materials[row], self.layout.dim
        size = ufl.variable(self._zero)
        direction = _in_space(ufl.as_tensor([[[size * jump[i] * n[j] * n[k] for k in range(d)] for j in range(d)] for i in range(d)]), d)
        along = evaluate_measures(material, F, H + direction)
        at = stresses(material, evaluate_measures(material, F, H), self._numbers[row])
        return sum(ufl.inner(s, ufl.diff(e, size)) for s, e in zip(at, along, strict=True))

    def _face(self, pair: tuple[int, int]) -> Any:
        """The potential per area of faces between cells of two materials."""
        (f0, h0, n, a0), (f1, h1, _, a1) = self._state("+"), self._state("-")
        d = self.layout.dim
        jump = ufl.as_vector([sum((f0[i, j] - f1[i, j]) * n[j] for j in range(d)) for i in range(d)])
        low, high = pair
        energy = 0
        for side, F, H, height in (("+", f0, h0, a0), ("-", f1, h1, a1)):
            work, k = self._double_work(low, F, H, n, jump), self._penalties[low]
            if low != high:
                first = ufl.lt(self._row(side), 0.5 * (low + high))
                work = ufl.conditional(first, work, self._double_work(high, F, H, n, jump))
                k = ufl.conditional(first, k, self._penalties[high])
            energy += 0.5 * (-work + 0.5 * k / height * ufl.dot(jump, jump))
        return energy

    @cached_property
    def _faces(self) -> ufl.Form | None:
        """Potential of the faces between cells with second gradients; None where there are none."""
        tagged, pairs = self._pairs
        degree = {"quadrature_degree": self.elements.quadrature_degree}
        dS = ufl.Measure("dS", domain=self.elements.mesh, subdomain_data=tagged, metadata=degree)
        parts = [self._face(pair) * dS(k + 1) for k, pair in enumerate(pairs)]
        return sum(parts[1:], parts[0]) if parts else None

    @cached_property
    def residual_form(self) -> ufl.Form:
        form = super().residual_form
        return form if self._faces is None else form + ufl.derivative(self._faces, self.x, self.test)

    @cached_property
    def tangent_form(self) -> ufl.Form:
        form = super().tangent_form
        if self._faces is None:
            return form
        return form + ufl.derivative(ufl.derivative(self._faces, self.x, self.test), self.x, self.trial)

    # supports -------------------------------------------------------------------------------------
    def slopes(self, facets: Facets, columns: Sequence[int]) -> SlopeForms:
        """Forms that hold du/dN of some components on facets of the boundary. Collective.

        Raises:
            InputError: no cell at these facets has second gradients.
        """
        from dolfinx import fem
        from dolfinx import mesh as dmesh

        e, d = self.elements, self.layout.dim
        has = np.array([m.second_gradient for m in e.points.materials])
        cells = e.mesh.topology.connectivity(d - 1, d)
        at = np.asarray(cells.array)[np.asarray(cells.offsets)[facets.facets]]
        dofs = compat.cell_dofs(self._row.function_space)[:, 0]
        rows = np.rint(self._row.x.array[dofs[at]]).astype(np.int32)
        tags = dmesh.meshtags(e.mesh, d - 1, facets.facets[has[rows]], rows[has[rows]] + 1)
        used = sorted(set().union(*e.comm.allgather(rows[has[rows]].tolist())))
        if not used:
            raise InputError(f"{facets.name}: no material there has second gradients; its slope can't be held")
        ds = ufl.Measure(
            "ds", domain=e.mesh, subdomain_data=tags, metadata={"quadrature_degree": e.quadrature_degree}
        )
        base = fem.Function(e.space)
        parts = [self._held_face(row, base, columns) * ds(int(row) + 1) for row in used]
        potential = sum(parts[1:], parts[0])
        residual = ufl.derivative(potential, self.x, self.test)
        return SlopeForms(base, potential, residual, ufl.derivative(residual, self.x, self.trial))

    def _held_face(self, number: int, base: Any, columns: Sequence[int]) -> Any:
        """The potential per area of a face of a material where the slope is held at that of `base`."""
        (F, H, n, height), d = self._state(None), self.layout.dim
        held = ufl.grad(base)
        rows = [sum((F[i, j] - (i == j) - held[i, j]) * n[j] for j in range(d)) for i in range(d)]
        gap = ufl.as_vector([row if i in columns else 0.0 for i, row in enumerate(rows)])
        penalty = 0.5 * self._penalties[number] / height * ufl.dot(gap, gap)
        return penalty - self._double_work(number, F, H, n, gap)


class SlopeForms:
    """What holds the slope on some facets, as compiled forms.

    Attributes:
        base: displacement whose slope is prescribed.
    """

    def __init__(self, base: Any, potential: ufl.Form, residual: ufl.Form, tangent: ufl.Form):
        self.base = base
        self._potential = potential
        self.residual, self.tangent = compat.compile_form(residual), compat.compile_form(tangent)

    def count_from(self, displacement: np.ndarray) -> None:
        """Hold the slopes that a displacement (nodes, d) has."""
        self.base.x.array[:] = displacement.ravel()

    @cached_property
    def potential(self) -> Any:
        return compat.compile_form(self._potential)


def _in_space(h: Any, dim: int) -> Any:
    """A second gradient with three components and directions."""
    n = range(dim)
    known = [[[h[i, min(j, k), max(j, k)] for k in n] for j in n] for i in n]  # half of them: shorter code
    if dim == 3:
        return ufl.as_tensor(known)
    plane = [[[*row, 0] for row in rows] + [[0] * 3] for rows in known]
    return ufl.as_tensor([*plane, [[0] * 3] * 3])


def _rows_of_cells(elements: Elements) -> Any:
    """Row of each cell's material, as a function that is constant on cells; ghosts' too. Collective."""
    from dolfinx import fem

    space = compat.cellwise_space(elements.mesh)
    row, own = fem.Function(space), elements.body.owned_cells
    at = compat.cell_dofs(space)[: len(own), 0]
    row.x.array[at] = elements.points.material[:: len(elements.reference_points)]
    row.x.scatter_forward()
    return row


def _pairs_of_faces(elements: Elements, row: Any) -> tuple[Any, list[tuple[int, int]]]:
    """Tags, from 1 on, of this rank's own faces between two cells with second gradients by the pairs of rows
    of their materials; and these pairs, the same on all ranks. Collective.

    Raises:
        InputError: ranks don't know the cells on the other side of their faces.
    """
    from dolfinx import mesh as dmesh

    mesh, dim, comm = elements.mesh, elements.dim, elements.comm
    mesh.topology.create_entities(dim - 1)
    mesh.topology.create_connectivity(dim - 1, dim)
    mesh.topology.create_connectivity(dim, dim - 1)
    cells, faces = mesh.topology.connectivity(dim - 1, dim), mesh.topology.index_map(dim - 1)
    ends = np.asarray(cells.offsets)[: faces.size_local + 1]
    inner = np.flatnonzero(np.diff(ends) == 2).astype(np.int32)
    outer = len(dmesh.exterior_facet_indices(mesh.topology))
    known, total = comm.allreduce(len(inner) + outer), faces.size_global
    if known != total:
        raise InputError(
            f"mesh: of {total - known} faces between two ranks the cell on the other side isn't known, which materials with "
            "second gradients need; make the mesh with ghost_mode=dolfinx.mesh.GhostMode.shared_facet"
        )
    sides = np.asarray(cells.array)[ends[inner][:, None] + np.arange(2)]
    has = np.array([m.second_gradient for m in elements.points.materials])
    dofs = compat.cell_dofs(row.function_space)[:, 0]
    rows = np.sort(np.rint(row.x.array[dofs[sides]]).astype(int), axis=1)
    both = has[rows].all(axis=1)
    inner, rows = inner[both], rows[both]
    pairs = sorted(set().union(*comm.allgather([tuple(r) for r in np.unique(rows, axis=0).tolist()])))
    values = np.array([1 + pairs.index(tuple(r)) for r in rows.tolist()], dtype=np.int32)
    return dmesh.meshtags(mesh, dim - 1, inner, values), pairs
