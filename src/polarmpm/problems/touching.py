"""Contact of bodies with each other, as a term of a problem (docs/contact.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bodies.corners import outer_faces
from ..bodies.selection import Selection
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..terms.bodycontact import BodyContact
from ..tools import checks
from .obstacles import SKIN, STIFF, parents_of, stiffest, surface_given


def add_body_contact(problem: Any, a: Any, b: Any, on: Any, options: dict[str, Any]) -> BodyContact:
    """See `Contact.contact`. Collective."""
    number = 1 + sum(isinstance(g.condition, BodyContact) for g in problem.given)
    name = f"contact {number}"
    if options["name"] is not None:
        name = checks.text("contact: name", options["name"])
    if problem.holds_on_facets:
        raise InputError(
            "contact: bodies of finite elements have no contact with each other; make material points of them"
        )
    if problem.points.bodies == 1:
        raise InputError(
            "contact: the points are one body; make a body of its own of some, before the problem is made: "
            "points.separate(selection), or points.join(other, apart=True)"
        )
    friction = checks.number(f"{name}: friction", options["friction"], least=0.0)
    gap = options["gap"]
    if gap is not None:
        gap = checks.number(f"{name}: gap", gap, above=0.0)
    surface, parents = _surfaces(problem, name, on)
    body = _of_points(problem, parents, problem.points.body)
    sides = _sides(problem, name, (a, b), parents, body)
    kept = np.flatnonzero(sides >= 0)
    for side in range(int(sides.max()) + 1) if a is None else (0, 1):
        if not np.any(sides == side):
            whose = f"body {side}" if a is None else "ab"[side]
            raise InputError(
                f"{name}: {whose} has no place on {'its' if on is None else 'the given'} surface"
            )
    if len(np.unique(sides[kept])) < 2:
        raise InputError(f"{name}: the surfaces are of one body only; those of two at least are needed")
    surface = Surface(surface.x[kept], surface.area[kept], surface.normal[kept])
    stiffness = options["stiffness"]
    if stiffness is None:
        stiffness = STIFF * _softer(problem, name, np.unique(body[kept])) / problem.cell_size
    stiffness = checks.number(f"{name}: stiffness", stiffness, above=0.0)
    numbers = {"stiffness": stiffness, "friction": friction, "distance": SKIN * problem.cell_size}
    current = on is not None and problem.progress.step > 0
    made = BodyContact(
        name,
        surface,
        parents[kept],
        sides[kept],
        body[kept],
        numbers,
        problem.cell_size,
        gap,
        current,
    )
    problem.add(made)
    return made


def _surfaces(problem: Any, name: str, on: Any) -> tuple[Surface, np.ndarray]:
    """Sites of contact as a surface, and ids of the material points that carry them."""
    if on is None:
        x, area, normal, parents, _ = outer_faces(problem.points)
        if not len(x):
            raise InputError(
                f"{name}: on: the points have no domains, whose faces could touch; give surfaces"
            )
        return Surface(x, area, normal), parents
    given = on if isinstance(on, list | tuple) else [on]
    if not given:
        raise checks.refuse(f"{name}: on", on, "surfaces of the bodies are needed")
    parts = [surface_given(problem, name, one) for one in given]
    x, area, normal = (np.concatenate([getattr(p, k) for p in parts]) for k in ("x", "area", "normal"))
    surface = Surface(x, area, normal)
    return surface, parents_of(problem, name, surface)


def _of_points(problem: Any, ids: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Whole numbers (n,) of points of given ids, of this rank's (np,). Collective."""
    every = problem.comm.allgather((problem.points.id, values))
    known, all_values = (np.concatenate(parts) for parts in zip(*every, strict=True))
    order = np.argsort(known, kind="stable")
    found: np.ndarray = all_values[order[np.searchsorted(known, ids, sorter=order)]].astype(np.int64)
    return found


def _sides(
    problem: Any, name: str, given: tuple[Any, Any], parents: np.ndarray, body: np.ndarray
) -> np.ndarray:
    """Which sites are in contact with which: those of one number with those of others; -1: with none."""
    if all(one is None for one in given):
        return body
    for which, one in zip("ab", given, strict=True):
        allowed = "selections of points are needed, both or none"
        if not isinstance(one, Selection):
            raise checks.refuse(f"{name}: {which}", one, allowed)
        problem.points.check(one)
    member = [np.isin(parents, one.ids) for one in given]
    bodies = [np.unique(_of_points(problem, one.ids, problem.points.body)) for one in given]
    common = np.intersect1d(*bodies)
    if len(common):
        raise InputError(
            f"{name}: a and b: points of body {common[0]} are in both; a body has no contact with itself"
        )
    return np.where(member[0], 0, np.where(member[1], 1, -1))


def _softer(problem: Any, name: str, bodies: np.ndarray) -> float:
    """The least of the bodies' stiffnesses, each that of its stiffest material (Pa). Collective."""
    p = problem.points
    pairs = np.unique(np.stack([p.body, p.material], axis=1), axis=0)
    pairs = np.unique(np.concatenate(problem.comm.allgather(pairs)), axis=0)
    return min(
        stiffest(problem, name, [p.materials[m] for m in pairs[pairs[:, 0] == one, 1]]) for one in bodies
    )
