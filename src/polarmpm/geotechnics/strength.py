"""Factors of safety by strength reduction: trials with ever less strength, and where the body fails."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, NotConverged
from ..problems.base import Problem
from ..solvers.stepping import Step
from ..tools import checks

Make = Callable[[float], Problem]
March = Callable[[Problem], Iterable[Step]]

_MOST = 40  # trials
_WIDEN = 1.25  # by which the range grows where one of its ends isn't on the side it should be


@dataclass(frozen=True)
class Trial:
    """One computation with reduced strength.

    Attributes:
        factor: by which the strength is divided.
        displacement: the largest one (m) of a point in the last converged step.
        converged: all load steps found an equilibrium. (A trial that is over because of its displacement
            hasn't got to the end either, but wasn't stopped by that.)
        stands: by the criterion of failure, see `strength_reduction`.
        load: load factor reached.
        iterations: of all its steps.
        reason: why it failed, in words; empty where the body stands.
    """

    factor: float
    displacement: float
    converged: bool
    stands: bool
    load: float
    iterations: int
    reason: str = ""


@dataclass(frozen=True, repr=False)
class StrengthReduction:
    """What `strength_reduction` has found.

    Attributes:
        factor: (low, high): the body stands with its strength divided by `low`, and fails with `high`.
        trials: each `Trial`, in the order in which they were made.
        limit: displacement (m) that counts as failure.
        reference: displacement (m) of the body if it stayed elastic, of which `limit` is a multiple; None
            where `limit` was given.
        standing, failed: problems of the trials at the ends of the bracket. The failed one is at its last
            equilibrium, or where its displacement was too large.
    """

    factor: tuple[float, float]
    trials: tuple[Trial, ...]
    limit: float
    reference: float | None
    standing: Problem
    failed: Problem

    def __repr__(self) -> str:
        low, high = self.factor
        return f"<StrengthReduction: factor of safety {low:.4g} to {high:.4g}, {len(self.trials)} trials>"

    @property
    def middle(self) -> float:
        """Of the bracket."""
        return 0.5 * (self.factor[0] + self.factor[1])

    def plot(self, ax: Any = None, *, length: tuple[float, str] = (1.0, "m")) -> Any:
        """Largest displacement over the factor: trials that stand, those that fail, the bracket between.

        Args:
            ax: axes to draw into; None makes a figure, see `plot.figures.save`.
            length: factor and unit of displacements, such as (1e3, "mm").

        Returns:
            The matplotlib axes on rank 0, None elsewhere.

        Raises:
            InputError: not axes in the plane.
        """
        from .drawing import draw_trials

        return draw_trials(self, ax, length)


def strength_reduction(
    make: Make,
    *,
    low: float = 1.0,
    high: float = 2.0,
    width: float = 0.02,
    growth: float = 5.0,
    limit: float | None = None,
    steps: int = 4,
    smallest: float = 0.25,
    march: March | None = None,
    report: Callable[[Trial], Any] | None = None,
) -> StrengthReduction:
    """The factor by which the strength of a body may be divided until it fails, as a bracket. Collective.

    A trial computes the body under its loads with reduced strength, from the beginning. **It fails** where a
    load step finds no equilibrium, or where the largest displacement of a point exceeds `growth` times that
    of the body if it were elastic. This is what it moves in the first load step of the first trial, divided
    by the load factor there. The criterion has no dimension; near failure displacements grow so fast that
    the factor hardly depends on `growth`: docs/soils.md measures it. Trials between the last that stands and
    the first that fails halve the bracket down to `width`.

    Args:
        make: of a factor, a problem with supports and loads whose strength is divided by it, see `reduced`.
            Problems that have been taken through stages before (initial stresses, excavation) and then are
            left to stand need a `limit` and a `march`.
        low, high: where the factor is sought. Where the body fails with `low`, or stands with `high`, the
            search goes on beyond.
        width: of the bracket, at most.
        growth: see above, > 1.
        limit: displacement (m) that counts as failure, in place of `growth`.
        steps: load steps of a trial, which are cut where they find no equilibrium;
        smallest: down to this share.
        march: of a problem, its load steps, in place of `problem.march(steps, adaptive=True, ...)`.
        report: called with each trial as soon as it is there, such as `print`.

    Raises:
        InputError: an argument is out of range; `make` doesn't give a problem, or the same again; the body
            stands, or fails, whatever the factor; it doesn't move in its first step, so that a `limit` is
            needed.
    """
    low = checks.number("low", low, above=0.0)
    high = checks.number("high", high, above=low, allowed=f"a factor above low = {low:g}")
    width = checks.number("width", width, above=0.0)
    growth = checks.number("growth", growth, above=1.0)
    limit = None if limit is None else checks.number("limit", limit, above=0.0)
    steps = checks.whole("steps", steps, least=1)
    smallest = checks.number("smallest", smallest, above=0.0, most=1.0)
    checks.function("make", make, "a function of the factor that makes a problem is", takes=("factor",))
    if march is not None:
        checks.function(
            "march", march, "a function of a problem that yields its steps is", takes=("problem",)
        )
    if report is not None:
        checks.function("report", report, takes=("trial",))
    search = _Search(make, march or _Steps(steps, smallest), growth, limit, report)
    return search.run(low, high, width)


@dataclass(frozen=True)
class _Steps:
    """The march of a trial, unless the script has another one."""

    steps: int
    smallest: float

    def __call__(self, problem: Problem) -> Iterable[Step]:
        # collapse is what is looked for: creep would find the same, with twice the iterations
        return problem.march(self.steps, adaptive=True, smallest=self.smallest, progress=False, creep=False)


class _Search:
    """Trials, and the bracket that they make.

    Attributes:
        kept: the problems at the ends of the bracket, by whether they stand.
    """

    def __init__(
        self,
        make: Make,
        march: March,
        growth: float,
        limit: float | None,
        report: Callable[[Trial], Any] | None,
    ):
        self.make, self.march, self.growth, self.limit, self.report = make, march, growth, limit, report
        self.reference: float | None = None
        self.trials: list[Trial] = []
        self.kept: dict[bool, Problem] = {}

    def run(self, low: float, high: float, width: float) -> StrengthReduction:
        if self._stands(low):
            while self._stands(high):
                low, high = high, high * _WIDEN
        else:
            low, high = low / _WIDEN, low
            while not self._stands(low):
                low, high = low / _WIDEN, low
        while high - low > width * (1 + 1e-12):
            middle = 0.5 * (low + high)
            if not low < middle < high:
                break  # neighbouring numbers
            if self._stands(middle):
                low = middle
            else:
                high = middle
        assert self.limit is not None
        return StrengthReduction(
            (low, high), tuple(self.trials), self.limit, self.reference, self.kept[True], self.kept[False]
        )

    def _stands(self, factor: float) -> bool:
        """Make a trial."""
        if len(self.trials) >= _MOST:
            what = "stands" if self.trials[-1].stands else "fails"
            raise InputError(
                f"strength_reduction: the body {what} with the factor {self.trials[-1].factor:.4g}, after "
                f"{_MOST} trials; give low, high and width so that fewer are needed"
            )
        problem = self.make(factor)
        checks.instance(f"make: make({factor:g})", problem, Problem, "a problem is")
        if any(problem is other for other in self.kept.values()):
            raise InputError("make: gives the same problem twice; each trial needs one of its own")
        trial = self._trial(problem, factor)
        self.trials.append(trial)
        if trial.stands in self.kept:
            self.kept[trial.stands].close()
        self.kept[trial.stands] = problem
        if self.report is not None:
            self.report(trial)
        return trial.stands

    def _trial(self, problem: Problem, factor: float) -> Trial:
        load, iterations, moved, reason, converged = problem.progress.factor, 0, 0.0, "", True
        try:
            for step in self.march(problem):
                load, moved, iterations = step.factor, _largest(problem), iterations + step.iterations
                self._refer(moved, load)
                assert self.limit is not None
                if moved > self.limit:
                    reason = f"a displacement of {moved:.4g} m, beyond {self.limit:.4g} m"
                    break
        except NotConverged as e:
            converged = False
            reason = f"no equilibrium at load factor {e.factor:.4g}"
        return Trial(factor, moved, converged, not reason, load, iterations, reason)

    def _refer(self, moved: float, load: float) -> None:
        """After the first converged step of all: what counts as failure."""
        if self.limit is not None:
            return
        if not (math.isfinite(load) and load > 0 and moved > 0):
            raise InputError(
                f"limit = None: in the first load step, to the factor {load:g}, the body moves by {moved:g} "
                "m, of which no displacement at failure can be told; a limit (m) is needed"
            )
        self.reference = moved / load
        self.limit = self.growth * self.reference


def _largest(problem: Problem) -> float:
    """Displacement (m) of the point that has moved farthest, over all ranks."""
    u = problem.points.displacement
    own = float(np.sqrt(np.max(np.sum(u * u, axis=1)))) if len(u) else 0.0
    return float(problem.comm.allreduce(own, op=MPI.MAX))
