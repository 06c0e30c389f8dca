"""How free parameters become unknowns that are alike: numbers without unit, zero at the start, of which 1 is
a large change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

_FAR = 300.0  # beyond this an unknown isn't taken: exp of it


@dataclass(frozen=True)
class Bounds:
    """A parameter between bounds that it never reaches: the unknown is ln((m - lower) / (upper - m)), or the
    logarithm of the distance to the only finite bound.

    Args:
        lower, upper: in the parameter's unit; one of them may be infinite.

    Raises:
        InputError: no numbers, no finite bound, or an upper one that isn't above the lower one.
    """

    lower: float
    upper: float

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            value = getattr(self, name)
            infinite = isinstance(value, float | np.floating) and math.isinf(value)
            object.__setattr__(self, name, float(value) if infinite else checks.number(name, value))
        if not self.lower < self.upper or (math.isinf(self.lower) and math.isinf(self.upper)):
            allowed = "lower < upper are needed, one of them finite"
            raise InputError(f"Bounds: lower = {self.lower!r}, upper = {self.upper!r}: {allowed}")

    def forward(self, m: float) -> float:
        if not self.lower < m < self.upper:
            raise InputError(f"{m!r} isn't within the bounds {self.lower!r} and {self.upper!r}")
        low, high = m - self.lower, self.upper - m
        return (0.0 if math.isinf(low) else math.log(low)) - (0.0 if math.isinf(high) else math.log(high))

    def inverse(self, u: float) -> float:
        if math.isinf(self.upper):
            return self.lower + math.exp(min(u, _FAR))
        if math.isinf(self.lower):
            return self.upper - math.exp(min(-u, _FAR))
        share = 1.0 / (1.0 + math.exp(-u)) if u > -_FAR else 0.0
        return self.lower + (self.upper - self.lower) * share

    def slope(self, m: float) -> float:
        low, high = m - self.lower, self.upper - m
        return 1.0 / ((0.0 if math.isinf(low) else 1.0 / low) + (0.0 if math.isinf(high) else 1.0 / high))


@dataclass(frozen=True)
class Linear:
    """A parameter that may have any sign: the unknown is m / scale.

    Args:
        scale: a change (in the parameter's unit) that counts as large.
    """

    scale: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", checks.number("scale", self.scale, above=0.0))

    def forward(self, m: float) -> float:
        return m / self.scale

    def inverse(self, u: float) -> float:
        return u * self.scale

    def slope(self, m: float) -> float:
        return self.scale


@dataclass(frozen=True)
class Log:
    """A parameter that keeps its sign: the unknown is ln|m|."""

    sign: float

    def forward(self, m: float) -> float:
        if not m * self.sign > 0:
            raise InputError(f"{m!r} has not the sign of the start, which a logarithm keeps")
        return math.log(m * self.sign)

    def inverse(self, u: float) -> float:
        return self.sign * math.exp(min(u, _FAR))

    def slope(self, m: float) -> float:
        return m


Transform = Bounds | Linear | Log
_ALLOWED = '"log", polarmpm.Bounds(lower, upper) or polarmpm.Linear(scale)'


@dataclass(frozen=True)
class Free:
    """The free parameters among all: `v` (n,) are the unknowns, 0 at the start."""

    start: dict[str, float]
    transforms: dict[str, Transform]

    @property
    def names(self) -> list[str]:
        return list(self.transforms)

    def values(self, v: np.ndarray) -> dict[str, float]:
        """All parameters, free and fixed."""
        out = dict(self.start)
        for value, (name, transform) in zip(v, self.transforms.items(), strict=True):
            out[name] = (
                self.start[name] if value == 0 else transform.inverse(self.origin(name) + float(value))
            )
        return out

    def value(self, name: str, v: float) -> float:
        """One free parameter of its unknown."""
        return self.transforms[name].inverse(self.origin(name) + float(v))

    def origin(self, name: str) -> float:
        return self.transforms[name].forward(self.start[name])

    def unknowns(self, values: Mapping[str, float]) -> np.ndarray:
        """v (n,) of values (those that are missing are at the start)."""
        pairs = [(n, values.get(n, self.start[n])) for n in self.transforms]
        return np.array([self.transforms[n].forward(m) - self.origin(n) for n, m in pairs])

    def slopes(self, values: Mapping[str, float]) -> np.ndarray:
        """dm/dv (n,), in the parameters' units."""
        return np.array([t.slope(values[name]) for name, t in self.transforms.items()])

    def without(self, name: str, value: float) -> Free:
        """The others, one being held at a value."""
        kept = {n: t for n, t in self.transforms.items() if n != name}
        return Free({**self.start, name: value}, kept)


def free_parameters(start: Any, free: Any) -> Free:
    """What a script gives, checked: numbers by name, and transforms of those that are free.

    Raises:
        InputError: no numbers by name; a free parameter without a start; a start that its transform refuses.
    """
    if not isinstance(start, Mapping) or not start:
        raise checks.refuse("start", start, 'numbers by name are needed, such as {"k": 150e6}')
    found = {
        checks.text("start: a name", name): checks.number(f"start: {name}", m) for name, m in start.items()
    }
    if isinstance(free, str) or not isinstance(free, Mapping | Sequence | set | frozenset) or not free:
        raise checks.refuse("free", free, f"names of parameters, or {_ALLOWED} by name")
    wanted = (
        free
        if isinstance(free, Mapping)
        else dict.fromkeys(sorted(free) if isinstance(free, set | frozenset) else free, "log")
    )
    transforms: dict[str, Transform] = {}
    for name, kind in wanted.items():
        if name not in found:
            raise checks.refuse("free", name, f"one of start, {', '.join(found)}")
        transforms[name] = _transform(name, kind, found[name])
    return Free(found, transforms)


def _transform(name: str, kind: Any, start: float) -> Transform:
    if isinstance(kind, str) and kind == "log":
        if start == 0:
            raise InputError(f"start: {name} = 0: a logarithm needs another start; {_ALLOWED}")
        return Log(math.copysign(1.0, start))
    if not isinstance(kind, Bounds | Linear | Log):
        raise checks.refuse(f"free: {name}", kind, f"{_ALLOWED} is needed")
    try:
        kind.forward(start)
    except InputError as e:
        raise InputError(f"start: {name} = {start!r}: {e}") from None
    return kind


def told(transform: Transform) -> Any:
    """As JSON has it."""
    if isinstance(transform, Log):
        return "log"
    if isinstance(transform, Linear):
        return {"scale": transform.scale}
    return {"lower": _finite(transform.lower), "upper": _finite(transform.upper)}


def _finite(value: float) -> float | None:
    return None if math.isinf(value) else value


def untold(name: str, told: Any, start: float) -> Transform:
    """A transform of what JSON has."""
    if told == "log":
        return _transform(name, "log", start)
    if "scale" in told:
        return Linear(told["scale"])
    low, high = told["lower"], told["upper"]
    return Bounds(-math.inf if low is None else low, math.inf if high is None else high)
