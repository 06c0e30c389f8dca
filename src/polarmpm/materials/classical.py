"""Classical hyperelastic solids, for scenes without microstructure: no rotation unknowns."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import ufl

from ..kinematics.spectral import squared_log_strain, strain_invariants
from ..tools.checks import require, require_finite
from .base import Material
from .moduli import lame


@dataclass(frozen=True)
class _Classical(Material):
    lam: float
    mu: float

    micropolar = False
    isotropic = True

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            require_finite(name, value)
        require(self.mu > 0, "mu", self.mu, "mu > 0")
        require(
            3 * self.lam + 2 * self.mu > 0,
            "lam",
            self.lam,
            f"3 lam + 2 mu > 0, that is lam > {-2 * self.mu / 3:g}",
        )

    @classmethod
    def from_engineering(cls, *, E: float, nu: float) -> Any:
        """From Young's modulus E > 0 (Pa) and Poisson's ratio -1 < nu < 1/2."""
        lam, mu = lame(E, nu)
        return cls(lam=lam, mu=mu)

    def parameters(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class NeoHookean(_Classical):
    """W = mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2 with C = F^T F; Lame's constants lam, mu in Pa."""

    def measures(self, F: Any) -> tuple[Any, ...]:
        return (ufl.dot(ufl.transpose(F), F),)

    def energy(self, C: Any, p: Any) -> Any:
        log_j = ufl.ln(ufl.det(C)) / 2
        return p.mu / 2 * (ufl.tr(C) - 3 - 2 * log_j) + p.lam / 2 * log_j**2


@dataclass(frozen=True)
class Hencky(_Classical):
    """W = mu |ln V|^2 + lambda/2 (ln J)^2 with the logarithmic strain; lam, mu in Pa.

    |ln V|^2 is exact to 4e-11 for principal stretches between 1/10 and 10, see `kinematics.spectral`.
    """

    stress_prediction = False  # invariants are no measures in which it would be linear

    def measures(self, F: Any) -> tuple[Any, ...]:
        return (*strain_invariants(F), ufl.det(F))

    def energy(self, first: Any, square: Any, third: Any, J: Any, p: Any) -> Any:
        return p.mu * squared_log_strain(first, square, third) + p.lam / 2 * ufl.ln(J) ** 2
