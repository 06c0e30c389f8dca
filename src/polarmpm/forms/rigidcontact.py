"""The weak form at a site in contact with a rigid body that moves freely, and the momentum of its turn.

The body's unknowns q stand after the site's: how far its centre goes in the step (m), and its turn (rad), one
angle in the plane, a rotation vector in space. Forces are per undeformed area of the site.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions, matrix
from ..kinematics import tensors as kin
from ..tools import compat
from .contact import ContactForm


def motions(dim: int) -> int:
    """How many unknowns a rigid body has."""
    return 3 if dim == 2 else 6


class RigidContactForm(ContactForm):
    """Forces on the site, and what they are as a force and a moment about the body's centre on this.

    Data as of `ContactForm`; the pose is that at the beginning of the step, and its turn zero. The last
    residuals do work on what the centre moves, and on the spin.
    """

    def further(self) -> int:
        return motions(self.layout.dim)

    def compile(self, comm: MPI.Comm) -> Kernel:
        self.symmetric = False  # as to the code: what turns has no potential in its rotation vector
        return super().compile(comm)

    def _of_body(self, y: Any) -> tuple[Any, Any]:
        """What the centre moves, and the turn, of unknowns."""
        d, first = self.layout.dim, self.slots.unknowns
        parts = [y[first + i] for i in range(motions(d))]
        return ufl.as_vector(parts[:d]), ufl.as_vector(parts[d:])

    def _pose(self) -> tuple[Any, Any, Any, Any]:
        centre, about, turn, t = super()._pose()
        moved, w = self._of_body(self.y)
        if len(w) == 1:
            c, s = ufl.cos(w[0]), ufl.sin(w[0])
            return centre + moved, about, ufl.dot(ufl.as_tensor([[c, -s], [s, c]]), turn), t
        return centre + moved, about, ufl.dot(kin.exp_map(w), turn), t

    def _turned(self) -> Any:
        return self._of_body(self.y)[1]

    def virtual_work(self) -> Any:
        d, place = self.layout.dim, self.coefficients[0]
        gap, normal, xi, turn = self._gap()
        _, pressure = self._normal(gap)
        centre = self._pose()[0]
        arm = ufl.as_vector([place[i] for i in range(d)]) + self._displacement(self.y) - centre
        moved, spin = self._of_body(self.test)
        carried = ufl.cross(spin, arm) if d == 3 else spin[0] * ufl.as_vector([-arm[1], arm[0]])
        along = ufl.dot(turn.T, self._displacement(self.test) - moved - carried)
        traction = -pressure * ufl.diff(gap, xi)
        if self.law.friction:
            traction = traction + self._friction(pressure, normal, xi)
        work = ufl.dot(traction, along)
        if self.law.turning:
            couple = self._couple(pressure, ufl.dot(turn, normal))
            work += kin.couple_work(couple, self._rotation(self.y), self._rotation(self.test))
            work -= ufl.dot(couple, spin)
        return work


def turning_momentum(w: Any, inertia: Any) -> Any:
    """What the spin's momentum s adds up to in a step in which a rigid body turns by w: the integral of s.

    inertia: tensor J (kg m^2) at the beginning of the step, in space. With s = P / dt the step is the
    implicit midpoint rule for the momentum in the body's frame, S' = S x J^-1 S, whose invariants, |S| and
    the energy, are quadratic and kept; the rotation that belongs to it, by Cayley's map, keeps s itself.
    """
    s = ufl.dot(w, w)
    half = kin.one_minus_cos(s)
    a = 2.0 * half / (1.0 - s * kin.t_minus_sin(s)) * w  # 2 tan(t/2) along the axis
    turned = ufl.dot(inertia, a)
    return turned + 0.5 * ufl.cross(a, turned)


def momentum_kernel(comm: MPI.Comm) -> Kernel:
    """Kernel (w, J row by row) -> `turning_momentum` (3) and its derivative (3 x 3). Collective."""
    space = PointSpace(compat.point_domain())
    w, inertia = space.coefficient(3), space.coefficient(9)
    at = ufl.variable(ufl.as_vector([w[i] for i in range(3)]))
    momentum = turning_momentum(at, matrix(inertia, 3, 3))
    values = [momentum, ufl.diff(momentum, at)]
    return compile_expressions(values, {w: 0, inertia: 3}, 12, space.domain, comm)
