"""Ways to the equilibrium of a load step, one after the other."""

from __future__ import annotations

import numpy as np

from ..assembly.system import NodalSystem
from ..errors import LocalFailure
from ..solvers import arclength, newton
from ..solvers.arclength import Path
from ..solvers.newton import Controls, Outcome

_FELT = 0.01  # out-of-balance force that is worth another equilibrium


class Search:
    """How a problem finds the equilibrium of a step; another way can be put in its place (`sensitivity`)."""

    def at_factor(
        self, system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls
    ) -> Outcome:
        """At the load factor whose loads are set. Arguments as of `solve`. Collective."""
        return solve(system, start, increments, controls)

    def along(self, path: Path, controls: Controls, to: float | None) -> Outcome:
        """At the end of a step along the path, see `arclength.solve`. Collective."""
        return arclength.solve(path, controls, to)


def solve(system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls) -> Outcome:
    """Newton's method in a system whose step has begun, and where that fails from other starts. Collective.

    Args:
        start: nodal increments (nodes, block) at the beginning of the step.
        increments: what the prescribed unknowns are to reach (nodes, block).
    """
    search = system.terms.kinked
    outcome = newton.solve(system, controls, search)
    if not outcome.converged and system.start_elastic(True):
        # where points unload, the elastic tangent is the better one to begin with
        tried, system.x = outcome.history, start
        system.set_prescribed(increments)
        outcome = newton.solve(system, controls, search)
        outcome.history[:0] = tried
        system.start_elastic(False)
    if not outcome.converged and outcome.local:
        tried, system.x = outcome.history, start
        system.set_prescribed(increments)
        outcome = newton.solve(system, controls, search=True)
        outcome.history[:0] = tried
    if not outcome.converged and system.leave_out_boxes(True):
        outcome = _start_without_boxes(system, start, increments, controls, outcome)
    if outcome.converged and system.flow_in_boxes(True):
        _flow_in_boxes(system, controls, outcome)
    return _refined(system, controls, outcome)


_MOST_REFINEMENTS = 50


def _refined(system: NodalSystem, controls: Controls, outcome: Outcome) -> Outcome:
    """Go on from an equilibrium until no term has to improve its forces. Collective."""
    for _ in range(_MOST_REFINEMENTS):
        if not outcome.converged:
            return outcome
        try:
            if not system.terms.refine(system.x):
                return outcome
        except LocalFailure as e:
            outcome.converged, outcome.reason = False, str(e)
            return outcome
        tried = outcome.history
        outcome = newton.solve(system, controls, system.terms.kinked)
        outcome.history[:0] = tried[:-1]
    outcome.converged, outcome.reason = False, f"terms still change after {_MOST_REFINEMENTS} refinements"
    return outcome


def _flow_in_boxes(system: NodalSystem, controls: Controls, outcome: Outcome) -> None:
    """Points that have begun to flow in this step hardly count for their boxes any more: where most of them
    have, that moves the equilibrium. Where there is none then, the one at hand stays."""
    x = system.x
    try:
        system.evaluate(False)
        felt = not system.convergence_measures()[0] < _FELT
    except LocalFailure:
        felt = True
    if felt:
        more = newton.solve(system, controls)
        outcome.history += more.history[1:]
        if more.converged:
            return
    system.flow_in_boxes(False)
    system.jump(x)
    system.evaluate(False)


def _start_without_boxes(
    system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls, failed: Outcome
) -> Outcome:
    """Iterate from the equilibrium without the points' boxes on: far from the solution their sides have
    strains that mean nothing."""
    initial, system.x = system.step.initial, start
    system.set_prescribed(increments)
    alone = newton.solve(system, controls)
    system.leave_out_boxes(False)
    outcome, tried = failed, failed.history + alone.history
    if alone.converged:
        system.set_prescribed(increments)
        system.step.initial = initial
        outcome = newton.solve(system, controls)
        tried += outcome.history
    outcome.history = tried
    return outcome
