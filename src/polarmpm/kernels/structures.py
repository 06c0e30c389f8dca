"""Structures, constants and prototypes of the compiled loops, read from their C text.

What a field or an argument is stands in the C text alone. Arrays and numbers are held against it here: ctypes
takes an array of any type for an address, and cuts a number that is too large.
"""

from __future__ import annotations

import ctypes
import numbers
import re
from collections.abc import Callable, Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

FOLDER = Path(__file__).parent
_NUMBERS: dict[str, Any] = {
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int": ctypes.c_int,
    "int8_t": ctypes.c_int8,
    "uint8_t": ctypes.c_uint8,
    "int32_t": ctypes.c_int32,
    "int64_t": ctypes.c_int64,
}
_ADDRESS = "kernel_t"  # a function's address, which Python holds as a number


class Structure(ctypes.Structure):
    """A C structure that knows its fields' types and keeps the arrays alive to which it points.

    Attributes:
        declared: the fields by name.
        kept: arrays by the names of the pointers to them.
    """

    declared: ClassVar[dict[str, Declared]] = {}
    kept: dict[str, np.ndarray[Any, Any]]

    def __init__(self) -> None:
        super().__init__()
        self.kept = {}


_STRUCTURES: dict[str, type[Structure]] = {}
_S = TypeVar("_S", bound=type[Structure])


class Declared:
    """A field or an argument: its owner, its name, its C type, of a pointer the one that it points to."""

    def __init__(self, owner: str, name: str, kind: str, pointer: bool):
        self.owner, self.name, self.kind, self.pointer = owner, name, kind, pointer

    @cached_property
    def ctype(self) -> Any:
        """What ctypes calls it."""
        if self.pointer and self.kind in _STRUCTURES:
            return ctypes.POINTER(_STRUCTURES[self.kind])
        return ctypes.c_void_p if self.pointer or self.kind == _ADDRESS else _NUMBERS[self.kind]

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Element type of the arrays that a pointer takes; addresses of other arrays are numbers, too."""
        found: np.dtype[Any] = np.dtype(_NUMBERS.get(self.kind, np.uintp))
        return found

    @cached_property
    def _limits(self) -> tuple[int, int]:
        """The least and the greatest whole number that it holds."""
        limits = np.iinfo(self.dtype)
        return int(limits.min), int(limits.max)

    def check(self, value: Any) -> None:
        """Whether a value fits.

        Raises:
            TypeError: it is of another kind or dtype.
            ValueError: an array is not contiguous, or a number is out of range.
        """
        if type(value) is np.ndarray and self.pointer:
            if value.dtype == self.dtype and value.flags.c_contiguous:
                return
        elif type(value) is int and self._holds(value):
            return
        what = f"{self.owner}.{self.name}"
        if self.pointer and isinstance(value, np.ndarray):
            if value.dtype != self.dtype:
                raise TypeError(f"{what} is an array of {value.dtype}; {self.dtype} is needed")
            if not value.flags.c_contiguous:
                raise ValueError(f"{what} is an array that is not contiguous; a contiguous one is needed")
        elif self.pointer and value is not None:
            raise TypeError(f"{what} = {value!r}: an array of {self.dtype} or None is needed")
        elif self.kind == "double" and not self.pointer and not isinstance(value, numbers.Real):
            raise TypeError(f"{what} = {value!r}: a number is needed")
        elif self.kind != "double" and not self.pointer:
            self._check_whole(value, what)

    def _holds(self, value: int) -> bool:
        """Whether it is a number that is large enough for a whole one."""
        if self.pointer or self.kind not in _NUMBERS:
            return False
        return self.kind == "double" or self._limits[0] <= value <= self._limits[1]

    def _check_whole(self, value: Any, what: str) -> None:
        if value is None and self.kind == _ADDRESS:
            return
        if not isinstance(value, numbers.Integral):
            raise TypeError(f"{what} = {value!r}: a whole number is needed")
        least, greatest = self._limits
        if not least <= int(value) <= greatest:
            raise ValueError(f"{what} = {value}: {self.kind} holds {least} to {greatest}")

    @property
    def of_array(self) -> bool:
        """Whether it points to an array's numbers."""
        return self.pointer and self.kind not in _STRUCTURES


# the C text ---------------------------------------------------------------------------------------------
@cache
def _code(file: str) -> str:
    """Text of a C file without comments and qualifiers."""
    text = (FOLDER / file).read_text(encoding="utf-8")
    return re.sub(r"/\*.*?\*/|\bconst\b|\brestrict\b", " ", text, flags=re.DOTALL)


@cache
def _structures(file: str) -> dict[str, str]:
    """The declarations in each structure of a file."""
    found = re.findall(r"typedef struct \{([^}]*)\} (\w+);", _code(file))
    return {name: body for body, name in found}


@cache
def _constants(file: str) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"\b([A-Z_]+) = (\d+)\b", _code(file))}


def _declarations(owner: str, text: str) -> list[Declared]:
    """The variables of a declaration such as `double *a, b`.

    Raises:
        ValueError: a type, or a kind of declaration, that this reader doesn't know.
    """
    words = text.replace("*", " * ").split(maxsplit=1)
    kind, names = words if len(words) == 2 else (text, "")
    out = []
    for variable in names.split(","):
        name, stars = variable.replace("*", "").strip(), variable.count("*")
        if not name.isidentifier() or not (kind in _NUMBERS or kind in _STRUCTURES or kind == _ADDRESS):
            raise ValueError(f"{owner}: the declaration `{text.strip()}` can't be read")
        out.append(Declared(owner, name, kind + "*" * (stars - 1), stars > 0))
    return out


def constant(file: str, name: str) -> int:
    """A number of the file's enums."""
    if name not in _constants(file):
        raise KeyError(f"{file} has no constant {name}")
    return _constants(file)[name]


def declared_in(file: str) -> Callable[[_S], _S]:
    """Decorator: gives a class the fields of the structure of its name."""

    def complete(cls: _S) -> _S:
        name = cls.__name__
        if name not in _structures(file):
            raise KeyError(f"{file} has no structure {name}")
        lines = [line for line in _structures(file)[name].split(";") if line.strip()]
        fields = [field for line in lines for field in _declarations(name, line)]
        cls.declared = {field.name: field for field in fields}
        cls._fields_ = [(field.name, field.ctype) for field in fields]
        _STRUCTURES[name] = cls
        return cls

    return complete


def prototypes() -> Iterator[tuple[str, bool, list[Declared]]]:
    """Name, whether it returns a number, and arguments of each function that Python may call."""
    for path in sorted(FOLDER.glob("_*.[ch]")):
        for result, name, text in re.findall(
            r"^(?:FAST )?(\w+) (polarmpm_\w+)\(([^)]*)\)\s*\{", _code(path.name), re.M
        ):
            arguments = [a for a in text.split(",") if a.strip() != "void"]
            yield name, result != "void", [d for a in arguments for d in _declarations(name, a)]
