"""The weak form at a site of one body in contact with another: UFL in, compiled residual and tangent out.

The unknown is y = (r, G): by how much more the site has moved than the place of the other body that it
faces, and the gradient of that body's displacement there. With the other body's normal n, which follows its
surface, and directions t in this, of which the first one is a line of its material, the gap is (x - c) . n
and the site's place on it (x - c) . t. Neither changes when both bodies move as one: so the forces' sum and
moment are zero, to rounding.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels.kernel import Kernel, compile_expressions, matrix
from ..kinematics import tensors as kin
from ..kinematics.layout import Layout, Part
from .contact import capped
from .surfaces import SurfaceForm

CONSTANTS = ("stiffness", "friction", "distance")


class BodyContactForm(SurfaceForm):
    """Normal force from a potential of the gap; friction by return mapping. Forces are per undeformed area.

    Data: place minus the other body's (m) at y = 0; the other body's deformation since increments count, at
    the beginning of the step, inverted, row by row; its normal then, in space also a direction in its
    surface; `CONSTANTS`; multiplier (Pa), elastic slip and x - c at the beginning of the step (m).
    """

    parts = (Part("displacement", 0), Part("displacement", 1))

    def __init__(self, layout: Layout, friction: bool):
        self.friction, self.symmetric, d = friction, not friction, layout.dim
        super().__init__(layout, d, d * d, d if d == 2 else 2 * d, len(CONSTANTS), 1 + 2 * d)

    def _frame(self) -> tuple[Any, Any, list[Any], list[Any]]:
        """x - c (m), the other body's normal, directions in its surface, and those at first."""
        d, (place, before, directions, *_) = self.layout.dim, self.coefficients
        moved = ufl.Identity(d) + self.slots.derivative(self.y, "displacement")
        f = ufl.dot(moved, matrix(before, d, d))
        n = ufl.as_vector([directions[i] for i in range(d)])
        first = ufl.as_vector([-n[1], n[0]] if d == 2 else [directions[d + i] for i in range(d)])
        normal, along = _unit(ufl.dot(kin.cofactor(f), n)), _unit(ufl.dot(f, first))
        now, then = [along], [first]
        if d == 3:
            now, then = [along, ufl.cross(normal, along)], [first, ufl.cross(n, first)]
        apart = ufl.as_vector([place[i] for i in range(d)]) + self._displacement(self.y)
        return apart, normal, now, then

    def _normal(self, gap: Any) -> tuple[Any, Any]:
        """Energy per area (J/m^2) and pressure (Pa) of a gap."""
        constants, multiplier = self.coefficients[3], self.coefficients[4][0]
        k = constants[CONSTANTS.index("stiffness")]
        force = multiplier - k * (gap - constants[CONSTANTS.index("distance")])
        pressure = ufl.conditional(ufl.gt(force, 0.0), force, 0.0)
        return pressure**2 / (2 * k), pressure

    def _resistance(self, pressure: Any) -> tuple[Any, Any]:
        """Traction (Pa) against the slip along the directions in the surface, and places along them."""
        apart, _, now, then = self._frame()
        constants, history = self.coefficients[3:]
        d = self.layout.dim
        k, mu = (constants[CONSTANTS.index(name)] for name in ("stiffness", "friction"))
        before, last = (ufl.as_vector([history[1 + k * d + i] for i in range(d)]) for k in (0, 1))
        places = [ufl.dot(apart, t) for t in now]
        slip = [s + ufl.dot(before - last, t) for s, t in zip(places, then, strict=True)]
        return capped(k * ufl.as_vector(slip), mu * pressure), ufl.as_vector(places)

    def virtual_work(self) -> Any:
        apart, normal, *_ = self._frame()
        energy, pressure = self._normal(ufl.dot(apart, normal))
        work = ufl.derivative(energy, self.y, self.test)
        if self.friction:
            against, places = self._resistance(pressure)
            work += ufl.dot(against, ufl.derivative(places, self.y, self.test))
        return work

    @property
    def told(self) -> dict[str, int]:
        """Names and sizes of what `teller` computes."""
        d = self.layout.dim
        return {"gap": 1, "pressure": 1, "traction": d, "slip": d}

    def teller(self, comm: MPI.Comm) -> Kernel:
        """Kernel (y, data...) -> gap (m), pressure (Pa), traction on the site's body (Pa), and elastic slip
        (m) in space. Collective."""
        apart, normal, now, _ = self._frame()
        gap = ufl.dot(apart, normal)
        _, pressure = self._normal(gap)
        traction, slip = pressure * normal, 0.0 * normal
        if self.friction:
            against, _ = self._resistance(pressure)
            resistance = sum((against[i] * t for i, t in enumerate(now[1:], 1)), against[0] * now[0])
            traction = traction - resistance
            slip = resistance / self.coefficients[3][CONSTANTS.index("stiffness")]
        values = [gap, pressure, traction, slip]
        inputs = self.size + sum(self.data)
        return compile_expressions(values, self._terminals(), inputs, self.space.domain, comm)


def _unit(v: Any) -> Any:
    return v / ufl.sqrt(ufl.dot(v, v))
