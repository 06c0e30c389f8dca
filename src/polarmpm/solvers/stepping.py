"""Load stepping: a fixed number of steps, or steps that adapt."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np
from tqdm import tqdm

from ..errors import InputError, NotConverged
from .newton import Outcome


class Marching(Protocol):
    """What stepping needs of a problem."""

    comm: MPI.Comm
    progress: Any
    steps: list[Step]

    def attempt(self, factor: float) -> Outcome: ...


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
    """

    number: int
    factor: float
    history: tuple[tuple[float, float], ...]
    cuts: int
    unresolved: float | None = None

    @property
    def iterations(self) -> int:
        """Linear solves."""
        return len(self.history) - 1

    def __repr__(self) -> str:
        force = f"{self.history[-1][0]:.2g}" if self.history else "unknown"
        unresolved = "" if self.unresolved is None else f", {100 * self.unresolved:.2g} % unresolved"
        return (
            f"Step(number={self.number}, factor={self.factor:.9g}, {self.iterations} iterations, "
            f"force measure {force}, {self.cuts} cuts{unresolved})"
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
    """

    steps: int | None = None
    to: float = 1.0
    adaptive: bool = False
    smallest: float = 1e-3
    largest: float | None = None
    easy: int = 6
    progress: bool | None = None

    def __post_init__(self) -> None:
        steps, largest = self.steps, self.largest
        if steps is None and not self.adaptive:
            raise InputError("steps: a number of steps is needed unless adaptive=True")
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 1):
            raise InputError(f"steps = {steps!r}: a positive whole number")
        if not math.isfinite(self.to):
            raise InputError(f"to = {self.to!r}: a finite load factor")
        if not 0 < self.smallest <= 1:
            raise InputError(f"smallest = {self.smallest!r}: between 0 and 1")
        if largest is not None and not (self.adaptive and math.isfinite(largest) and largest > 0):
            raise InputError(f"largest = {largest!r}: a positive load factor increment, with adaptive=True")

    @property
    def number(self) -> int:
        """Number of equal steps; the first adaptive step is one of so many."""
        return self.steps or _STEPS


_STEPS = 10  # of which the first adaptive one is a part, unless a number is given


Explain = Callable[[NotConverged], None]


def march(problem: Marching, schedule: Schedule, explain: Explain | None = None) -> Iterator[Step]:
    """Steps to the final factor; see `Problem.march`.

    Args:
        explain: puts into an error that is about to be raised why the step has failed.
    """
    hidden = (not schedule.progress) if schedule.progress is not None else None
    if problem.comm.rank:
        hidden = True
    with tqdm(total=100, unit="%", disable=hidden, bar_format=_BAR) as bar:
        stepper = _adaptive if schedule.adaptive else _equal
        begin = problem.progress.factor
        for step in stepper(problem, schedule, explain):
            problem.steps.append(step)
            share = (step.factor - begin) / (schedule.to - begin) if schedule.to != begin else 1.0
            bar.update(100 * share - bar.n)
            force = step.history[-1][0]
            bar.set_postfix_str(f"step {step.number}, {step.iterations} iterations, residual {force:.1e}")
            yield step


_BAR = "{desc}{percentage:3.0f}%|{bar}| {elapsed} {postfix}"


def _attempt(problem: Marching, factor: float, tried: list[str]) -> Step | Outcome:
    outcome = problem.attempt(factor)
    if not outcome.converged:
        tried.append(f"load factor {factor:.6g}: {outcome.reason} after {outcome.iterations} iterations")
        return outcome
    return Step(problem.progress.step, factor, tuple(outcome.history), len(tried), outcome.unresolved)


def failed(
    factor: float, history: Sequence[tuple[float, float]], tried: Sequence[str], explain: Explain | None
) -> NotConverged:
    """The error to raise, explained."""
    error = NotConverged(factor, history, tried)
    if explain is not None:
        explain(error)
    return error


def _equal(problem: Marching, schedule: Schedule, explain: Explain | None) -> Iterator[Step]:
    begin = problem.progress.factor
    for k in range(1, schedule.number + 1):
        factor = schedule.to if k == schedule.number else _part(begin, schedule.to, k / schedule.number)
        tried: list[str] = []
        step = _attempt(problem, factor, tried)
        if isinstance(step, Outcome):
            raise failed(factor, step.history, tried, explain)
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
    first = (schedule.to - problem.progress.factor) / schedule.number
    largest = first if schedule.largest is None else math.copysign(schedule.largest, first)
    size = min(first, largest, key=abs)
    while problem.progress.factor != schedule.to:
        tried: list[str] = []
        while True:
            begin = problem.progress.factor
            left = schedule.to - begin
            # the last step takes what is left, so that none is tiny
            factor = schedule.to if abs(left) <= 1.000001 * abs(size) else begin + size
            step = _attempt(problem, factor, tried)
            if isinstance(step, Step):
                break
            size = 0.5 * min(size, left, key=abs)
            if abs(size) < schedule.smallest * abs(first):
                raise failed(factor, step.history, tried, explain)
        if step.iterations <= schedule.easy:
            size = min(1.5 * size, largest, key=abs)
        yield step
