"""Elastic materials in a body that bears a stress at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl

from .base import Material
from .plastic import Plastic, check_elastic


@dataclass(frozen=True)
class Prestressed(Plastic):
    """An elastic material whose points have been deformed elastically before, F = Fe Fp with an Fp that
    stays: what `problem.initial_stress` makes of elastic materials. It never yields.

    The law is that of the elastic part at Fe, so that stiffness and energy are those of a body that was
    loaded up to this stress: unlike a stress that is added, it can't be in excess of what the law can bear,
    and users' laws and anisotropic ones hold as they are.
    """

    elastic: Material
    yields = False

    def __post_init__(self) -> None:
        check_elastic(self.elastic)

    def __repr__(self) -> str:
        return f"{self.elastic!r}, with an initial stress"

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return ufl.as_ufl(-1.0)
