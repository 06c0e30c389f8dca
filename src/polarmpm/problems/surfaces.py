"""Tractions, pressures and supports on surfaces that the body carries, as terms of a problem."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ..bodies.points import Points
from ..conditions.supports import Support, make_support
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout
from ..materials.base import Material
from ..terms.base import Term
from ..terms.surfaces import Pressure, SurfaceSupport, Traction
from ..tools import checks
from .state import Progress

_PENALTY = 1e3  # default springs: a layer of a thousandth of a cell, of the body's stiffness


class Loaded(Protocol):
    """The problem to which surfaces belong."""

    layout: Layout
    points: Points
    progress: Progress
    knows_undeformed: bool

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
    share = 1.0 / float(surface.area.sum())
    made = Traction(problem.surface_name("load"), surface, force, couple, share=share)
    problem.add(made, counts=counts)
    return made


def add_pressure(problem: Loaded, surface: Any, p: Any, counts: str | None = None) -> Pressure:
    """See `Conditions.pressure`."""
    made = Pressure(problem.surface_name("pressure"), surface, p)
    problem.add(made, counts=counts)
    return made


def add_support(
    problem: Loaded,
    surface: Surface,
    components: dict[str, Any],
    *,
    stiffness: float | None,
    rotation_stiffness: float | None,
    augment: bool,
    normal: Any,
    counts: str | None,
) -> SurfaceSupport:
    """See `Conditions.fix`."""
    name, layout = problem.surface_name("surface support"), problem.layout
    late = problem.progress.step > 0
    if late and counts == "total" and not problem.knows_undeformed:
        raise InputError(
            f"{name}: counts = 'total': a surface that is added in mid-run is given where it is now; where "
            "it was in the undeformed body isn't known. Add it before the first load step"
        )
    if late and counts == "total" and any(c.startswith("theta") for c in components):
        raise InputError(
            f"{name}: counts = 'total': how far a surface that is added in mid-run has turned isn't known"
        )
    displaced = [c for c in components if not c.startswith("theta")]
    if normal is not None and displaced:
        raise InputError(f"{name}: normal is given together with {', '.join(displaced)}")
    support = None
    if components or normal is None:
        support = make_support(_nowhere, name, components, layout, 0)
    augment = checks.flag(f"{name}: augment", augment)
    springs = _stiffness(problem, f"{name}: stiffness", stiffness, 0)
    turning = 0.0
    if _turns(support, layout):
        turning = _stiffness(problem, f"{name}: rotation_stiffness", rotation_stiffness, 1)
    made = SurfaceSupport(
        name,
        surface,
        support=support,
        normal=normal,
        stiffness=springs,
        rotation_stiffness=turning,
        augment=augment,
    )
    problem.add(made, counts=counts or ("from now" if late else "total"))
    return made


def _stiffness(problem: Loaded, argument: str, value: float | None, rotation: int) -> float:
    if value is None:
        size = problem.cell_size
        return max(_springs(argument, m, size, rotation) for m in problem.points.materials)
    return checks.number(argument, value, above=0.0)


def _turns(support: Support | None, layout: Layout) -> bool:
    """Whether a support prescribes rotations."""
    return support is not None and any(column >= layout.dim for column in support.columns)


def _nowhere(x: np.ndarray) -> np.ndarray:
    return np.zeros(len(x), dtype=bool)


def _springs(argument: str, material: Material, size: float, rotation: int) -> float:
    """Default stiffness of a surface's springs."""
    needed = ("mu", "gamma") if rotation else ("lam", "mu")
    p = material.moduli(*needed)
    if len(p) < len(needed):
        raise InputError(
            f"{argument}: {type(material).__name__} has no parameters named {' and '.join(needed)}; give "
            f"{argument.split(': ')[-1]}"
        )
    if rotation:
        return _PENALTY * (p["gamma"] / size + p["mu"] * size)
    return _PENALTY * (p["lam"] + 2 * p["mu"]) / size
