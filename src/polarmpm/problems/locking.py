"""What of the cure of locking a scene needs (docs/theory.md, docs/stability.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..basis.base import Basis
from ..bodies.elements import Elements
from ..conditions.supports import Support
from ..errors import TrustWarning
from ..forms.choice import make_form, make_projected
from ..forms.points import PointForm
from ..kinematics.layout import Layout
from ..materials.base import Material, warn_of_locking
from ..tools import checks
from ..tools.caller import warn

if TYPE_CHECKING:
    from ..forms.elements import ElementForms


class Patched(Protocol):
    """Functions whose points have patches: a basis, or elements."""

    @property
    def patch(self) -> int: ...

    @property
    def patch_stiffness(self) -> float: ...


LOCKING = ("auto", "always")
_SPLINES_LOCK = 0.495  # Poisson's ratio beyond which functions of higher degree lock on coarse cells, too
INCOMPRESSIBLE = 0.4  # Poisson's ratio above which volume locks
DILATES = 0.05  # angle of dilatancy (rad) from which on limit loads feel it by 2 % and more
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
    return poisson(material) > INCOMPRESSIBLE or material.yields or _coupled(material)


def _coupled(material: Material) -> bool:
    known = material.moduli("mu", "kappa")
    return len(known) == 2 and known["kappa"] > COUPLED * known["mu"]


def cured(locking: str | None, material: Material, basis: Patched) -> bool:
    """Whether a material's stiff scalars are projected."""
    if locking is None or not basis.patch or material.second_gradient:
        return False
    return locking == "always" or locks(material)


def choose_form(
    locking: str | None, material: Material, dim: int, basis: Patched, axial: bool = False
) -> PointForm:
    """The form of a material at points of a basis; `axial`: of a body of revolution."""
    if not cured(locking, material, basis):
        return make_form(material, dim, axial)
    mu = material.moduli("mu").get("mu", 0.0)
    stiffness = 0.0 if material.yields or not np.isfinite(mu) else basis.patch_stiffness * mu
    rotation = material.micropolar and (material.yields or _coupled(material) or locking == "always")
    return make_projected(material, dim, axial, rotation=rotation, stabilisation=stiffness)


@dataclass(frozen=True)
class ElementPatch:
    """Of elements: each is a patch, but simplices of degree 1, which lock whatever their pressure, and those
    of degree 3, which hardly do.

    Increments count from each converged step, where what holds points to their patch would be forgotten:
    there is nothing that does.
    """

    patch: int
    patch_stiffness: float = 0.0

    @classmethod
    def of(cls, elements: Elements) -> ElementPatch:
        simple = elements.degree == 1 and elements.body.cell in ("triangle", "tetrahedron")
        return cls(0 if simple or elements.degree > 2 else 1)


def warn_of_turning(forms: Sequence[PointForm], support: Support, layout: Layout) -> None:
    """Warn of a support that turns microrotations alone, where splines' relative rotations are averaged over
    patches: their functions have modes that decay from the support on and have no mean in any patch, so that
    a length far below a cell hands on too little torque (docs/theory.md). Means over cells are exact there.
    """
    dim, columns = layout.dim, support.columns
    for column, (amplitude, component) in columns.items():
        beside = range(2) if dim == 2 else set(range(3)) - {column - dim}
        if column < dim or all(c in columns for c in beside) or amplitude.is_zero(component):
            continue
        if any(form.turns for form in forms):
            warn(
                f"{support.name}: turns microrotations, but not the displacements beside them, and the cure "
                "of locking averages relative rotations of splines over two cells: where the material's "
                "length is less than a cell, the body may be much too soft; take basis='mpm' or 'gimpm', "
                "whose means over cells are right, or prescribe displacements, too",
                TrustWarning,
            )
        return


def forms_of_elements(locking: str | None, elements: Elements) -> list[PointForm]:
    """The forms of a meshed body's materials."""
    patch = ElementPatch.of(elements)
    axial, materials = elements.points.axisymmetric, elements.points.materials
    return [choose_form(locking, material, elements.dim, patch, axial) for material in materials]


def warn_of_plastic_locking(
    locking: str | None, materials: Sequence[Material], functions: str, remedy: str
) -> None:
    """Warn where "auto" was to cure plastic flow and can't: it keeps the volume, or changes it by a rule, at
    any ratio of Poisson."""
    for material in materials:
        if locking == "auto" and material.yields:
            warn(
                f"{type(material).__name__}: in plastic flow {functions} lock, and have no cure: bearing "
                f"loads are a quarter too large and more, and may rise without a limit; take {remedy}, or "
                "locking=None where this is meant",
                TrustWarning,
            )
            return


def warn_of_dilatancy(forms: Sequence[PointForm], remedy: str) -> None:
    """Warn of micropolar flow that dilates in patches of constants, which share no volumes out there
    (`assembly.elasticvolumes` is for one scalar)."""
    if not any(form.turns and form.material.yields for form in forms):
        return
    from ..materials.cones import DruckerPrager
    from ..materials.pyramids import MohrCoulomb

    for form in forms:
        material = form.material
        if form.turns and isinstance(material, DruckerPrager | MohrCoulomb) and material.psi > DILATES:
            warn(
                f"{type(material).__name__}: micropolar flow that dilates (psi = {material.psi:.3g} rad) "
                "brings a condition for each point, of which means over cells aren't cured: limit loads "
                f"are up to a tenth too high at psi = 0.35 and go on to rise; take {remedy}",
                TrustWarning,
            )
            return


def warn_of_elements(locking: str | None, elements: Elements, forms: ElementForms) -> None:
    """Warn of what locks on a mesh and has no cure. On one rank."""
    simple = elements.body.cell in ("triangle", "tetrahedron")
    if elements.degree == 1:
        warn_of_locking(forms.uncured, "elements of degree 1", "degree 2")
        remedy = "degree=2" if simple else "assembly='native'"
        warn_of_plastic_locking(locking, forms.uncured, "elements of degree 1", remedy)
    if elements.degree == 1 or simple:
        warn_of_dilatancy(forms.point_forms, "quadrilaterals or hexahedra of degree 2")


def warn_of_functions(locking: str | None, left: Sequence[Material], basis: Basis) -> None:
    """Warn of materials that lock with the functions of a basis and have no cure."""
    functions = f"the functions of basis={basis.name!r}"
    if basis.locks:
        warn_of_locking(left, functions, "locking='auto' with assembly='direct', or basis='bspline'")
        warn_of_plastic_locking(locking, left, functions, "assembly='direct'")
    else:
        few = "displacements are 2 to 6 % too small with 32 and 16 cells across a body that bends"
        remedy = "locking='auto' with basis='bspline', or smaller cells"
        warn_of_locking(left, functions, remedy, beyond=_SPLINES_LOCK, how=few)
