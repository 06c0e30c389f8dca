"""A Saint-Venant-Kirchhoff solid with second gradients, W = psi(E) + sum l_a^2 / 12 psi(E,a)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import ufl

import polarmpm as pm


def _energy(F: Any, H: Any, p: Any) -> Any:
    def psi(a: Any) -> Any:
        return 0.5 * p.lam * ufl.tr(a) ** 2 + p.mu * ufl.inner(a, a)

    w = psi(0.5 * (ufl.dot(F.T, F) - ufl.Identity(3)))
    i, j = ufl.indices(2)
    for a, length in enumerate((p.l1, p.l2, p.l3)):
        along = ufl.as_tensor(H[i, j, a], (i, j))
        w += length**2 / 12 * psi(ufl.sym(ufl.dot(F.T, along)))
    return w


def gradient_solid(E: float, nu: float, lengths: Sequence[float]) -> pm.UserEnergy:
    """Of Young's modulus E (Pa), Poisson's ratio nu, and lengths (m) of the directions of space."""
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    named = dict(zip(("l1", "l2", "l3"), (*lengths, 0.0, 0.0), strict=False))
    numbers = {"lam": lam, "mu": mu, **named}
    return pm.UserEnergy(_energy, numbers, micropolar=False, second_gradient=True)
