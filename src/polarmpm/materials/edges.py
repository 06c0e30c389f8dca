"""Faces and sharp edges of Mohr-Coulomb's pyramid, in principal axes.

Of isotropic classical materials elastic trial state, stress and flow have the same principal axes, which are
known from the trial state. On a face the flow along each axis is a constant; as derivatives of the yield
function by the stress its directions would be lost to rounding near an edge, and its moduli long before. On
an edge two principal stresses are the same, the stress is symmetric about the axis of the third, and what
flows across it is any sum of the two faces' flows (Koiter).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import ufl

from ..kinematics.spectral import squared_log_strain, strain_invariants
from .regions import LocalState, Region, Scales, YieldSurface

# cos(arccos(1 - e)/3) = F(1/3, -1/3; 1/2; e/2), the hypergeometric series; the closed form has no derivative
# at e = 0, where two eigenvalues coincide
_SERIES, _NEAR = 9, 1e-2
_APART = 1.1e-8  # a strain: by more, less what counts as rounding, principal stresses differ
_NO_DISTANCE = 1e-30  # square of a distance of principal values where there is none


def largest_root(x: Any) -> Any:
    """cos(arccos(x)/3) for x from -1 to 1, smooth at 1."""
    half = (1.0 - x) / 2
    term = total = ufl.as_ufl(1.0)
    for k in range(_SERIES):
        term = term * half * ((k + 1 / 3) * (k - 1 / 3) / ((k + 0.5) * (k + 1)))
        total = total + term
    apart = ufl.acos(ufl.max_value(-1.0, ufl.min_value(1.0 - 1e-3 * _NEAR, x)))
    return ufl.conditional(ufl.lt(half, _NEAR / 2), total, ufl.cos(apart / 3))


def _cosine(d: Any) -> tuple[Any, Any]:
    """sqrt(J2/3) of a deviator, and the cosine whose third of the angle tells its largest eigenvalue."""
    second = ufl.inner(d, d) / 2
    return ufl.sqrt(second / 3), math.sqrt(27) / 2 * ufl.det(d) / (second * ufl.sqrt(second))


def principal_values(a: Any) -> tuple[Any, Any, Any]:
    """Eigenvalues of a symmetric tensor, the largest first; no derivatives are asked of them."""
    d = ufl.dev(a)
    size, x = _cosine(d)
    x = ufl.max_value(-1.0, ufl.min_value(1.0, ufl.conditional(ufl.gt(size, 0.0), x, 0.0)))
    high, low = (2 * size * ufl.cos(ufl.acos(y) / 3) for y in (x, -x))
    mean = ufl.tr(a) / 3
    return mean + high, mean + low - high, mean - low


def _certain(trial: Any, sign: Any) -> Any:
    """By how much the largest (sign 1) or smallest eigenvalue of a trial Fe Fe^T differs from the next one,
    less what counts as rounding: with a smaller distance the axis would be any."""
    size, x = _cosine(sign * ufl.dev(trial))
    high = 2 * size * largest_root(ufl.conditional(ufl.gt(size, 0.0), x, 0.0))
    return 1.5 * high - ufl.sqrt(ufl.max_value(0.0, 3 * size**2 - 0.75 * high**2)) - _APART


def axis_projector(a: Any, sign: Any) -> Any:
    """n n of the axis of a symmetric tensor's largest (sign 1) or smallest (-1) eigenvalue, which is to be a
    single one."""
    d = sign * ufl.dev(a)
    size, x = _cosine(d)
    high, second = 2 * size * largest_root(x), 3 * size**2
    above = ufl.dot(d, d) + high * d + (high**2 - second) * ufl.Identity(3)
    return above / (3 * high**2 - second)


class PyramidFace(Region):
    """The faces of the pyramid: three different principal stresses.

    The axis of the principal value that is farther from the middle one is found first, the two others in the
    plane across it: near an edge those, but not the first, are as uncertain as rounding over their distance.

    Args:
        material: Mohr-Coulomb's.
        surface: the pyramid's faces.
    """

    def __init__(self, material: Any, surface: YieldSurface):
        self.material, self.name, self.surfaces = material, surface.name, (surface,)

    @staticmethod
    def _trial(s: LocalState) -> tuple[Any, Any, Any]:
        """Fe Fe^T, whether its largest eigenvalue is the one that is apart, and the sign of that."""
        trial = ufl.dot(s.Fe_trial, ufl.transpose(s.Fe_trial))
        above = ufl.gt(ufl.det(ufl.dev(trial)), 0.0)
        return trial, above, ufl.conditional(above, 1.0, -1.0)

    @staticmethod
    def _axes(s: LocalState) -> tuple[Any, Any, Any]:
        """n n of the largest and of the smallest principal stress, and by how much the two eigenvalues of the
        trial state that are close to each other differ."""
        trial, above, sign = PyramidFace._trial(s)
        first = axis_projector(trial, sign)
        plane = ufl.Identity(3) - first
        across = ufl.dot(plane, ufl.dot(trial, plane))
        across = across - ufl.tr(across) / 2 * plane
        size = ufl.sqrt(ufl.inner(across, across) / 2 + _NO_DISTANCE)
        second = plane / 2 - sign * across / (2 * size)
        high = ufl.as_tensor(
            [[ufl.conditional(above, first[i, j], second[i, j]) for j in range(3)] for i in range(3)]
        )
        return high, first + second - high, 2 * size

    def residual(self, s: LocalState) -> list[Any]:
        """The flow along the axes, and the yield function of the principal stresses."""
        tau, _ = s.kirchhoff()
        high, low, _ = self._axes(s)
        (multiplier,), half = s.multipliers, math.sqrt(3) / 2
        rise, fall = half * (1 + s.p.sin_psi), half * (1 - s.p.sin_psi)
        flow = ufl.Identity(3) + (ufl.exp(-multiplier * rise) - 1) * high
        flow = flow + (ufl.exp(multiplier * fall) - 1) * low
        rows = s.flat(s.Ue - ufl.dot(flow, s.Fe_trial))
        shear = half * (1 + s.p.sin_phi) * ufl.inner(tau, high)
        shear = shear - half * (1 - s.p.sin_phi) * ufl.inner(tau, low)
        return [
            *rows,
            s.chi - s.chi_before - multiplier,
            shear - self.material.cohesion(s.chi, s.p),
        ]

    def row_scale(self, scales: Scales) -> np.ndarray:
        return np.array([1.0] * (scales.deformation + 1) + [1.0 / scales.modulus])

    def flow(self, s: LocalState) -> list[Any]:
        """Dissipation, and the smallest of the multiplier and the distances of the principal stresses."""
        tau, _ = s.kirchhoff()
        (multiplier,), half = s.multipliers, math.sqrt(3) / 2
        *axes, distance = self._axes(s)
        high, low = (ufl.inner(tau, axis) for axis in axes)
        middle = ufl.tr(tau) - high - low
        work = half * multiplier * ((1 + s.p.sin_psi) * high - (1 - s.p.sin_psi) * low)
        apart = ufl.min_value(high - middle, middle - low) / s.p.scale - _APART
        trial, _, sign = self._trial(s)
        certain = ufl.min_value(distance - _APART, _certain(trial, sign))
        return [work - s.hardening_work(), ufl.min_value(multiplier, ufl.min_value(apart, certain))]


class PyramidEdge(Region):
    """An edge of the pyramid: triaxial compression, where the smallest principal stress is the single one
    (tension positive), or extension, where the largest is.

    Args:
        material: Mohr-Coulomb's.
        name: "compression" or "extension".
        surface: the pyramid's faces.
    """

    def __init__(self, material: Any, name: str, surface: YieldSurface):
        self.material, self.name, self.surfaces = material, name, (surface,)
        self.sign = -1 if name == "compression" else 1

    def _shear(self, s: LocalState, tau: Any) -> Any:
        """k: the deviator is sign k (3 n n - I), of which a face's law makes this (Pa)."""
        mean, friction = ufl.tr(tau) / 3, s.p.sin_phi
        strength = self.material.cohesion(s.chi, s.p) / math.sqrt(3)
        return 2 * (strength - mean * friction) / (3 + self.sign * friction)

    def _flow(self, s: LocalState) -> tuple[Any, Any, Any]:
        """n n, and the logarithms of what flows along the axis and in volume."""
        projector = axis_projector(ufl.dot(s.Fe_trial, ufl.transpose(s.Fe_trial)), self.sign)
        return projector, ufl.ln(ufl.inner(projector, s.flow)), ufl.ln(ufl.det(s.flow))

    def residual(self, s: LocalState) -> list[Any]:
        """The stress on the edge, the flow symmetric, and its share along the axis that of the faces."""
        tau, _ = s.kirchhoff()
        projector, along, volume = self._flow(s)
        apart = ufl.dev(ufl.sym(tau))
        apart = apart - self.sign * self._shear(s, tau) * (3 * projector - ufl.Identity(3))
        pairs = ((0, 1), (0, 2), (1, 2)) if s.dim == 3 else ((0, 1),)
        rows = [apart[0, 0], apart[1, 1], *(apart[i, j] for i, j in pairs)]
        rows += [s.flow[i, j] - s.flow[j, i] for i, j in pairs]
        (multiplier,) = s.multipliers
        share = math.sqrt(3) / 2 * (self.sign + s.p.sin_psi)
        rows += [along - share * multiplier, volume - math.sqrt(3) * s.p.sin_psi * multiplier]
        return [*rows, s.chi - s.chi_before - multiplier]

    def row_scale(self, scales: Scales) -> np.ndarray:
        pairs = 3 if scales.dim == 3 else 1
        return np.array([1.0 / scales.modulus] * (2 + pairs) + [1.0] * (pairs + 3))

    def flow(self, s: LocalState) -> list[Any]:
        """Dissipation, and the least of both faces' multipliers and the distance of principal stresses, which
        is negative beyond the tip."""
        tau, _ = s.kirchhoff()
        _, along, volume = self._flow(s)
        shear = self._shear(s, tau)
        work = ufl.tr(tau) / 3 * volume + self.sign * shear * (3 * along - volume)
        across = volume - along  # of both directions across the axis
        square = squared_log_strain(*strain_invariants(s.flow)) - along**2
        apart = ufl.sqrt(ufl.max_value(0.0, square / 2 - across**2 / 4))
        least = -self.sign * across * (0.5 + 1e-6) - apart
        trial = ufl.dot(s.Fe_trial, ufl.transpose(s.Fe_trial))
        apart = ufl.min_value(3 * shear / s.p.scale - _APART, _certain(trial, self.sign))
        return [work - s.hardening_work(), ufl.min_value(least, apart)]
