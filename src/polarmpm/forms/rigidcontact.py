"""The weak form at a site in contact with a rigid body that moves freely.

The body's unknowns q stand after the site's: how far its centre goes in the step (m), and its turn (rad), one
angle in the plane, a rotation vector in space. Forces are per undeformed area of the site.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels.kernel import Kernel
from ..kinematics import tensors as kin
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
