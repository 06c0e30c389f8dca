"""Values that follow the load factor."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import InputError

Value = float | Sequence[float] | Callable[..., Any]


class Amplitude:
    """A number or vector that follows the load factor.

    A number (or sequence) is ramped: value times load factor. A function of one argument gives the value at
    a load factor; a function of two, (factor, positions (n, d)), gives a value for each position.

    Raises:
        InputError: wrong size, or a value that is not finite, naming the condition and the factor.
    """

    def __init__(self, name: str, value: Value, size: int):
        self.name, self.size = name, size
        self.function: Callable[..., Any] | None = value if callable(value) else None
        self.field = False
        if self.function is not None:
            self.field = _positional(self.function) >= 2
            if not self.field:
                self.at(1.0, np.zeros((1, 1)))
        else:
            try:
                constant = np.asarray(value, float)
            except (TypeError, ValueError):
                raise InputError(f"{name} = {value!r}: a number, a sequence or a function") from None
            if constant.shape not in ((), (size,)):
                raise InputError(f"{name} = {value!r}: one number or {size} of them")
            self.constant = np.broadcast_to(constant, (size,)).astype(float)
            self._check(self.constant, 1.0)

    def _check(self, values: np.ndarray, factor: float) -> None:
        if not np.all(np.isfinite(values)):
            bad = values[~np.isfinite(values)].flat[0]
            raise InputError(f"{self.name} is {bad} at load factor {factor:g}; finite numbers are allowed")

    def at(self, factor: float, positions: np.ndarray) -> np.ndarray:
        """Values (n, size) at positions (n, d)."""
        n = len(positions)
        if self.function is None:
            return np.broadcast_to(factor * self.constant, (n, self.size))
        raw = self.function(factor, positions) if self.field else self.function(factor)
        try:
            values = np.asarray(raw, float)
            if self.field and values.shape == (n,):
                values = values[:, None]
            values = np.broadcast_to(values, (n, self.size))
        except (TypeError, ValueError):
            raise InputError(
                f"{self.name} returned {raw!r} at load factor {factor:g}; {self.size} number(s) are needed"
            ) from None
        self._check(values, factor)
        return values


def _positional(function: Callable[..., Any]) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is inspect.Parameter.empty for p in parameters)
