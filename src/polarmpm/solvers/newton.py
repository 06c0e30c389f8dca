"""Newton's method with the convergence measures of T (2.53)-(2.54)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from ..errors import LocalFailure
from ..tools import checks
from .linear import SingularTangent
from .linesearch import Searched, shorten


class System(Searched, Protocol):
    """A nonlinear system at a load factor."""

    def evaluate(self, tangent: bool) -> None:
        """Residual, and the tangent if asked, at the present unknowns.

        Raises:
            LocalFailure: there is none at them; the attempt has failed.
        """

    def convergence_measures(self) -> tuple[float, float]:
        """Normalised out-of-balance force and energy; NaN or infinite when the iteration has diverged."""

    def waits(self) -> bool:
        """Whether the next tangent costs more than others: it is asked for when it is known to be needed."""

    def pending(self) -> bool:
        """Whether prescribed values are still to be put in."""

    def backtrack(self) -> bool:
        """Take back half of the last correction; False if there is none in this step."""

    def update(self, fresh: bool, accuracy: float) -> None:
        """Solve with the last tangent and add the correction to the unknowns.

        Args:
            fresh: the tangent has been evaluated since the last solution, else its factor is at hand.
            accuracy: of the correction: what the residual of the linear system may be, relative to that of
                this one.
        """


@dataclass(frozen=True)
class Controls:
    """When iterations stop.

    Attributes:
        force_tolerance: on |f_R| / |f_ext + f_rct|, T (2.53); couples count as forces at the distance
            of a cell.
        energy_tolerance: on f_R . du relative to the work of the step's external forces and reactions,
            T (2.54); T's measure is in joules, this one doesn't depend on the unit of length.
        max_iterations: linear solves before the step counts as failed.
        divergence: force measure at which the step counts as failed. Bending overshoots by 1e3 to 1e4 in
            the first iteration, so it is far above that.

    Raises:
        InputError: tolerances that aren't below 1, or no iterations.
    """

    force_tolerance: float = 1e-9
    energy_tolerance: float = 1e-16
    max_iterations: int = 25
    divergence: float = 1e14

    def __post_init__(self) -> None:
        checked = {
            "force_tolerance": checks.number("force_tolerance", self.force_tolerance, above=0.0, below=1.0),
            "energy_tolerance": checks.number(
                "energy_tolerance", self.energy_tolerance, least=0.0, below=1.0
            ),
            "max_iterations": checks.whole("max_iterations", self.max_iterations, least=1),
            "divergence": checks.number("divergence", self.divergence, above=1.0),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)


@dataclass
class Outcome:
    """What an attempt led to.

    Attributes:
        converged: success.
        history: (force, energy) before the first and after every iteration.
        reason: why it failed, in words.
        unresolved: see `Step`.
        local: it failed as points had no stresses.
        regrids: see `Step`.
    """

    converged: bool = False
    history: list[tuple[float, float]] = field(default_factory=list)
    reason: str = ""
    unresolved: float | None = None
    local: bool = False
    regrids: int = 0

    @property
    def iterations(self) -> int:
        """Linear solves."""
        return max(0, len(self.history) - 1)

    def __repr__(self) -> str:
        force = f", force measure {self.history[-1][0]:.2g}" if self.history else ""
        what = "converged" if self.converged else f"failed: {self.reason or 'no reason yet'}"
        return f"Outcome({what}; {self.iterations} iterations{force})"


def solve(system: System, controls: Controls, search: bool = False) -> Outcome:
    """Iterate until one of the convergence measures is below its tolerance. Collective.

    Args:
        search: halve corrections that don't make the residual smaller from the beginning; else from when on
            iterations go round in circles.
    """
    outcome = Outcome()
    try:
        _iterate(system, controls, outcome, search)
    except (LocalFailure, SingularTangent) as e:
        outcome.converged, outcome.reason = False, str(e)
        outcome.local = isinstance(e, LocalFailure)
    return outcome


def _iterate(system: System, controls: Controls, outcome: Outcome, search: bool) -> None:
    """Put convergence measures and the result into the outcome.

    Near the solution the residual falls quadratically and the tangent hardly changes any more. Where the
    last ratio of residuals promises that the tangent at hand is good enough for the tolerance, the last
    correction is made with it (a chord step); if that isn't enough, a full iteration follows.
    """
    tangent, chord, lifted = True, False, True
    while True:
        evaluate(
            system, tangent, system.backtrack, outcome.history[-1][0] if search and not lifted else math.inf
        )
        force, energy = system.convergence_measures()
        if outcome.history and not force < _FALLS * outcome.history[-1][0] and shorten(system, tangent):
            force, energy = system.convergence_measures()
        outcome.history.append((force, energy))
        if not math.isfinite(force) or force > controls.divergence:
            outcome.reason = f"diverged (force measure {force:.3g})"
            return
        small = force < controls.force_tolerance or (
            outcome.iterations > 0 and energy < controls.energy_tolerance
        )
        if small and not system.pending():
            outcome.converged = True
            return
        if outcome.iterations >= controls.max_iterations:
            outcome.reason = (
                f"no convergence in {controls.max_iterations} iterations (force measure {force:.3g})"
            )
            return
        ratio, lifted = _ratio(outcome), system.pending()
        search = search or _in_circles(outcome)
        chord = not chord and not system.pending() and _SAFETY * ratio * force < controls.force_tolerance
        if not tangent and not chord:
            system.evaluate(True)
        system.update(not chord, _accuracy(ratio, force, controls))
        # the next residual and ratio if both fall quadratically: is a tangent needed for what then comes?
        following = ratio**2 * force
        tangent = not chord and _SAFETY * ratio**2 * following > controls.force_tolerance
        tangent = tangent and not system.waits()


def evaluate(system: System, tangent: bool, backtrack: Callable[[], bool], below: float = math.inf) -> None:
    """Evaluate where the points have stresses, and where the force measure is `below` a number: while it
    isn't so, go back half of the last correction, a few times.

    Raises:
        LocalFailure: the points still have no stresses.
    """
    for _ in range(_BACKTRACKS if below == math.inf else _SEARCHES):
        try:
            system.evaluate(tangent)
        except LocalFailure:
            if not backtrack():
                raise
        else:
            if below == math.inf or system.convergence_measures()[0] < below or not backtrack():
                return
        tangent = True  # prescribed values may be pending again
    system.evaluate(True)


def _in_circles(outcome: Outcome) -> bool:
    """Whether the last iterations have hardly made the residual smaller."""
    forces = [force for force, _ in outcome.history]
    return len(forces) > _PATIENCE and min(forces[-_CIRCLE:]) > 0.5 * min(forces[:-_CIRCLE])


def expected_to_end(outcome: Outcome, controls: Controls) -> bool:
    """Whether the next residual is small enough if residuals go on to fall quadratically."""
    return _SAFETY * _ratio(outcome) ** 2 * outcome.history[-1][0] < controls.force_tolerance


def _accuracy(ratio: float, force: float, controls: Controls) -> float:
    """Of a correction: what leaves the quadratic fall of the residual as it is, and no more than the last
    correction needs (S. C. Eisenstat, H. F. Walker: Choosing the forcing terms in an inexact Newton method,
    SIAM J. Sci. Comput. 17 (1996), 16-32)."""
    enough = _SHARE * controls.force_tolerance / force if force > 0 else 1.0
    return max(_FINEST, min(_COARSEST, max(_SHARE * ratio**2, enough)))


_SHARE = 0.1  # of the residual to come that a linear solution may leave
_COARSEST, _FINEST = 1e-3, 1e-10  # relative residuals of linear systems
_FALLS = 0.8  # ratio of residuals above which a correction may have been too long
_BACKTRACKS = 4  # corrections halved before points without stresses end the attempt
_SEARCHES = 8  # the same where the residual is to become smaller
_PATIENCE, _CIRCLE = 8, 4  # iterations before they may be said to go round in circles, and that have to
_SAFETY = 10.0  # the change of the tangent is about twice the ratio


def _ratio(outcome: Outcome) -> float:
    """Last ratio of consecutive residuals; infinite before there are two of them."""
    forces = [force for force, _ in outcome.history]
    return forces[-1] / forces[-2] if len(forces) > 2 and forces[-2] > 0 else math.inf
