"""Rigid motions of a body as changes of its nodes' unknowns."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np


def rigid_motions(
    position: np.ndarray, turned: np.ndarray, comm: MPI.Comm, centre: np.ndarray | None = None
) -> np.ndarray:
    """Rigid motions of nodes as changes of their unknowns, (k, n, block). Collective.

    Where the microrotation has been turned by exp(Dw), a further spin b changes Dw by J_l(Dw)^-1 b, which is
    b + b x Dw / 2 up to the square of Dw. To that order it is linear in the nodal increments, and right at
    points between nodes, whatever the increments of nodes that the points hardly reach. Rotations are about
    `centre`, the nodes' by default.

    Args:
        position: current positions (n, d) (m).
        turned: increments of the microrotation (n, r) (rad), r = 0 for classical materials.
    """
    (n, d), r = position.shape, turned.shape[1]
    if centre is None:
        centre = comm.allreduce(position.sum(axis=0)) / max(1, comm.allreduce(n))
    arm = np.pad(position - centre, ((0, 0), (0, 3 - d)))
    spins = np.eye(3)[2:] if d == 2 else np.eye(3)
    out: np.ndarray = np.zeros((d + len(spins), n, d + r))
    for k in range(d):
        out[k, :, k] = 1.0
    for motion, spin in zip(out[d:], spins, strict=True):
        motion[:, :d] = np.cross(spin, arm)[:, :d]
        if r == 3:
            motion[:, d:] = spin + 0.5 * np.cross(spin, turned)
        elif r:
            motion[:, d] = 1.0
    return out
