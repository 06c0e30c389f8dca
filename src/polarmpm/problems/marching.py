"""The march that a script iterates over: it says when none does."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Generator, Iterator
from functools import partial
from typing import Any

from ..errors import NotConverged
from ..solvers.stepping import Step
from ..tools.caller import line_of_script
from . import telling


class March(Iterator[Step]):
    """The steps of a march, one after the other, as they are asked for.

    Warns, on rank 0, when it is dropped before the first step: `problem.march(10)` alone solves nothing.

    Args:
        marching: makes the steps, of the problem, the schedule and what explains a failure.
        way: "equal", "adaptive" or "arc length", for the diagnosis.
    """

    def __init__(self, problem: Any, marching: Callable[..., Iterator[Step]], schedule: Any, way: str):
        self._problem, self._way = problem, way
        self._steps = marching(problem, schedule, partial(_explain, problem, way))
        self._begun = self._reported = False
        self._taken: list[Step] = []
        self._quiet = getattr(schedule, "progress", None) is False
        self._unused: Any = None
        if problem.comm.rank == 0:
            method = "march_arc_length" if way == "arc length" else "march"
            self._unused = weakref.finalize(self, _warn, method, *line_of_script())

    def __iter__(self) -> March:
        return self

    def __next__(self) -> Step:
        self._used()
        try:
            step = next(self._steps)
        except StopIteration:
            if not (self._reported or self._quiet) and self._problem.report:
                telling.report(self._problem, self._taken)
            self._reported = True
            raise
        self._taken.append(step)
        return step

    def close(self) -> None:
        """End the march where it is."""
        self._used()
        if isinstance(self._steps, Generator):
            self._steps.close()

    def _used(self) -> None:
        self._begun = True
        if self._unused is not None:
            self._unused.detach()
            self._unused = None

    def __repr__(self) -> str:
        state = "begun" if self._begun else "not begun"
        return f"{type(self).__name__}({self._way} steps, {state}, from {self._problem!r})"


def _explain(problem: Any, way: str, error: NotConverged) -> None:
    from . import diagnosis  # lazy import: most runs need none

    diagnosis.explain(problem, error, way)


def _warn(method: str, file: str, line: int) -> None:
    warnings.warn_explicit(
        f"problem.{method}(...) was never iterated, so that nothing has been solved: write "
        f"for step in problem.{method}(...):",
        UserWarning,
        file,
        line,
    )
