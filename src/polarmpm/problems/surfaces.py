"""Tractions, pressures and supports on surfaces that the body carries, as terms of a problem."""

from __future__ import annotations

from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points
from ..conditions.supports import Support, make_support
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout
from ..terms.base import Term
from ..terms.nitsche import ConsistentSupport
from ..terms.surfaces import METHODS, Pressure, SurfaceSupport, Traction
from ..terms.surfaceterms import SurfaceCondition, undeformed_area
from ..tools import checks
from .behind import Found, check_outward, default_stiffness, find_behind, inward, warn_of_resolution
from .state import Progress


class Loaded(Protocol):
    """The problem to which surfaces belong."""

    comm: MPI.Comm
    layout: Layout
    points: Points
    progress: Progress
    knows_undeformed: bool

    @property
    def surfaces(self) -> list[SurfaceCondition]: ...

    def surface_name(self, kind: str) -> str: ...

    @property
    def cell_size(self) -> float: ...

    def add(self, term: Term, *, counts: str | None = None) -> None: ...


def add_traction(
    problem: Loaded,
    surface: Any,
    force: Any,
    couple: Any,
    *,
    follows: bool = False,
    counts: str | None = None,
) -> Traction:
    """See `Conditions.traction`."""
    made = Traction(problem.surface_name("traction"), surface, force, couple, follows=follows)
    problem.add(made, counts=counts)
    return made


def add_load(
    problem: Loaded, surface: Surface, force: Any, couple: Any, counts: str | None = None
) -> Traction:
    """A total, spread evenly over a surface."""
    share = 1.0 / float(undeformed_area(surface, problem.layout).sum())
    made = Traction(problem.surface_name("load"), surface, force, couple, share=share)
    problem.add(made, counts=counts)
    return made


def add_pressure(problem: Loaded, surface: Any, p: Any, counts: str | None = None) -> Pressure:
    """See `Conditions.pressure`."""
    name = problem.surface_name("pressure")
    made = Pressure(name, surface, p)
    check_outward(problem, name, surface)
    problem.add(made, counts=counts)
    return made


def add_support(
    problem: Loaded,
    surface: Surface,
    components: dict[str, Any],
    *,
    method: str | None,
    stiffness: float | None,
    rotation_stiffness: float | None,
    augment: bool,
    normal: Any,
    counts: str | None,
) -> SurfaceSupport:
    """See `Conditions.fix`."""
    name, layout = problem.surface_name("surface support"), problem.layout
    late = problem.progress.step > 0
    if late and counts == "total":
        _check_total(problem, name, components)
    displaced = [c for c in components if not c.startswith("theta")]
    if normal is not None and displaced:
        raise InputError(f"{name}: normal is given together with {', '.join(displaced)}")
    support = None
    if components or normal is None:
        support = make_support(_nowhere, name, components, layout, 0)
    augment = checks.flag(f"{name}: augment", augment)
    if method is not None:
        method = checks.choice(f"{name}: method", method, METHODS)
    given = {"stiffness": stiffness}
    if _turns(support, layout):
        given["rotation_stiffness"] = rotation_stiffness
    least, above = (-np.inf, 0.0) if method in (None, "penalty") else (0.0, -np.inf)
    for key, value in given.items():
        if value is not None:
            given[key] = checks.number(f"{name}: {key}", value, least=least, above=above)
    if surface.dim != layout.dim:
        raise InputError(f"{name}: the surface has {surface.dim} dimensions, the body has {layout.dim}")
    if normal is None:
        surface = _turned_outward(problem, surface)
    else:
        check_outward(problem, name, surface)
    found = find_behind(problem, surface)
    if layout.axial and not found.no_stress:
        found.no_stress = "tractions on a body of revolution aren't known"
    columns = range(layout.dim) if support is None else support.columns
    now = late and not problem.knows_undeformed
    twice = [c.name for c in problem.surfaces if _holds_too(c, surface, columns, now=now)]
    if twice and not found.no_stress:
        found.no_stress = f"{twice[0]} does the work of the tractions there already"
    method = _choose(
        name, method, found, [*(k for k, v in given.items() if v is not None), *["augment"] * augment]
    )
    options: dict[str, Any] = {"support": support, "normal": normal, "augment": augment}
    options |= default_stiffness(problem, surface, name, found, given, method)
    made = SurfaceSupport(name, surface, **options)
    if method != "penalty":
        symmetric = method == "nitsche"
        made = ConsistentSupport(name, surface, behind=found.behind, symmetric=symmetric, **options)
    problem.add(made, counts=counts or ("from now" if late else "total"))
    warn_of_resolution(problem, name, surface)
    return made


def _turned_outward(problem: Loaded, surface: Surface) -> Surface:
    """A surface with normals outward from the body, where only the tractions ask which side that is."""
    turned = inward(problem, surface)
    if not turned.any():
        return surface
    return Surface(surface.x, surface.area, np.where(turned[:, None], -1.0, 1.0) * surface.normal)


def _check_total(problem: Loaded, name: str, components: dict[str, Any]) -> None:
    """Whether values of a support that is added in mid-run can count from the undeformed body."""
    if not problem.knows_undeformed:
        raise InputError(
            f"{name}: counts = 'total': a surface that is added in mid-run is given where it is now; where "
            "it was in the undeformed body isn't known. Add it before the first load step"
        )
    if any(c.startswith("theta") for c in components):
        raise InputError(
            f"{name}: counts = 'total': how far a surface that is added in mid-run has turned isn't known"
        )


def _holds_too(condition: Any, surface: Surface, columns: Any, now: bool) -> bool:
    """Whether a support by tractions holds some of these components of a surface, which is given where it is
    `now`, or in the undeformed body."""
    if not isinstance(condition, ConsistentSupport) or condition.faded:
        return False
    return condition.also_held(surface.x, columns, now=now)


def _choose(name: str, method: str | None, found: Found, given: list[str]) -> str:
    """The method that is meant, `given` what asks for springs."""
    if method is None:
        return "penalty" if given or found.no_stress else "nitsche-unsymmetric"
    if method != "penalty" and "augment" in given:
        raise InputError(
            f"{name}: augment belongs to method='penalty'; method = {method!r} leaves no gap to it"
        )
    if method != "penalty" and found.no_stress:
        raise InputError(
            f"{name}: method = {method!r}: {found.no_stress}; method='penalty' holds it by springs"
        )
    return method


def _turns(support: Support | None, layout: Layout) -> bool:
    """Whether a support prescribes rotations."""
    return support is not None and any(column >= layout.dim for column in support.columns)


def _nowhere(x: np.ndarray) -> np.ndarray:
    return np.zeros(len(x), dtype=bool)
