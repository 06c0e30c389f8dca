"""Access to the compiled loops over points (`_native.c`) through ctypes."""

from __future__ import annotations

import ctypes
import importlib.util
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from . import structures
from .structures import Declared, Structure, declared_in

INTERFACE = structures.constant("_points.h", "INTERFACE")  # what the headers say; the build may be older


@declared_in("_points.h")
class Batch(Structure):
    """Points of one material, sorted by node set."""

    @property
    def frames(self) -> np.ndarray:
        """The points' frames (n, dim, dim), with which their states begin."""
        d = self.dim
        frames: np.ndarray = self.kept["state"][:, : d * d].reshape(-1, d, d)
        return frames


@declared_in("_points.h")
class Matrix(Structure):
    """Where the blocks of node pairs stand in the sparse matrix."""


@declared_in("_points.h")
class PointKernels(Structure):
    """Compiled kernels of a batch."""


@declared_in("_points.h")
class Patches(Structure):
    """Patches of a batch's points."""


@declared_in("_elements.c")
class Elements(Structure):
    """Finite elements of one material, and where their nodes' blocks stand in the sparse matrix."""


@declared_in("_return.c")
class Return(Structure):
    """Kernels and controls of a return mapping."""


@declared_in("_rows.h")
class BlockRows(Structure):
    """A sparse matrix of blocks, in double precision."""


@declared_in("_rows.h")
class Relaxation(Structure):
    """What relaxation by blocks needs of a matrix, in single precision."""


@declared_in("_lattice.c")
class Transfer(Structure):
    """Interpolation from a coarser lattice."""


STRUCTURES = (Batch, Matrix, PointKernels, Patches, Elements, Return, BlockRows, Relaxation, Transfer)


_number_at: Callable[[Any], ctypes.c_char] = ctypes.c_char.from_buffer


def address(array: np.ndarray) -> int:
    """Where an array's numbers begin: as `array.ctypes.data`, which takes twelve times as long."""
    try:
        return ctypes.addressof(_number_at(array))
    except (TypeError, ValueError):  # it can't be written to, or is empty
        found: int = array.ctypes.data
        return found


def rows(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Addresses of arrays (n, k), which may be columns of wider ones, and numbers from row to row.

    Raises:
        ValueError: numbers of a row that don't stand one after the other.
    """
    if any(a.size and a.strides[-1] != a.itemsize for a in arrays):
        raise ValueError("numbers of a row must stand one after the other")
    step = np.array([a.strides[0] // a.itemsize for a in arrays], dtype=np.int64)
    return np.array([a.ctypes.data for a in arrays], dtype=np.uintp), step


def fill(structure: Structure, **values: Any) -> None:
    """Set numbers and array addresses of a structure, which keeps the arrays alive.

    Raises:
        TypeError: a field that the structure doesn't have, or a value that is not of the field's type.
        ValueError: an array that is not contiguous, or a number out of range.
    """
    for name, value in values.items():
        field = structure.declared.get(name)
        if field is None:
            allowed = ", ".join(structure.declared)
            raise TypeError(f"{type(structure).__name__} has no field {name}; it has {allowed}")
        field.check(value)
        if isinstance(value, np.ndarray):
            structure.kept[name] = value
            value = address(value)
        else:
            structure.kept.pop(name, None)
        setattr(structure, name, value)


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The shared library, built when the package was installed.

    Raises:
        ImportError: it isn't built, or from other headers than the package's.
    """
    spec = importlib.util.find_spec("polarmpm.kernels._native")
    if spec is None or spec.origin is None:
        raise ImportError("polarmpm.kernels._native is not built; install the package (pip install -e .)")
    lib = ctypes.CDLL(spec.origin)
    built = lib.polarmpm_interface() if hasattr(lib, "polarmpm_interface") else 0
    if built != INTERFACE:
        raise ImportError(
            f"polarmpm.kernels._native has interface {built}, the package needs {INTERFACE}; "
            "install it again (pip install -e .)"
        )
    for structure in STRUCTURES:
        size = ctypes.c_int64.in_dll(lib, f"polarmpm_size_{structure.__name__}").value
        if size != ctypes.sizeof(structure):
            raise ImportError(
                f"polarmpm.kernels._native has a {structure.__name__} of {size} bytes, the headers declare "
                f"{ctypes.sizeof(structure)}; install it again (pip install -e .)"
            )
    for name, returns, arguments in structures.prototypes():
        function = getattr(lib, name)
        function.argtypes = [argument.ctype for argument in arguments]
        function.restype = ctypes.c_int if returns else None
        setattr(lib, name, _checking(function, arguments))
    return lib


def _checking(function: Any, arguments: list[Declared]) -> Callable[..., Any]:
    """A function of the library that takes arrays, and checks them. Not by `from_param`: ctypes would make an
    ArgumentError of whatever interrupts that."""

    arrays = [(k, argument) for k, argument in enumerate(arguments) if argument.of_array]

    def call(*given: Any) -> Any:
        if len(given) != len(arguments):
            raise TypeError(f"{function.__name__} takes {len(arguments)} arguments, {len(given)} are given")
        passed = list(given)
        for k, argument in arrays:
            value = passed[k]
            if isinstance(value, np.ndarray):
                argument.check(value)
                passed[k] = address(value)
        return function(*passed)

    return call
