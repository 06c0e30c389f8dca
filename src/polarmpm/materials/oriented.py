"""Micropolar elasticity of an oriented micro-space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import ufl

from ..tools import checks
from ..tools.checks import put_numbers, require
from .base import Material, numbers
from .microspace import MicroSpace
from .moduli import check_bulk, lame


@dataclass(frozen=True, repr=False)
class OrientedMicropolar(Material):
    """The mean of psi(E + sum_a z_a K_a) over a micro-space of rigid fibres.

    psi(A) = lam/2 (tr A)^2 + mu A : A. The fibres lie along the directors d_a, |z_a| <= l_a / 2, and turn
    with the microrotation: K_a v = (Gamma v) x d_a. In components of the directors

        W = psi(E) + sum_a l_a^2/24 [lam (Gamma_cb - Gamma_bc)^2 + 2 mu (Gamma : Gamma - Gamma_aj Gamma_aj)],

    (a, b, c) cyclic: a fibre doesn't feel a spin about itself. With equal lengths it is
    `MicropolarElastic` with kappa = mu, alpha = 0, gamma = l^2 mu / 6, beta = l^2 (lam + 2 mu) / 12, which
    has no preferred directions.

    Args:
        lam, mu: Lame's constants (Pa), mu > 0, 3 lam + 2 mu > 0.
        lengths: of the fibres (m), not negative: one for each of three directors, or one number for all. With
            a single one above zero nothing holds the rotation about that fibre but the strain.
        directors: three orthonormal vectors, one a row; the coordinate axes by default. In plane problems
            one is along the third axis.

    Raises:
        InputError: a number out of its range, lengths or directors that are none.
    """

    lam: float
    mu: float
    lengths: float | Sequence[float]
    directors: Any = None

    micropolar = True
    isotropic = False
    units: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("lam", "mu"), "Pa"),
        **dict.fromkeys(("l_1", "l_2", "l_3"), "m"),
    }

    def __post_init__(self) -> None:
        put_numbers(self, "lam", "mu")
        require(self.mu > 0, "mu", self.mu, "mu > 0")
        check_bulk(self.lam, self.mu)
        space = MicroSpace.of(self.lengths, self.directors, count=3)
        if not space.orthonormal:
            allowed = "three vectors at right angles are needed, one a row"
            raise checks.refuse("directors", self.directors, allowed)
        object.__setattr__(self, "lengths", space.lengths)
        object.__setattr__(self, "directors", space.directors)

    @classmethod
    def from_engineering(
        cls, *, E: float, nu: float, lengths: float | Sequence[float], directors: Any = None
    ) -> OrientedMicropolar:
        """From Young's modulus E > 0 (Pa) and Poisson's ratio -1 < nu < 1/2."""
        lam, mu = lame(E, nu)
        return cls(lam, mu, lengths, directors)

    def __repr__(self) -> str:
        along = ", ".join(f"({', '.join(f'{c:.6g}' for c in d)})" for d in self.directors)
        return f"OrientedMicropolar({numbers(self.parameters(), self.units)}, along {along})"

    def parameters(self) -> dict[str, float]:
        """lam, mu, and the lengths l_1, l_2, l_3 of the directors."""
        named = {f"l_{a}": length for a, length in enumerate(self._space.lengths, 1)}
        return {"lam": self.lam, "mu": self.mu, **named}

    def choices(self) -> dict[str, str | bool]:
        return self._space.described()

    def check_dimension(self, dim: int) -> None:
        self._space.check_dimension(dim)

    @property
    def _space(self) -> MicroSpace:
        return MicroSpace(self.lengths, self.directors)  # type: ignore[arg-type]

    def energy(self, E: Any, Gamma: Any, p: Any) -> Any:
        total = p.lam / 2 * ufl.tr(E) ** 2 + p.mu * ufl.inner(E, E)
        rows = np.array(self.directors)
        if np.linalg.det(rows) < 0:  # a fibre has no sense of direction
            rows = -rows
        d = ufl.as_matrix(rows.tolist())
        g = ufl.dot(d, ufl.dot(Gamma, ufl.transpose(d)))
        whole = ufl.inner(Gamma, Gamma)
        for a, length in enumerate((p.l_1, p.l_2, p.l_3)):
            b, c = (a + 1) % 3, (a + 2) % 3
            spin = sum(g[a, j] ** 2 for j in range(3))
            total += length**2 / 24 * (p.lam * (g[c, b] - g[b, c]) ** 2 + 2 * p.mu * (whole - spin))
        return total
