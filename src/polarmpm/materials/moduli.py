"""Conversions between elastic moduli."""

from __future__ import annotations

import math

from ..errors import InputError
from ..tools.checks import number, require


def lame(E: float, nu: float) -> tuple[float, float]:
    """Lame's constants of Young's modulus (Pa) and Poisson's ratio."""
    E, nu = number("E", E), number("nu", nu)
    require(E > 0, "E", E, "E > 0")
    require(-1 < nu < 0.5, "nu", nu, "-1 < nu < 1/2")
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    check_computed(f"E = {E:g}, nu = {nu:.17g}", lam, mu)
    require(3 * lam + 2 * mu > 0, "nu", nu, f"lam = {lam:g} and mu = {mu:g} follow, but 3 lam + 2 mu > 0")
    return lam, mu


def check_bulk(lam: float, mu: float) -> None:
    """Raise InputError unless Lame's constants resist a change of volume."""
    allowed = f"with mu = {mu:g}, 3 lam + 2 mu > 0, that is lam > {-2 * mu / 3:g}"
    require(3 * lam + 2 * mu > 0, "lam", lam, allowed)


def check_computed(given: str, *moduli: float) -> None:
    """Raise InputError where moduli that follow from others aren't finite numbers."""
    if not all(math.isfinite(m) for m in moduli):
        raise InputError(f"{given}: out of range, the moduli that follow are {moduli}")
