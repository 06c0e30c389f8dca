"""Checks of arguments."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

from ..errors import InputError


def require_finite(name: str, value: Any) -> None:
    """Raise InputError unless `value` is a finite number."""
    if not isinstance(value, Real) or not math.isfinite(value):
        raise InputError(f"{name} = {value!r} is not a finite number")


def require(condition: bool, name: str, value: float, allowed: str) -> None:
    """Raise InputError with the argument's name, value and what is allowed."""
    if not condition:
        raise InputError(f"{name} = {value:g} is out of range: {allowed}")
