"""The state from which a body's increments count, and the increments at its points."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..tools.parallel import Route
from .points import Points


@dataclass
class Reference:
    """State of the points from which increments count: F at the last reset, rotations at their last base.

    Attributes:
        reset_wryness: wryness at the last reset.
    """

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    reset_wryness: np.ndarray

    @classmethod
    def of(cls, points: Points) -> Reference:
        """The points' current state."""
        w = points.wryness
        return cls(points.x.copy(), points.F.copy(), points.q.copy(), w.copy(), w.copy())

    def moved(self, route: Route) -> Reference:
        """The same of points that have gone to other ranks. Collective."""
        return Reference(**{f.name: route.forward(getattr(self, f.name)) for f in fields(self)})


@dataclass
class Increments:
    """Interpolated increments at the points: value (n, block), du/dx~ (n, d, d), dw/dx~ (n, r, d)."""

    value: np.ndarray
    gradient: np.ndarray
    rotation_gradient: np.ndarray
