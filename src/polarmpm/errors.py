"""Errors raised by the package. Every message names the culprit, its value and what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


def _rebuilt(kind: type[PolarMPMError], args: tuple[Any, ...], state: dict[str, Any]) -> PolarMPMError:
    error = kind.__new__(kind, *args)
    error.args = args
    error.__dict__.update(state)
    return error


class PolarMPMError(Exception):
    """Base of all errors of the package. All can be pickled, so that they pass through process pools and
    between ranks."""

    def __reduce__(self) -> tuple[Callable[..., PolarMPMError], tuple[Any, ...]]:
        return _rebuilt, (type(self), self.args, dict(self.__dict__))


class InputError(PolarMPMError, ValueError):
    """An argument is out of its admissible range; nothing has been changed."""


class OutputError(PolarMPMError, OSError):
    """A file couldn't be written, such as on a full disc; raised on all ranks alike, naming file and reason.
    The last converged state and what was in the file before are intact, and the run can go on."""


class ErrorOnAnotherRank(PolarMPMError, RuntimeError):
    """The script, or a function of it, has failed on another rank, which raises its own error; see
    `tools.parallel.errors_on_all_ranks`.

    Attributes:
        rank: the lowest rank on which it failed.
        error: kind and text of the error there.
    """

    def __init__(self, rank: int, error: str):
        self.rank, self.error = rank, error
        super().__init__(f"rank {rank}: {error}")


class RanksApart(PolarMPMError, RuntimeError):
    """The ranks aren't in the same collective call, and would wait for each other for ever; raised on all of
    them alike, naming what each is in. None of these calls has done anything.

    Attributes:
        calls: what each rank is in, by rank.
    """

    def __init__(self, calls: Mapping[int, str], text: str):
        self.calls = dict(calls)
        super().__init__(
            f"the ranks aren't in the same call: {text}; the script has to make all collective calls on all "
            "ranks, in the same order"
        )


class PointsOutsideGrid(PolarMPMError, ValueError):
    """Material points lie (or have moved) outside the background grid.

    Attributes:
        ids: permanent ids of the points, at most the first twenty of this rank.
    """

    def __init__(self, ids: Sequence[int], count: int, where: str):
        self.ids = [int(i) for i in ids][:20]
        shown = ", ".join(map(str, self.ids[:8])) + (", ..." if count > 8 else "")
        super().__init__(f"{count} material point(s) outside the grid ({where}): ids {shown}")


class SupportLost(PolarMPMError, RuntimeError):
    """At a reset of the grid the body has left a support, which would hold nothing from there on; raised on
    all ranks alike, naming the support, the step and what to do. The last converged state is intact."""


@dataclass(frozen=True)
class Finding:
    """One thing that the diagnosis of a failed load step has found; the same on all ranks.

    Attributes:
        kind: "free rigid motion", "linear system", "too few points", "limit load", "not finite",
            "too large", "inside out", "out of balance", "iterations", "load steps", or "no diagnosis";
            docs/failures.md says more of each.
        text: what it is and what to do, in a line.
        places: where (m), a tuple of coordinates each: of nodes, of points, or the middle of a part of the
            body.
        ids: permanent ids of points, or numbers of a mesh's elements, at most five.
        unknowns: names of the nodes' unknowns at `places`, where it is about these.
        direction: of a free motion: its translation (d,), or of a turn the axis (3,); else ().
    """

    kind: str
    text: str
    places: tuple[tuple[float, ...], ...] = ()
    ids: tuple[int, ...] = ()
    unknowns: tuple[str, ...] = ()
    direction: tuple[float, ...] = ()


class NotConverged(PolarMPMError, RuntimeError):
    """A load step did not converge; the last converged state is intact.

    Attributes:
        factor: load factor, or time (s), that was aimed at.
        clock: which of the two it is.
        history: (force, energy) measures of every iteration of the last attempt, T (2.53)-(2.54).
        tried: one line for each attempt.
        findings: why, as far as the diagnosis could tell, the most telling first; see `Finding`.
    """

    def __init__(
        self,
        factor: float,
        history: Sequence[tuple[float, float]],
        tried: Sequence[str],
        clock: str = "load factor",
    ):
        self.factor, self.history, self.tried, self.clock = factor, list(history), list(tried), clock
        self.findings: list[Finding] = []
        super().__init__(self._message())

    def _message(self) -> str:
        lines = [
            f"no equilibrium at {self.clock} {self.factor:.6g}; the last converged state is intact. Tried:"
        ]
        lines += [f"  {line}" for line in self.tried]
        if self.findings:
            lines += ["Found:", *(f"  {finding.kind}: {finding.text}" for finding in self.findings)]
        return "\n".join(lines)

    def explain(self, findings: Sequence[Finding]) -> None:
        """Add what a diagnosis has found to the message."""
        self.findings = [*self.findings, *findings]
        self.args = (self._message(),)


class NotDifferentiable(PolarMPMError, RuntimeError):
    """A run's answers have no derivative by a parameter that could be found; raised on all ranks alike.

    Attributes:
        parameter: its name.
        step, factor: number and load factor of the step.
        smallest: step of ln m that was tried last.
    """

    def __init__(self, parameter: str, step: int, factor: float, smallest: float, trouble: str):
        self.parameter, self.step, self.factor, self.smallest = parameter, step, factor, smallest
        super().__init__(
            f"{parameter}: step {step} to load factor {factor:.6g} has no derivative by it: a twin with "
            f"another {parameter} (by {smallest:.0e} of it) doesn't go along with the run: {trouble}"
        )


class LocalFailure(PolarMPMError, RuntimeError):
    """The state at a point could not be found, such as by a return mapping; raised on all ranks alike.

    The attempt at the load step fails with the message as its reason, and adaptive stepping tries less.
    """


class NotConserved(PolarMPMError, RuntimeError):
    """Points were lost, or grid and points don't belong together any more; raised on all ranks alike."""


class KernelError(PolarMPMError, RuntimeError):
    """An expression could not be turned into compiled code."""


class TrustWarning(UserWarning):
    """An answer that may be far off for a reason that the solver sees; the message says what to change."""
