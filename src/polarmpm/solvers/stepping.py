"""Load stepping: a fixed number of steps, or steps that adapt."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Protocol, TypeVar

from mpi4py import MPI

import numpy as np

from ..errors import InputError, NotConverged
from ..tools import checks, progress
from .newton import Outcome

T = TypeVar("T")


class Stepped(Protocol):
    """How far a problem has come."""

    comm: MPI.Comm
    progress: Any
    steps: list[Step]


class Marching(Stepped, Protocol):
    """What stepping needs of a problem."""

    def attempt(self, factor: float) -> Outcome: ...

    def attempt_creeping(self, factor: float) -> Outcome:
        """Another way, where `attempt` has failed and no shorter step is to be tried."""

    def suited(self, size: float) -> float:
        """How long a step should be, after one of `size`, where errors are controlled."""

    def whole(self, work: Callable[[], T]) -> T:
        """Do work as a whole or, if anything ends it early, not at all."""


@dataclass(eq=False)
class Restored:
    """What a run knows that goes on from a restart file; output files are continued by it.

    Attributes:
        number: steps up to the saved state.
        steps: those that are known, by their numbers; all of them unless the script has taken some away.
        sizes: what the march was called with, and its step sizes after the saved state, see `sizes_of`.
        continued: the output files that this run has gone on with so far.
    """

    number: int
    steps: dict[int, Step]
    sizes: tuple[str, list[float]] | None = None
    continued: set[Any] = field(default_factory=set)


@dataclass(frozen=True)
class Step:
    """A converged load step.

    Attributes:
        number: 1 for the first.
        factor: load factor reached.
        history: (force, energy) measures before the first and after every iteration, T (2.53)-(2.54).
        cuts: failed attempts before this one.
        unresolved: share of the step's work that is done inside the points' boxes, where neither the grid nor
            the points resolve it; None where points have no boxes.
        restored: of a run that goes on from a restart file; None: it began with the undeformed body.
        regrids: how often `regrid=` changed the grid before it was solved; see `problem.regrids`.
    """

    number: int
    factor: float
    history: tuple[tuple[float, float], ...]
    cuts: int
    unresolved: float | None = None
    restored: Restored | None = field(default=None, compare=False, repr=False)
    regrids: int = 0

    @property
    def iterations(self) -> int:
        """Linear solves."""
        return len(self.history) - 1

    @property
    def time(self) -> float:
        """Time reached (s), in a dynamic problem, where it stands for the load factor."""
        return self.factor

    def __repr__(self) -> str:
        force = f"{self.history[-1][0]:.2g}" if self.history else "unknown"
        unresolved = "" if self.unresolved is None else f", {100 * self.unresolved:.2g} % unresolved"
        return (
            f"Step(number={self.number}, factor={self.factor:.9g}, {self.iterations} iterations, "
            f"force measure {force}, {self.cuts} cuts{unresolved}{', in another grid' * bool(self.regrids)})"
        )


@dataclass(frozen=True)
class Schedule:
    """How to reach the final load factor; see `Problem.march`.

    Attributes:
        steps: number of equal steps; for adaptive stepping the first and largest step follows from it (10
            unless given).
        to: final load factor.
        adaptive: cut and retry a failed step, grow after easy ones.
        smallest: smallest adaptive step, relative to the first one.
        largest: load factor increment to which adaptive steps may grow; None: the first one.
        easy: a step of at most so many iterations lets the next one grow.
        progress: progress bar; None shows it on a terminal only.
        controlled: adaptive steps are as long as their error allows, see `Marching.suited`.
        creep: a step that fails for good is followed as the body creeps.
    """

    steps: int | None = None
    to: float = 1.0
    adaptive: bool = False
    smallest: float = 1e-3
    largest: float | None = None
    easy: int = 6
    progress: bool | None = None
    controlled: bool = False
    creep: bool = True

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            "adaptive": checks.flag("adaptive", self.adaptive),
            "to": checks.number("to", self.to, allowed="a finite load factor"),
            "smallest": checks.number("smallest", self.smallest, **BETWEEN),
            "easy": checks.whole("easy", self.easy, least=0),
            "creep": checks.flag("creep", self.creep),
        }
        if self.steps is not None:
            checked["steps"] = checks.whole("steps", self.steps, least=1)
        elif not self.adaptive:
            raise InputError("steps: a number of steps is needed unless adaptive=True")
        if self.largest is not None:
            allowed = "a positive load factor increment, with adaptive=True"
            if not self.adaptive:
                raise checks.refuse("largest", self.largest, allowed)
            checked["largest"] = checks.number("largest", self.largest, above=0.0, allowed=allowed)
        if self.progress is not None:
            checked["progress"] = checks.flag("progress", self.progress)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def number(self) -> int:
        """Number of equal steps; the first adaptive step is one of so many."""
        return self.steps or _STEPS


# what `smallest` may be: of a first step
BETWEEN: dict[str, Any] = {"above": 0.0, "most": 1.0, "allowed": "a number above 0 and of at most 1"}
_STEPS = 10  # of which the first adaptive one is a part, unless a number is given


Explain = Callable[[NotConverged], None]


def march(problem: Marching, schedule: Schedule, explain: Explain | None = None) -> Iterator[Step]:
    """Steps to the final factor; see `Problem.march`.

    Args:
        explain: puts into an error that is about to be raised why the step has failed.
    """
    with progress.bar(
        False if problem.comm.rank else schedule.progress, total=100, unit="%", bar_format=_BAR
    ) as bar:
        stepper = _adaptive if schedule.adaptive else _equal
        begin = problem.progress.factor
        steps = forgotten_at_end(problem, stepper(problem, schedule, explain))

        def take() -> Step | None:
            step = next(steps, None)
            if step is not None:
                problem.steps.append(step)
                share = (step.factor - begin) / (schedule.to - begin) if schedule.to != begin else 1.0
                bar.update(100 * share - bar.n)
                force = step.history[-1][0]
                what = f"step {step.number}, {step.iterations} iterations, residual {force:.1e}"
                bar.set_postfix_str(what + ", in another grid" * bool(step.regrids))
            return step

        while (step := problem.whole(take)) is not None:
            yield step


_BAR = "{desc}{percentage:3.0f}%|{bar}| {elapsed} {postfix}"


def check_alone(problem: Stepped, last: Step | None) -> None:
    """Raise InputError if something else has taken the problem on since a march's last step."""
    p = problem.progress
    if last is not None and (p.step, p.factor) != (last.number, last.factor):
        raise InputError(
            f"march: since its step {last.number} to load factor {last.factor:g} the problem has been taken "
            f"on to step {p.step} at {p.factor:g}, by another march or attempt; one march at a time"
        )


def restored_of(problem: Any) -> Restored | None:
    """What a problem knows of the run before, if it goes on from a restart file."""
    found: Restored | None = getattr(problem, "restored", None)
    return found


def sizes_of(problem: Any, schedule: Any) -> list[float]:
    """Step sizes with which a march that was interrupted by a restart goes on, if it is called with the same
    arguments; else nothing. They are what `note_sizes` has noted."""
    run = restored_of(problem)
    here = run is not None and run.number == problem.progress.step
    return run.sizes[1] if run and here and run.sizes and run.sizes[0] == _called(schedule) else []


def note_sizes(problem: Any, schedule: Any, sizes: list[float]) -> None:
    """Note step sizes for a restart file."""
    problem.step_sizes = _called(schedule), sizes


def forgotten_at_end(problem: Any, steps: Iterator[Step]) -> Iterator[Step]:
    """The steps of a march, whose sizes are forgotten when it ends: then there is nothing to go on with."""
    try:
        yield from steps
    finally:
        problem.step_sizes = None


def _called(schedule: Any) -> str:
    given = vars(schedule).items()
    return repr({name: value for name, value in given if name not in ("progress", "until")})


def _attempt(problem: Marching, factor: float, tried: list[str], creep: bool) -> Step | Outcome:
    """Try a step; `creep`: also as the body creeps."""
    outcome = problem.attempt(factor)
    if not outcome.converged and creep:
        crept = problem.attempt_creeping(factor)
        if crept.converged:
            crept.history[:0] = outcome.history
            outcome = crept
    if not outcome.converged:
        tried.append(
            f"{clock_of(problem)} {factor:.6g}: {outcome.reason} after {outcome.iterations} iterations"
        )
        return outcome
    reached, history = problem.progress.step, tuple(outcome.history)
    run, found = restored_of(problem), outcome
    return Step(reached, factor, history, len(tried), found.unresolved, run, found.regrids)


def clock_of(problem: Any) -> str:
    """What its steps count: the load factor, or in dynamic problems the time."""
    return str(getattr(problem, "clock", "load factor"))


def failed(
    problem: Any,
    factor: float,
    history: Sequence[tuple[float, float]],
    tried: Sequence[str],
    explain: Explain | None,
) -> NotConverged:
    """The error to raise, explained."""
    error = NotConverged(factor, history, tried, clock_of(problem))
    if explain is not None:
        explain(error)
    return error


def _equal(problem: Marching, schedule: Schedule, explain: Explain | None) -> Iterator[Step]:
    begin, last = problem.progress.factor, None
    for k in range(1, schedule.number + 1):
        check_alone(problem, last)
        factor = schedule.to if k == schedule.number else _part(begin, schedule.to, k / schedule.number)
        tried: list[str] = []
        step = _attempt(problem, factor, tried, schedule.creep)
        if isinstance(step, Outcome):
            raise failed(problem, factor, step.history, tried, explain)
        last = step
        yield step


def _part(begin: float, end: float, share: float) -> float:
    """begin + (end - begin) share, so that a run that was restarted on the way passes the very same numbers.

    As a rule they are fractions of the end with a small denominator, of which rounding leaves no doubt.
    """
    unit = end or 1.0
    part = begin / unit + (end / unit - begin / unit) * share
    simple = Fraction(part).limit_denominator(_DENOMINATOR)
    if abs(part - float(simple)) <= _FEW_DIGITS * max(1.0, abs(begin / unit)):
        part = float(simple)
    return unit * part


_DENOMINATOR = 10**6  # different fractions are 1e-12 apart
_FEW_DIGITS = 8 * float(np.finfo(float).eps)


def _adaptive(problem: Marching, schedule: Schedule, explain: Explain | None) -> Iterator[Step]:
    before = sizes_of(problem, schedule)
    first = before[0] if before else (schedule.to - problem.progress.factor) / schedule.number
    largest = first if schedule.largest is None else math.copysign(schedule.largest, first)
    size, last = before[1] if before else min(first, largest, key=abs), None
    while problem.progress.factor != schedule.to:
        check_alone(problem, last)
        tried: list[str] = []
        while True:
            begin = problem.progress.factor
            left = schedule.to - begin
            # the last step takes what is left, so that none is tiny
            factor = schedule.to if abs(left) <= 1.000001 * abs(size) else begin + size
            half = 0.5 * min(size, left, key=abs)
            shortest = abs(half) < schedule.smallest * abs(first)
            step = _attempt(problem, factor, tried, shortest and schedule.creep)
            if isinstance(step, Step):
                break
            size = half
            if shortest:
                raise failed(problem, factor, step.history, tried, explain)
        if schedule.controlled:
            size = min(problem.suited(size), largest, key=abs)
        elif step.iterations <= schedule.easy:
            size = min(1.5 * size, largest, key=abs)
        last = step
        note_sizes(problem, schedule, [first, size])
        yield step
