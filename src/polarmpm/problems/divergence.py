"""Where the iterations of a load step have gone wrong: they are repeated, and looked at on the way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.reference import Increments
from ..conditions.supports import component_names
from ..errors import Finding, LocalFailure
from ..solvers import newton
from ..solvers.linear import SingularTangent
from ..solvers.newton import Controls
from .wording import names_of, own_ids, place, smallest

_LARGE = 1.0  # size of a correction, over the body's, that is too large


@dataclass
class Iterate:
    """Increments x (nodes, block) of an iteration, and its residual (nodes, block); None: there is none."""

    number: int
    x: np.ndarray
    residual: np.ndarray | None


@dataclass
class Replay:
    """A load step's iterations, once more.

    Attributes:
        forces: the force measures.
        start: the first iterate.
        diagonal: of its tangent (owned nodes, block); None: it has none.
        first: increments after the first correction.
        wrong: the first iterate after which the force measure never fell below what it was before; None:
            there is none.
        reason: why it ended, if iterations can't go on.
        singular: the linear system couldn't be solved.
    """

    start: Iterate
    diagonal: np.ndarray | None = None
    forces: list[float] = field(default_factory=list)
    first: np.ndarray | None = None
    wrong: Iterate | None = None
    reason: str = ""
    singular: bool = False


def repeat(
    system: NodalSystem,
    controls: Controls,
    limit: int,
    at_start: Callable[[Replay], bool],
    with_factor: Callable[[Replay], None],
) -> Replay:
    """Iterate again in a system whose step has begun, at most `limit` times. Collective.

    Args:
        at_start: called before the first solution; True: there is no need to go on.
        with_factor: called when the first linear system has been solved, or not.
    """
    replay, best = Replay(Iterate(0, system.x, None)), math.inf
    for k in range(limit + 1):
        here = Iterate(k, system.x, None)
        try:
            newton.evaluate(system, True, system.backtrack)
        except LocalFailure as e:
            replay.wrong, replay.reason = Iterate(k, system.x, None), str(e)
            return replay
        here = Iterate(k, system.x, system.residual)
        force, _ = system.convergence_measures()
        replay.forces.append(force)
        if k == 0:
            replay.start, replay.diagonal = here, system.diagonal().copy()
        if not math.isfinite(force) and not (k == 0 and _finite(system, system.residual)):
            replay.wrong = here
            return replay
        if force < controls.force_tolerance and not system.pending():
            replay.wrong = None
            return replay
        if force < best:
            best, replay.wrong = force, None
        elif replay.wrong is None:
            replay.wrong = here
        if k == limit or force > controls.divergence or (k == 0 and at_start(replay)):
            return replay
        _update(system, replay)
        if k == 0:
            replay.first = system.x
            with_factor(replay)
        if replay.singular:
            return replay
    return replay


def _update(system: NodalSystem, replay: Replay) -> None:
    try:
        system.update(True)
    except SingularTangent as e:
        replay.singular, replay.reason = True, str(e)


def _finite(system: NodalSystem, values: np.ndarray) -> bool:
    here = bool(np.all(np.isfinite(values[: system.nodes.owned])))
    return bool(system.comm.allreduce(here, op=MPI.LAND))


# where ------------------------------------------------------------------------------------------------
def where_inverted(problem: Any, system: NodalSystem, iterate: Iterate) -> Finding | None:
    """Points that an iterate turns inside out."""
    ratio = volume_ratios(problem, system, iterate.x)
    bad = ~(ratio > 0.0)
    number = int(problem.comm.allreduce(int(bad.sum())))
    if not number:
        return None
    worst = np.where(np.isfinite(ratio), ratio, -np.inf)[bad]
    rows = smallest(problem.comm, worst, _table(problem)[bad])
    ids, places = _ids_and_places(rows)
    first = f"{_named(problem, rows[0])} has J = {rows[0, 0]:.3g}"
    text = (
        f"iteration {iterate.number} turns {number} point(s) inside out: {first}; take smaller load steps, "
        "or a finer grid there"
    )
    return Finding("inside out", text, places, ids)


def where_not_finite(problem: Any, system: NodalSystem, iterate: Iterate) -> Finding | None:
    """Nodes and points whose stresses an iterate makes infinite or not a number."""
    assert iterate.residual is not None
    own = system.nodes.owned
    bad = np.zeros_like(iterate.x)
    bad[:own][np.any(~np.isfinite(iterate.residual[:own]), axis=1)] = 1.0
    system.nodes.update_ghosts(bad)
    number = int(system.comm.allreduce(int(bad[:own, 0].sum())))
    if not number:
        return None
    share = system.at_points(bad)[:, 0]
    inside = share > 1.0 - 1e-9
    most = system.comm.allreduce(float(share.max(initial=0.0)), op=MPI.MAX)
    inside = inside if system.comm.allreduce(bool(inside.any()), op=MPI.LOR) else share >= most
    grown = size_of_gradient(problem, system, iterate.x)
    keys = -np.where(np.isfinite(grown), grown, np.inf)[inside]
    rows = smallest(problem.comm, keys, _table(problem)[inside])
    ids, places = _ids_and_places(rows)
    when = "before the first iteration" if iterate.number == 0 else f"in iteration {iterate.number}"
    cure = "see its energy at no strain" if iterate.number == 0 else "smaller load steps"
    text = (
        f"{when} the forces of {number} node(s) are not finite, nor are the stresses of "
        f"{_named(problem, rows[0])}: {cure}"
    )
    return Finding("not finite", text, places, ids)


def where_unbalanced(problem: Any, system: NodalSystem, iterate: Iterate) -> Finding:
    """The point with the largest strain, and the node farthest from equilibrium if there is a residual."""
    grown = size_of_gradient(problem, system, iterate.x)
    rows = smallest(problem.comm, -grown, _table(problem))
    ids, places = _ids_and_places(rows)
    strained = f"most strained, by {-rows[0, 0]:.2g}, is {_named(problem, rows[0])}"
    if iterate.residual is None:
        text = f"where it ended, in iteration {iterate.number}, {strained}"
        return Finding("out of balance", text, places[:1], ids[:1])
    own = system.nodes.owned
    r = np.abs(system.on_free(iterate.residual)[:own]) * system.as_force
    r /= system.comm.allreduce(float(r.max(initial=0.0)), op=MPI.MAX) or 1.0
    node, column = np.arange(own), r.argmax(axis=1) if own else np.zeros(0, dtype=int)
    most = smallest(problem.comm, -r[node, column], np.column_stack([column, system.positions()[:own]]))
    share = -most[0, 0] / math.sqrt(system.comm.allreduce(float(np.sum(r**2))) or 1.0)
    name, at = component_names(system.layout)[int(most[0, 1])], tuple(map(float, most[0, 2:]))
    text = (
        f"from iteration {iterate.number} on the residual grows: {100 * share:.0f} % of it in {name} of the "
        f"node at {place(at)} m; {strained}"
    )
    return Finding("out of balance", text, (at, *places[:1]), ids[:1], (name,))


def _table(problem: Any) -> np.ndarray:
    """Id, material, whether it has flowed, and position of the local points, (np, 3 + d)."""
    p = problem.points
    return np.column_stack([own_ids(problem), p.material, flowed(p), p.x])


def flowed(points: Any) -> np.ndarray:
    """Which points have flowed (np,)."""
    if not points.plastic:
        return np.zeros(len(points))
    flowing: np.ndarray = (points.hardening > 0.0).astype(float)
    return flowing


def _ids_and_places(rows: np.ndarray) -> tuple[tuple[int, ...], tuple[tuple[float, ...], ...]]:
    """Of rows (key, id, material, flowed, x)."""
    return tuple(int(r[1]) for r in rows), tuple(tuple(map(float, r[4:])) for r in rows)


def _named(problem: Any, row: np.ndarray) -> str:
    """A point of a row (key, id, material, flowed, x), in words."""
    material = type(problem.points.materials[int(row[2])]).__name__
    more = ", has flowed" if row[3] else ""
    return f"{names_of(problem, [int(row[1])])} at {place(row[4:])} m ({material}{more})"


def _increments(problem: Any, system: NodalSystem, x: np.ndarray) -> Increments:
    before, system.x = system.x, x
    try:
        found: Increments = problem._increments(system)
    finally:
        system.x = before
    return found


def size_of_gradient(problem: Any, system: NodalSystem, x: np.ndarray) -> np.ndarray:
    """Norms of the increments' gradients at the points (np,)."""
    gradient = _increments(problem, system, x).gradient
    size: np.ndarray = np.sqrt(np.einsum("nij,nij->n", gradient, gradient))
    return size


def volume_ratios(problem: Any, system: NodalSystem, x: np.ndarray) -> np.ndarray:
    """J at the points (np,) for increments x (nodes, block)."""
    ratios: np.ndarray = problem.volume_ratios(_increments(problem, system, x))
    return ratios


def too_large(problem: Any, system: NodalSystem, replay: Replay) -> Finding | None:
    """A first correction that is larger than the body."""
    if replay.first is None:
        return None
    d, p, comm = system.layout.dim, problem.points, problem.comm
    moved = np.linalg.norm(system.at_points(replay.first - replay.start.x)[:, :d], axis=1)
    most = comm.allreduce(float(moved.max(initial=0.0)), op=MPI.MAX)
    ends = np.stack([p.x.max(axis=0, initial=-np.inf), -p.x.min(axis=0, initial=np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    size = float(np.linalg.norm(ends.sum(axis=0)))
    if not math.isfinite(most) or most <= _LARGE * size or size == 0.0:
        return None
    text = (
        f"the first iteration moves the body by {most:.3g} m, {most / size:.3g} times its size: the load "
        "step is far too large, or load and moduli are in different units"
    )
    return Finding("too large", text)
