"""What a saved state was made of, and how that differs from the problem that is to take it.

Of each group of facts a file has the numbers themselves, so that a difference can be named with both values.
"""

from __future__ import annotations

import json
import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl

from ..bodies.lineage import Lineage
from ..errors import InputError
from ..kernels.codegen import Scalariser, expand
from ..materials.base import Material, evaluate_energy
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..problems.motion import Moving
from ..terms.base import Term
from ..terms.rigid import RigidBody
from ..terms.surfaceterms import SurfaceCondition
from ..tools import checks
from ..tools.parallel import known_anywhere, raise_on_all_ranks, values_by_number
from . import meshstate

# groups of differences that a script may allow, and what it means to
ALLOWED = ("materials", "points", "grid", "basis", "terms", "conditions", "motion")
_OF_ELEMENTS = ("materials", "terms", "conditions", "motion")
_ROUNDING = 1e-12  # of a number that another machine has computed
_NEAR = 1e-9  # of a cell; farther apart, two positions aren't the same

Facts = dict[str, dict[str, Any]]


def check_allowed(problem: Problem, allow: Any) -> frozenset[str]:
    """Groups of differences that a script allows.

    Raises:
        InputError: not names of groups.
    """
    known = _OF_ELEMENTS if isinstance(problem, QuasiStaticFEM) else ALLOWED
    several = isinstance(allow, Collection) and not isinstance(allow, str | bytes | Mapping)
    names = allow if several else (allow,)
    for name in names:
        if not isinstance(name, str) or name not in known:
            raise checks.refuse("allow", allow, f"a set of some of {', '.join(map(repr, known))}")
    return frozenset(names)


def made_of(problem: Problem, terms: Sequence[Term]) -> Facts:
    """Facts by group; the same on every rank. Collective.

    Args:
        terms: of the problem that count.
    """
    layout = problem.layout
    facts: Facts = {"unknowns": {"dimensions": layout.dim, "unknowns of a node": layout.block}}
    facts["unknowns"] |= {"axisymmetric": True} if layout.axial else {}
    facts |= {"materials": _materials(problem), "terms": _terms(terms)}
    if isinstance(problem, QuasiStaticFEM):
        facts["mesh"] = meshstate.header(problem)
    else:
        p: Any = problem
        facts["points"] = _points(problem)
        facts["grid"] = dict(p.initial_grid.description())
        facts["basis"] = {"basis": p.basis.name, "boxes": p.boxes, "locking": str(p.locking)}
    if isinstance(problem, Moving):
        facts["motion"] = problem.inertia()
    found: Facts = json.loads(json.dumps(facts, default=_plain))
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _public(thing: Any) -> dict[str, Any]:
    """Numbers and texts of a dataclass."""
    if not is_dataclass(thing):
        return {}
    found = {f.name: getattr(thing, f.name) for f in fields(thing) if not f.name.startswith("_")}
    return {name: value for name, value in found.items() if isinstance(value, int | float | str)}


def _points(problem: Problem) -> dict[str, Any]:
    p = problem.points
    sums = problem.comm.allreduce(np.array([p.shares().sum(), p.volume0.sum()]))
    bodies = {"bodies": p.bodies} if p.bodies > 1 else {}
    return {"number of points": round(sums[0]), "reference volume": float(sums[1]), **bodies}


def _terms(terms: Sequence[Term]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for k, term in enumerate(terms):
        numbers = {**_public(term), **_public(getattr(term, "penalty", None))}
        if isinstance(term, SurfaceCondition):
            numbers["surface points"] = len(term.surface)
        if isinstance(term, RigidBody):
            inertia = [] if term.inertia is None else term.inertia.ravel().tolist()
            numbers |= {"mass": term.mass, "inertia": inertia, "held": list(term.reaction)}
        kind, state = type(term).__qualname__, bool(term.state())
        out[f"terms[{k}]"] = {"name": term.name, "class": kind, **numbers, "state": state}
    return out


# materials --------------------------------------------------------------------------------------------
def _materials(problem: Problem) -> dict[str, Any]:
    materials = problem.first_materials  # what they change to follows from the conditions
    out: dict[str, Any] = {"materials": len(materials)}
    return out | {f"materials[{k}]": _of_material(material) for k, material in enumerate(materials)}


def _of_material(material: Material) -> dict[str, Any]:
    kind, elastic = type(material), material.elastic_part
    facts: dict[str, Any] = {"class": kind.__qualname__}
    if elastic is not material:
        facts["elastic class"] = type(elastic).__qualname__
    facts |= {"micropolar": material.micropolar, "plastic": material.plastic}
    facts |= {"second gradient": True} if material.second_gradient else {}
    facts |= {name: float(value) for name, value in material.parameters().items()}
    facts |= elastic.choices()
    parts = material, elastic, getattr(elastic, "elastic", elastic)  # a mean is one of another material
    given = (type(one).__module__.split(".")[0] != __package__.split(".")[0] for one in parts)
    if any(given) or any(type(one).__name__.startswith("User") for one in parts):
        facts |= _sample(material)
    return facts


_sampled: dict[int, tuple[weakref.ref[Material], dict[str, float], dict[str, float | None]]] = {}


def _sample(material: Material) -> dict[str, float | None]:
    """A script's functions as numbers: their values in a state that is always the same."""
    key, numbers = id(material), material.parameters()
    known = _sampled.get(key)
    if known is None or known[0]() is not material or known[1] != numbers:
        found = {f"{name} at the sample": value for name, value in _samples(material)}
        known = weakref.ref(material, lambda _: _sampled.pop(key, None)), numbers, found
        _sampled[key] = known
    return known[2]


def _samples(material: Material) -> Iterator[tuple[str, float | None]]:
    rng = np.random.default_rng(0)
    first, second = (0.1 * rng.uniform(-1.0, 1.0, (3, 3)) for _ in range(2))
    a, b = (ufl.as_tensor(m.tolist()) for m in (first, second))
    numbers = SimpleNamespace(**{n: ufl.as_ufl(float(v)) for n, v in material.parameters().items()})
    yield "energy", _value(lambda: _energy(material, a, b, numbers))
    if not material.plastic:
        return
    plastic: Any = material
    size = 0.01 * plastic.modulus
    tau, chi = ufl.as_tensor((size * (first + first.T)).tolist()), ufl.as_ufl(0.01)
    nu = ufl.as_tensor((0.01 * plastic.couple_modulus * second).tolist()) if plastic.micropolar else None
    yield "hardening energy", _value(lambda: plastic.hardening_energy(chi, numbers))
    for surface in {s.name: s for region in plastic.regions for s in region.surfaces}.values():
        yield f"f of {surface.name}", _value(lambda s=surface: s.function(tau, nu, chi, numbers))
        flow = surface.potential or surface.function
        yield f"g of {surface.name}", _value(lambda g=flow: g(tau, nu, chi, numbers))


def _energy(material: Material, a: Any, b: Any, numbers: Any) -> Any:
    if material.second_gradient:
        n = range(3)
        second = [[[a[i, j] * b[k, i] + a[i, k] * b[j, i] for k in n] for j in n] for i in n]
        strains = material.measures(ufl.Identity(3) + a, ufl.as_tensor(second))
    else:
        strains = (a, b) if material.micropolar else material.measures(ufl.Identity(3) + a)
    return evaluate_energy(material, strains, numbers)


def _value(function: Any) -> float | None:
    scalarise = Scalariser({})  # which folds constants, and knows each part of an expression once
    try:
        found: Any = scalarise(expand(ufl.as_ufl(function()))).data
        node = scalarise.plain(found[()])
    except Exception:  # whatever a script's function, UFL or a number out of range may raise
        return None
    value = scalarise.graph.value(node)
    return value if value is not None and np.isfinite(value) else None


# comparing --------------------------------------------------------------------------------------------
def differences(saved: Facts, here: Facts) -> Iterator[tuple[str, str]]:
    """Group and description of each difference."""
    for group in dict.fromkeys([*saved, *here]):
        old, new = saved.get(group, {}), here.get(group, {})
        if group == "terms":  # new ones count from now on, if they have no past
            new = {name: facts for name, facts in new.items() if name in old or facts["state"]}
        for name, one, other in _differing(old, new):
            of = "its points are of another body: " if group == "points" else ""
            yield group, f"{of}{name} is {_shown(one)}, this problem has {_shown(other)}"


def _differing(saved: Any, here: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(saved, dict) and isinstance(here, dict):
        for key in dict.fromkeys([*saved, *here]):
            full = f"{name}.{key}" if name else key
            yield from _differing(saved.get(key), here.get(key), full)
    elif not _same(saved, here):
        yield name, saved, here


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (one, other))
    if numbers:
        return bool(abs(one - other) <= _ROUNDING * max(abs(one), abs(other)))
    return bool(one == other)


def _shown(value: Any) -> str:
    if value is None:
        return "missing"
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.12g}"
    return checks.shown(value)


def refuse_differences(path: Any, found: list[tuple[str, str]], allow: frozenset[str]) -> None:
    """Raise InputError if there are differences that aren't allowed, naming them."""
    left = [(group, text) for group, text in found if group not in allow]
    if not left:
        return
    first = "; ".join(text for _, text in left[:3])
    more = f"; and {len(left) - 3} more" if len(left) > 3 else ""
    groups, hint = list(dict.fromkeys(group for group, _ in left)), ""
    if all(group in ALLOWED for group in groups):
        hint = f" (allow={{{', '.join(map(repr, groups))}}} takes the state all the same)"
    raise InputError(f"restart file {path}: {first}{more}{hint}")


# points -----------------------------------------------------------------------------------------------
def check_points(
    problem: Any,
    rows: dict[str, np.ndarray],
    path: Any,
    allow: frozenset[str],
    lineage: Lineage | None = None,
    inside: Any = None,
) -> None:
    """Compare a file's material points, of which each rank has some, with those of the problem, of which
    some may have been split since. Collective.

    Args:
        inside: tells which points (n, d) are in the grid; default: that of the problem's.

    Raises:
        InputError: they are others, or don't go together with materials and selections.
        PointsOutsideGrid: they don't lie in the problem's grid.
    """
    p, comm = problem.points, problem.comm
    error = None
    if np.any((rows["points/material"] < 0) | (rows["points/material"] >= len(p.materials))):
        error = InputError(f"restart file {path}: points of more materials than the {len(p.materials)} here")
    elif not np.all((inside or problem.initial_grid.inside)(rows["points/x"])):
        error = InputError(f"restart file {path}: its points lie outside of this problem's grid")
    raise_on_all_ranks(comm, error)
    ids = rows["points/id"]
    seeded, share = (ids, np.ones(len(ids))) if lineage is None else lineage.roots(ids)
    if "points" in allow:
        chosen = [getattr(load, "selection", None) for load in problem.loads]
        loaded = [selection.ids for selection in chosen if selection is not None]
        wanted = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *loaded]))
        if not np.all(known_anywhere(comm, seeded, wanted)):
            raise InputError(f"restart file {path}: its points don't have all those that bear loads here")
        return
    body = p.body if p.bodies > 1 else np.zeros(len(p))
    mine = np.column_stack([np.ones(len(p)), p.X, p.volume0, p.material, body, _reach(p)])
    here = values_by_number(comm, p.id, mine, seeded)
    here, reach = here[:, : -p.dim], here[:, -p.dim :]
    X, volume, material = (rows[f"points/{name}"] for name in ("X", "volume0", "material"))
    body, cell = rows.get("points/body", np.zeros(len(ids))), problem.initial_grid.smallest
    there = np.column_stack([np.ones(len(ids)), X, volume / share, material, body])
    slack = np.tile(_NEAR * np.array([1, *cell, np.prod(cell), 1, 1]), (len(ids), 1))
    slack[:, 1 : 1 + p.dim] += np.where(share < 1.0, 1.0, 0.0)[:, None] * reach
    off = np.any(np.abs(here - there) > slack, axis=1)
    if np.any(off):
        at = int(np.argmax(off))
        error = InputError(
            f"restart file {path}: its points are of another body: {_differs(ids[at], there[at], here[at])}"
        )
    raise_on_all_ranks(comm, error)


def _reach(points: Any) -> np.ndarray:
    """How far (m) the parts of points may lie from these along each axis (np, d)."""
    found: np.ndarray = np.abs(points.half_axes0).sum(axis=1)
    return found


def _differs(number: int, there: np.ndarray, here: np.ndarray) -> str:
    if not here[0]:
        return f"point {number} isn't in this problem"
    if np.any(there[1:-3] != here[1:-3]):
        places = (", ".join(f"{c:.9g}" for c in row[1:-3]) for row in (there, here))
        return "point {} was seeded at ({}), this problem has it at ({})".format(number, *places)
    name, k = next((n, k) for n, k in (("volume", -3), ("material", -2), ("body", -1)) if there[k] != here[k])
    return f"the {name} of point {number} is {there[k]:.9g}, this problem has {here[k]:.9g}"
