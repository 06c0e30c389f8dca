"""Between nodes and points: point values that stand for nodal forces, nodal ones for the points' motion."""

from __future__ import annotations

import numpy as np

from ..bodies.points import Points
from ..kinematics import rotations
from .system import NodalSystem

_ITERATIONS = 500
_ACCURACY = 1e-12
_SHIFT = 1e-7


def point_values(system: NodalSystem, forces: np.ndarray) -> np.ndarray:
    """Values (np, block) at the points, times their volumes, that spread to forces (nodes, block), complete
    on owned rows, with the weighting functions. Collective."""
    volume = system.point_volumes()[:, None]
    values = np.zeros((len(volume), forces.shape[1]))
    for _ in range(3):  # what the small multiple leaves
        missing = forces - system.from_points(values)
        values = values + volume * system.at_points(_solve(system, missing))
    return values


def nodal_values(system: NodalSystem, values: np.ndarray) -> np.ndarray:
    """Nodal values (nodes, c) whose interpolation comes nearest to values (np, c) at the points, weighted by
    volume. Collective."""
    block, volume = system.layout.block, system.point_volumes()[:, None]
    columns = values.shape[1]
    padded = np.pad(values, ((0, 0), (0, -columns % block)))
    parts = [
        _solve(system, system.from_points(np.ascontiguousarray(volume * padded[:, k : k + block])))
        for k in range(0, padded.shape[1], block)
    ]
    found: np.ndarray = np.hstack(parts)[:, :columns]
    return found


def motion_of(system: NodalSystem, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (nodes, d) and rotations (nodes, 4) of the nodes that fit the points'. Collective."""
    d, moved = points.dim, nodal_values(system, np.hstack([points.displacement, points.q]))
    length = np.linalg.norm(moved[:, d:], axis=1) > 0  # a node that no point weights has none
    q = np.where(length[:, None], moved[:, d:], rotations.identity(len(moved)))
    return moved[:, :d], rotations.normalise(q)


def _solve(system: NodalSystem, right: np.ndarray) -> np.ndarray:
    """Solve sum_p V_p N_n N_m x_m = b_n for x (nodes, block) by conjugate gradients, as far as it can be:
    where few points reach a node it is undetermined, and a small multiple of the volumes decides. Collective.
    """
    own, comm, nodes = system.owned, system.comm, system.nodes
    volume = system.point_volumes()[:, None]

    def dot(a: np.ndarray, b: np.ndarray) -> float:
        return float(comm.allreduce(float(np.sum(a[:own] * b[:own]))))

    lumped = np.abs(system.node_volumes())
    most = comm.allreduce(float(lumped[:own].max(initial=0.0)))
    lumped = np.maximum(lumped, 1e-6 * most)[:, None]

    def product(x: np.ndarray) -> np.ndarray:
        out: np.ndarray = system.from_points(volume * system.at_points(x)) + _SHIFT * lumped * x
        return out

    x, r = np.zeros_like(right), right.copy()
    z = r / lumped
    p, rz = z.copy(), dot(r, z)
    end = _ACCURACY**2 * rz
    for _ in range(_ITERATIONS):
        if rz <= end:
            break
        nodes.update_ghosts(p)
        q = product(p)
        pq = dot(p, q)
        if pq <= 0.0:
            break
        x, r = x + rz / pq * p, r - rz / pq * q
        z = r / lumped
        old, rz = rz, dot(r, z)
        p = z + rz / old * p
    nodes.update_ghosts(x)
    return x
