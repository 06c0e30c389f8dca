"""Access to the compiled loops over points (`_native.c`) through ctypes."""

from __future__ import annotations

import ctypes
import importlib.util
from functools import lru_cache
from typing import Any

import numpy as np

INTERFACE = 7  # the same number as in _points.h

_I32, _I64, _PTR = ctypes.c_int32, ctypes.c_int64, ctypes.c_void_p


class Batch(ctypes.Structure):
    """Points of one material, sorted by node set; mirrors the C structure."""

    _fields_ = [
        ("dim", _I32),
        ("rot", _I32),
        ("slots", _I32),
        ("nstate", _I32),
        ("nparam", _I32),
        ("npoints", _I64),
        ("ngroups", _I64),
        ("weights", _PTR),
        ("count", _PTR),
        ("state", _PTR),
        ("param", _PTR),
        ("volume", _PTR),
        ("first", _PTR),
        ("node_first", _PTR),
        ("nodes", _PTR),
    ]


class Matrix(ctypes.Structure):
    """Where the blocks of node pairs stand in the sparse matrix; mirrors the C structure."""

    _fields_ = [
        ("symmetric", _I32),
        ("half", _I32),
        ("reach", _I32),
        ("place", _PTR),
        ("row_start", _PTR),
        ("number", _PTR),
        ("fixed", _PTR),
        ("lift", _PTR),
        ("values", _PTR),
    ]


class Law(ctypes.Structure):
    """Compiled kernels of a batch; mirrors the C structure."""

    _fields_ = [
        ("kernel", _PTR),
        ("couple", _PTR),
        ("couple_of", _PTR),
        ("couples", _PTR),
        ("before", _PTR),
        ("block_of", _PTR),
        ("blocks", _PTR),
    ]


class Return(ctypes.Structure):
    """Kernels and controls of a return mapping; mirrors the C structure."""

    _fields_ = [
        ("local", _PTR),
        ("stress", _PTR),
        ("moduli", _PTR),
        ("row_scale", _PTR),
        ("tolerance", ctypes.c_double),
        ("loose", ctypes.c_double),
        ("nin", _I32),
        ("nx", _I32),
        ("nz", _I32),
        ("most", _I32),
    ]


def fill(structure: Any, **arrays: Any) -> None:
    """Set numbers and array addresses of a structure, which keeps the arrays alive."""
    kept = structure.__dict__.setdefault("kept", {})
    for name, value in arrays.items():
        if isinstance(value, np.ndarray):
            if not value.flags.c_contiguous:
                raise ValueError(f"{name} is not contiguous")
            kept[name] = value
            value = value.ctypes.data
        setattr(structure, name, value)


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The shared library, built when the package was installed."""
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
    lib.polarmpm_gather.argtypes = [_PTR, _PTR, _I32, _PTR, _PTR]
    lib.polarmpm_spread.argtypes = [_PTR, _PTR, _I32, _PTR]
    lib.polarmpm_couple_nodes.argtypes = [_PTR, _I32, _PTR]
    lib.polarmpm_scalar_columns.argtypes = [_I64, _PTR, _PTR, _I32, _I32, _PTR]
    lib.polarmpm_assemble.argtypes = [_PTR] * 6
    lib.polarmpm_mirror.argtypes = [_PTR, _I32, _I64, _PTR, _PTR, _PTR, _PTR]
    lib.polarmpm_moments.argtypes = [_PTR, _PTR, _PTR, _I32, _PTR, _PTR]
    lib.polarmpm_project.argtypes = [_I64, _I32, _I32, _PTR, _PTR, _PTR, _PTR]
    lib.polarmpm_return.argtypes = [_PTR, _I64, _PTR, _I32, _PTR, _PTR, _PTR, _PTR]
    lib.polarmpm_evaluate.argtypes = [_PTR, _I64, _I32, _PTR, _PTR, _I32, _PTR]
    for name in ("gather", "assemble", "moments", "return", "evaluate"):
        getattr(lib, f"polarmpm_{name}").restype = ctypes.c_int
    for name in ("spread", "couple_nodes", "scalar_columns", "mirror", "project"):
        getattr(lib, f"polarmpm_{name}").restype = None
    return lib
