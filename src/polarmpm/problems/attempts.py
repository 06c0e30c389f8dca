"""Ways to the equilibrium of a load step, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..assembly.onpattern import OnPattern
from ..assembly.system import NodalSystem
from ..assembly.viscosity import Viscosity
from ..errors import LocalFailure
from ..solvers import arclength, newton
from ..solvers.arclength import Path
from ..solvers.linear import SingularTangent
from ..solvers.newton import Controls, Outcome

_FELT = 0.01  # out-of-balance force that is worth another equilibrium


class Search:
    """How a problem finds the equilibrium of a step; another way can be put in its place (`sensitivity`).

    Attributes:
        creeps: the body is followed as it creeps to its equilibrium, as nothing else has led there.
    """

    creeps = False

    def at_factor(
        self, system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls
    ) -> Outcome:
        """At the load factor whose loads are set. Arguments as of `solve`. Collective."""
        return (creep if self.creeps else solve)(system, start, increments, controls)

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


_BEGIN, _THICKEST, _THIN = 1.0, 1e3, 1e-8  # viscous stress over the elastic one of the same strain
_GAIN, _STALLED = 0.1, 8.0  # of out-of-balance forces in a stage; by which it is made stiffer if it fails
_LOOSEST = 0.5  # tolerance of a stage, however far from balance it begins
_THINNER = (0.1, 0.1, 0.2, 0.3, 0.5, 0.7)  # the next stage, by iterations of the last one
_STAGE, _PATIENCE = 8, 6  # iterations of a stage, and of all of them over those of a step


def creeping(problem: Any, attempt: Callable[[], Outcome]) -> Outcome:
    """What an attempt of a problem's step leads to by creep, as nothing else has led anywhere. Collective."""
    system = problem._ready()
    moves = not isinstance(system, OnPattern) or system.inertia is not None or system.viscosity is not None
    if moves or not system.plastic:
        return Outcome(reason="nothing that creeps")
    failed_at, problem.search.creeps = problem.failed_at, True
    try:
        outcome = attempt()
    finally:
        problem.search.creeps = False
    if not outcome.converged:
        problem.failed_at = failed_at
    return outcome


def creep(system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls) -> Outcome:
    """Follow the body as it creeps to its equilibrium, by implicit steps of a time in which its elastic
    moduli are viscosities, too; without them, at the end. Arguments as of `solve`. Collective.

    Where flow isn't associated the tangent loses its positive eigenvalues long before a body does its
    equilibrium: Newton's corrections then lead nowhere. What creeps goes on along such modes until it is
    stable (pseudo-transient continuation: C. T. Kelley, D. E. Keyes, SIAM J. Numer. Anal. 35 (1998), 508).
    """
    system.x = start
    system.set_prescribed(increments)
    made = Viscosity(1.0)
    made.begin(system, 1.0)
    outcome = Outcome(reason="no equilibrium to creep to")
    try:
        _creep(system, made, increments, controls, outcome)
    except (LocalFailure, SingularTangent) as e:
        outcome.reason = str(e)
    finally:
        system.viscosity = None
    if outcome.converged and system.flow_in_boxes(True):
        _flow_in_boxes(system, controls, outcome)
    return _refined(system, controls, outcome)


def _creep(
    system: NodalSystem, made: Viscosity, increments: np.ndarray, controls: Controls, outcome: Outcome
) -> None:
    """Stages of `creep`, whose results are put into the outcome."""
    system.evaluate(False)
    initial, scale, solved = system.step.initial, _BEGIN, 0
    outcome.history.append(system.convergence_measures())
    force = 1.0 if system.pending() else outcome.history[0][0]
    while solved < _PATIENCE * controls.max_iterations and scale < _THICKEST:
        x, made.scale = system.x, scale if scale > _THIN else 0.0
        made.count_from(system)
        system.viscosity = made
        enough = max(min(_GAIN * force, _LOOSEST), controls.force_tolerance)
        stage = replace(controls, force_tolerance=enough, energy_tolerance=0.0, max_iterations=_STAGE)
        found = newton.solve(system, stage, system.terms.kinked)
        outcome.history += found.history[1:]
        solved += found.iterations
        system.viscosity = None
        if not found.converged:
            system.x, scale = x, _STALLED * scale
            system.set_prescribed(increments)
            system.step.initial = initial
            continue
        system.evaluate(False)
        outcome.history[-1] = system.convergence_measures()
        force = outcome.history[-1][0]
        if force < controls.force_tolerance:
            outcome.converged, outcome.reason = True, ""
            return
        scale *= _THINNER[found.iterations] if found.iterations < len(_THINNER) else 1.0


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
