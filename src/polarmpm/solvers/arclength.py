"""Arc-length method: load steps measured along the path, past limit points of the load (docs/theory.md).

The load factor is an unknown. What is prescribed is the length s of a step, the root of the mean square
displacement increment of the body:

    r(x, f) = p(x) - e0 - f e1 = 0,    sum over the nodes of V |Du|^2 = s^2 sum of V.

Newton's method on both solves twice with one factor of the tangent: for the residual and for e1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..errors import InputError, LocalFailure
from ..tools import checks, progress
from ..tools.parallel import errors_on_all_ranks
from . import newton
from .linear import SingularTangent
from .newton import Controls, Outcome, expected_to_end
from .stepping import (
    BETWEEN,
    Explain,
    Step,
    Stepped,
    T,
    check_alone,
    failed,
    forgotten_at_end,
    note_sizes,
    restored_of,
    sizes_of,
)

_IDLE = 1e-11  # growth of the load factor in a step that loads have no part in
_LENGTH_TOLERANCE = 1e-8  # of a step's length; the state is an equilibrium however long the step is
# Least cosine between a step and its tangent; what is farther off may be another branch. If steps of a fifth
# of the first one's length bend as much, it is the path that does: where points unload it has a kink.
_BEND, _KINK, _SHORT = 0.8, 0.0, 0.2
_EASY = 6  # a step of at most so many iterations lets the next one grow
_BAR = "arc length {n} steps, {elapsed} {postfix}"


@dataclass(frozen=True)
class ArcSchedule:
    """How to follow a path; see `Problem.march_arc_length`."""

    first: float
    until: Callable[[Step], bool] | None = None
    largest: float | None = None
    smallest: float = 1e-3
    to: float | None = None
    steps: int | None = None
    progress: bool | None = None

    def __post_init__(self) -> None:
        first = check_length("first", self.first)
        checked: dict[str, Any] = {
            "first": first,
            "smallest": checks.number("smallest", self.smallest, **BETWEEN),
        }
        if self.largest is not None:
            checked["largest"] = check_length("largest", self.largest)
            if checked["largest"] < first:
                raise checks.refuse("largest", self.largest, f"at least first = {first!r}")
        if self.to is not None:
            checked["to"] = checks.number("to", self.to, allowed="a finite load factor")
        if self.steps is not None:
            checked["steps"] = checks.whole("steps", self.steps, least=1)
        if self.until is not None:
            what = "a function of the step that tells when to stop is"
            checks.function("until", self.until, what, takes=("step",))
        if self.progress is not None:
            checked["progress"] = checks.flag("progress", self.progress)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.until is None and self.to is None and self.steps is None:
            raise InputError("march_arc_length: one of until, to and steps has to tell where to stop")


def check_length(name: str, value: Any) -> float:
    """Length of a step along the path (m)."""
    return checks.number(name, value, above=0.0, allowed="a positive length (m)")


# what may depend on the load factor -----------------------------------------------------------------


def least_cosine(kink: bool) -> float:
    """Between a step and its tangent."""
    return _KINK if kink else _BEND


class PathSystem(newton.System, Protocol):
    """What following a path needs of a nonlinear system, beside what Newton's method needs.

    Attributes:
        comm: its ranks.
        dim: leading components of a node's unknowns that are displacements.
        owned: nodes of this rank that it owns, the first ones.
        x: nodal increments (nodes, block).
        residual: of the last evaluation (nodes, block).
    """

    comm: MPI.Comm
    x: np.ndarray
    residual: np.ndarray

    @property
    def dim(self) -> int: ...

    @property
    def owned(self) -> int: ...

    def put_external(self, forces: np.ndarray) -> None: ...

    def solve_free(self, forces: np.ndarray, fresh: bool) -> np.ndarray: ...

    def add(self, step: np.ndarray) -> None: ...

    def jump(self, x: np.ndarray) -> None: ...


# one step ---------------------------------------------------------------------------------------------
class _Unsettled(Exception):
    """There is no equilibrium at the load factor of before."""

    def __str__(self) -> str:
        return f"out of balance from the start: {self.args[0]}"


@dataclass
class Path:
    """The equations of a step.

    Attributes:
        loads: e0 and e1, forces on the nodes (nodes, block).
        volume: of the nodes (nodes,); complete on owned rows.
        length: s (m).
        factor: the load factor, an unknown.
        sense: positive for a direction (nodes, block) in which the path goes on.
        bend: least cosine between the step and its tangent.
    """

    system: PathSystem
    loads: tuple[np.ndarray, np.ndarray]
    volume: np.ndarray
    length: float
    factor: float
    sense: Callable[[np.ndarray], float]
    bend: float = _BEND

    def __post_init__(self) -> None:
        self.own = slice(0, self.system.owned)
        self.begin = self.factor
        self.start: np.ndarray = self.system.x.copy()
        self.size = self.length**2 * self.system.comm.allreduce(float(self.volume[self.own].sum()))
        self.forward: np.ndarray | None = None  # the first correction; None: still at the start
        self.growth = 0.0  # of the load factor in the last correction
        self.settled = False
        self.left: np.ndarray | None = None  # out of balance at `start`, where that has been relaxed

    def inner(self, a: np.ndarray, b: np.ndarray) -> float:
        """Sum of V a . b over all nodes, displacements only. Collective."""
        d = self.system.dim
        here = np.einsum("n,ni,ni->", self.volume[self.own], a[self.own, :d], b[self.own, :d])
        return float(self.system.comm.allreduce(here))

    @property
    def increment(self) -> np.ndarray:
        increment: np.ndarray = self.system.x - self.start
        return increment

    @property
    def idles(self) -> bool:
        """Whether the load factor has stayed as it was but for rounding: nothing resists the motion."""
        return abs(self.factor - self.begin) <= _IDLE * max(1.0, abs(self.begin))

    def put_load(self) -> None:
        """Put the load of the present factor into the system."""
        self.system.put_external(self.loads[0] + self.factor * self.loads[1])

    def excess(self) -> float:
        """(length / s)^2 - 1."""
        excess: float = self.inner(self.increment, self.increment) / self.size - 1.0
        return excess

    def predict(self, controls: Controls, outcome: Outcome) -> None:
        """Along the tangent, with what the state at the start relaxes; if that is much of the step, relax it
        only, at the load factor of before: after a reset, or where loads are there from the start."""
        relaxed, along = self._solutions()
        if not self.settled and self.inner(relaxed, relaxed) > 0.25 * self.size:
            inner = newton.solve(self.system, controls)
            outcome.history += inner.history[1:-1]
            if not inner.converged:
                raise _Unsettled(inner.reason)
            self.start, self.settled = self.system.x.copy(), True
            self.left = self.system.residual.copy()
            return
        square = self.inner(along, along)
        if square == 0.0:
            raise SingularTangent("the load moves nothing")
        growth = math.copysign(math.sqrt(self.size / square), self.sense(along))
        self.forward = growth * along
        self._add(self.forward + relaxed, growth)

    def correct(self) -> None:
        """One iteration on residual and length."""
        relaxed, along = self._solutions()
        now = self.increment
        slope = 2.0 * self.inner(now, along)
        if slope == 0.0:
            raise SingularTangent("the path is at right angles to the step")
        growth = -(self.excess() * self.size + 2.0 * self.inner(now, relaxed)) / slope
        self._add(relaxed + growth * along, growth)

    def _solutions(self) -> tuple[np.ndarray, np.ndarray]:
        relaxed = self.system.solve_free(-self.system.residual, fresh=True)
        return relaxed, self.system.solve_free(self.loads[1], fresh=False)

    def _add(self, correction: np.ndarray, growth: float) -> None:
        self.system.add(correction)
        self.growth = growth
        self.factor += growth
        self.put_load()

    def backtrack(self) -> bool:
        """Take back half of the last correction; False if there is none in this step."""
        if not self.system.backtrack():
            return False
        self.growth *= 0.5
        self.factor -= self.growth
        self.put_load()
        return True


def solve(path: Path, controls: Controls, to: float | None) -> Outcome:
    """Find the state at the end of a step; its load factor is then in `path`. Collective.

    A step that would lead past the load factor `to` ends there.
    """
    outcome = Outcome()
    path.put_load()
    try:
        _iterate(path, controls, outcome)
    except (LocalFailure, SingularTangent, _Unsettled) as e:
        outcome.converged, outcome.reason = False, str(e)
    if outcome.converged and path.idles:
        outcome.converged, outcome.reason = False, "moved on while the loads stayed as they were"
    if outcome.converged and to is not None and path.begin != to:
        share = (to - path.begin) / (path.factor - path.begin) if path.factor != path.begin else 2.0
        if 0.0 < share <= 1.0:
            return _stop_at(path, controls, to, share, outcome.history)
    return outcome


def _stop_at(
    path: Path, controls: Controls, to: float, share: float, history: list[tuple[float, float]]
) -> Outcome:
    """Newton's method at a load factor, from between the step's two ends."""
    path.system.jump(path.start + share * path.increment)
    path.factor = to
    path.put_load()
    outcome = newton.solve(path.system, controls)
    outcome.history[:0] = history[:-1]
    if outcome.converged and path.excess() > 0.5:
        outcome.converged, outcome.reason = False, "left the path"
    return outcome


def _iterate(path: Path, controls: Controls, outcome: Outcome) -> None:
    system, tangent = path.system, True
    while True:
        newton.evaluate(system, tangent, path.backtrack)
        force, energy = system.convergence_measures()
        outcome.history.append((force, energy))
        if not math.isfinite(force) or force > controls.divergence:
            outcome.reason = f"diverged (force measure {force:.3g})"
            return
        if path.forward is not None:
            balanced = force < controls.force_tolerance or energy < controls.energy_tolerance
            if balanced and abs(path.excess()) < _LENGTH_TOLERANCE:
                cosine = path.inner(path.increment, path.forward) / path.size
                outcome.converged = cosine > path.bend
                outcome.reason = "" if outcome.converged else f"turned off the tangent (cosine {cosine:.2g})"
                return
        if outcome.iterations >= controls.max_iterations:
            outcome.reason = (
                f"no convergence in {controls.max_iterations} iterations (force measure {force:.3g}, "
                f"length off by {path.excess():.3g})"
            )
            return
        if not tangent:
            system.evaluate(True)
        if path.forward is None:
            path.predict(controls, outcome)
        else:
            path.correct()
            tangent = not expected_to_end(outcome, controls)


# the march --------------------------------------------------------------------------------------------
class Marching(Stepped, Protocol):
    """What following a path needs of a problem."""

    def attempt_along(self, length: float, to: float | None, kink: bool = False) -> tuple[Outcome, float]: ...

    def whole(self, work: Callable[[], T]) -> T:
        """Do work as a whole or, if anything ends it early, not at all."""


def march(problem: Marching, schedule: ArcSchedule, explain: Explain | None = None) -> Iterator[Step]:
    """Converged steps; see `Problem.march_arc_length`. `explain` as of `stepping.march`."""
    with progress.bar(False if problem.comm.rank else schedule.progress, bar_format=_BAR) as bar:
        steps = enumerate(forgotten_at_end(problem, _steps(problem, schedule, explain)), 1)

        def take() -> tuple[Step | None, bool]:
            done, step = next(steps, (0, None))
            if step is None:
                return None, True
            problem.steps.append(step)
            stop = False
            if schedule.until is not None:
                with errors_on_all_ranks(problem.comm, "until"):
                    stop = checks.flag("until returned", schedule.until(step))
            stop = problem.comm.bcast(stop) or done == schedule.steps
            bar.update()
            bar.set_postfix_str(f"load factor {step.factor:.6g}, {step.iterations} iterations")
            return step, stop

        stop = False
        while not stop:
            step, stop = problem.whole(take)
            if step is not None:
                yield step


def _steps(problem: Marching, schedule: ArcSchedule, explain: Explain | None) -> Iterator[Step]:
    length, largest = schedule.first, schedule.largest or schedule.first
    last: Step | None = None
    length = (sizes_of(problem, schedule) or [length])[0]
    while schedule.to is None or problem.progress.factor != schedule.to:
        check_alone(problem, last)
        tried: list[str] = []
        begin = problem.progress.factor
        while True:
            kink = length < _SHORT * schedule.first
            outcome, aim = problem.attempt_along(length, schedule.to, kink)
            if outcome.converged:
                break
            tried.append(
                f"length {length:.6g} m from load factor {begin:.6g}, at load factor {aim:.6g}: "
                f"{outcome.reason} after {outcome.iterations} iterations"
            )
            length *= 0.5
            if length < schedule.smallest * schedule.first:
                raise failed(problem, aim, outcome.history, tried, explain)
        if outcome.iterations <= _EASY:
            length = min(1.5 * length, largest)
        note_sizes(problem, schedule, [length])
        last = Step(
            problem.progress.step,
            problem.progress.factor,
            tuple(outcome.history),
            len(tried),
            outcome.unresolved,
            restored_of(problem),
        )
        yield last
