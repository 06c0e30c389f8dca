"""A hyperelastic material in one file."""

# recipe: begin
from dataclasses import asdict, dataclass
from typing import Any

import ufl

import polarmpm as pm
from polarmpm.tools.checks import put_numbers, require


@dataclass(frozen=True)
class MicropolarNeoHookean(pm.Material):
    """W = mu/2 (U : U - 3 - 2 ln J) + lam/2 (ln J)^2 + kappa |skw U|^2 + mu l^2/2 |Gamma|^2
    with U = Q^T F = E + I and J = det U.

    Args:
        lam, mu: Lame's constants (Pa), mu > 0.
        kappa: coupling modulus (Pa), >= 0.
        l: characteristic length (m), > 0.
    """

    lam: float
    mu: float
    kappa: float
    l: float

    micropolar = True
    isotropic = True  # W(R E R^T, R Gamma R^T) = W(E, Gamma): the cheaper frame is allowed

    def __post_init__(self) -> None:
        put_numbers(self, "lam", "mu", "kappa", "l")
        require(self.mu > 0, "mu", self.mu, "mu > 0")
        require(3 * self.lam + 2 * self.mu > 0, "lam", self.lam, f"lam > {-2 * self.mu / 3:g}")
        require(self.kappa >= 0, "kappa", self.kappa, "kappa >= 0")
        require(self.l > 0, "l", self.l, "l > 0")

    def parameters(self) -> dict[str, float]:
        return asdict(self)

    def energy(self, E: Any, Gamma: Any, p: Any) -> Any:
        U = E + ufl.Identity(3)
        log_j, skew = ufl.ln(ufl.det(U)), ufl.skew(U)
        stretching = p.mu / 2 * (ufl.inner(U, U) - 3 - 2 * log_j) + p.lam / 2 * log_j**2
        return stretching + p.kappa * ufl.inner(skew, skew) + p.mu * p.l**2 / 2 * ufl.inner(Gamma, Gamma)


# recipe: end
