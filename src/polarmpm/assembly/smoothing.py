"""Least-squares projection of what points have to what the nodes' functions can give them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

_ENOUGH = 1e-13  # residual of the normal equations, relative
_MOST = 2000


def projected(system: Any, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (np, block) of the nodes' functions that are nearest to given ones, weighted with `weights` (np,
    block), masses: what nodes can move isn't changed, and sums of weights times values stay. By conjugate
    gradients, as the matrix of the normal equations may be singular where there is little of the body.
    Collective.
    """
    comm, own = system.comm, slice(0, system.nodes.owned)

    def product(x: np.ndarray) -> np.ndarray:
        found: np.ndarray = system.from_points(weights * system.at_points(x))
        return found

    def sums(*pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        found = np.array([np.sum(one[own] * other[own]) for one, other in pairs])
        comm.Allreduce(MPI.IN_PLACE, found)
        return found

    lumped = system.from_points(weights)
    scale = 1.0 / np.where(lumped > 0.0, lumped, np.inf)
    residual = system.from_points(weights * values)
    x = np.zeros_like(residual)
    direction = scale * residual
    (size,) = sums((residual, direction))
    least = _ENOUGH**2 * size
    for _ in range(_MOST):
        if not size > least:
            break
        system.nodes.update_ghosts(direction)
        moved = product(direction)
        (curved,) = sums((direction, moved))
        x, residual = x + size / curved * direction, residual - size / curved * moved
        (now,) = sums((residual, scale * residual))
        direction, size = scale * residual + now / size * direction, float(now)
    system.nodes.update_ghosts(x)
    out: np.ndarray = system.at_points(x)
    return out
