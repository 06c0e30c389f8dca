"""Conversions between elastic moduli."""

from __future__ import annotations

from ..tools.checks import require, require_finite


def lame(E: float, nu: float) -> tuple[float, float]:
    """Lame's constants of Young's modulus (Pa) and Poisson's ratio."""
    require_finite("E", E)
    require_finite("nu", nu)
    require(E > 0, "E", E, "E > 0")
    require(-1 < nu < 0.5, "nu", nu, "-1 < nu < 1/2")
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
