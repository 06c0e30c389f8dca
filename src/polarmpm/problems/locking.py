"""What of the cure of locking a scene needs (docs/theory.md, docs/stability.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..basis.base import Basis
from ..forms.choice import make_form, make_projected
from ..forms.points import PointForm
from ..materials.base import Material
from ..tools import checks

LOCKING = ("auto", "always")
INCOMPRESSIBLE = 0.4  # Poisson's ratio above which volume locks
COUPLED = 10.0  # kappa / mu above which relative rotations lock elastic bodies


def check_locking(locking: Any) -> str | None:
    """The argument of a problem.

    Raises:
        InputError: it is none of these.
    """
    if locking is None or (isinstance(locking, str) and locking in LOCKING):
        return locking
    raise checks.refuse("locking", locking, f"allowed are {', '.join(map(repr, LOCKING))} and None")


def poisson(material: Material) -> float:
    """Poisson's ratio; zero of a material whose moduli aren't known by their names."""
    known = material.moduli("lam", "mu")
    return known["lam"] / (2 * (known["lam"] + known["mu"])) if len(known) == 2 else 0.0


def locks(material: Material) -> bool:
    """Whether it locks on coarse cells: by its volume, by plastic flow, or by its relative rotation."""
    return poisson(material) > INCOMPRESSIBLE or material.plastic or _coupled(material)


def _coupled(material: Material) -> bool:
    known = material.moduli("mu", "kappa")
    return len(known) == 2 and known["kappa"] > COUPLED * known["mu"]


def cured(locking: str | None, material: Material, basis: Basis) -> bool:
    """Whether a material's stiff scalars are projected."""
    if locking is None or not basis.patch or material.second_gradient:
        return False
    return locking == "always" or locks(material)


def choose_form(locking: str | None, material: Material, dim: int, basis: Basis) -> PointForm:
    """The form of a material at points of a basis."""
    if not cured(locking, material, basis):
        return make_form(material, dim)
    mu = material.moduli("mu").get("mu", 0.0)
    stiffness = 0.0 if material.plastic or not np.isfinite(mu) else basis.patch_stiffness * mu
    rotation = material.micropolar and (material.plastic or _coupled(material) or locking == "always")
    return make_projected(material, dim, rotation=rotation, stabilisation=stiffness)
