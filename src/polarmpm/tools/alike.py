"""What a script gives to a call, as a text that is the same on all ranks if it is the same."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from typing import Any

from mpi4py import MPI

import numpy as np

_DIGITS = 10  # in which numbers are compared
_FEW = 8  # entries that are written out
_LONGEST = 2000  # characters; what is longer ends in a digest


def described(args: tuple[Any, ...], options: Mapping[str, Any]) -> str:
    """Arguments of a call. Of functions, and of objects that aren't known here, only the kind."""
    parts = [told(value) for value in args]
    parts += [f"{name}={told(value)}" for name, value in sorted(options.items())]
    return _short(", ".join(parts))


def told(value: Any) -> str:
    """One value."""
    if value is None or isinstance(value, bool | np.bool_ | str | bytes):
        return repr(value) if not isinstance(value, np.bool_) else repr(bool(value))
    if isinstance(value, MPI.Comm):
        return "communicator"
    if isinstance(value, os.PathLike):
        return repr(os.fspath(value))
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return f"{value:.{_DIGITS}g}"
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{told(k)}: {told(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return _short("(" + ", ".join(map(told, value)) + ")")
    if isinstance(value, type):
        return value.__qualname__
    own = {name: getattr(value, name, None) for name in _compared(value)}
    if own:
        return _short(f"{type(value).__name__}(" + ", ".join(f"{k}={told(v)}" for k, v in own.items()) + ")")
    if callable(value):
        return "a function"
    name = getattr(value, "name", None)
    return f"{type(value).__name__} {name}" if isinstance(name, str) else type(value).__name__


def _compared(value: Any) -> list[str]:
    """Attributes of an object that are the same on all ranks: those that its class names in `alike`; of
    other data classes all but arrays, which may be a rank's own."""
    named = getattr(type(value), "alike", None)
    if named is not None:
        return list(named)
    if not dataclasses.is_dataclass(value):
        return []
    of = [f.name for f in dataclasses.fields(value) if f.repr]
    return [name for name in of if not isinstance(getattr(value, name, None), np.ndarray)]


def _array(value: np.ndarray) -> str:
    if value.dtype == object or value.size <= _FEW:
        return told(value.tolist())
    rounded = value
    if value.dtype.kind == "f":
        with np.errstate(all="ignore"):
            scale = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(np.where(value == 0, 1.0, np.abs(value)))))
            rounded = np.round(value * scale) / scale + 0.0
    return f"array {value.shape} {_digest(np.ascontiguousarray(rounded).tobytes())}"


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]}... {_digest(text.encode())}"


def _digest(content: bytes) -> str:
    return "#" + hashlib.blake2b(content, digest_size=6).hexdigest()
