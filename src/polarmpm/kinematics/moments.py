"""Moments of forces and couples."""

from __future__ import annotations

import numpy as np


def moments(x: np.ndarray, forces: np.ndarray, couples: np.ndarray) -> np.ndarray:
    """Moments (n, 1) in the plane, (n, 3) in space, about the origin of forces (n, d) at x (n, d) (m), with
    couples (n, r) (r = 0: there are none)."""
    if x.shape[1] == 2:
        of_forces = (x[:, 0] * forces[:, 1] - x[:, 1] * forces[:, 0])[:, None]
    else:
        of_forces = np.cross(x, forces)
    out: np.ndarray = of_forces + couples if couples.shape[1] else of_forces
    return out
