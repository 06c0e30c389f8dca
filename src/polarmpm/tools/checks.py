"""Checks of arguments, the same wording everywhere: each returns the value in the type the code works with.

A check takes the argument's name first and raises InputError with name, value and what is allowed. Numbers
and whole numbers may be NumPy's. What only one rank can see is for `tools.parallel.errors_on_all_ranks`.
"""

from __future__ import annotations

import inspect
import math
import operator
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

from mpi4py import MPI

import numpy as np

from ..errors import InputError

T = TypeVar("T")
_ADDRESS = re.compile(" at 0x[0-9a-f]+")
_SHOWN = 80  # characters of a value in a message


def shown(value: Any) -> str:
    """A value as messages show it: on one line, and short."""
    if isinstance(value, np.ndarray) and value.size > 6:
        return f"an array of shape {value.shape}"
    try:
        text = _ADDRESS.sub("", " ".join(repr(value).split()))  # addresses differ between ranks
    except Exception:  # a user's class may have a broken repr
        text = f"an instance of {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def ordinary(error: Exception) -> bool:
    """Whether an error is what a mistake in a value or a function leads to, rather than one from outside that
    came while it was looked at, such as an alarm's, or an exception of the script's own."""
    return type(error).__module__.split(".")[0] in ("builtins", "numpy", "ufl") and not isinstance(
        error, OSError
    )


@contextmanager
def evaluating(what: str, hint: Callable[[Exception], str] = lambda error: "") -> Iterator[None]:
    """A call of a script's function: what a mistake in it raises becomes an InputError, with a hint."""
    try:
        yield
    except Exception as e:  # a user's function and UFL may raise anything
        if not ordinary(e):
            raise
        raise InputError(f"{what} can't be evaluated: {type(e).__name__}: {e}{hint(e)}") from e


def refuse(name: str, value: Any, allowed: str) -> InputError:
    """The error to raise: `raise refuse("steps", steps, "a positive whole number")`."""
    return InputError(f"{name} = {shown(value)}: {allowed}")


def number(
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
    allowed: str = "",
) -> float:
    """A finite number with least <= value <= most and above < value < below."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    good = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if good:
        try:
            good = math.isfinite(float(value)) and least <= value <= most and above < value < below
        except OverflowError:  # a whole number of hundreds of digits
            good = False
    if not good:
        raise refuse(name, value, allowed or _range("a finite number", least, above, most, below))
    return float(value)


def whole(
    name: str, value: Any, *, least: float = -math.inf, most: float = math.inf, allowed: str = ""
) -> int:
    """A whole number with least <= value <= most; NumPy's are taken, floats and booleans are not."""
    try:
        n = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        n = None
    if n is None or not least <= n <= most:
        raise refuse(name, value, allowed or _range("a whole number", least, -math.inf, most, math.inf))
    return n


def _range(what: str, least: float, above: float, most: float, below: float) -> str:
    if least == 0 and most == below == math.inf:
        return f"{what}, not negative"
    if (above == 0 or (least == 1 and what == "a whole number")) and most == below == math.inf:
        return f"{what.replace('a ', 'a positive ', 1)}"
    ends = [f"of at least {least:g}"] if least > -math.inf else []
    ends += [f"above {above:g}"] if above > -math.inf else []
    ends += [f"of at most {most:g}"] if most < math.inf else []
    ends += [f"below {below:g}"] if below < math.inf else []
    return " ".join([what, " and ".join(ends)]).strip()


def flag(name: str, value: Any, *, or_none: bool = False) -> bool:
    """True or False, nothing that merely counts as such; `or_none` only tells that None is allowed, too."""
    if not isinstance(value, bool | np.bool_):
        raise refuse(name, value, "True, False or None" if or_none else "True or False")
    return bool(value)


def choice(name: str, value: Any, allowed: Collection[T]) -> T:
    """One of the allowed values."""
    for one in allowed:
        if type(one) is type(value) and one == value:
            return one
    raise refuse(name, value, "one of " + ", ".join(map(repr, allowed)))


def array(name: str, value: Any, shape: Sequence[int | None], what: str = "") -> np.ndarray:
    """Finite numbers (float64) of a shape; None in it allows any length.

    Args:
        what: says what the array is, for the message: "one volume for each point".
    """
    found = numeric(name, value, what)
    if found.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, found.shape, strict=True)):
        wanted = ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "")
        raise refuse(
            name, value, f"an array of shape ({wanted}) is needed{_of(what)}; its shape is {found.shape}"
        )
    if not np.isfinite(found).all():
        raise refuse(name, value, f"finite numbers are needed{_of(what)}")
    return found


def numeric(name: str, value: Any, what: str = "", kinds: str = "iuf") -> np.ndarray:
    """Real numbers (float64) of whatever shape; not a number and infinite ones, too.

    Args:
        kinds: of numpy's types; "biuf" takes booleans as zeros and ones.
    """
    try:
        raw = np.asarray(value)
        good = raw.dtype.kind in kinds
        found = raw.astype(float) if good else raw
    except Exception as e:  # rows of several lengths, say, and a user's class may do anything
        if not ordinary(e):
            raise
        good = False
    if not good:
        raise refuse(name, value, f"numbers are needed{_of(what)}")
    return found


def _of(what: str) -> str:
    return f" ({what})" if what else ""


def vector(name: str, value: Any, dim: int, what: str = "") -> np.ndarray:
    """A vector (dim,) of finite numbers."""
    return array(name, value, (dim,), what or f"a vector of {dim} components")


def several(value: Any) -> bool:
    """Whether it is a sequence or an array rather than one thing."""
    return isinstance(value, list | tuple | range) or (isinstance(value, np.ndarray) and value.ndim > 0)


def sequence(name: str, value: Any, number: int, what: str = "values") -> tuple[Any, ...]:
    """So many things in a sequence (or array), whatever they are."""
    try:
        found = None if isinstance(value, str | bytes | Mapping) else tuple(value)
    except Exception:
        found = None
    if found is None or len(found) != number:
        raise refuse(name, value, f"{number} {what} are needed")
    return found


def text(name: str, value: Any, allowed: str = "a text that isn't empty") -> str:
    """A string that isn't empty."""
    if not isinstance(value, str) or not value:
        raise refuse(name, value, allowed)
    return value


def path(name: str, value: Any, what: str = "the name of a file") -> Path:
    """Name of a file or folder, made absolute: a later os.chdir must not move it."""
    try:
        raw = os.fspath(value)
    except TypeError:
        raw = ""
    if not isinstance(raw, str) or not raw or "\0" in raw:
        raise refuse(name, value, f"{what} is needed")
    return Path(os.path.abspath(raw))


def instance(name: str, value: Any, types: type[T] | tuple[type[T], ...], what: str) -> T:
    """An object of a type: `instance("points", points, Points, "material points, as pm.seed makes them")`."""
    if not isinstance(value, types):
        raise refuse(name, value, f"{what} needed")
    return value


def function(
    name: str, value: Any, what: str = "a function is", *, takes: Sequence[str] = ()
) -> Callable[..., Any]:
    """Something that can be called, with the arguments that `takes` names for messages; () isn't checked."""
    if not callable(value):
        raise refuse(name, value, f"{what} needed")
    if takes:
        try:
            inspect.signature(value).bind(*takes)
        except TypeError as e:
            raise refuse(
                name, value, f"it is called with {len(takes)} argument(s), {', '.join(takes)}: {e}"
            ) from None
        except ValueError:  # functions written in C may not tell
            if isinstance(value, np.ufunc) and value.nin != len(takes):
                raise refuse(name, value, f"it is called with {', '.join(takes)}") from None
    called: Callable[..., Any] = value
    return called


def mask(name: str, value: Any, number: int) -> np.ndarray:
    """What a predicate of `number` positions has returned: a bool for each of them."""
    try:
        found = np.asarray(value)
    except Exception as e:  # rows of several lengths, say
        if not ordinary(e):
            raise
        found = np.array(None)
    if found.dtype != bool or found.shape != (number,):
        raise InputError(
            f"{name}: returned {shown(value)} of type {found.dtype} and shape {found.shape}; a bool for each "
            f"of the {number} positions is needed, such as x[:, 0] > 0"
        )
    return found


def communicator(name: str, value: Any) -> MPI.Intracomm:
    """Ranks that work together."""
    if not isinstance(value, MPI.Intracomm) or value == MPI.COMM_NULL:
        raise refuse(name, value, "a communicator of mpi4py, such as MPI.COMM_WORLD, is needed")
    return value


def put_numbers(owner: Any, *names: str) -> None:
    """Make attributes of a frozen dataclass finite floats, or raise InputError."""
    for name in names:
        object.__setattr__(owner, name, number(name, getattr(owner, name)))


def numbers_by_name(name: str, value: Any) -> dict[str, float]:
    """Finite numbers under names that can be written as attributes, p.name."""
    if not isinstance(value, Mapping):
        raise refuse(name, value, 'numbers by name are needed, such as {"a": 1.0}')
    for key in value:
        if not isinstance(key, str) or not key.isidentifier():
            raise InputError(f"{name}: {shown(key)} is no name; it is to be written as an attribute, p.a")
    return {str(key): number(key, one) for key, one in value.items()}


def require(condition: bool, name: str, value: float, allowed: str) -> None:
    """Raise InputError with the argument's name, value and what is allowed."""
    if not condition:
        raise InputError(f"{name} = {value:g} is out of range: {allowed}")
