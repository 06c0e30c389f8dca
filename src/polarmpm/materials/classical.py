"""Classical hyperelastic solids, for scenes without microstructure: no rotation unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import ufl

from ..kinematics.spectral import squared_log_strain, strain_invariants, tensor_invariants
from ..tools.checks import put_numbers, require
from .base import Material
from .moduli import check_bulk, lame


@dataclass(frozen=True, repr=False)
class _Classical(Material):
    lam: float
    mu: float

    micropolar = False
    isotropic = True
    units: ClassVar[Mapping[str, str]] = {"lam": "Pa", "mu": "Pa"}

    def __post_init__(self) -> None:
        put_numbers(self, "lam", "mu")
        require(self.mu > 0, "mu", self.mu, "mu > 0")
        check_bulk(self.lam, self.mu)

    @classmethod
    def from_engineering(cls, *, E: float, nu: float) -> Any:
        """From Young's modulus E > 0 (Pa) and Poisson's ratio -1 < nu < 1/2."""
        lam, mu = lame(E, nu)
        return cls(lam=lam, mu=mu)

    def parameters(self) -> dict[str, float]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def measures(self, F: Any) -> tuple[Any, ...]:
        found = self.measures_of(ufl.dot(ufl.transpose(F), F))
        assert found is not None
        return found


@dataclass(frozen=True, repr=False)
class SaintVenantKirchhoff(_Classical):
    """W = lambda/2 (tr E)^2 + mu E : E with Green's strain E = (F^T F - I)/2; lam, mu in Pa.

    For large rotations and moderate strains: it softens under compression, and a bar shortened to 58 % of its
    length has lost its stiffness.
    """

    def measures_of(self, C: Any) -> tuple[Any, ...]:
        return ((C - ufl.Identity(3)) / 2,)

    def energy(self, E: Any, p: Any) -> Any:
        return p.lam / 2 * ufl.tr(E) ** 2 + p.mu * ufl.inner(E, E)


@dataclass(frozen=True, repr=False)
class NeoHookean(_Classical):
    """W = mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2 with C = F^T F; Lame's constants lam, mu in Pa."""

    def measures_of(self, C: Any) -> tuple[Any, ...]:
        return (C,)

    def energy(self, C: Any, p: Any) -> Any:
        log_j = ufl.ln(ufl.det(C)) / 2
        return p.mu / 2 * (ufl.tr(C) - 3 - 2 * log_j) + p.lam / 2 * log_j**2


@dataclass(frozen=True, repr=False)
class Hencky(_Classical):
    """W = mu |ln V|^2 + lambda/2 (ln J)^2 with the logarithmic strain; lam, mu in Pa.

    |ln V|^2 is exact to 4e-11 for principal stretches between 1/10 and 10, see `kinematics.spectral`.
    """

    stress_prediction = False  # invariants are no measures in which it would be linear

    def measures(self, F: Any) -> tuple[Any, ...]:
        return (*strain_invariants(F), ufl.det(F))

    def measures_of(self, C: Any) -> tuple[Any, ...]:
        return (*tensor_invariants(C - ufl.Identity(3)), ufl.sqrt(ufl.det(C)))

    def energy(self, first: Any, square: Any, third: Any, J: Any, p: Any) -> Any:
        return p.mu * squared_log_strain(first, square, third) + p.lam / 2 * ufl.ln(J) ** 2
