"""The state from which a body's increments count, and the increments at its points."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..kinematics import rotations
from ..tools.parallel import Route
from .points import Points

_ZERO = bytes(np.dtype(float).itemsize)


def _nothing(*shape: int) -> np.ndarray:
    """Zeros that can't be written to, and take no memory; a tenth of `np.broadcast_to`'s time."""
    return np.ndarray(shape, buffer=_ZERO, strides=(0,) * len(shape))


@dataclass
class Reference:
    """State of the points from which increments count: F at the last reset, rotations at their last base.

    Arrays are replaced, never written to; what isn't there takes no memory.

    Attributes:
        x, F, q, wryness: as of `Points`.
        side_F: how F varies along the points' half axes at the last reset, (np, d, d, d); (np, 0, d, d): that
            isn't known.
        side_wryness: wryness from which on rotations vary within the points' boxes.
        side_gradients: derivatives along the points' half axes of the gradients of the rotations before their
            base, (np, d, r, d): dw/dx~ F~ of what has turned since then.
        initial_stress: what a balanced reset has added to the stresses, per reference volume, (np, b, d) for
            b unknowns of a node: S0 of a classical material; B0 (Pa) and below it M0 (N/m) of a micropolar
            one (docs/theory.md). In a body with second gradients (np, d, d + m): beside S0 the work T0
            (N/m) on the m different second gradients.
        grad_F: as of `Points`; (np, 0) of a body without second gradients.
        stiff_scalars: what the points' stiff scalars have begun with at the base of the rotations, (np, 4).
    """

    x: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray
    side_F: np.ndarray
    side_wryness: np.ndarray
    side_gradients: np.ndarray
    initial_stress: np.ndarray
    grad_F: np.ndarray
    stiff_scalars: np.ndarray

    @classmethod
    def of(cls, points: Points, block: int, *, sides: bool = False) -> Reference:
        """The points' current state, without an initial stress.

        Args:
            block: unknowns of a node.
            sides: go on with how the deformation varies within the points' boxes, where that is known.
        """
        n, d = len(points), points.dim
        wryness = points.wryness.copy()
        varying = _nothing(n, 0, d, d), wryness, _nothing(n, d, block - d, d)
        if sides and points.has_sides:
            turning = points.side_gradients[:, :, 3 - (block - d) :].copy()
            varying = points.side_F.copy(), points.side_wryness.copy(), turning
        columns = d + points.second_gradient * d * (d + 1) // 2
        second = points.grad_F.copy() if points.second_gradient else _nothing(n, 0)
        state = points.x.copy(), points.F.copy(), points.q.copy(), wryness
        return cls(*state, *varying, _nothing(n, block, columns), second, _nothing(n, 4))

    def rebase_rotations(self, points: Points) -> None:
        """Count rotations from the points' current ones on; an initial stress turns with its base."""
        if self.initial_stress.any():
            self._turn_initial_stress(points)
        self.q, self.wryness = points.q.copy(), points.wryness.copy()

    def _turn_initial_stress(self, points: Points) -> None:
        d = self.x.shape[1]
        turn = rotations.to_tensor(points.q) @ np.swapaxes(rotations.to_tensor(self.q), 1, 2)
        stress = self.initial_stress.copy()
        for first in range(0, d * (stress.shape[1] // d), d):  # no rows of a turn about an axis
            rows = slice(first, first + d)
            stress[:, rows] = turn[:, :d, :d] @ stress[:, rows]
        self.initial_stress = stress

    def moved(self, route: Route) -> Reference:
        """The same of points that have gone to other ranks. Collective."""
        return Reference(**{f.name: route.forward(getattr(self, f.name)) for f in fields(self)})


@dataclass
class Increments:
    """Interpolated increments at the points: value (n, block), du/dx~ (n, d, d), dw/dx~ (n, r, d); in a
    body with second gradients d^2u/dx~^2 (n, d, d, d), zero at points of other materials."""

    value: np.ndarray
    gradient: np.ndarray
    rotation_gradient: np.ndarray
    second_gradient: np.ndarray | None = None
