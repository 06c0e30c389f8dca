"""Boundaries that take waves up instead of throwing them back: dashpots on a surface.

A plane wave that hits the surface at right angles leaves the body without a reflection where the traction is
t = -rho (c_p n n + c_s (I - n n)) v (J. Lysmer, R. L. Kuhlemeyer: Finite dynamic model for infinite media,
J. Eng. Mech. Div. ASCE 95 (1969), 859-877). v is the mean velocity of the step up to the collocated state.
"""

from __future__ import annotations

from typing import Any

import ufl

from ..forms.surfaceenergy import SurfacePoint
from ..geometry.surfaces import Surface
from .surfaceterms import SurfaceTerm

_BEFORE = ("ux", "uy", "uz")


class Absorbing(SurfaceTerm):
    """Dashpots on a surface. At rest, or in a quasi-static problem, they do nothing.

    Args:
        normal, tangential: impedances rho c_p and rho c_s (Pa s/m): traction per velocity across the surface
            and along it.
    """

    external = False
    carried = False
    proportional = False

    def __init__(self, name: str, surface: Surface, normal: float, tangential: float):
        before = dict.fromkeys(_BEFORE[: surface.dim], 0.0)
        super().__init__(name, surface, {"zn": normal, "zt": tangential, "rate": 0.0, **before})

    def energy(self, at: SurfacePoint, p: Any) -> Any:
        """The potential of the tractions, per area."""
        moved = at.u - ufl.as_vector([getattr(p, name) for name in _BEFORE[: self.layout.dim]])
        across = ufl.dot(moved, at.normal)
        return 0.5 * p.rate * ((p.zn - p.zt) * across**2 + p.zt * ufl.dot(moved, moved))

    def begin_step(self, duration: float) -> None:
        self.numbers["rate"] = 1.0 / duration
        self.numbers |= dict(zip(_BEFORE, self.u.T, strict=False))
