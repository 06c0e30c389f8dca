"""Finite elements with plastic materials by dolfinx: stresses and moduli at the points as numbers.

The return mapping is the material points' own. What it finds at the quadrature points goes into the forms of
`forms.numbers`, which dolfinx assembles; elastic points get theirs from the elastic kernels. The sums of
`assembly.elementsums` are held against these.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from ..bodies.elements import Elements
from ..kinematics.layout import Layout
from .elementkernels import KernelForms
from .numbers import QuadratureForms


class PlasticElementForms(KernelForms):
    """As `ElementForms`, for bodies in which a material can yield."""

    def __init__(self, elements: Elements):
        super().__init__(elements)
        self.symmetric = False  # whatever the materials, whole tangents are put into the matrix

    @cached_property
    def _quadrature_forms(self) -> QuadratureForms:
        e, _ = self.elements, self.compiled
        return QuadratureForms(e.space, self.layout, e.quadrature_degree, symmetric=False, turn=e.turn)

    @property
    def residual(self) -> Any:
        return self._quadrature_forms.residual

    @property
    def tangent(self) -> Any:
        return self._quadrature_forms.tangent

    # evaluation -----------------------------------------------------------------------------------
    def update(self, tangent: bool) -> None:
        """Stresses, and moduli if asked, at the present unknowns. Collective.

        Raises:
            LocalFailure: return mapping failed at some points.
        """
        n, nz = len(self.elements.points), self.layout.unknowns
        z = self._unknowns()
        s, moduli = np.zeros((n, nz)), np.zeros((n if tangent else 0, nz * nz))
        for k, (rows, turn) in enumerate(zip(self._rows_of, self._turns, strict=True)):
            frame = _frame(self.layout, turn, len(rows))
            framed = np.einsum("nij,nj->ni", frame, z[rows])
            s[rows], a = self._evaluate(k, self.kernel_inputs(k, framed), tangent)
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
        predicts = tangent and self.point_forms[k].predicts
        out = self.compiled[0][k][tangent](inputs, *([inputs[:, :nz]] if predicts else []))
        s, a = out[:, :nz], np.zeros((len(inputs) if tangent else 0, nz, nz))
        if tangent:
            i, j = np.triu_indices(nz)
            a[:, i, j] = a[:, j, i] = out[:, nz:]
        mapping = self.compiled[1][k]
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
