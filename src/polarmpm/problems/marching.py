"""The march that a script iterates over: says when it never does, and why a step has failed."""

from __future__ import annotations

import sys
import warnings
import weakref
from collections.abc import Generator, Iterator
from typing import Any

from ..errors import NotConverged
from ..solvers.stepping import Step


class March(Iterator[Step]):
    """The steps of a march, one after the other, as they are asked for.

    Warns, on rank 0, when it is dropped before the first step: `problem.march(10)` alone solves nothing.

    Args:
        steps: makes them.
        way: "equal", "adaptive" or "arc length", for the diagnosis.
    """

    def __init__(self, problem: Any, steps: Iterator[Step], way: str):
        self._problem, self._steps, self._way = problem, steps, way
        self._unused: Any = None
        if problem.comm.rank == 0:
            script = sys._getframe(2)  # the line that has called problem.march
            method = "march_arc_length" if way == "arc length" else "march"
            line = script.f_code.co_filename, script.f_lineno
            self._unused = weakref.finalize(self, _warn, method, *line)

    def __iter__(self) -> March:
        return self

    def __next__(self) -> Step:
        self._used()
        try:
            return next(self._steps)
        except NotConverged as error:
            from . import diagnosis  # lazy import: most runs need none

            diagnosis.explain(self._problem, error, self._way)
            raise

    def close(self) -> None:
        """End the march where it is."""
        self._used()
        if isinstance(self._steps, Generator):
            self._steps.close()

    def _used(self) -> None:
        if self._unused is not None:
            self._unused.detach()
            self._unused = None

    def __repr__(self) -> str:
        state = "not begun" if self._unused else "begun"
        return f"{type(self).__name__}({self._way} steps, {state}, from {self._problem!r})"


def _warn(method: str, file: str, line: int) -> None:
    warnings.warn_explicit(
        f"problem.{method}(...) was never iterated, so that nothing has been solved: write "
        f"for step in problem.{method}(...):",
        UserWarning,
        file,
        line,
    )
