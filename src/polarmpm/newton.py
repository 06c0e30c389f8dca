"""Newton's method with the convergence measures of T (2.53)-(2.54)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

from .linear import SingularTangent


class System(Protocol):
    """A nonlinear system at a load factor."""

    def evaluate(self, tangent: bool) -> None:
        """Residual, and the tangent if asked, at the present unknowns."""

    def measures(self) -> tuple[float, float]:
        """Normalised out-of-balance force and energy; NaN or infinite when the state is beyond repair."""

    def pending(self) -> bool:
        """Whether prescribed values are still to be put in."""

    def advance(self) -> None:
        """Solve with the tangent and add the correction to the unknowns."""


@dataclass(frozen=True)
class Controls:
    """When iterations stop.

    Attributes:
        force_tolerance: on |f_R| / |f_ext + f_rct|, T (2.53).
        energy_tolerance: on f_R . du relative to the work of the step's external forces and reactions,
            T (2.54); T's measure is in joules, this one doesn't depend on the unit of length.
        max_iterations: linear solves before the step counts as failed.
        divergence: force measure at which the step counts as failed. Bending overshoots by 1e3 to 1e4 in
            the first iteration, so it is far above that.
    """

    force_tolerance: float = 1e-9
    energy_tolerance: float = 1e-16
    max_iterations: int = 25
    divergence: float = 1e14


@dataclass
class Outcome:
    """What an attempt led to.

    Attributes:
        converged: success.
        history: (force, energy) before the first and after every iteration.
        reason: why it failed, in words.
    """

    converged: bool = False
    history: list[tuple[float, float]] = field(default_factory=list)
    reason: str = ""

    @property
    def iterations(self) -> int:
        """Linear solves."""
        return max(0, len(self.history) - 1)


def solve(system: System, controls: Controls) -> Outcome:
    """Iterate until one of the measures is below its tolerance. Collective.

    Near the solution the next residual is predicted from the last one (quadratic convergence); when it
    should do, the residual is evaluated without the tangent.
    """
    outcome, tangent = Outcome(), True
    while True:
        system.evaluate(tangent)
        force, energy = system.measures()
        outcome.history.append((force, energy))
        if not math.isfinite(force) or force > controls.divergence:
            outcome.reason = f"diverged (force measure {force:.3g})"
            return outcome
        small = force < controls.force_tolerance or (
            outcome.iterations > 0 and energy < controls.energy_tolerance
        )
        if small and not system.pending():
            outcome.converged = True
            return outcome
        if outcome.iterations >= controls.max_iterations:
            outcome.reason = (
                f"no convergence in {controls.max_iterations} iterations (force measure {force:.3g})"
            )
            return outcome
        if not tangent:
            system.evaluate(True)
        try:
            system.advance()
        except SingularTangent as e:
            outcome.reason = str(e)
            return outcome
        tangent = force**2 > 1e-2 * controls.force_tolerance
