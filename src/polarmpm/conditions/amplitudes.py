"""Values that follow the load factor."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

Value = float | Sequence[float] | Callable[..., Any]


COUNTS = ("from now", "total")


def check_counts(name: str, counts: str | None) -> str | None:
    """What a user gives as `counts`; None: the default.

    Raises:
        InputError: something else.
    """
    if counts is not None and not (isinstance(counts, str) and counts in COUNTS):
        allowed = f"allowed are {' and '.join(map(repr, COUNTS))}"
        raise checks.refuse(f"{name}: counts", counts, allowed)
    return counts


@dataclass(frozen=True)
class Fade:
    """How a load that is released vanishes: evenly, from the load factor `begin` to `end`.

    Attributes:
        over: it has vanished, for good, wherever the load factor goes.
    """

    begin: float
    end: float
    over: bool = False

    def share(self, factor: float) -> float:
        """What is left of it at a load factor, 0 to 1."""
        if self.over:
            return 0.0
        return float(np.clip((self.end - factor) / (self.end - self.begin), 0.0, 1.0))

    def after(self, factor: float) -> Fade:
        """The same once a step has converged at a load factor."""
        return self if self.over or self.share(factor) else replace(self, over=True)

    def leaves(self, factor: float, to: float) -> bool:
        """Whether the way from a load factor to another one leads away from where it has vanished."""
        return not self.over and (self.end - self.begin) * (to - factor) < 0.0


class Amplitude:
    """A number or vector that follows the load factor.

    A number (or sequence) is ramped: value times load factor. A function of one argument gives the value at
    a load factor; a function of two, (factor, positions (n, d)), gives a value for each position. A load that
    is added in mid-run counts from then on, or in total, see `begin`.

    Attributes:
        begun: load factor from which it counts.
        fade: how it vanishes once it has been released; None: it hasn't.

    Raises:
        InputError: wrong size, or a value that is not finite, naming the condition and the factor.
    """

    def __init__(self, name: str, value: Value, size: int):
        self.name, self.size = name, size
        self.begun, self._differs = 0.0, False
        self.fade: Fade | None = None
        self.function: Callable[..., Any] | None = None
        self.field = False
        if callable(value):
            self.field = _positional(value) >= 2
            takes = ("load factor", "positions")[: 1 + self.field]
            self.function = checks.function(name, value, takes=takes)
            if not self.field:
                self.at(1.0, np.zeros((1, 1)))
        else:
            constant = checks.numeric(name, value, f"{_numbers(size)}, or a function of the load factor")
            if constant.shape not in ((), (size,)):
                raise checks.refuse(name, value, f"{_numbers(size)} needed")
            self.constant = np.broadcast_to(constant, (size,)).astype(float)
            self._check(self.constant, 1.0)
            if constant.shape == () and size > 1 and constant != 0.0:
                what = f"one number for {size} components; {self._hint(value)}"
                raise checks.refuse(name, value, what)

    def _hint(self, value: Any) -> str:
        zeros = ", 0" * (self.size - 1)
        return f"write {self.name.split(', ')[-1]}=({value}{zeros}) or the like"

    def is_zero(self, component: int) -> bool:
        """Whether a component is the number zero; a function isn't."""
        return self.function is None and bool(self.constant[component] == 0.0)

    def begin(self, factor: float, counts: str | None = None) -> None:
        """Count from a load factor at which it is added: "from now", what it gains from then on, or in
        "total", the value at the load factor. By default numbers count from now, functions in total."""
        counts = counts or (COUNTS[0] if self.function is None else COUNTS[1])
        self.begun = factor
        self._differs = counts == COUNTS[0] and not (self.function is None and factor == 0.0)

    def _check(self, values: np.ndarray, factor: float) -> None:
        if not np.all(np.isfinite(values)):
            bad = values[~np.isfinite(values)].flat[0]
            raise InputError(f"{self.name} is {bad} at load factor {factor:g}; finite numbers are allowed")

    def at(self, factor: float, positions: np.ndarray) -> np.ndarray:
        """Values (n, size) at positions (n, d)."""
        if self.fade is not None:
            return self._counted(self.fade.begin, positions) * self.fade.share(factor)
        return self._counted(factor, positions)

    def _counted(self, factor: float, positions: np.ndarray) -> np.ndarray:
        value = self._total(factor, positions)
        return value - self._total(self.begun, positions) if self._differs else value

    def _total(self, factor: float, positions: np.ndarray) -> np.ndarray:
        n = len(positions)
        if self.function is None:
            return np.broadcast_to(factor * self.constant, (n, self.size))
        # a copy: what a script does with its positions is up to it
        raw = self.function(factor, positions.copy()) if self.field else self.function(factor)
        try:
            given = checks.numeric(self.name, raw)
            one = given.ndim == 0 or (self.field and given.shape == (n,) != (self.size,))
            # an array (n, 1) isn't to be broadcast to several components
            if not one and given.shape[-1] != self.size:
                raise ValueError
            values = given[:, None] if one and given.ndim else given
            values = np.broadcast_to(values, (n, self.size))
        except ValueError:
            where = f", or an array of shape ({n}, {self.size})" if self.field else ""
            raise InputError(
                f"{self.name} returned {checks.shown(raw)} at load factor {factor:g}; {_numbers(self.size)} "
                f"needed{where}"
            ) from None
        self._check(values, factor)
        if one and self.size > 1 and np.any(given):
            first = given[np.nonzero(given)][0] if given.ndim else raw
            raise InputError(
                f"{self.name} returned one number at load factor {factor:g} for {self.size} components; "
                f"{self._hint(first)}{' for each position' if given.ndim else ''}"
            )
        return values


def _numbers(size: int) -> str:
    return "one number is" if size == 1 else f"{size} numbers are"


def _positional(function: Callable[..., Any]) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is inspect.Parameter.empty for p in parameters)
