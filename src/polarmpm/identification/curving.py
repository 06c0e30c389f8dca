"""Steps of least squares that follow a curved valley: residuals to second order along what is known already.

Gauss-Newton's steps are straight. Where data hardly tell two unknowns apart, chi2 has a valley that curves
as both change, and a straight step leaves it. Derivatives at an earlier point have been paid for: how they
differ from those here is the residuals' second derivative along the way between (as of Schnabel and Frank's
tensor methods), and with the values at both ends residuals are known to third order on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_MISSED = 0.5  # of what a straight line misses of an earlier point: where more is left, it tells nothing
_STEPS, _SAME = 20, 1e-6  # of the search for the model's minimum; change that ends it, over the region
_ROUNDING = 1e-14  # singular values below this part of the largest


@dataclass(frozen=True, eq=False)
class Point:
    """Unknowns v (n,), residuals (N,) and their derivatives (N, n)."""

    v: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray

    @property
    def square(self) -> float:
        return float(self.residual @ self.residual)


class Model:
    """Residuals near a point: linear, and along the way to an earlier one as they are known to be.

    With s = t p + q, where p leads to the earlier point and q is at right angles to it, they are
    r + J s + t (J1 - J) q + t^2 b + t^3 c. Between both points the cubic has the values and slopes of both;
    beyond this point it is the parabola of the slopes.
    """

    def __init__(self, here: Point, other: Point | None):
        self.here = here
        self._p: np.ndarray | None = None
        if other is None:
            return
        p = other.v - here.v
        bend = other.jacobian - here.jacobian
        straight = here.jacobian @ p
        missed = other.residual - here.residual - straight
        half = 0.5 * (bend @ p)
        if not np.linalg.norm(missed - half) < _MISSED * np.linalg.norm(missed):
            return
        self._p, self._bend, self._half = p / (p @ p), bend - np.outer(bend @ p, p) / (p @ p), half
        self._square, self._cube = 3.0 * missed - 2.0 * half, 2.0 * half - 2.0 * missed

    def __call__(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N,) after a step s (n,), and their derivatives (N, n)."""
        r, j = self.here.residual + self.here.jacobian @ s, self.here.jacobian
        if self._p is None:
            return r, j
        t, across = float(self._p @ s), self._bend @ s
        square, cube = (self._square, self._cube) if t > 0.0 else (self._half, 0.0 * self._half)
        along = across + 2.0 * t * square + 3.0 * t**2 * cube
        return r + t * across + t**2 * square + t**3 * cube, j + t * self._bend + np.outer(along, self._p)


def latest(here: Point, known: Sequence[Point]) -> Point | None:
    """The point that was known last but this one: where it came from, or where a step has failed that began
    here."""
    return next((p for p in reversed(known) if p is not here), None)


def best_step(model: Model, region: float) -> tuple[np.ndarray, float]:
    """The step (n,) of a length up to `region` that makes the model's sum of squares least, and by how much
    it makes it smaller."""
    s = np.zeros_like(model.here.v)
    r, j = model(s)
    for _ in range(_STEPS):
        aim = _within(j, r - j @ s, region)
        share = 1.0
        while True:
            there = s + share * (aim - s)
            found = model(there)
            if found[0] @ found[0] < r @ r or share < _SAME:
                break
            share *= 0.5
        if not found[0] @ found[0] < r @ r:
            break
        moved, s, (r, j) = float(np.linalg.norm(there - s)), there, found
        if moved < _SAME * region:
            break
    return s, model.here.square - float(r @ r)


def _within(jacobian: np.ndarray, residual: np.ndarray, region: float) -> np.ndarray:
    """The s (n,) of a length up to `region` that makes |residual + jacobian s| least."""
    u, size, vt = np.linalg.svd(jacobian, full_matrices=False)
    right = -(u.T @ residual)
    good = size > _ROUNDING * size.max(initial=0.0)

    def step(shift: float) -> np.ndarray:
        shares = np.where(good, size / np.where(good, size**2 + shift, 1.0) * right, 0.0)
        found: np.ndarray = vt.T @ shares
        return found

    free = step(0.0)
    if np.linalg.norm(free) <= region:
        return free
    low, high = 0.0, float(np.linalg.norm(size * right)) / region
    for _ in range(100):  # the length falls as the shift grows
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.linalg.norm(step(middle)) > region else (low, middle)
        if high - low < 1e-12 * high:
            break
    return step(high)
