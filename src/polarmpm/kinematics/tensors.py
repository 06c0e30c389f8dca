"""Kinematics in UFL: deformation gradient, microrotation, Cosserat strain and wryness (T 3.3, 3.4).

All rotations in forms are *increments* Dw since the last reset, so they are moderate, and the functions
of their angle are power series in its square: smooth at zero, and UFL can derive them.
"""

from __future__ import annotations

from math import factorial
from typing import Any

import ufl

_TERMS = 14  # machine precision up to an angle of pi; still 1e-7 at 2 pi


def hat(a: Any) -> Any:
    """Skew tensor of a vector, hat(a) b = a x b."""
    return ufl.as_tensor(((0, -a[2], a[1]), (a[2], 0, -a[0]), (-a[1], a[0], 0)))


def _series(s: Any, shift: int) -> Any:
    """sum_k (-s)^k / (2 k + shift)! in Horner's form."""
    total = ufl.as_ufl(1.0 / factorial(2 * _TERMS + shift))
    for k in range(_TERMS - 1, -1, -1):
        total = 1.0 / factorial(2 * k + shift) - s * total
    return total


def one_minus_cos(s: Any) -> Any:
    """(1 - cos t) / t^2 of s = t^2."""
    return _series(s, 2)


def t_minus_sin(s: Any) -> Any:
    """(t - sin t) / t^3 of s = t^2."""
    return _series(s, 3)


def exp_map(w: Any) -> Any:
    """Rotation tensor exp(hat(w)) of a rotation vector w (three components)."""
    s = ufl.dot(w, w)
    sinc = 1 - s * t_minus_sin(s)
    return (1 - s * one_minus_cos(s)) * ufl.Identity(3) + sinc * hat(w) + one_minus_cos(s) * ufl.outer(w, w)


def right_tangent(w: Any) -> Any:
    """J_r(w): dexp(hat(w)) = exp(hat(w)) hat(J_r(w) dw). See `docs/theory.md`."""
    s = ufl.dot(w, w)
    b, c = one_minus_cos(s), t_minus_sin(s)
    return (1 - s * c) * ufl.Identity(3) - b * hat(w) + c * ufl.outer(w, w)


def left_tangent(w: Any) -> Any:
    """J_l(w) = J_r(-w): the spin of a rotation increment is J_l(Dw) d(Dw)."""
    return right_tangent(-w)


def couple_work(m: Any, w: Any, dw: Any) -> Any:
    """Virtual work m . J_l(w) dw of a couple: it does work on the spin J_l(w) dw, not on dw.

    Vectors of three components, or of one, about the normal of a plane, where the two agree.
    """
    return m[0] * dw[0] if len(m) == 1 else ufl.dot(m, ufl.dot(left_tangent(w), dw))


def cofactor(f: Any) -> Any:
    """cof F of a 2 x 2 or 3 x 3 tensor, without a division: cof F N dA = n da."""
    if f.ufl_shape == (2, 2):
        return ufl.as_tensor([[f[1, 1], -f[1, 0]], [-f[0, 1], f[0, 0]]])
    following = (1, 2, 0)

    def minor(i: int, j: int) -> Any:
        a, b, c, e = following[i], following[following[i]], following[j], following[following[j]]
        return f[a, c] * f[b, e] - f[a, e] * f[b, c]

    return ufl.as_tensor([[minor(i, j) for j in range(3)] for i in range(3)])


def convected(load: Any, normal: Any, f: Any) -> Any:
    """A load per current area that follows the surface, as a load per undeformed area.

    Its part along the normal follows the normal; the part in the surface is convected with it and keeps its
    size. Of a couple about the normal of a plane (one component) only the area changes.

    Args:
        load: measured on the undeformed body; d components, or one.
        normal: unit normal of the undeformed surface (d,).
        f: deformation gradient (d, d).
    """
    area = ufl.dot(cofactor(f), normal)
    if len(load) == 1:
        return load * ufl.sqrt(ufl.dot(area, area))
    along = ufl.dot(load, normal)
    inside = load - along * normal
    turned = ufl.dot(f, inside)
    # size of the part in the surface over its convected length; without that part nothing is divided by 0
    tiny = 1e-60
    stretch = ufl.sqrt((ufl.dot(inside, inside) + tiny) / (ufl.dot(turned, turned) + tiny))
    return along * area + ufl.sqrt(ufl.dot(area, area)) * stretch * turned


def quaternion_tensor(q: Any) -> Any:
    """Rotation tensor of a unit quaternion (scalar first), T (3.168)."""
    v = ufl.as_vector((q[1], q[2], q[3]))
    return (2 * q[0] * q[0] - 1) * ufl.Identity(3) + 2 * ufl.outer(v, v) + 2 * q[0] * hat(v)


def exp_quaternion(w: Any) -> list[Any]:
    """Components of the unit quaternion of a rotation vector w (three components), T (3.170)."""
    s = ufl.dot(w, w) / 4
    half = (1 - s * t_minus_sin(s)) / 2
    return [1 - s * one_minus_cos(s), *(half * w[i] for i in range(3))]


def quaternion_product(a: Any, b: Any) -> list[Any]:
    """Components of the product of two quaternions: first the rotation b, then a. T (3.167)."""
    u, v = (ufl.as_vector(list(q[1:])) for q in (a, b))
    vector = a[0] * v + b[0] * u + ufl.cross(u, v)
    return [a[0] * b[0] - ufl.dot(u, v), *(vector[i] for i in range(3))]


def plane_exp_map(w: Any) -> Any:
    """Rotation tensor of an in-plane rotation by the angle w about the third axis."""
    s = w * w
    cos, sin = 1 - s * one_minus_cos(s), w * (1 - s * t_minus_sin(s))
    return ufl.as_tensor(((cos, -sin, 0), (sin, cos, 0), (0, 0, 1)))


def plane_gradient(g: Any, hoop: Any = 0) -> Any:
    """A 2 x 2 gradient as a 3 x 3 tensor without out-of-plane entries, but the one along the hoop."""
    return ufl.as_tensor(((g[0, 0], g[0, 1], 0), (g[1, 0], g[1, 1], 0), (0, 0, hoop)))


def plane_tensor(f: Any, hoop: Any = 1) -> Any:
    """A 2 x 2 deformation-like tensor in plane strain: unit stretch along the third axis, if not `hoop`."""
    return ufl.as_tensor(((f[0, 0], f[0, 1], 0), (f[1, 0], f[1, 1], 0), (0, 0, hoop)))


def plane_wryness(g: Any, hoop: Any = (0, 0)) -> Any:
    """The two entries of the plane wryness, d(theta)/dX, as the third row of a tensor; `hoop`: what a body of
    revolution has in the third column."""
    return ufl.as_tensor(((0, 0, hoop[0]), (0, 0, hoop[1]), (g[0], g[1], 0)))
