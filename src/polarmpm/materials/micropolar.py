"""Isotropic micropolar elasticity, T 3.3.7."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import ufl

from ..tools.checks import number, put_numbers, require
from .base import Material
from .moduli import check_bulk, check_computed, lame


@dataclass(frozen=True, repr=False)
class MicropolarElastic(Material):
    """Saint Venant-Kirchhoff type isotropic micropolar solid, T (3.122)-(3.125).

    W = 1/2 E : B + 1/2 Gamma : S with

        B = lambda tr(E) I + 2 mu sym E + 2 kappa skw E,
        S = alpha tr(Gamma) I + 2 gamma sym Gamma + 2 beta skw Gamma.

    Args:
        lam, mu: Lame's constants (Pa).
        kappa: coupling modulus (Pa).
        alpha, beta, gamma: couple-stress moduli (N); the wryness counts in 1/m.

    Raises:
        InputError: the energy is not non-negative for every strain and wryness (T 3.3.7):
            mu > 0, 3 lambda + 2 mu > 0, kappa >= 0, gamma >= 0, beta >= 0, 3 alpha + 2 gamma >= 0.
    """

    lam: float
    mu: float
    kappa: float
    alpha: float
    beta: float
    gamma: float

    micropolar = True
    isotropic = True
    units: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("lam", "mu", "kappa"), "Pa"),
        **dict.fromkeys(("alpha", "beta", "gamma"), "N"),
    }

    def __post_init__(self) -> None:
        put_numbers(self, *(f.name for f in fields(self)))
        lam, mu, alpha, gamma = self.lam, self.mu, self.alpha, self.gamma
        require(mu > 0, "mu", mu, "mu > 0")
        check_bulk(lam, mu)
        require(self.kappa >= 0, "kappa", self.kappa, "kappa >= 0")
        require(self.beta >= 0, "beta", self.beta, "beta >= 0")
        require(gamma >= 0, "gamma", gamma, "gamma >= 0")
        slack = 1e-9 * gamma  # bounded stiffness sits on the limit, where rounding must not decide
        allowed = f"3 alpha + 2 gamma >= 0, that is alpha >= -2/3 gamma = {-2 * gamma / 3:g}"
        require(3 * alpha + 2 * gamma >= -slack, "alpha", alpha, allowed)

    @classmethod
    def from_engineering(
        cls, *, E: float, nu: float, n: float, l_b: float, l_t: float, psi: float
    ) -> MicropolarElastic:
        """From engineering constants, T (3.129)-(3.134).

        Args:
            E: Young's modulus (Pa), > 0.
            nu: Poisson's ratio, -1 < nu < 1/2.
            n: coupling number, 0 <= n < 1; kappa = n^2 / (1 - n^2) mu.
            l_b, l_t: characteristic lengths in bending and torsion (m), l_b^2 = (gamma + beta) / (4 mu),
                l_t^2 = gamma / mu; 0 <= l_t <= 2 l_b.
            psi: polar ratio, psi = 2 gamma / (2 gamma + alpha), 0 < psi <= 3/2.
        """
        lam, mu = lame(E, nu)
        n, l_b, l_t, psi = map(number, ("n", "l_b", "l_t", "psi"), (n, l_b, l_t, psi))
        require(0 <= n < 1, "n", n, "0 <= n < 1")
        require(l_b >= 0, "l_b", l_b, "l_b >= 0")
        require(l_t >= 0, "l_t", l_t, "l_t >= 0")
        require(l_t <= 2 * l_b * (1 + 1e-12), "l_t", l_t, f"l_t <= 2 l_b = {2 * l_b:g} (else beta < 0)")
        require(0 < psi <= 1.5 * (1 + 1e-12), "psi", psi, "0 < psi <= 3/2")
        gamma = mu * (l_t * l_t)
        beta = max(0.0, 4 * mu * (l_b * l_b) - gamma)
        alpha, kappa = 2 * gamma * ((1 - psi) / psi), n**2 / (1 - n**2) * mu
        given = f"E = {E:g}, n = {n:.17g}, l_b = {l_b:g}, l_t = {l_t:g}, psi = {psi:g}"
        check_computed(given, alpha, beta, gamma, kappa)
        return cls(lam=lam, mu=mu, kappa=kappa, alpha=alpha, beta=beta, gamma=gamma)

    @classmethod
    def bounded_stiffness(cls, *, lam: float, mu: float, kappa: float, l_b: float) -> MicropolarElastic:
        """Moduli whose torsional stiffness stays bounded for thin bodies: beta = 0,
        gamma = 4 mu l_b^2, alpha = -2/3 gamma (T 3.3.7; lengths in m, moduli in Pa)."""
        mu, l_b = number("mu", mu), number("l_b", l_b)
        require(l_b >= 0, "l_b", l_b, "l_b >= 0")
        require(mu > 0, "mu", mu, "mu > 0")
        gamma = 4 * mu * (l_b * l_b)
        check_computed(f"mu = {mu:g}, l_b = {l_b:g}", gamma)
        return cls(lam=lam, mu=mu, kappa=kappa, alpha=-2 / 3 * gamma, beta=0.0, gamma=gamma)

    @classmethod
    def from_microspace(cls, *, E: float, nu: float, l: float) -> MicropolarElastic:
        """W = psi(E) + l^2/12 psi(Gamma), psi(A) = lam/2 (tr A)^2 + mu A : A for all of A:
        kappa = mu, alpha = l^2 lam / 12, beta = gamma = l^2 mu / 12. See docs/generalised.md.

        Args:
            E: Young's modulus (Pa), > 0.
            nu: Poisson's ratio, -1 < nu < 1/2.
            l: extent of the micro-space (m), >= 0.
        """
        lam, mu = lame(E, nu)
        l = number("l", l)
        require(l >= 0, "l", l, "l >= 0")
        share = l * l / 12
        alpha, gamma = share * lam, share * mu
        check_computed(f"E = {E:g}, nu = {nu:.17g}, l = {l:g}", alpha, gamma)
        return cls(lam=lam, mu=mu, kappa=mu, alpha=alpha, beta=gamma, gamma=gamma)

    def engineering(self) -> dict[str, float]:
        """E, nu, n, l_b, l_t, psi (psi is nan without couple stress)."""
        lam, mu, gamma = self.lam, self.mu, self.gamma
        polar = 2 * gamma + self.alpha
        return {
            "E": mu * (3 * lam + 2 * mu) / (lam + mu),
            "nu": lam / (2 * (lam + mu)),
            "n": math.sqrt(self.kappa / (self.kappa + mu)),
            "l_b": math.sqrt((gamma + self.beta) / (4 * mu)),
            "l_t": math.sqrt(gamma / mu),
            "psi": 2 * gamma / polar if polar > 0 else math.nan,
        }

    def parameters(self) -> dict[str, float]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def energy(self, E: Any, Gamma: Any, p: Any) -> Any:
        def quadratic(a: Any, trace: Any, symmetric: Any, skew: Any) -> Any:
            # 2 s sym + 2 k skw = (s + k) a + (s - k) a^T
            both = (symmetric + skew) * ufl.inner(a, a) + (symmetric - skew) * ufl.inner(a, ufl.transpose(a))
            return 0.5 * (trace * ufl.tr(a) ** 2 + both)

        return quadratic(E, p.lam, p.mu, p.kappa) + quadratic(Gamma, p.alpha, p.gamma, p.beta)
