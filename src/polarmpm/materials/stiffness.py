"""Stiffness of a material in the undeformed state, for scales."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from ..tools import compat, quiet
from .base import Material, evaluate_energy, evaluate_measures


def stiffness_at_rest(material: Material) -> tuple[float, float]:
    """Second derivatives of the energy by stretch (Pa) and by a wryness (N; the larger of twist and bending),
    zero where there are none. What UFL can't evaluate counts as zero."""
    wrynesses = [(0, 0), (0, 1)] if material.micropolar else []
    bends = [_second_derivative(material, place, wryness=True) for place in wrynesses]
    return _second_derivative(material, (0, 0), wryness=False), max(bends, default=0.0)


def _second_derivative(material: Material, place: tuple[int, int], *, wryness: bool) -> float:
    space = ufl.FunctionSpace(compat.point_domain(), compat.quadrature_element("interval", 1))
    size = ufl.Coefficient(space)
    t = ufl.variable(size[0])
    direction = np.zeros((3, 3))
    direction[place] = 1.0
    strain = t * ufl.as_tensor(direction.tolist())
    zero = 0 * ufl.Identity(3)
    if material.micropolar:
        arguments: Any = (zero, strain) if wryness else (strain, zero)
    else:
        second = ufl.as_tensor(np.zeros((3, 3, 3)).tolist()) if material.second_gradient else None
        arguments = evaluate_measures(material, ufl.Identity(3) + strain, second)
    w = evaluate_energy(material, arguments, SimpleNamespace(**material.parameters()))
    second = ufl.diff(ufl.diff(w, t), t)
    try:
        with quiet.ufl():
            value = apply_derivatives(apply_algebra_lowering(second))((), {size: (0.0,)})
    except Exception:  # UFL evaluates numbers of most of its functions only
        return 0.0
    return abs(float(value)) if np.isfinite(float(value)) else 0.0
