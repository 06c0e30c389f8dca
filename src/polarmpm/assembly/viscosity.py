"""Viscosity of a body in motion: stresses that its elastic moduli make of the rate of its deformation.

The part of Rayleigh damping that is proportional to the stiffness, K v, with the elastic tangent at the start
of the step and the mean velocity up to the collocated state: what a point's unknowns have gained over the
time that it took. Rotations of a step count to its second order only: it is for bodies that hardly turn.
"""

from __future__ import annotations

from typing import Any

import numpy as np


class Viscosity:
    """Viscous forces of a system's points.

    Args:
        time: stress over that of the same strain, per strain rate (s).

    Attributes:
        scale: stress over the elastic one of the same strain, since the start of the step.
    """

    def __init__(self, time: float):
        self.time, self.scale = time, 0.0
        self._moduli: list[np.ndarray] = []
        self._start: list[np.ndarray] = []

    def begin(self, system: Any, duration: float) -> None:
        """A step begins, which takes `duration` (s) up to the state in which forces are in balance."""
        self.scale = self.time / duration
        self._moduli = [_whole(*system.elastic_tangent(k)) for k in range(system.batches)]
        self.count_from(system)

    def count_from(self, system: Any) -> None:
        """Strains count from the present increments on."""
        self._start = [system.unknowns(k) for k in range(system.batches)]

    def blocks(self, system: Any, k: int, tangent: bool) -> np.ndarray:
        """Stresses, and with `tangent` moduli, of the points of batch k, as of a return mapping."""
        moduli = self.scale * self._moduli[k]
        stress: np.ndarray = np.einsum("nij,nj->ni", moduli, system.unknowns(k) - self._start[k])
        if not tangent:
            return stress
        n, size = stress.shape
        return np.hstack([stress, moduli.reshape(n, size * size)])


def _whole(blocks: np.ndarray, size: int) -> np.ndarray:
    """Matrices (n, size, size) of residuals and upper triangles."""
    rows, columns = np.triu_indices(size)
    found = np.zeros((len(blocks), size, size))
    found[:, rows, columns] = found[:, columns, rows] = blocks[:, size:]
    return found
