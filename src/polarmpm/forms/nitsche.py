"""The weak form of a consistent support at a point of a surface (Nitsche's method): UFL in, compiled out.

With the gap g = (u, w) - (prescribed increments) and its held part c, the potential per undeformed area is

    -(P N) . c_u - (Q S N) . J_l(w) c_w + 1/2 g . (stiffness) g.

Traction and couple traction are the work that the material's stresses do on the gradients c_u (x) N and
c_w (x) N, so that every energy gives them (docs/theory.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from ..kernels.kernel import matrix
from ..kinematics.layout import STRESSED_SURFACE, Layout
from ..materials.base import Material, parameter_values
from .strains import strains, stresses
from .surfaces import SurfaceForm


class ConsistentForm(SurfaceForm):
    """A support that does the work of the stresses on its gap.

    Data: state of the point (F~, q~, Gamma~); F~^-T N; held part of a gap, b x b; stiffness, b x b; prescribed
    increments b; a given force b; the material's numbers.

    Args:
        material: whose stresses act at the point.
        symmetric: the derivative of the potential. Else the gap does work on the variation of the tractions
            with the opposite sign, which needs no stiffness.
    """

    parts = STRESSED_SURFACE

    def __init__(self, layout: Layout, material: Material, *, symmetric: bool = True):
        self.material, self.symmetric = material, symmetric
        b, d, numbers = layout.block, layout.dim, len(parameter_values(material))
        super().__init__(layout, layout.state().size, d, b * b, b * b, b, b, numbers)

    def virtual_work(self) -> Any:
        held, stiffness, target, force = self.coefficients[2:6]
        b = self.layout.block
        values, varied = self._values(self.y), self._values(self.test)
        gap = [value - target[i] for i, value in enumerate(values)]

        def part(of: list[Any]) -> list[Any]:
            return [sum(held[b * i + j] * of[j] for j in range(b)) for i in range(b)]

        energy = sum(0.5 * gap[i] * stiffness[b * i + j] * gap[j] for i in range(b) for j in range(b))
        energy += sum(force[i] * gap[i] for i in range(b))
        springs = ufl.derivative(energy, self.y, self.test)
        of_gap = ufl.derivative(self._work(part(gap)), self.y, self.test)
        return springs - of_gap if self.symmetric else springs + of_gap - 2 * self._work(part(varied))

    def _work(self, moved: list[Any]) -> Any:
        """Work of traction and couple traction on a displacement and a rotation vector's change."""
        state, normal, numbers = self.coefficients[0], self.coefficients[1], self.coefficients[6]
        direction = [0 * normal[0]] * self.size
        for k, (field, component, axes) in enumerate(self.slots.slots):
            if axes:
                direction[k] = moved[self.slots.rows(field)[component]] * normal[axes[0]]
        measures = strains(self.material, self.layout, self._unknowns(state), state, rotated=False)
        pairs = zip(stresses(self.material, measures, numbers), measures, strict=True)
        along = ufl.as_vector(direction)
        return sum(ufl.inner(s, ufl.derivative(e, self.y, along)) for s, e in pairs)

    def _unknowns(self, state: Any) -> Any:
        """z of a material point: gradients by X."""
        d, point = self.layout.dim, self.layout
        frame = matrix(state, d, d, point.state().at_frame.start)
        gradients = {}
        for field in ("displacement", "rotation"):
            if point.rows(field):
                gradients[field] = ufl.dot(self.slots.derivative(self.y, field), frame)
        value = {s: self.y[k] for k, s in enumerate(self.slots.slots) if not s.axes}
        found = [
            gradients[s.field][s.component, s.axes[0]] if s.axes else value[s] for s in point.slots
        ]
        return ufl.as_vector(found)

    def numbers(self) -> np.ndarray:
        """The material's, as the kernel reads them."""
        return parameter_values(self.material)
