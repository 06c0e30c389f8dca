"""The state from which a body's increments count, and the increments at its points."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..kinematics import rotations
from ..tools.parallel import Route
from .points import Points


@dataclass
class Reference:
    """State of the points from which increments count: F at the last reset, rotations at their last base.

    Attributes:
        x, F, q, wryness: as of `Points`.
        reset_wryness: wryness at the last reset.
        side_gradients: derivatives along the points' half axes of the gradients of the rotations before their
            base, (np, d, r, d): dw/dx~ F~ of what has turned since the reset.
        initial_stress: what a balanced reset has added to the stresses, per reference volume, (np, b, d) for
            b unknowns of a node: S0 of a classical material; B0 (Pa) and below it M0 (N/m) of a micropolar
            one (docs/theory.md).
        stiff_scalars: what the points' stiff scalars have begun with at the base of the rotations, (np, 4).
    """

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    reset_wryness: np.ndarray
    side_gradients: np.ndarray
    initial_stress: np.ndarray
    stiff_scalars: np.ndarray

    @classmethod
    def of(cls, points: Points, block: int) -> Reference:
        """The points' current state, without an initial stress; `block`: unknowns of a node."""
        x, w, n, d = points.x, points.wryness, len(points), points.dim
        sides, stress = np.zeros((n, d, block - d, d)), np.zeros((n, block, d))
        return cls(
            x.copy(), points.F.copy(), points.q.copy(), w.copy(), w.copy(), sides, stress, np.zeros((n, 4))
        )

    def rebase_rotations(self, points: Points) -> None:
        """Count rotations from the points' current ones on; an initial stress turns with its base."""
        d = self.x.shape[1]
        turn = rotations.to_tensor(points.q) @ np.swapaxes(rotations.to_tensor(self.q), 1, 2)
        stress = self.initial_stress.copy()
        for first in range(0, d * (stress.shape[1] // d), d):  # no rows of a turn about an axis
            rows = slice(first, first + d)
            stress[:, rows] = turn[:, :d, :d] @ stress[:, rows]
        self.initial_stress = stress
        self.q, self.wryness = points.q.copy(), points.wryness.copy()

    def moved(self, route: Route) -> Reference:
        """The same of points that have gone to other ranks. Collective."""
        return Reference(**{f.name: route.forward(getattr(self, f.name)) for f in fields(self)})


@dataclass
class Increments:
    """Interpolated increments at the points: value (n, block), du/dx~ (n, d, d), dw/dx~ (n, r, d)."""

    value: np.ndarray
    gradient: np.ndarray
    rotation_gradient: np.ndarray
