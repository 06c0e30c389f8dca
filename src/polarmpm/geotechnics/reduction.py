"""Materials whose strength is divided by a factor."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from ..errors import InputError
from ..materials.cones import DruckerPrager, VonMises
from ..materials.pyramids import MohrCoulomb
from ..tools import checks


def reduced(material: Any, factor: float) -> Any:
    """A material whose strength is divided by a factor: c and tan(phi), tan(psi) alike, and what hardens.

    The cohesion c (or k) with its hardening H, a tension cut-off and the tangents of both angles are divided;
    the elastic part and lengths stay. An elastic material is returned as it is.

    Args:
        material: `MohrCoulomb`, `Tresca`, `DruckerPrager`, `VonMises`, or an elastic one.
        factor: > 0; below 1 it makes the material stronger.

    Raises:
        InputError: a material with a strength of another kind.
    """
    factor = checks.number("factor", factor, above=0.0)
    if isinstance(material, VonMises):
        return replace(material, k=material.k / factor, H=material.H / factor)
    if isinstance(material, MohrCoulomb):
        cut = None if material.cut is None else material.cut / factor
        return replace(
            material,
            c=material.c / factor,
            H=material.H / factor,
            cut=cut,
            tip=material.tip / factor,
            **_angles(material, factor),
        )
    if isinstance(material, DruckerPrager):
        return _reduced_cone(material, factor)
    if getattr(material, "plastic", True):
        allowed = "MohrCoulomb, Tresca, DruckerPrager or VonMises; of others, reduce the strength yourself"
        raise InputError(f"material = {checks.shown(material)}: {allowed}")
    return material


def _angles(material: Any, factor: float) -> dict[str, Any]:
    return {name: math.atan(math.tan(getattr(material, name)) / factor) for name in ("phi", "psi")}


def _reduced_cone(material: DruckerPrager, factor: float) -> DruckerPrager:
    """The cone of the pyramid whose c and tan(phi) are divided, its hardening included."""
    angles = _angles(material, factor)
    changed = replace(material, **angles)
    # k and H belong to cohesions k / (k of a cohesion of one)
    unit = replace(material, c=1.0, k=None).strength, replace(changed, c=1.0, k=None).strength
    share = unit[1] / unit[0] / factor
    strength: dict[str, Any] = {} if material.k is None else {"k": material.k * share}
    if material.c is not None:
        strength["c"] = material.c / factor
    return replace(changed, **strength, H=material.H * share, tip=material.tip * share)
