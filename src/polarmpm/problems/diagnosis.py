"""Why a load step has failed: looked for when it has, and said in the words of `NotConverged`.

The step begins again from the last converged state, and its iterations are repeated once, no more of them
than there were. What is looked for: motions that nothing holds; motions that the tangent doesn't resist;
stresses that are not finite; too few points; loads near their limit; where iterations go wrong. The state is
put back. All functions are collective and find the same on all ranks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..assembly.parts import Parts
from ..assembly.system import NodalSystem
from ..conditions.supports import component_names
from ..errors import Finding, LocalFailure, NotConverged, PolarMPMError
from ..solvers.linear import SingularTangent
from ..solvers.weakest import Mode, WeakTangent
from . import divergence, freemotion
from .divergence import Iterate, Replay
from .wording import names_of, own_ids, place, smallest

_MOST = 6  # findings
_KEPT = ("x", "before", "residual", "loads", "external", "step", "carried")
_NOTHING = 1e-13  # curvature along a motion, relative to the tangent's diagonal, that is rounding
_WORK = 1e-8  # share of the forces that work on such a motion
_LOCAL = 0.2  # share of the nodes that take part in a motion of a few nodes
_WEAK = 1e-9  # its curvature
_YIELDING = 1.5  # displacement by load factor over the mean so far, from which on a load may have a limit
_FALLING = 0.5  # ratio of residuals with which iterations get on
_FACTORED = {2: 300_000, 3: 60_000}  # unknowns up to which the tangent is factored once more
_FEW = 1.5  # points a cell, in each direction, that are too few; or so many cells have a single one:
_ALONE = 0.5


@dataclass
class _Case:
    """A failed step, begun again.

    Attributes:
        pushed: what the loads have grown by in this step (nodes, block).
        decisive: what makes an equilibrium impossible, whatever else there is.
        motions: free rigid ones.
        weak: the weakest motion that the forces work on.
        rate: displacement by load factor over its mean so far; None: not known.
        unstable: the tangent at the start has a motion with a negative curvature.
    """

    problem: Any
    system: NodalSystem
    error: NotConverged
    way: str
    pushed: np.ndarray
    decisive: list[Finding] = field(default_factory=list)
    motions: list[Finding] = field(default_factory=list)
    weak: Mode | None = None
    rate: float | None = None
    unstable: bool = False


def explain(problem: Any, error: NotConverged, way: str) -> None:
    """Put what is found into the message of an error that is about to be raised.

    Args:
        way: "equal" or "adaptive" steps, or along the "arc length".
    """
    error.explain(diagnose(problem, error, way))


def diagnose(problem: Any, error: NotConverged, way: str) -> list[Finding]:
    """Why the last step has failed, the most telling first. Raises nothing, and leaves all as it is."""
    system: NodalSystem | None = problem.system
    if system is None:
        return []
    kept = {name: getattr(system, name) for name in _KEPT}
    try:
        with np.errstate(all="ignore"):
            return _find(problem, system, error, way)[:_MOST]
    except PolarMPMError as e:  # the same on all ranks
        return [Finding("no diagnosis", str(e).splitlines()[0])]
    except Exception as e:
        return [Finding("no diagnosis", f"{type(e).__name__}: {e}")]
    except BaseException:
        problem._stale = True  # the solver may have been left in the middle of its work
        raise
    finally:
        for name, value in kept.items():
            setattr(system, name, value)
        problem.failed_at = None


def _find(problem: Any, system: NodalSystem, error: NotConverged, way: str) -> list[Finding]:
    case = _Case(problem, system, error, way, _pushed(problem, system, error.factor, way))
    system.set_prescribed(problem._prescribed_at(system, error.factor))
    limit = max(1, min(len(error.history) - 1, problem.controls.max_iterations))
    hooks = partial(_look_at_start, case), partial(_look_at_tangent, case)
    replay = divergence.repeat(system, problem.controls, limit, *hooks)
    system.x = replay.start.x
    if replay.start.residual is None or _not_finite(system, replay.start.residual):
        return [*filter(None, [_at_start_not_finite(case, replay)])]
    if case.decisive:
        return case.decisive
    if case.motions and replay.singular:
        return case.motions
    causes = [*filter(None, [_mechanism(case, replay), _few_points(case)])]
    if not causes and not case.motions:  # of motions without stiffness the sign is a matter of rounding
        causes = [*filter(None, [_limit_load(case)])]
    course = _course(case, replay)
    if causes and causes[0].kind != "limit load":
        course = [f for f in course if f.kind in ("inside out", "not finite")]
    return causes + course + case.motions


def _pushed(problem: Any, system: NodalSystem, factor: float, way: str) -> np.ndarray:
    """Begin the step again; by what its loads grow (nodes, block): with the load factor along a path, as a
    step may have come to a factor like the last one there."""
    growth: np.ndarray | None = None
    if way == "arc length":
        problem._put_loads(system, factor + 1.0)
        growth = system.working_loads()
    start = problem._begin(system, factor)
    pushed: np.ndarray = start.new - start.before if growth is None else growth - start.new
    return pushed


def _look_at_start(case: _Case, replay: Replay) -> bool:
    """Before the first solution: what can be told without one. Whether that makes equilibrium impossible."""
    forces, diagonal = replay.start.residual, replay.diagonal
    assert forces is not None
    assert diagonal is not None
    without = _without_stiffness(case, diagonal)
    if without is not None:
        case.decisive = [without]
        return True
    if case.system.inertia is not None:  # nothing has to hold what moves
        return False
    parts = Parts.of(case.system, case.problem.points)
    if case.way == "arc length":
        forces = forces - case.pushed
    free = freemotion.free_parts(case.system, parts, forces, diagonal)
    case.motions = freemotion.findings(case.problem, case.system, parts, free)
    if any(one.pushed for one in free):
        case.decisive = case.motions
    return bool(case.decisive)


def _look_at_tangent(case: _Case, replay: Replay) -> None:
    """After the first solution: ask its matrix what it hardly resists."""
    system, problem = case.system, case.problem
    own = slice(0, system.nodes.owned)
    assert replay.start.residual is not None
    forces = replay.start.residual
    if system.tangent is None or system.nodes.total * system.layout.block > _FACTORED[system.dim]:
        return
    try:
        weak = WeakTangent(system.tangent, system.symmetric)
    except SingularTangent:
        return
    try:
        case.weak = weak.mode(system.on_free(forces)[own].ravel())
        case.unstable = weak.negative > 0
        if problem.progress.step:
            case.rate = _rate(case, weak)
    finally:
        weak.destroy()


def _rate(case: _Case, weak: WeakTangent) -> float | None:
    """How far the load of this step would move the body by load factor, over the mean so far."""
    system, problem, d = case.system, case.problem, case.system.layout.dim
    own, p = slice(0, system.nodes.owned), problem.points
    change = case.error.factor - problem.progress.factor
    pushed = system.on_free(case.pushed)[own]
    if change == 0.0 or problem.progress.factor == 0.0:
        return None
    moved = np.zeros_like(system.x)
    moved[own] = weak.solve(pushed.ravel()).reshape(pushed.shape)
    system.complete(moved)
    now = system.at_points(moved)[:, :d] / change
    before = (p.x - p.X) / problem.progress.factor
    sums = [float(np.sum(p.volume0[:, None] * u**2)) for u in (now, before)]
    squares = problem.comm.allreduce(np.array(sums))
    return math.sqrt(squares[0] / squares[1]) if squares[1] > 0.0 else None


def _not_finite(system: NodalSystem, values: np.ndarray) -> bool:
    here = not bool(np.all(np.isfinite(values[: system.nodes.owned])))
    return bool(system.comm.allreduce(here, op=MPI.LOR))


def _at_start_not_finite(case: _Case, replay: Replay) -> Finding | None:
    if replay.start.residual is None and not _without_boxes(case, replay):
        return Finding("not finite", f"before the first iteration: {replay.reason}")
    loads = _not_finite(case.system, case.system.external)
    if loads:
        return Finding("not finite", "the loads at this load factor are not finite")
    return divergence.where_not_finite(case.problem, case.system, replay.start)


def _without_boxes(case: _Case, replay: Replay) -> bool:
    """Evaluate the start once more, where its boxes have no stresses; whether there is a residual then."""
    system = case.system
    if not system.leave_out_boxes(True):
        return False
    try:
        system.evaluate(False)
        replay.start.residual = system.residual
    except LocalFailure:
        return False
    finally:
        system.leave_out_boxes(False)
    return _not_finite(system, system.residual)


# causes ----------------------------------------------------------------------------------------------------
def _without_stiffness(case: _Case, raw: np.ndarray) -> Finding | None:
    """Nodes that the body reaches, but whose diagonal is zero."""
    system, own = case.system, case.system.nodes.owned
    volume = system.node_volumes()[:own]
    real = volume > 1e-6 * system.comm.allreduce(float(volume.max(initial=0.0)), op=MPI.MAX)
    free = system.prescribed.free[:own] & real[:, None]
    most = system.comm.allreduce(np.abs(raw[:, : system.layout.dim]).max(initial=0.0), op=MPI.MAX)
    zero = free & (np.abs(raw) <= 1e-14 * most)
    counts = system.comm.allreduce(np.array([np.any(zero, axis=1).sum(), np.any(free, axis=1).sum()]))
    if not counts[0]:
        return None
    rows = np.flatnonzero(np.any(zero, axis=1))
    table = np.column_stack([zero[rows], system.positions()[:own][rows]])
    shown = smallest(system.comm, np.arange(len(rows), dtype=float), table)
    block = system.layout.block
    places = tuple(tuple(map(float, row[1 + block :])) for row in shown)
    names = [n for n, z in zip(component_names(system.layout), shown[0, 1 : 1 + block], strict=True) if z]
    kinds = ", ".join(sorted({type(m).__name__ for m in case.problem.points.materials}))
    text = (
        f"{counts[0]} of {counts[1]} nodes have no stiffness ({', '.join(names)} of the node at "
        f"{place(places[0])} m): the energy of {kinds} doesn't depend on it"
    )
    return Finding("linear system", text, places, unknowns=tuple(names))


def _mechanism(case: _Case, replay: Replay) -> Finding | None:
    """A motion that the tangent doesn't resist and the forces work on."""
    system, weak = case.system, case.weak
    own, block = slice(0, system.nodes.owned), system.layout.block
    if weak is None:
        if not replay.singular:
            return None
        return Finding("linear system", f"{replay.reason} in iteration {len(replay.forces)}")
    motion = np.abs(weak.values.reshape(-1, block)) / system.as_force
    squares = np.sum(motion**2, axis=1)
    sums = system.comm.allreduce(np.array([squares.sum(), np.sum(squares**2)]))
    taking_part = sums[0] ** 2 / sums[1] if sums[1] > 0 else system.nodes.total
    local = taking_part < max(6.0, _LOCAL * system.nodes.total)
    curvature = abs(weak.curvature - system.diagonal_shift)
    nothing = curvature < _NOTHING
    if weak.share < _WORK or not (nothing or (local and curvature < _WEAK)):
        return None
    column = motion.argmax(axis=1) if len(motion) else np.zeros(0, dtype=int)
    top = motion[np.arange(len(motion)), column]
    table = np.column_stack([column, system.positions()[own]])
    shown = smallest(system.comm, -top, table)
    shown = shown[-shown[:, 0] > 0.2 * -shown[0, 0]]
    names = tuple(component_names(system.layout)[int(row[1])] for row in shown)
    places = tuple(tuple(map(float, row[2:])) for row in shown)
    top_node = np.zeros_like(system.x)
    here = (motion.max(axis=1) if len(motion) else top) >= -shown[0, 0]
    top_node[own][here] = 1.0
    ids = _points_at(case, top_node, np.asarray(places[0]))
    nodes = "; ".join(f"{name} at {place(x)}" for name, x in zip(names, places, strict=True))
    how = "is singular: it doesn't resist" if nothing else "hardly resists"
    there = names_of(case.problem, ids) or "no point there"
    text = (
        f"the tangent {how} a motion on which the load works, most of the nodes' {nodes} m, that is of "
        f"{there}; {_cure(case)}"
    )
    return Finding("linear system", text, places, ids, names)


def _cure(case: _Case) -> str:
    if isinstance(case.system, LoadedPoints):
        if case.system.interpolation.boxes is None:
            return "take more points a cell, a spline basis with boxes, or a ghost penalty"
        return "hold it, or take more points a cell"
    return "hold it, or connect what hangs together by these nodes alone"


def _points_at(case: _Case, node: np.ndarray, x: np.ndarray) -> tuple[int, ...]:
    """Ids of the points that a node at x reaches, the nearest five at most; `node` is one there."""
    case.system.nodes.update_ghosts(node)
    p, reached = case.problem.points, case.system.at_points(node)[:, 0] != 0.0
    distance = np.linalg.norm(p.x - x, axis=1)[reached]
    ids = own_ids(case.problem)[reached, None].astype(float)
    rows = smallest(case.system.comm, distance, ids, 20)
    return tuple(dict.fromkeys(int(row[1]) for row in rows))[:5]


def _few_points(case: _Case) -> Finding | None:
    """Too few points a cell for points that stand for themselves alone."""
    system, comm = case.system, case.system.comm
    if not isinstance(system, LoadedPoints) or system.interpolation.boxes is not None:
        return None
    if any(piece.name == "ghost" for piece in system.terms.pieces):
        return None
    grid, x, p = system.interpolation.grid, system.interpolation.reference.x, case.problem.points
    cells, first, number = np.unique(
        grid.cell_number(grid.cells_of(x)), return_index=True, return_counts=True
    )
    alone = number == 1
    sums = comm.allreduce(np.array([len(cells), len(x), int(alone.sum())]))
    volume = np.array([p.volume.sum(), float(np.prod(grid.sizes(grid.cells_of(x)), axis=1).sum())])
    volume = comm.allreduce(volume)  # cells that the body cuts have fewer points anyhow
    dense = volume[0] * _FEW**grid.dim <= volume[1]
    if not sums[0] or (dense and sums[2] < _ALONE * sums[0]):
        return None
    table = np.column_stack([p.id, x])[first[alone]]
    shown = smallest(comm, table[:, 0], table)
    ids = tuple(int(row[1]) for row in shown)
    places = tuple(tuple(map(float, row[2:])) for row in shown)
    at = f", such as that of point {ids[0]} at {place(places[0])} m" if ids else ""
    text = (
        f"{sums[1]} points in {sums[0]} cells are too few for basis "
        f"{system.interpolation.basis.name!r}: {sums[2]} cells have a single one{at}; take two or more in "
        "each direction (points_per_cell), ghost='thesis', or basis 'bspline'"
    )
    return Finding("too few points", text, places, ids)


def _limit_load(case: _Case) -> Finding | None:
    factor = case.problem.progress.factor
    if case.way == "arc length":
        return None
    if case.unstable and not case.problem.progress.step:
        kinds = ", ".join(sorted({type(m).__name__ for m in case.problem.points.materials}))
        return Finding(
            "linear system",
            f"the tangent of the unloaded body has a motion of negative stiffness: see the energy of {kinds}",
        )
    if case.unstable:
        said = "the last converged state is not stable: the tangent has a motion of negative stiffness"
    elif case.rate is not None and case.rate > _YIELDING:
        said = (
            f"the body gives way: at load factor {factor:.6g} the load moves it {case.rate:.2g} times as "
            "far, by load factor, as it did on the way"
        )
    else:
        return None
    return Finding(
        "limit load",
        f"{said}; the load may have reached its limit: follow the path by march_arc_length, or prescribe "
        "displacements",
    )


# course ----------------------------------------------------------------------------------------------------
def _course(case: _Case, replay: Replay) -> list[Finding]:
    """Where and how the iterations went wrong."""
    system, problem = case.system, case.problem
    found: list[Finding] = []
    found += filter(None, [divergence.too_large(problem, system, replay)])
    wrong = replay.wrong
    if problem.failed_at is not None and (wrong is None or case.way == "arc length"):
        wrong = divergence.Iterate(max(0, len(case.error.history) - 1), problem.failed_at, None)
    found += filter(None, [_iterations(case)])
    if wrong is not None:
        found += filter(None, [_where(case, wrong)])
    found += filter(None, [_equal_steps(case, replay)])
    return found


def _where(case: _Case, wrong: Iterate) -> Finding | None:
    """What is wrong at an iterate."""
    system, problem = case.system, case.problem
    if _not_finite(system, wrong.x):
        return None
    inverted = divergence.where_inverted(problem, system, wrong)
    if inverted is not None:
        return inverted
    if wrong.residual is not None and _not_finite(system, wrong.residual):
        return divergence.where_not_finite(problem, system, wrong)
    return divergence.where_unbalanced(problem, system, wrong)


def _ratios(forces: Sequence[float]) -> list[float]:
    return [b / a if a > 0 else math.inf for a, b in pairwise(forces)]


def _iterations(case: _Case) -> Finding | None:
    """Iterations that were still getting on, or have stopped near the tolerance, when there were no more."""
    controls, forces = case.problem.controls, [f for f, _ in case.error.history]
    if len(forces) - 1 < controls.max_iterations or not all(map(math.isfinite, forces)) or len(forces) < 3:
        return None
    last = _ratios(forces)[-2:]
    if max(last) < _FALLING:
        text = (
            f"the residual was still falling, by a factor of {np.prod(last) ** (1 / len(last)):.2g} in an "
            f"iteration: allow more than max_iterations={controls.max_iterations} (Controls), or take "
            "smaller load steps"
        )
        return Finding("iterations", text)
    if max(forces[-3:]) < 1e3 * max(controls.force_tolerance, 1e-13):
        text = (
            f"the force measure stays at {min(forces[-3:]):.2g}, near force_tolerance="
            f"{controls.force_tolerance:g}, which rounding may not allow here"
        )
        return Finding("iterations", text)
    return None


def _equal_steps(case: _Case, replay: Replay) -> Finding | None:
    """What to try where steps aren't cut."""
    if case.way != "equal":
        return None
    ratios = _ratios(replay.forces[1:])
    got_on = len(ratios) > 1 and ratios[0] < 1.0
    how = "at first the residual fell" if got_on else "the residual didn't fall from the first iteration on"
    text = f"{how}; equal load steps aren't cut (adaptive=False): try more steps, or march(adaptive=True)"
    return Finding("load steps", text)
