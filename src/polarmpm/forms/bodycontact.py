"""The weak form at a site of one body in contact with another: UFL in, compiled residual and tangent out.

The unknown is y = (r, G): by how much more the site has moved than the place of the other body that it faces,
and the gradient of that body's displacement there. Places are seen in the other body's frame, xi = R^T (x - c),
whose turn R since the beginning of the step is that of its material (to the second order of the step's
strains). Gap and slip don't change when both bodies move as one, whatever they do: so the forces' sum and
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
    the beginning of the step, inverted, row by row; its normal then; `CONSTANTS`; multiplier (Pa), elastic
    slip and xi at the end of the last step (m).
    """

    parts = (Part("displacement", 0), Part("displacement", 1))

    def __init__(self, layout: Layout, friction: bool):
        self.friction, self.symmetric, d = friction, not friction, layout.dim
        super().__init__(layout, d, d * d, d, len(CONSTANTS), 1 + 2 * d)

    def _frame(self) -> tuple[Any, Any, Any]:
        """Gap (m), outward normal of the other body, and its turn since the beginning of the step."""
        d, (place, before, normal, *_) = self.layout.dim, self.coefficients
        moved = ufl.Identity(d) + self.slots.derivative(self.y, "displacement")
        f = ufl.dot(moved, matrix(before, d, d))
        cofactor = kin.cofactor(f)
        outward = ufl.dot(cofactor, ufl.as_vector([normal[i] for i in range(d)]))
        outward = outward / ufl.sqrt(ufl.dot(outward, outward))
        turn = 0.5 * (f + cofactor / ufl.det(f))  # a step of Newton's towards the polar rotation
        apart = ufl.as_vector([place[i] for i in range(d)]) + self._displacement(self.y)
        return ufl.dot(apart, outward), outward, (turn, ufl.dot(turn.T, apart))

    def _normal(self, gap: Any) -> tuple[Any, Any]:
        """Energy per area (J/m^2) and pressure (Pa) of a gap."""
        constants, multiplier = self.coefficients[3], self.coefficients[4][0]
        k = constants[CONSTANTS.index("stiffness")]
        force = multiplier - k * (gap - constants[CONSTANTS.index("distance")])
        pressure = ufl.conditional(ufl.gt(force, 0.0), force, 0.0)
        return pressure**2 / (2 * k), pressure

    def _resistance(self, pressure: Any, xi: Any) -> Any:
        """Traction (Pa) against the slip, in the other body's frame."""
        normal, constants, history = self.coefficients[2:]
        d = self.layout.dim
        k, mu = (constants[CONSTANTS.index(name)] for name in ("stiffness", "friction"))
        before, last = (ufl.as_vector([history[1 + k * d + i] for i in range(d)]) for k in (0, 1))
        n = ufl.as_vector([normal[i] for i in range(d)])
        slip = before + xi - last
        return capped(k * (slip - ufl.dot(slip, n) * n), mu * pressure)

    def virtual_work(self) -> Any:
        gap, _, (_, xi) = self._frame()
        energy, pressure = self._normal(gap)
        work = ufl.derivative(energy, self.y, self.test)
        if self.friction:
            work += ufl.dot(self._resistance(pressure, xi), ufl.derivative(xi, self.y, self.test))
        return work

    @property
    def told(self) -> dict[str, int]:
        """Names and sizes of what `teller` computes."""
        d = self.layout.dim
        return {"gap": 1, "pressure": 1, "traction": d, "slip": d}

    def teller(self, comm: MPI.Comm) -> Kernel:
        """Kernel (y, data...) -> gap (m), pressure (Pa), traction on the site's body (Pa), and elastic slip
        (m) in space. Collective."""
        gap, outward, (turn, xi) = self._frame()
        _, pressure = self._normal(gap)
        traction, slip = pressure * outward, 0.0 * outward
        if self.friction:
            resistance = ufl.dot(turn, self._resistance(pressure, xi))
            traction = traction - resistance
            slip = resistance / self.coefficients[3][CONSTANTS.index("stiffness")]
        values = [gap, pressure, traction, slip]
        inputs = self.size + sum(self.data)
        return compile_expressions(values, self._terminals(), inputs, self.space.domain, comm)
