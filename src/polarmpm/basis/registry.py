"""The bases by their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..errors import InputError
from ..tools import checks
from .averaged import AveragedSplines
from .base import Basis, check_basis
from .bspline import QuadraticSplines
from .bspline3 import CubicSplines
from .gimpm import Gimpm
from .tents import Tents

BASES: dict[str, Basis] = {}


def register(basis: Basis) -> None:
    """Make a basis known by its name.

    Raises:
        InputError: it is not a `Basis`, its functions aren't what `check_basis` wants, or another one has its
            name.
    """
    made = isinstance(basis, type) and issubclass(basis, Basis)
    checks.instance("basis", basis, Basis, "an instance is" if made else "a Basis is")
    check_basis(basis)
    known = BASES.setdefault(basis.name, basis)
    if type(known) is not type(basis):
        raise InputError(f"basis {basis.name!r}: a {type(known).__name__} has this name already")


def basis_of(basis: Any) -> Basis:
    """The basis of a name, or the basis itself.

    Raises:
        InputError: an unknown name.
    """
    if isinstance(basis, Basis):
        check_basis(basis)
        return basis
    if not isinstance(basis, str) or basis not in BASES:
        raise checks.refuse("basis", basis, f"allowed are {', '.join(BASES)}")
    return BASES[basis]


def names(suits: Callable[[Basis], bool]) -> str:
    """Names of the bases that suit; for messages."""
    found = [repr(name) for name, basis in BASES.items() if suits(basis)]
    return " and ".join(filter(None, [", ".join(found[:-1]), *found[-1:]]))


for _basis in (Gimpm(), Tents(), QuadraticSplines(), CubicSplines(), AveragedSplines()):
    BASES[_basis.name] = _basis  # tests try their functions
