"""Finite elements with plastic materials: stresses and consistent tangents at quadrature points as numbers.

The return mapping is the material points' own. What it finds at the quadrature points goes into the forms of
`forms.numbers`, which dolfinx assembles; elastic points get theirs from the elastic kernels.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from ..bodies.elements import Elements
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..materials.base import parameter_values
from .choice import make_form
from .elements import ElementForms
from .numbers import QuadratureForms
from .returnmapping import ReturnMapping


class PlasticElementForms(ElementForms):
    """As `ElementForms`, for bodies in which a material can yield."""

    symmetric = False

    def __init__(self, elements: Elements):
        super().__init__(elements)
        points, comm = elements.points, elements.comm
        self._rows_of = [np.flatnonzero(points.material == m) for m in range(len(points.materials))]
        self._point_forms = [make_form(m, elements.dim) for m in points.materials]
        for form in self._point_forms:
            _ = form.energy  # evaluated now, so that a mistake in a user's energy shows here
        self._comm = comm
        self._states: list[np.ndarray] = []  # kernel inputs after z
        self._frames: list[np.ndarray] = []  # see `_frame`

    @property
    def residual_form(self) -> None:
        """The stresses are numbers here."""
        return None

    # kernels --------------------------------------------------------------------------------------
    @cached_property
    def _compiled(self) -> tuple[list[tuple[Kernel, Kernel]], list[ReturnMapping | None]]:
        """Kernels of the materials, and their return mappings; made by the first step. Collective."""
        kernels: list[tuple[Kernel, Kernel]] = []
        mappings: list[ReturnMapping | None] = []
        for form, rows in zip(self._point_forms, self._rows_of, strict=True):
            kernels.append(form.compile(self._comm))
            ids = self.elements.points.id[rows]
            mappings.append(ReturnMapping(form, self._comm, ids) if form.material.plastic else None)
        return kernels, mappings

    @property
    def _mappings(self) -> list[ReturnMapping | None]:
        """Those that there are."""
        return self._compiled[1] if "_compiled" in self.__dict__ else []

    @cached_property
    def _quadrature_forms(self) -> QuadratureForms:
        e, _ = self.elements, self._compiled
        return QuadratureForms(e.space, self.layout, e.quadrature_degree, symmetric=False)

    @property
    def residual(self) -> Any:
        return self._quadrature_forms.residual

    @property
    def tangent(self) -> Any:
        return self._quadrature_forms.tangent

    # state --------------------------------------------------------------------------------------
    def pack(self) -> None:
        p = self.elements.points
        self._states, self._frames = [], []
        for form, rows in zip(self._point_forms, self._rows_of, strict=True):
            state = form.pack(p.F[rows], p.q[rows], p.wryness[rows], p.plastic_state(rows))
            numbers = np.tile(parameter_values(form.material), (len(rows), 1))
            self._states.append(np.hstack([state, numbers]))
            turned = self.layout.rotations and form.material.isotropic
            turn = rotations.to_tensor(p.q[rows]) if turned else None
            self._frames.append(_frame(self.layout, turn, len(rows)))

    def start_elastic(self, on: bool) -> bool:
        for mapping in self._mappings:
            if mapping is not None:
                mapping.start_elastic = on
        return True

    def changing(self) -> list[Any]:
        return [mapping for mapping in self._mappings if mapping is not None]

    def flow(self, base: np.ndarray) -> None:
        """Put the plastic flow of a converged step into the points' plastic state; their deformation has been
        updated, `base` (n, 4) is their microrotation before."""
        for rows, mapping in zip(self._rows_of, self._mappings, strict=True):
            if mapping is not None and mapping.yielding is not None:
                yielding = rows[mapping.yielding.rows]
                mapping.update_plastic_state(self.elements.points, yielding, base[yielding])

    # evaluation -----------------------------------------------------------------------------------
    def update(self, tangent: bool) -> None:
        """Stresses, and moduli if asked, at the present unknowns. Collective.

        Raises:
            LocalFailure: return mapping failed at some points.
        """
        n, nz = len(self.elements.points), self.layout.unknowns
        z = self._unknowns()
        s, moduli = np.zeros((n, nz)), np.zeros((n if tangent else 0, nz * nz))
        for k, (rows, frame) in enumerate(zip(self._rows_of, self._frames, strict=True)):
            framed = np.einsum("nij,nj->ni", frame, z[rows])
            s[rows], a = self._evaluate(k, np.hstack([framed, self._states[k]]), tangent)
            back = np.swapaxes(frame, 1, 2)
            s[rows] = np.einsum("nij,nj->ni", back, s[rows])
            if tangent:
                moduli[rows] = (back @ a @ frame).reshape(len(rows), nz * nz)
        self.put_at_points(self._quadrature_forms.residual_values, s)
        if tangent:
            self.put_at_points(self._quadrature_forms.tangent_values, moduli)

    def _unknowns(self) -> np.ndarray:
        """z = (dDu/dX, Dw, dDw/dX) at the points (n, nz)."""
        return self.layout.pack(*self.values_at_points())

    def _evaluate(self, k: int, inputs: np.ndarray, tangent: bool) -> tuple[np.ndarray, np.ndarray]:
        """s (n, nz) and moduli (n, nz, nz) of a material's points."""
        nz = self.layout.unknowns
        # no correction before: an elastic material beside plastic ones has the tangent itself
        predicts = tangent and self._point_forms[k].predicts
        out = self._compiled[0][k][tangent](inputs, *([inputs[:, :nz]] if predicts else []))
        s, a = out[:, :nz], np.zeros((len(inputs) if tangent else 0, nz, nz))
        if tangent:
            i, j = np.triu_indices(nz)
            a[:, i, j] = a[:, j, i] = out[:, nz:]
        mapping = self._compiled[1][k]
        if mapping is not None:
            y = mapping.evaluate(inputs, tangent)
            s[y.rows] = y.returned[:, :nz]
            if tangent:
                a[y.rows] = y.returned[:, nz:].reshape(-1, nz, nz)
        return s, a


def _frame(layout: Layout, turn: np.ndarray | None, n: int) -> np.ndarray:
    """Matrices (n, nz, nz) from z of gradients by X to z of gradients in the kernels' frame, times Q~^T."""
    d, out = layout.dim, np.tile(np.eye(layout.unknowns), (n, 1, 1))
    if turn is not None:
        for at in layout.gradients:
            out[:, at, at] = turn[:, :d, :d]
    return out
