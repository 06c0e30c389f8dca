"""The weak form of a consistent support at a point of a surface (Nitsche's method): UFL in, compiled out.

With the gap g = (u, w) - (prescribed increments) and its held part c, the potential per undeformed area is

    -(P N) . c_u - (Q S N) . J_l(w) c_w + 1/2 g . (stiffness) g.

Traction and couple traction are the work that the material's stresses do on the gradients c_u (x) N and
c_w (x) N, so that every energy gives them (docs/theory.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import ufl

from ..kernels.kernel import matrix
from ..kinematics.layout import STRESSED_SURFACE, Layout
from ..materials.base import Material, evaluate_energy, named_parameters, parameter_values
from .strains import strains
from .surfaces import SurfaceForm


class ConsistentForm(SurfaceForm):
    """A support that does the work of the stresses on its gap.

    Data: state of the point (F~, q~, Gamma~); F~^-T N; held part of a gap, b x b; stiffness, b x b;
    prescribed increments b; a given force b; the material's numbers.

    Args:
        material: whose stresses act at the point.
        symmetric: the derivative of the potential. Else the tractions' variation does work on the gap with
            the opposite sign, which needs no stiffness.
    """

    parts = STRESSED_SURFACE

    def __init__(self, layout: Layout, material: Material, *, symmetric: bool = True):
        self.material, self.symmetric = material, symmetric
        b, d, numbers = layout.block, layout.dim, len(parameter_values(material))
        super().__init__(layout, layout.state().size, d, b * b, b * b, b, b, numbers)

    def numbers(self) -> np.ndarray:
        """The material's, as the kernel reads them."""
        return parameter_values(self.material)

    def virtual_work(self) -> Any:
        springs = ufl.derivative(self._energy, self.y, self.test)
        return springs + sum(ufl.inner(acting, moved) for acting, moved in self._pairs)

    def linearised(self) -> ufl.Form:
        """What acts is derived by the strains, and these by y, which keeps the code short."""
        y, trial = self.y, self._trial
        work = ufl.derivative(ufl.derivative(self._energy, y, self.test), y, trial)
        for acting, moved in self._pairs:
            work += ufl.inner(self._rate(acting), moved)
            work += ufl.inner(acting, ufl.derivative(moved, y, trial))
        return work * self.dx

    # springs ----------------------------------------------------------------------------------------
    @cached_property
    def _gap(self) -> list[Any]:
        target = self.coefficients[4]
        return [value - target[i] for i, value in enumerate(self._values(self.y))]

    @property
    def _energy(self) -> Any:
        stiffness, force, gap, b = self.coefficients[3], self.coefficients[5], self._gap, self.layout.block
        energy = sum(0.5 * gap[i] * stiffness[b * i + j] * gap[j] for i in range(b) for j in range(b))
        return energy + sum(force[i] * gap[i] for i in range(b))

    # tractions --------------------------------------------------------------------------------------
    @cached_property
    def _strained(self) -> tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]:
        """The material's strains, and their changes on the gap's gradient across the surface: each as a
        function of y, and as a variable."""
        state = self.coefficients[0]
        measures = strains(self.material, self.layout, self._unknowns(state), state, rotated=False)
        changes = [ufl.derivative(e, self.y, self._across(self._gap)) for e in measures]
        return [(e, ufl.variable(e)) for e in measures], [(c, ufl.variable(c)) for c in changes]

    @cached_property
    def _pairs(self) -> list[tuple[Any, Any]]:
        """What acts, a function of the variables, and what it does work on.

        The work of the tractions on the gap is psi = stresses : changes; its variation comes with one sign or
        the other, and holds the tractions' work on the variation of the gap.
        """
        measures, changes = self._strained
        numbers = named_parameters(self.material, self.coefficients[6])
        w = evaluate_energy(self.material, [v for _, v in measures], numbers)
        stresses = [ufl.diff(w, v) for _, v in measures]
        psi = sum(ufl.inner(s, c) for s, (_, c) in zip(stresses, changes, strict=True))
        sign, pairs = -1 if self.symmetric else 1, []
        for (e, v), (c, _), stress in zip(measures, changes, stresses, strict=True):
            pairs.append((sign * ufl.diff(psi, v), ufl.derivative(e, self.y, self.test)))
            pairs.append((sign * stress, ufl.derivative(c, self.y, self.test)))
            if not self.symmetric:
                across = self._across(self._values(self.test))
                pairs.append((-2 * stress, ufl.derivative(e, self.y, across)))
        return pairs

    def _rate(self, acting: Any) -> Any:
        """Derivative of what acts by the trial function, by way of the variables."""
        measures, changes = self._strained
        return sum(
            _times(ufl.diff(acting, v), ufl.derivative(e, self.y, self._trial), len(acting.ufl_shape))
            for e, v in (*measures, *changes)
        )

    def _across(self, values: Sequence[Any]) -> Any:
        """The direction in y of gradients across the surface, of the held part of values (b)."""
        held, normal, b, direction = self.coefficients[2], self.coefficients[1], self.layout.block, []
        part = [sum(held[b * i + j] * values[j] for j in range(b)) for i in range(b)]
        for field, component, axes in self.slots.slots:
            value = part[self.slots.rows(field)[component]]
            direction.append(value * normal[axes[0]] if axes else 0 * value)
        return ufl.as_vector(direction)

    def _unknowns(self, state: Any) -> Any:
        """z of a material point: gradients by X."""
        point, d = self.layout, self.layout.dim
        frame = matrix(state, d, d, point.state().at_frame.start)
        fields = [field for field in ("displacement", "rotation") if point.rows(field)]
        by_X = {field: ufl.dot(self.slots.derivative(self.y, field), frame) for field in fields}
        value = {s: self.y[k] for k, s in enumerate(self.slots.slots) if not s.axes}
        found = [by_X[s.field][s.component, s.axes[0]] if s.axes else value[s] for s in point.slots]
        return ufl.as_vector(found)


def _times(derivative: Any, rate: Any, rank: int) -> Any:
    """The derivative of something of a rank by a tensor, or by a scalar, times the rate of that."""
    if not rate.ufl_shape:
        return derivative * rate
    free, summed = ufl.indices(rank), ufl.indices(len(rate.ufl_shape))
    product = derivative[(*free, *summed)] * rate[summed]
    return ufl.as_tensor(product, free) if rank else product
