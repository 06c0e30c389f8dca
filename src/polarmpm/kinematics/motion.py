"""How increments move the state of a point on, T 3.4.5, in UFL and compiled.

F = (I + du/dx~) F~, Q = exp(hat(Dw)) Q~ as unit quaternions, Gamma = Gamma~ + Q~^T J_r(Dw) dw/dx~ F~.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions, matrix
from ..tools import compat
from . import measures as kin
from .layout import Layout


class Motion:
    """Compiled update of points of a layout. Collective."""

    def __init__(self, layout: Layout, comm: MPI.Comm):
        self.layout = layout
        space = PointSpace(compat.point_domain())
        size = 22 if layout.rotations else 9
        self._state, self._z = space.coefficient(size), space.coefficient(layout.unknowns)
        terminals = {self._state: 0, self._z: size}
        inputs = size + layout.unknowns
        self._kernel: Kernel = compile_expressions(self._expressions(), terminals, inputs, space.domain, comm)

    def _expressions(self) -> list[Any]:
        d, r, s, z = self.layout.dim, self.layout.rotations, self._state, self._z
        F, gradient = matrix(s, 3, 3), matrix(z, d, d)
        if d == 2:
            gradient = kin.plane_gradient(gradient)
        moved = ufl.dot(ufl.Identity(3) + gradient, F)
        if r == 0:
            return [moved]
        q, wryness = [s[9 + i] for i in range(4)], matrix(s, 3, 3, 13)
        if d == 2:
            w, turning = ufl.as_vector([0, 0, z[4]]), kin.plane_wryness([z[5], z[6]])
        else:
            w, turning = ufl.as_vector([z[9 + i] for i in range(3)]), matrix(z, 3, 3, 12)
        turned = kin.quaternion_product(kin.exp_quaternion(w), q)
        length = ufl.sqrt(sum(c * c for c in turned))
        back = ufl.transpose(kin.quaternion_tensor(q))
        change = ufl.dot(back, ufl.dot(kin.right_tangent(w), ufl.dot(turning, F)))
        return [moved, ufl.as_vector([c / length for c in turned]), wryness + change]

    def __call__(self, state: tuple[np.ndarray, ...], z: np.ndarray) -> tuple[np.ndarray, ...]:
        """States (F, q, Gamma), of classical materials (F,), moved on by z = (du/dx~, w, dw/dx~) (n, nz)."""
        out, n = self._kernel(*state, z), len(z)
        F = out[:, :9].reshape(n, 3, 3)
        if not self.layout.rotations:
            return (F,)
        return F, out[:, 9:13].copy(), out[:, 13:].reshape(n, 3, 3)
