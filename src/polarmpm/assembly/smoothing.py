"""What points have, as the nodes' functions can give it to them: its least-squares projection, and means."""

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


def means(interpolation: Any, volume: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (np, c) of points with volumes (np,) as means at the nodes, and these at the points.
    Collective."""
    i, block = interpolation, interpolation.layout.block
    whole = i.spread(np.ascontiguousarray(volume[:, None]))
    nodal = i.spread(volume[:, None] * values) / np.where(whole > 0.0, whole, np.inf)
    i.nodes.update_ghosts(nodal)
    out = np.empty_like(values)
    for first in range(0, values.shape[1], block):
        part = nodal[:, first : first + block]
        x = np.zeros((len(nodal), block))
        x[:, : part.shape[1]] = part
        out[:, first : first + block] = i.gather(x).value[:, : part.shape[1]]
    return out
