"""Linear equations of the tangent-linear run, by conjugate residuals with the run's factor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..assembly.system import NodalSystem

ENOUGH = 1e-9  # imbalance of the linear equation, over that of its right-hand side
_STALLED, _MOST = 0.5, 25  # ratio of imbalances above which an iteration brings nothing; iterations


def solve(
    system: NodalSystem,
    aim: np.ndarray,
    products: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    known: list[tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, float, np.ndarray]:
    """Increments (nodes, block) from `start` on, at which free unknowns have no residual, what is left
    over the first, and the residual (nodes, block) of all: conjugate residuals, with the factor at hand.
    Collective.

    Args:
        aim: residual (nodes, block) at the start.
        products: the matrix times increments.
        known: directions of earlier solutions with the same matrix, and their products, on
            free unknowns and on all; more are added.
    """
    own = slice(0, system.owned)

    def dot(a: np.ndarray, b: np.ndarray) -> float:
        return float(system.comm.allreduce(float(np.sum(a[own] * b[own] * system.as_force**2))))

    x, r, rest = start, system.on_free(aim), aim
    first = size = np.sqrt(dot(r, r))

    def improve(direction: np.ndarray, image: np.ndarray, forces: np.ndarray) -> None:
        nonlocal x, r, rest
        share = dot(image, r)
        x, r, rest = x - share * direction, r - share * image, rest - share * forces

    for one in known:
        improve(*one)
    for _ in range(_MOST):
        before, size = size, np.sqrt(dot(r, r))
        if not size > ENOUGH * first or (_STALLED * before < size < 1e-8 * first):
            break
        z = preconditioned(system, r)
        forces = products(z)
        az = system.on_free(forces)
        for other, image, own_forces in known:
            share = dot(image, az)
            z, az, forces = z - share * other, az - share * image, forces - share * own_forces
        length = np.sqrt(dot(az, az))
        if not length > 0.0:
            break
        known.append((z / length, az / length, forces / length))
        improve(*known[-1])
    size = np.sqrt(dot(r, r))
    return x, size / first if first > 0.0 else 0.0, rest


def preconditioned(system: Any, forces: np.ndarray) -> np.ndarray:
    step = np.zeros_like(forces)
    own = system.owned
    step[:own] = system.solve_again(system.on_free(forces)[:own])
    system.complete(step)
    step[system.prescribed.fixed] = 0.0
    return step
