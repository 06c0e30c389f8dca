"""Work of the forces on the nodes, step by step: the energy balance of a run (docs/theory.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..assembly.system import NodalSystem
from ..tools.parallel import reduce_in_place


@dataclass
class StepStart:
    """What a load step begins with. Arrays are (nodes, block), forces complete on owned rows; they are those
    that do work on the increments.

    Attributes:
        x: increments since the reset.
        before: forces of the loads of the last converged state.
        new: forces of the new loads, at the same state.
    """

    x: np.ndarray
    before: np.ndarray
    new: np.ndarray


def step_work(
    system: NodalSystem, start: StepStart, last: np.ndarray, left: np.ndarray
) -> tuple[float, float]:
    """Work (J) in a step that has converged, of loads and supports, and of what resets carry along: forces,
    and initial stresses, whose energy it takes. Collective.

    By the trapezoidal rule, so that its error falls with the square of the step. The reactions at the start
    are those in the present basis, from the internal forces of the first evaluation.

    Args:
        last: forces of the loads at the end, as in `StepStart`.
        left: unknowns (nodes, block), bool, of supports that have been released before the step.
    """
    own = slice(0, system.nodes.owned)
    held = system.prescribed.fixed[own]
    moved = system.x[own] - start.x[own]
    # the first evaluation had the new loads already
    assert system.step.initial is not None
    at_start = (system.step.initial + start.new - start.before)[own]
    reactions, free = at_start + system.residual[own], left[own] & ~held
    sums = np.array(
        [
            0.5 * np.sum((start.before[own] + last[own]) * moved),
            0.5 * np.sum(reactions[held] * moved[held]) + 0.5 * np.sum(at_start[free] * moved[free]),
            np.sum(system.carried[own] * moved)
            + system.initial_energy(start.x)
            - system.initial_energy(system.x),
        ]
    )
    reduce_in_place(system.comm, sums)
    return float(sums[0] + sums[1]), float(sums[2])
