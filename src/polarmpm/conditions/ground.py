"""Stresses at rest of ground that nobody has dug in yet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

Surface = float | Sequence[float] | Callable[..., Any]


class K0:
    """Ground at rest: its vertical stress is the weight of what is above, the horizontal one K0 times that.

    With depth z below the ground's surface, sigma_v = -(surcharge + sum weight z) and sigma_h = K0 sigma_v,
    tension positive; the same in all horizontal directions. It is in equilibrium with `force` below level
    ground. The vertical is the last axis, y in the plane and z in space.

    Args:
        weight: weight (N/m^3); of several layers, from above, a sequence.
        K0: horizontal over vertical stress; one number, or one a layer. 1 - sin(phi) is usual (Jaky).
        surface: height (m) of the ground; of several layers their tops, from above. Or, of one layer, a
            function of positions (n, d) that returns heights (n,), such as of a slope.
        surcharge: what lies on the ground (Pa).

    Raises:
        InputError: numbers out of range, tops that don't go down, or as many numbers as there are no layers.

    Example:
        >>> ground = K0(weight=18e3, K0=0.5, surface=10.0)
        >>> problem.initial_stress(ground)
        >>> problem.body_load(force=ground.force)
    """

    alike = ("weight", "ratio", "surface", "surcharge")

    def __init__(
        self,
        *,
        weight: float | Sequence[float],
        K0: float | Sequence[float],
        surface: Surface,
        surcharge: float = 0.0,
    ):
        self.surface: Any = surface
        count = 1
        if callable(surface):
            checks.function("surface", surface, takes=("positions",))
        else:
            tops = np.atleast_1d(checks.numeric("surface", surface, "a height (m), or tops of layers"))
            count = len(tops)
            if tops.ndim != 1 or not count or not np.isfinite(tops).all() or np.any(np.diff(tops) >= 0):
                raise checks.refuse("surface", surface, "a height (m), or the tops of layers from above")
            self.surface = tuple(tops.tolist())
        self.weight = _of_layers("weight", weight, count)
        self.ratio = _of_layers("K0", K0, count)
        self.surcharge = checks.number("surcharge", surcharge, least=0.0)

    def __repr__(self) -> str:
        where = "a function" if callable(self.surface) else ", ".join(f"{s:g}" for s in self.surface)
        numbers = [", ".join(f"{v:g}" for v in values) for values in (self.weight, self.ratio)]
        last = f"surface = {where}, surcharge = {self.surcharge:g} Pa"
        return f"K0(weight = {numbers[0]} N/m^3, K0 = {numbers[1]}, {last})"

    def _height(self, positions: np.ndarray) -> np.ndarray:
        """Of the ground above positions (n,)."""
        if not callable(self.surface):
            return np.full(len(positions), self.surface[0])
        found = checks.numeric("surface", self.surface(positions.copy()), "heights (n,) (m)")
        if found.shape not in ((), (len(positions),)) or not np.isfinite(found).all():
            raise InputError(f"surface: heights ({len(positions)},) are needed, not {checks.shown(found)}")
        heights: np.ndarray = np.broadcast_to(found, (len(positions),))
        return heights

    def _layer(self, positions: np.ndarray) -> np.ndarray:
        """In which layer positions are (n,)."""
        if callable(self.surface):
            return np.zeros(len(positions), dtype=np.int64)
        below = positions[:, -1][:, None] < np.array(self.surface[1:])
        layer: np.ndarray = np.count_nonzero(below, axis=1)
        return layer

    def stress(self, positions: np.ndarray) -> np.ndarray:
        """Stresses (n, 3, 3) (Pa) at positions (n, d) (m); none above the ground."""
        positions = np.asarray(positions, dtype=float)
        y = positions[:, -1]
        vertical: np.ndarray = self.surcharge + self.weight[0] * np.maximum(self._height(positions) - y, 0.0)
        if not callable(self.surface):
            for k, top in enumerate(self.surface[1:], 1):
                vertical = vertical + (self.weight[k] - self.weight[k - 1]) * np.maximum(top - y, 0.0)
        ratio = np.array(self.ratio)[self._layer(positions)]
        out: np.ndarray = np.einsum("n,ij->nij", -vertical * ratio, np.eye(3))
        axis = positions.shape[1] - 1
        out[:, axis, axis] = -vertical
        return out

    def force(self, factor: float, positions: np.ndarray) -> np.ndarray:
        """The weight (N/m^3) at positions (n, d), whatever the load factor: for `body_load(force=...)`."""
        out = np.zeros_like(positions)
        out[:, -1] = -np.array(self.weight)[self._layer(positions)]
        return out


def _of_layers(name: str, value: Any, count: int) -> tuple[float, ...]:
    found = checks.numeric(name, value, "a number, or one a layer")
    if found.ndim > 1 or (found.ndim and len(found) != count) or not np.isfinite(found).all():
        raise checks.refuse(name, value, f"a number, or one for each of the {count} layer(s) of `surface`")
    if np.any(found < 0):
        raise checks.refuse(name, value, "numbers that aren't negative")
    return tuple(np.broadcast_to(found, (count,)).tolist())
