"""Compiled expressions of arrays, evaluated row by row."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..tools import compat
from . import codegen, csource, graph, jit, native
from .codegen import Scalariser
from .csource import write_c
from .recall import recalled


@cache
def generator_version() -> str:
    """Digest of the code that writes kernels: another generator compiles them anew."""
    return jit.digest(*(Path(str(module.__file__)).read_text() for module in (codegen, csource, graph)))


Slots = Mapping[Any, int | tuple[int, ...]]  # of coefficients in a kernel's input, see `Scalariser`


class Kernel:
    """Compiled functions of arrays (n, inputs) -> (n, outputs), eight rows a call."""

    def __init__(self, lib: ctypes.CDLL, name: str, inputs: int, outputs: int):
        self.inputs, self.outputs = inputs, outputs
        self.address: int = ctypes.cast(getattr(lib, name), ctypes.c_void_p).value or 0
        self._library = lib  # keeps the code loaded

    @property
    def code(self) -> str:
        """Name of its code in the cache, which is a digest of what it computes."""
        return Path(self._library._name).stem

    def __call__(self, *columns: np.ndarray) -> np.ndarray:
        """Evaluate for all rows, (n, outputs). The sums over points call the code from C."""
        rows = len(columns[0])
        flat = [np.ascontiguousarray(c, dtype=float).reshape(rows, _width(c)) for c in columns]
        widths = np.array([c.shape[1] for c in flat], dtype=np.int32)
        if widths.sum() != self.inputs:
            raise ValueError(f"kernel has {self.inputs} inputs, {widths.sum()} are given")
        addresses = np.array([native.address(c) for c in flat], dtype=np.uintp)
        out = np.empty((rows, self.outputs))
        evaluate = native.library().polarmpm_evaluate
        if evaluate(self.address, rows, len(flat), widths, addresses, self.outputs, out):
            raise MemoryError("no memory to evaluate a kernel")
        return out


def _width(columns: np.ndarray) -> int:
    """Numbers in a row, also where there are no rows."""
    return math.prod(columns.shape[1:])


@dataclass
class PointSpace:
    """Vector-valued functions on the points' quadrature space."""

    domain: Any

    def function_space(self, size: int) -> Any:
        return ufl.FunctionSpace(self.domain, compat.quadrature_element("interval", size))

    def coefficient(self, size: int) -> Any:
        return ufl.Coefficient(self.function_space(size))


def matrix(c: Any, rows: int, columns: int, start: int = 0) -> Any:
    return ufl.as_tensor([[c[start + columns * i + j] for j in range(columns)] for i in range(rows)])


def third(c: Any) -> Any:
    """A tensor 3 x 3 x 3 of 27 components."""
    return ufl.as_tensor([[[c[9 * i + 3 * j + k] for k in range(3)] for j in range(3)] for i in range(3)])


def compile_expressions(
    expressions: list[Any] | Callable[[], list[Any]],
    terminals: Slots,
    inputs: int,
    domain: Any,
    comm: MPI.Comm,
    known: Sequence[str] = (),
    of: Hashable = None,
) -> Kernel:
    """One kernel that evaluates UFL expressions (any shape, flattened row by row) of its inputs.

    Args:
        expressions: or what makes them, which a kernel that is known by `of` isn't asked for.
        known: what tells it from others, if signatures, which take a while, needn't.
        of: what the expressions are made of, see `recall`.
    """
    built: Callable[[], list[Any]] = cache(expressions if callable(expressions) else lambda: expressions)
    layout = ",".join(f"{slot}" for slot in terminals.values())

    def named() -> tuple[str, int]:
        order, signatures = {c: i for i, c in enumerate(terminals)}, known
        if not known:
            signatures = [compat.expression_signature(e, {**order, domain: 0}) for e in built()]
        size = sum(int(np.prod(e.ufl_shape, dtype=int)) for e in built())
        return jit.digest(generator_version(), "expr", layout, *signatures), size

    def source() -> str:
        scalarise = Scalariser(terminals)
        nodes = []
        for e in built():
            data = scalarise(codegen.expand(e)).data
            nodes += [scalarise.plain(data[index]) for index in np.ndindex(*data.shape)]
        return write_c(scalarise.graph, {"evaluate": nodes})

    code, size = recalled(of and ("expressions", of, layout), named)
    return Kernel(jit.library(code, source, comm), "evaluate", inputs, size)
