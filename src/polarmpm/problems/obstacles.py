"""Rigid obstacles, as terms of a problem (docs/contact.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.corners import outer_corners
from ..bodies.nearby import behind, of_nearest
from ..errors import InputError
from ..forms.contact import Law
from ..forms.rest import stiffness_across
from ..geometry.shapes import shape_of
from ..geometry.surfaces import Surface
from ..materials.base import Material
from ..terms.obstacles import Obstacle
from ..terms.rigid import RigidBody
from ..terms.rigidobstacles import RigidObstacle
from ..tools import checks
from .surfaces import Loaded

STIFF = 10.0  # default of the penalty: times the body's stiffness over a cell
SKIN = 1e-9  # cells by which springs are ahead of the surface
_ASIDE = (0.61803, 0.38197, 0.23607)  # by which ties between the points beside a site are broken


def add_obstacle(problem: Any, phi: Any, on: Any, options: dict[str, Any]) -> Obstacle:
    """See `Conditions.obstacle`. Collective."""
    number = 1 + sum(isinstance(g.condition, Obstacle) for g in problem.given)
    name = f"obstacle {number}"
    if options.get("name") is not None:
        name = checks.text("obstacle: name", options["name"])
    shape = shape_of(f"{name}: phi", phi)
    law, constants, gap = _law(problem, name, options)
    body = _rigid(problem, name, options)
    surface, parents = _sites(problem, name, on)
    of = (name, shape, surface, parents, law, constants, problem.cell_size, gap)
    aslant = on is None and parents is not None
    if body is None:
        motion = options["motion"], options["rotation"], options["about"]
        made = Obstacle(*of, *motion, aslant=aslant)
    else:
        made = RigidObstacle(*of, aslant=aslant, body=body)
        if not body.taken:
            problem.add(body)
    made.whole = on is None
    problem.add(made)
    return made


def _rigid(problem: Any, name: str, options: dict[str, Any]) -> RigidBody | None:
    """The rigid body whose surface an obstacle is."""
    if options["body"] is None:
        return None
    body = checks.instance(f"{name}: body", options["body"], RigidBody, "a polarmpm.RigidBody is")
    for key in ("motion", "rotation", "about"):
        if options[key] is not None:
            raise checks.refuse(
                f"{name}: {key}", options[key], f"body = {body!r} moves by itself, or as its `held` says"
            )
    if body.dim != problem.layout.dim:
        raise InputError(f"{name}: {body!r} has {body.dim} dimensions, the body has {problem.layout.dim}")
    if problem.layout.axial:
        body.revolve()
    if body.taken and not any(term is body for term in problem.terms):
        raise InputError(f"{name}: body = {body!r} belongs to another problem; make another one")
    body.check_motion(hasattr(problem, "velocity"))
    return body


def _law(problem: Loaded, name: str, given: dict[str, Any]) -> tuple[Law, dict[str, float], float | None]:
    """Which forces there are, their numbers, and the gap (m) that is allowed."""
    numbers = {key: checks.number(f"{name}: {key}", given[key], least=0.0) for key in ("friction",)}
    for key in ("rolling", "drilling"):
        numbers[key] = checks.number(f"{name}: {key}", given[key], least=0.0)
        if numbers[key] and not problem.layout.rotations:
            raise InputError(
                f"{name}: {key} = {numbers[key]:g}: a classical material has no rotations for it to resist"
            )
    if numbers["drilling"] and problem.layout.dim == 2:
        raise InputError(
            f"{name}: drilling = {numbers['drilling']:g}: in the plane nothing turns about a normal"
        )
    barrier, gap, stiffness = given["barrier"], given["gap"], given["stiffness"]
    if barrier is not None:
        barrier = checks.number(f"{name}: barrier", barrier, above=0.0)
        if gap is not None:
            raise InputError(
                f"{name}: gap = {gap!r} belongs to springs; a barrier = {barrier:g} lets nothing through"
            )
    if gap is not None:
        gap = checks.number(f"{name}: gap", gap, above=0.0)
    if stiffness is None:
        stiffness = STIFF * stiffest(problem, name, problem.points.materials) / problem.cell_size
    stiffness = checks.number(f"{name}: stiffness", stiffness, above=0.0)
    law = Law(numbers["friction"] > 0, numbers["rolling"] > 0, numbers["drilling"] > 0, barrier is not None)
    turning = stiffness * problem.cell_size**2
    constants = {
        **numbers,
        "stiffness": stiffness,
        "tangential": stiffness,
        "turning": turning,
        "distance": SKIN * problem.cell_size if barrier is None else barrier,
    }
    return law, constants, gap


def stiffest(problem: Any, name: str, materials: Sequence[Material]) -> float:
    """The stiffest of some materials, lam + 2 mu (Pa). Collective."""
    most, dim = 0.0, problem.layout.dim
    for material in materials:
        p = material.moduli("lam", "mu")
        if len(p) == 2:
            most = max(most, p["lam"] + 2 * p["mu"])
        elif material.second_gradient:
            kind = type(material).__name__
            raise InputError(f"{name}: stiffness: {kind} has no parameters named lam and mu; give stiffness")
        else:
            most = max(most, float(stiffness_across(material, dim, np.eye(dim), problem.comm)[0].max()))
    if not most > 0.0:
        kinds = ", ".join(dict.fromkeys(type(m).__name__ for m in materials))
        raise InputError(
            f"{name}: stiffness: {kinds} has no stiffness in the undeformed state; give stiffness"
        )
    return most


def _sites(problem: Any, name: str, on: Any) -> tuple[Surface, np.ndarray | None]:
    """Sites of contact as a surface, and ids of the material points that carry them; None for elements."""
    if problem.holds_on_facets:
        if on is None:
            on = _everywhere
        return problem._surface_of(on), None
    if on is None:
        points = problem.points
        counts = np.bincount(points.body, minlength=points.bodies) if points.bodies > 1 else len(points)
        if np.any(problem.comm.allreduce(counts) == 1):
            raise InputError(
                f"{name}: a body is one material point alone: nodes around it move without it, and nothing "
                "holds it; take more points, or smaller cells"
            )
        x, area, normal, parents = outer_corners(problem.points)
        return Surface(x, area, normal), parents
    surface = surface_given(problem, name, on)
    return surface, parents_of(problem, name, surface)


def surface_given(problem: Any, name: str, on: Any) -> Surface:
    """The surface of a body of material points that is meant by `on`."""
    surface = problem._named(on)
    if not isinstance(surface, Surface):
        raise checks.refuse(
            f"{name}: on", on, "a Surface, or the name of a group of facets of the points' mesh, is needed"
        )
    if surface.dim != problem.layout.dim:
        raise InputError(
            f"{name}: the surface has {surface.dim} dimensions, the body has {problem.layout.dim}"
        )
    return surface


def _everywhere(x: np.ndarray) -> np.ndarray:
    return np.ones(len(x), dtype=bool)


def parents_of(problem: Any, name: str, surface: Surface) -> np.ndarray:
    """Ids of the points nearest to the sites, of the body that is behind them. Collective."""
    points = problem.points
    place, volume = (points.x, points.volume) if problem.progress.step else (points.X, points.volume0)
    size = volume ** (1.0 / points.dim)
    aside = np.array(_ASIDE[: points.dim]) * 1e-6 * problem.cell_size
    values = np.column_stack([points.id.astype(float), size])
    if points.bodies == 1:
        distance, found = of_nearest(problem.comm, place, values, surface.x + aside)
    else:
        normal = surface.normal
        distance, found, _ = behind(problem.comm, place, points.body, values, surface.x + aside, normal)
    far = distance > 2.0 * np.maximum(found[:, 1], problem.cell_size)
    if np.any(far):
        at = int(np.argmax(distance * far))
        where = tuple(float(round(c, 9)) for c in surface.x[at])
        raise InputError(
            f"{name}: on: surface point {at} at {where} lies {distance[at]:.4g} m from the nearest material "
            f"point ({int(far.sum())} such in all): it isn't on this body"
        )
    return found[:, 0].astype(np.int64)
