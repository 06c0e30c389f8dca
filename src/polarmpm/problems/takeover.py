"""Dynamic problems that begin where quasi-static ones end: they take over state, supports and loads."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from ..bodies.partition import LoadShares
from ..conditions.loads import Applied, HandedOver
from ..conditions.supports import Support
from ..errors import InputError
from ..terms.base import Term
from ..terms.bodycontact import BodyContact
from ..terms.ghost import Ghost
from ..terms.obstacles import Obstacle
from ..terms.rigid import RigidBody
from ..terms.rigidobstacles import RigidObstacle
from ..tools import checks
from .given import Given


def check(problem: Any, kind: type) -> None:
    """Raise InputError unless a problem can be gone on from."""
    if not isinstance(problem, kind) or hasattr(problem, "velocity"):
        raise checks.refuse("of: problem", problem, f"a {kind.__name__} is needed")
    before: Any = problem
    before.check_open()
    before._check_outside("of")
    before._check_left()
    if not before.progress.step:
        raise InputError("of: no load step has been solved yet; give conditions to a dynamic problem itself")
    if any(isinstance(load, HandedOver) or load.amplitude.fade is not None for load in before.loads):
        raise InputError("of: some conditions are still fading; let them fade out first")
    terms = [
        term.name for term in before.terms if not isinstance(term, Ghost | Obstacle | BodyContact | RigidBody)
    ]
    if terms:
        raise InputError(
            f"of: {terms[0]}: conditions on surfaces, and terms of one's own, can't be taken over; "
            "release them"
        )
    timed = [t.name for t in before.terms if isinstance(t, Obstacle) and t.timed]
    if timed:
        raise InputError(f"of: {timed[0]}: a level set of the load factor can't be taken over; release it")
    if getattr(before, "held_slopes", None):
        raise InputError("of: slopes that are held on facets can't be taken over; release them")


def take_conditions(made: Any, before: Any) -> None:
    """Supports hold the body where it is, and loads keep the values that they have."""
    factor, bodies = before.progress.factor, dict[int, RigidBody]()
    for given in before.given:
        if given.released is not None:
            continue
        if isinstance(given.condition, RigidBody):
            body = bodies[id(given.condition)] = given.condition.still(factor)
            body.check_motion(True)
            made._terms.append(body)
            made.given.add(Given(body.name, body, 0.0), "term")
            continue
        if isinstance(given.condition, Obstacle | BodyContact):
            stays = given.condition.still(factor)
            if isinstance(stays, RigidObstacle):
                stays.body = bodies[id(stays.body)]
            made._terms.append(stays)
            made.given.add(Given(stays.name, stays, 0.0), "surface")
            continue
        if isinstance(given.condition, Term):
            continue
        if isinstance(given.condition, Support):
            support = _still(given.condition)
            made._supports.append(support)
            made.given.add(Given(support.name, support, 0.0, "from now"), "support")
        else:
            parts = tuple(_frozen(part, factor) for part in given.condition.parts)
            made.given.add(Given(given.name, Applied(given.name, parts), 0.0), "load")
            for part in parts:
                (made._surface_loads if hasattr(part, "facets") else made._loads).append(part)
    made._stale = True


def _still(support: Support) -> Support:
    columns = {}
    for column, (amplitude, k) in support.columns.items():
        none = copy(amplitude)
        none.function, none.constant = None, np.zeros(none.size)
        none.begin(0.0, "from now")
        columns[column] = none, k
    return replace(support, columns=columns, total=False, committed=True)


def _frozen(load: Any, factor: float) -> Any:
    """A load whose values are for ever those at a load factor."""
    made, amplitude = copy(load), copy(load.amplitude)
    amplitude.function, amplitude.field = (lambda time, x: load.amplitude.at(factor, x)), True
    amplitude.begin(0.0, "total")
    made.amplitude = amplitude
    return made


def take_progress(made: Any, before: Any) -> None:
    """Time begins at zero; the energies of the run so far go on."""
    p = made.progress = replace(before.progress)
    p.factor = p.reset_factor = p.rotation_factor = p.factor_change = 0.0


def take_points(made: Any, before: Any, ids: np.ndarray, rebalance: float | None) -> None:
    """Go on in the system of the grid's last reset, with what it carries along. Collective.

    Args:
        ids: of this rank's points before the new problem was made.
    """
    here = np.array_equal(ids, made.points.id)
    same = made.comm.allreduce(int(not here)) == 0
    increments = before.increments() if same else None
    kept, shares = before.kept() if same else {}, before.load_shares.state()
    made.load_shares = LoadShares(made.comm, rebalance)
    made.restore(made.progress, increments, kept, shares)
    made.box_record.restore(before.box_record.state())
