"""Which way a step of the arc-length method goes, and what grows with the load factor."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..assembly.system import NodalSystem
from ..conditions.proportional import check_linear


def moved(problem: Any, system: NodalSystem, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Displacements (np, d) of the local points between two states of the increments (nodes, block)."""
    x, d = system.x, problem.layout.dim
    system.x = start
    before = problem._increments(system).value[:, :d]
    system.x = end
    way: np.ndarray = problem._increments(system).value[:, :d] - before
    system.x = x
    return way


def sense(problem: Any, system: NodalSystem, direction: np.ndarray) -> float:
    """Positive where nodal increments (nodes, block) lead on in the direction of the last step."""
    along, p = 0.0, problem.points
    if problem._last_x is not None:
        way = moved(problem, system, system.x, system.x + direction)
        along = float(np.einsum("n,ni,ni->", p.volume0, p.x - problem._last_x, way))
    along = problem.comm.allreduce(along)
    return along or problem.progress.factor_change or 1.0


def growth_of_terms(problem: Any, system: NodalSystem) -> np.ndarray:
    """What the residual forces (nodes, block) of the terms, complete on owned rows, gain while the load
    factor grows from 0 to 1. The terms are left at 0. Collective.

    Raises:
        InputError: a term's forces aren't linear in the load factor.
    """
    found = []
    for factor in (2.0, 1.0, 0.0):
        problem._set_terms(factor)
        found.append(system.terms.forces(system.x, lambda piece: True))
    two, one, zero = found
    check_linear(problem.comm, [term.name for term in problem.terms], zero, one, two)
    growth: np.ndarray = one - zero
    system.nodes.add_to_owners(growth)
    return growth
