"""How the deformation varies within the points' boxes, which bodies in motion carry through resets."""

from __future__ import annotations

import numpy as np

from .pointfields import SIDE_FIELDS


class WithSides:
    """Points that may know it: those of bodies in motion do between a step and the reset that it asks for.

    Attributes:
        side_F: derivatives of F along the half axes of the points' boxes, (np, d, d, d).
        side_wryness: wryness from which on rotations vary within the boxes, (np, 3, 3).
        side_gradients: derivatives of the wryness since then along the half axes, times Q, (np, d, 3, d).
    """

    dim: int
    wryness: np.ndarray
    side_F: np.ndarray
    side_wryness: np.ndarray
    side_gradients: np.ndarray

    @property
    def has_sides(self) -> bool:
        """Whether they know it."""
        return "side_F" in vars(self)

    def begin_sides(self) -> None:
        """Begin without any variation."""
        n, d = len(self.wryness), self.dim
        self.side_F, self.side_gradients = np.zeros((n, d, d, d)), np.zeros((n, d, 3, d))
        self.side_wryness = self.wryness.copy()

    def forget_sides(self) -> None:
        """It isn't known any more."""
        for name in SIDE_FIELDS:
            vars(self).pop(name, None)
