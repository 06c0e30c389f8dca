"""The state from which a body's increments count, and the increments at its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tools.parallel import Route
from .points import Points


@dataclass
class Reference:
    """State of the points from which increments count: F at the last reset, rotations at their last base."""

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray

    @classmethod
    def of(cls, points: Points) -> Reference:
        """The points' current state."""
        return cls(points.x.copy(), points.F.copy(), points.q.copy(), points.wryness.copy())

    def moved(self, route: Route) -> Reference:
        """The same of points that have gone to other ranks. Collective."""
        return Reference(*(route.forward(a) for a in (self.x, self.F, self.q, self.wryness)))


@dataclass
class Increments:
    """Interpolated increments at the points: value (n, block), du/dx~ (n, d, d), dw/dx~ (n, r, d)."""

    value: np.ndarray
    gradient: np.ndarray
    rotation_gradient: np.ndarray
