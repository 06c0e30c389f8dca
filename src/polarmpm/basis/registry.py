"""The bases by their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..errors import InputError
from .averaged import AveragedSplines
from .base import Basis
from .bspline import QuadraticSplines
from .bspline3 import CubicSplines
from .gimpm import Gimpm
from .tents import Tents

BASES: dict[str, Basis] = {}


def register(basis: Basis) -> None:
    """Make a basis known by its name.

    Raises:
        InputError: it is not a `Basis`, or another one has its name.
    """
    if not isinstance(basis, Basis):
        raise InputError(f"basis = {basis!r} is not a Basis")
    known = BASES.setdefault(basis.name, basis)
    if type(known) is not type(basis):
        raise InputError(f"basis {basis.name!r}: a {type(known).__name__} has this name already")


def basis_of(basis: Any) -> Basis:
    """The basis of a name, or the basis itself.

    Raises:
        InputError: an unknown name.
    """
    if isinstance(basis, Basis):
        return basis
    if not isinstance(basis, str) or basis not in BASES:
        raise InputError(f"basis = {basis!r}: allowed are {', '.join(BASES)}")
    return BASES[basis]


def names(suits: Callable[[Basis], bool]) -> str:
    """Names of the bases that suit; for messages."""
    found = [repr(name) for name, basis in BASES.items() if suits(basis)]
    return " and ".join(filter(None, [", ".join(found[:-1]), *found[-1:]]))


register(Gimpm())
register(Tents())
register(QuadraticSplines())
register(CubicSplines())
register(AveragedSplines())
