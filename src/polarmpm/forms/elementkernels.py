"""Finite elements by the material points' own kernels: a quadrature point is one of them.

A mesh moves with its nodes, so that gradients are those by X, and the state of a quadrature point is all that
its kernel has to know of the past. Kernels in the rotated frame take gradients times Q~^T.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bodies.elements import Elements
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..materials.base import Material, parameter_values
from ..tools import compat
from .choice import make_form
from .elements import ElementForms
from .points import PointForm
from .projected import ProjectedForm

if TYPE_CHECKING:
    from .returnmapping import ReturnMapping


class KernelForms(ElementForms):
    """Kernels of the materials, and what they take, at the quadrature points.

    Args:
        forms: of the materials; default: without any projection.
    """

    def __init__(self, elements: Elements, forms: Sequence[PointForm] = ()):
        super().__init__(elements)
        points = elements.points
        self.symmetric = not any(m.yields for m in points.materials)
        self._rows_of = [np.flatnonzero(points.material == m) for m in range(len(points.materials))]
        self.point_forms = list(forms) or [
            make_form(m, elements.dim, points.axisymmetric) for m in points.materials
        ]
        for form in self.point_forms:
            form.check()
        self._comm = elements.comm
        self._parameters = [parameter_values(form.material) for form in self.point_forms]
        self._states: list[np.ndarray] = []  # of each material's points
        self._turns: list[np.ndarray | None] = []  # (n, 3, 3), of gradients; None: they stay

    @property
    def uncured(self) -> list[Material]:
        return [form.material for form in self.point_forms if not form.scalars]

    @property
    def residual_form(self) -> None:
        """There is none on the mesh."""
        return None

    def put_materials(self, materials: Sequence[Material]) -> None:
        for form, material in zip(self.point_forms, materials, strict=True):
            form.take(material)
        self._parameters = [parameter_values(material) for material in materials]

    # kernels --------------------------------------------------------------------------------------
    @cached_property
    def compiled(self) -> tuple[list[tuple[Kernel, Kernel]], list[ReturnMapping | None]]:
        """Kernels of the materials, and their return mappings; made by the first step. Collective."""
        kernels: list[tuple[Kernel, Kernel]] = []
        mappings: list[ReturnMapping | None] = []
        for form, rows in zip(self.point_forms, self._rows_of, strict=True):
            kernels.append(form.compile(self._comm))
            mappings.append(self._mapping(form, rows) if form.material.yields else None)
        return kernels, mappings

    def _mapping(self, form: PointForm, rows: np.ndarray) -> ReturnMapping:
        from .returnmapping import ReturnMapping  # lazy import: elastic scenes need no plasticity

        return ReturnMapping(form, self._comm, self.elements.points.id[rows])

    @property
    def _mappings(self) -> list[ReturnMapping]:
        """Those that there are."""
        made = self.compiled[1] if "compiled" in self.__dict__ else []
        return [mapping for mapping in made if mapping is not None]

    # state --------------------------------------------------------------------------------------
    def pack(self) -> None:
        p = self.elements.points
        self._states, self._turns = [], []
        for form, rows in zip(self.point_forms, self._rows_of, strict=True):
            radii = np.stack([p.X[rows, 0], p.x[rows, 0]], axis=1)
            state = form.pack(p.F[rows], p.q[rows], p.wryness[rows], p.plastic_state(rows), radii=radii)
            if isinstance(form, ProjectedForm):
                state = form.extend(state, np.zeros((len(rows), form.scalars)))
            self._states.append(np.ascontiguousarray(state))
            turned = self.layout.rotations and form.rotated
            self._turns.append(rotations.to_tensor(p.q[rows]) if turned else None)

    def start_elastic(self, on: bool) -> bool:
        for mapping in self._mappings:
            mapping.start_elastic = on
        return not self.symmetric

    def changing(self) -> list[Any]:
        return list(self._mappings)

    def dissipate(self, share: float) -> None:
        for mapping in self._mappings:
            mapping.dissipate(share)

    def flow(self, base: np.ndarray) -> None:
        """Put the plastic flow of a converged step into the points' plastic state; their deformation has been
        updated, `base` (n, 4) is their microrotation before."""
        made = self.compiled[1] if self._mappings else [None] * len(self._rows_of)
        for rows, mapping in zip(self._rows_of, made, strict=True):
            if mapping is not None:
                mapping.update_plastic_state(self.elements.points, rows, base[rows])

    def kernel_inputs(self, k: int, z: np.ndarray) -> np.ndarray:
        """Inputs (n, form.inputs) of a material's residual at unknowns z (n, nz) in the kernel's frame."""
        return np.hstack([z, self._states[k], np.tile(self._parameters[k], (len(z), 1))])


@dataclass
class Part:
    """The elements of one material.

    Attributes:
        cells: which of this rank's own cells.
        points: which of the quadrature points, element by element.
        elements: what the sums in C read, but for the state and the columns of the matrix.
    """

    form: PointForm
    cells: np.ndarray
    points: np.ndarray
    elements: native.Elements


class NativeElementForms(KernelForms):
    """Elements that compiled loops sum; dolfinx has the loads.

    Attributes:
        parts: the elements by material.
    """

    def __init__(self, elements: Elements, forms: Sequence[PointForm] = ()):
        super().__init__(elements, forms)
        e, xi = elements, elements.reference_points
        _, jacobian = compat.mesh_geometry(e.mesh, xi, e.live)
        inverse = np.linalg.inv(jacobian).reshape(len(e.live) * len(xi), e.dim, e.dim)
        # dxi/dX, X being where an element is undeformed
        self._inverse = np.ascontiguousarray(inverse if e.placed is None else inverse @ e.placed)
        table = compat.tabulate(e.body.cell, e.degree, xi)
        self._table = np.ascontiguousarray(np.swapaxes(table, 0, 1))  # [point][1 + d][node]
        self._axes: list[np.ndarray] = []  # of each material's points: dxi/dX, turned into the kernel's frame
        self._now = self._inverse  # of all points, not turned
        self._whole = self._structure(None, np.arange(len(e.live)))
        self.parts = []
        for form, rows in zip(self.point_forms, self._rows_of, strict=True):
            cells = rows[:: len(xi)] // len(xi)
            self.parts.append(Part(form, cells, rows, self._structure(form, cells)))

    def _structure(self, form: PointForm | None, cells: np.ndarray) -> native.Elements:
        e, (points, _, nodes) = self.elements, self._table.shape
        at = (cells[:, None] * points + np.arange(points)).ravel()
        numbers = np.zeros(0) if form is None else parameter_values(form.material)
        out = native.Elements()
        native.fill(
            out,
            dim=e.dim,
            rot=self.layout.rotations,
            second=self.layout.kind,
            nodes=nodes,
            points=points,
            nstate=0 if form is None else form.packed_size,
            nparam=len(numbers),
            nelements=len(cells),
            table=self._table,
            axes=self._inverse[at] if form is None else None,
            param=numbers,
            volume=np.ascontiguousarray(e.points.volume0[at]),
            cells=np.ascontiguousarray(e.live_nodes[cells], dtype=np.int32),
        )
        return out

    def pack(self) -> None:
        super().pack()
        d, self._axes, inverse = self.layout.dim, [], self._inverse
        if any(part.form.scalars for part in self.parts):
            inverse = np.ascontiguousarray(inverse @ self._by_projected())
        self._now = inverse
        for part, turn in zip(self.parts, self._turns, strict=True):
            axes = inverse[part.points]
            if turn is not None:
                axes = axes @ np.swapaxes(turn[:, :d, :d], 1, 2)
            self._axes.append(np.ascontiguousarray(axes))

    def _by_projected(self) -> np.ndarray:
        """F^-1 Fbar (np, d, d) of points whose F is projected, F being the nodes': it makes gradients by X
        those by x~ times Fbar, as of a material point with Fbar."""
        d, p = self.layout.dim, self.elements.points
        z, _ = self._gather_all(self._inverse, self.total.x.array)
        start = np.eye(d) if self.elements.placed is None else self.elements.placed
        true = start + self.layout.part(z, "displacement", 1)
        found = np.tile(np.eye(d), (len(p), 1, 1))
        for part in self.parts:
            if part.form.scalars:
                rows = part.points
                found[rows] = np.linalg.solve(true[rows], p.F[rows][:, :d, :d])
        return found

    def bound(self, k: int) -> native.Elements:
        """The elements of a material in the present state."""
        elements = self.parts[k].elements
        native.fill(elements, state=self._states[k], axes=self._axes[k], param=self._parameters[k])
        return elements

    def unknowns(self, k: int, x: np.ndarray) -> np.ndarray:
        """z (n, nz) of a material's points at increments (nodes, block), in the kernel's frame."""
        return self._gather(self.bound(k), x)[0]

    def values_at_points(self) -> tuple[np.ndarray, np.ndarray]:
        layout = self.layout
        z, value = self._gather_all(self._now, self.x.x.array)
        gradients = [layout.part(z, field, 1) for field in ("displacement", "rotation")]
        return value, np.concatenate(gradients, axis=1)

    def _gather_all(self, axes: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        native.fill(self._whole, axes=axes)
        return self._gather(self._whole, x.reshape(-1, self.layout.block))

    def _gather(self, elements: native.Elements, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n, layout = elements.nelements * elements.points, self.layout
        z, value = np.empty((n, layout.unknowns)), np.empty((n, layout.block))
        x = np.ascontiguousarray(x)
        if native.library().polarmpm_gather_elements(ctypes.byref(elements), x, z, value):
            raise MemoryError("no memory to interpolate nodal values")
        return z, value

    def load_code(self) -> None:
        _ = self.compiled
