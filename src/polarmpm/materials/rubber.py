"""Rubber as a network of chains of limited length: Arruda and Boyce's energy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import ufl

from ..tools.checks import choice, number, put_numbers, require
from .base import Material
from .moduli import check_computed, lame

_SERIES = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)  # of the inverse Langevin function's integral
_CHAINS = ("exact", "series")


@dataclass(frozen=True, repr=False)
class ArrudaBoyce(Material):
    """Eight-chain model of Arruda and Boyce with W_vol = kappa/2 (ln J)^2 and Ī1 = J^(-2/3) tr C.

        exact:   W = C_R N [x b + ln(b / sinh b)] + W_vol,  coth b - 1/b = x = sqrt(Ī1 / 3N)
        series:  W = C_R sum_k c_k N^(1-k) (Ī1^k - 3^k) + W_vol,  k = 1 .. 5

    The exact energy (to 1e-9) becomes infinite where a chain is straight, x = 1; a uniaxial stretch of
    about sqrt(3 N) is the limit. The series knows no limit: its stress is 1 % low at x = .72 and 10 % at .87.

    Args:
        C_R: modulus n k T of the network (Pa), > 0; the shear modulus at rest is a little larger (`moduli`).
        N: rigid links of a chain, > 1, at most 1e6.
        kappa: bulk modulus (Pa), > 0.
        chain: "exact" or "series".

    Raises:
        InputError: a number out of its range.
    """

    C_R: float
    N: float
    kappa: float
    chain: str = "exact"

    micropolar = False
    isotropic = True
    units: ClassVar[Mapping[str, str]] = {"C_R": "Pa", "kappa": "Pa"}

    def __post_init__(self) -> None:
        put_numbers(self, "C_R", "N", "kappa")
        require(self.C_R > 0, "C_R", self.C_R, "C_R > 0")
        require(1 < self.N <= 1e6, "N", self.N, "1 < N <= 1e6")
        require(self.kappa > 0, "kappa", self.kappa, "kappa > 0")
        object.__setattr__(self, "chain", choice("chain", self.chain, _CHAINS))

    @classmethod
    def from_engineering(cls, *, E: float, nu: float, N: float, chain: str = "exact") -> ArrudaBoyce:
        """From Young's modulus (Pa) and Poisson's ratio at rest, and the number of links."""
        lam, mu = lame(E, nu)
        unit = cls(1.0, N, 1.0, chain)
        C_R, kappa = mu / unit.moduli("mu")["mu"], lam + 2 / 3 * mu
        check_computed(f"E = {E:g}, nu = {nu:.17g}, N = {number('N', N):g}", C_R, kappa)
        return cls(C_R, N, kappa, chain)

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, chain = {self.chain!r})"

    def parameters(self) -> dict[str, float]:
        return {"C_R": self.C_R, "N": self.N, "kappa": self.kappa}

    def choices(self) -> dict[str, str | bool]:
        return {"chain": self.chain}

    def moduli(self, *names: str) -> dict[str, float]:
        """Also Lame's constants at rest: lam, mu."""
        if self.chain == "series":
            slope = sum(k * c * (3 / self.N) ** (k - 1) for k, c in enumerate(_SERIES, 1))
        else:
            slope = _inverse_langevin(1 / math.sqrt(self.N)) * math.sqrt(self.N) / 6
        mu = 2 * slope * self.C_R
        known = {**self.parameters(), "lam": self.kappa - 2 / 3 * mu, "mu": mu}
        return {name: known[name] for name in names if name in known}

    def measures(self, F: Any) -> tuple[Any, ...]:
        return self.measures_of(ufl.dot(ufl.transpose(F), F))

    def measures_of(self, C: Any) -> tuple[Any, ...]:
        return ufl.tr(C), ufl.det(C)

    def energy(self, first: Any, third: Any, p: Any) -> Any:
        first = first * third ** (-1 / 3)
        shape = self._by_series(first, p) if self.chain == "series" else self._exact(first, p)
        return p.C_R * p.N * shape + p.kappa / 8 * ufl.ln(third) ** 2

    @staticmethod
    def _by_series(first: Any, p: Any) -> Any:
        """Of one chain, without C_R N."""

        def series(s: Any) -> Any:
            total = 0.0
            for c in reversed(_SERIES):
                total = (total + c) * s
            return total

        return series(first / p.N) - series(3 / p.N)

    @staticmethod
    def _exact(first: Any, p: Any) -> Any:
        return _chain_energy(first / (3 * p.N)) - _chain_energy(1 / p.N)


def _chain_energy(square: Any) -> Any:
    """x b + ln(b / sinh b) of x^2.

    b comes from Kroeger's approximation (relative error 3e-3) and a step of Newton's method (1e-5). The
    energy is stationary in b, so what is left counts with its square, in the stress, too.
    """
    x, left = ufl.sqrt(square), ufl.sqrt(1 - square)  # not a number beyond the limit
    b = x * (3 - square / 5 * (6 + square - 2 * square**2)) / left**2
    e = ufl.exp(-2 * b)
    lost = (1 + e) / (1 - e) - 1 / b - x
    b = b - lost / (1 / b**2 - 4 * e / (1 - e) ** 2)
    return x * b - b + ufl.ln(2 * b / (1 - ufl.exp(-2 * b)))


def _inverse_langevin(x: float) -> float:
    """b with coth b - 1/b = x, for 0 < x < 1."""
    b = x * (3 - x**2) / (1 - x**2)
    for _ in range(50):
        slope = 1 / b**2 - 1 / np.sinh(b) ** 2 if b < 300 else 1 / b**2
        b -= (1 / math.tanh(b) - 1 / b - x) / slope
    return float(b)
