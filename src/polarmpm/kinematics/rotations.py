"""Tensors, unit quaternions and rotation vectors of many points at once (NumPy).

Shapes: quaternion (n, 4) with the scalar first, rotation vector (n, 3) in radians, tensor (n, 3, 3).
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def identity(n: int) -> Array:
    """Quaternions of no rotation, T (3.169)."""
    q = np.zeros((n, 4))
    q[:, 0] = 1.0
    return q


def normalise(q: Array) -> Array:
    """Unit quaternions; products of many would otherwise drift off the sphere."""
    unit: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
    return unit


def multiply(a: Array, b: Array) -> Array:
    """Quaternion product: first the rotation b, then a. T (3.167)."""
    a0, av, b0, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    scalar = a0 * b0 - np.sum(av * bv, axis=1, keepdims=True)
    return np.concatenate([scalar, a0 * bv + b0 * av + np.cross(av, bv)], axis=1)


def conjugate(q: Array) -> Array:
    """The inverse rotation of unit quaternions."""
    inverse: Array = q * np.array([1.0, -1.0, -1.0, -1.0])
    return inverse


def from_vector(w: Array) -> Array:
    """Quaternion of a rotation vector, T (3.170)."""
    half = 0.5 * np.linalg.norm(w, axis=1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * w], axis=1)


def turned(q: Array, w: Array) -> Array:
    """Unit quaternions exp(w) q of rotation vectors (n, 3), (n, 1) in the plane, or (n, 0) of no rotation."""
    return normalise(multiply(from_vector(in_space(w)), q)) if w.shape[1] else q


def to_vector(q: Array) -> Array:
    """Rotation vector of a quaternion, T (3.171), with an angle between 0 and 2 pi; for output only.

    q and -q turn a point alike, but a point's q is continuous in time, so the angle passes pi smoothly; it
    wraps at 2 pi.
    """
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    half = np.arctan2(sine, q[:, :1])
    small = sine < 1e-12
    # near half = 0 the axis times the angle is 2 qv; near half = pi the axis is undefined
    factor = np.where(small, 2.0, 2.0 * half / np.where(small, 1.0, sine))
    vector: Array = factor * q[:, 1:]
    return vector


def to_tensor(q: Array) -> Array:
    """Rotation tensor of a quaternion, T (3.168)."""
    s, v = q[:, 0], q[:, 1:]
    t: Array = 2.0 * v[:, :, None] * v[:, None, :] + 2.0 * s[:, None, None] * hat(v)
    t[:, range(3), range(3)] += (2.0 * s**2 - 1.0)[:, None]
    return t


def hat(w: Array) -> Array:
    """Skew tensors, hat(w) v = w x v."""
    t = np.zeros((len(w), 3, 3))
    t[:, 0, 1], t[:, 0, 2], t[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
    t[:, 1, 0], t[:, 2, 0], t[:, 2, 1] = w[:, 2], -w[:, 1], w[:, 0]
    return t


def couples_on_spins(w: Array, couples: Array) -> Array:
    """Couples (n, 3) that do work on spins, of those m that do it on increments of the rotation vectors
    w (n, 3): J_r(w)^-1 m."""
    turned: Array = np.linalg.solve(right_tangent(w), couples[:, :, None])[:, :, 0]
    return turned


def right_tangent(w: Array) -> Array:
    """J_r(w) = I - (1 - cos t)/t^2 hat(w) + (t - sin t)/t^3 hat(w)^2, t = |w|."""
    t = np.linalg.norm(w, axis=1)
    b = 0.5 * np.sinc(t / (2.0 * np.pi)) ** 2  # (1 - cos t)/t^2 = 2 sin^2(t/2)/t^2
    large = np.where(t < 0.05, 1.0, t)
    c = np.where(
        t < 0.05, 1.0 / 6.0 - t**2 / 120.0 + t**4 / 5040.0 - t**6 / 362880.0, (t - np.sin(t)) / large**3
    )
    h = hat(w)
    tangent: Array = np.eye(3) - b[:, None, None] * h + c[:, None, None] * (h @ h)
    return tangent


def relative_vector(w_to: Array, w_from: Array) -> Array:
    """Shortest rotation vector that leads from exp(w_from) to exp(w_to)."""
    q = multiply(from_vector(w_to), conjugate(from_vector(w_from)))
    return to_vector(np.where(q[:, :1] < 0, -q, q))


def in_space(w: Array) -> Array:
    """Rotation vectors (n, 3) of rotations (n, 1) in the plane; vectors of three components stay."""
    return np.pad(w, ((0, 0), (2, 0))) if w.shape[1] == 1 else w


def determinant(a: Array) -> Array:
    """Determinants (n,) of tensors (n, 2, 2) or (n, 3, 3); LAPACK takes ten times as long for small ones."""
    if a.shape[1] == 2:
        plane: Array = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
        return plane
    (x, y, z), (u, v, w) = (a[:, i].T for i in (1, 2))
    triple: Array = a[:, 0, 0] * (y * w - z * v) - a[:, 0, 1] * (x * w - z * u) + a[:, 0, 2] * (x * v - y * u)
    return triple
