"""Out-of-balance forces that rounding makes: loads as small as these can't be balanced."""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np

from ..tools.parallel import reduce_in_place

_ROUNDING = 16 * float(np.finfo(float).eps)
_CONTRAST = 1e8  # over the median: stiffer nodes are none of a body, but of a modulus without meaning


def squares(diagonal: np.ndarray, sizes: np.ndarray, mean_size: float, comm: MPI.Comm) -> np.ndarray:
    """Squares of the out-of-balance forces (N) that a relative rounding of strains makes, and of those that
    one of rotations of a radian makes beside. Collective.

    Strains and rotations are rounded relative to one, and the tangent's diagonal turns that into forces: a
    rotation is a strain, and a displacement is one over a cell. It is different where bending stiffness is
    large: a change of the wryness is rounded relative to itself, and is as small as the rotations.

    Args:
        diagonal: of the tangent, (n, block), at owned nodes.
        sizes: of cells (d,), or of those around each node (n, d) (m).
        mean_size: (m).
    """
    d = sizes.shape[-1]
    forces = np.abs(diagonal[:, :d]) * sizes
    if len(forces):
        middle = forces.size // 2
        forces = np.minimum(forces, _CONTRAST * np.partition(forces, middle, axis=None)[middle])
    found = np.array([np.vdot(forces, forces), 0.0])
    if diagonal.shape[1] > d:
        couples = np.abs(diagonal[:, d:]) / mean_size
        strains = np.minimum(couples, forces.sum(axis=1, keepdims=True) / d)
        found += np.vdot(strains, strains), np.vdot(couples, couples)
    reduce_in_place(comm, found)
    return _ROUNDING**2 * found


def level(made: np.ndarray | None, turned: float) -> float:
    """Out-of-balance force (N) that rounding makes at increments: loads whose strains are near rounding can't
    be balanced more closely.

    Args:
        made: of `squares`, None: 0.
        turned: the largest increment of a rotation of all ranks, 0 without microrotations.
    """
    return 0.0 if made is None else math.sqrt(made[0] + min(1.0, turned) ** 2 * made[1])
