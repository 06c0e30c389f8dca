"""Inertia of what turns in space and isn't alike in all directions: rigid bodies, and microrotations."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import ufl

from ..kernels.kernel import Kernel, PointSpace, compile_expressions, matrix
from ..kinematics import tensors as kin
from ..tools import compat


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

    def values() -> list[Any]:
        at = ufl.variable(ufl.as_vector([w[i] for i in range(3)]))
        momentum = turning_momentum(at, matrix(inertia, 3, 3))
        return [momentum, ufl.diff(momentum, at)]

    return compile_expressions(values, {w: 0, inertia: 3}, 12, space.domain, comm, of="momentum")


def gyration_kernel(comm: MPI.Comm) -> Kernel:
    """Kernel (w, J row by row, c, theta) -> what the inertia of a turn w does on the increments of w (3), and
    its derivative (3 x 3): J_l(w)^T c theta P(w / theta), as couples do work on spins. Collective."""
    space = PointSpace(compat.point_domain())
    sizes = 3, 9, 2
    w, inertia, numbers = (space.coefficient(n) for n in sizes)

    def values() -> list[Any]:
        at = ufl.variable(ufl.as_vector([w[i] for i in range(3)]))
        scale, theta = numbers[0], numbers[1]
        couple = scale * theta * turning_momentum(at / theta, matrix(inertia, 3, 3))
        work = ufl.dot(kin.left_tangent(at).T, couple)
        return [work, ufl.diff(work, at)]

    slots = {w: 0, inertia: 3, numbers: 12}
    return compile_expressions(values, slots, 14, space.domain, comm, of="gyration")
