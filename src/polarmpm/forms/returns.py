"""Compiled returns: from a region's local equations in UFL to the kernels that the return mapping calls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, Slots, generator_version
from ..tools import compat

_WAIST = 2  # scalars that a derivative is carried through; a fifth to a half fewer operations


@dataclass
class Return:
    """Compiled kernels of one region of the yield surface.

    Attributes:
        local: (inputs, X) -> residual (nx) and its derivative by X (nx, nx).
        stress: (inputs, X) -> s (nz).
        moduli: (inputs, X) -> s, ds/dz (nz, nz), ds/dX (nz, nx), dr/dz (nx, nz).
        flow: (inputs, X) -> dissipation per reference volume (Pa), a strain that is negative where the
            solution is not admissible, and the yield functions (Pa) that aren't active.
        row_scale: factors (nx,) that make residuals strains.
    """

    local: Kernel
    stress: Kernel
    moduli: Kernel
    flow: Kernel
    row_scale: np.ndarray

    @property
    def size(self) -> int:
        """Length of X."""
        return len(self.row_scale)


@dataclass
class LocalProblem:
    """A region's equations for X at given z, in UFL.

    Attributes:
        name: of the region.
        z, X: coefficients of nz and nx components.
        terminals: first input slot of each coefficient; X comes last.
        inputs: length of the kernels' input, with X.
        residual, flow: UFL scalars, see `materials.regions`.
        work: s(X, z), a linear form in variations of z.
        row_scale: factors (nx,) that make residuals strains.
    """

    name: str
    z: Any
    X: Any
    terminals: Slots
    inputs: int
    residual: list[Any]
    flow: list[Any]
    work: Any
    row_scale: np.ndarray

    def compile(self, space: PointSpace, comm: MPI.Comm) -> Return:
        """The region's kernels. Collective."""
        nz, nx, s = self.z.ufl_shape[0], self.X.ufl_shape[0], self.work
        by_local, by_z = (ufl.TrialFunction(space.function_space(n)) for n in (nx, nz))
        form = ufl.dot(ufl.as_vector(self.residual), ufl.TestFunction(space.function_space(nx)))
        local: Functions = {
            "local": [Vector(form, nx), Matrix(ufl.derivative(form, self.X, by_local), nx, nx)],
        }
        work: Functions = {
            "stress": [Vector(s, nz)],
            "moduli": [
                Vector(s, nz),
                Matrix(ufl.derivative(s, self.z, by_z), nz, nz),
                Matrix(ufl.derivative(s, self.X, by_local), nz, nx),
                Matrix(ufl.derivative(form, self.z, by_z), nx, nz),
            ],
        }
        kernels: dict[str, Kernel] = {}
        for part, functions in (("local", local), ("work", work), ("flow", {"flow": self.flow})):
            name = f"{self.name}_{part}"
            kernels |= compile_functions(space, name, functions, self.terminals, self.inputs, comm)
        return Return(kernels["local"], kernels["stress"], kernels["moduli"], kernels["flow"], self.row_scale)


@dataclass
class Vector:
    """Coefficients of the test function's components."""

    form: Any
    rows: int


@dataclass
class Matrix:
    """Coefficients of test and trial function, row by row."""

    form: Any
    rows: int
    columns: int


Functions = dict[str, list[Any]]  # UFL scalars, `Vector` and `Matrix` by the name of a C function


def compile_functions(
    space: PointSpace,
    name: str,
    functions: Functions,
    terminals: Slots,
    inputs: int,
    comm: MPI.Comm,
    known: Sequence[str] = (),
) -> dict[str, Kernel]:
    """Kernels of functions that are lists of UFL scalars or of forms' coefficients; `known` as of
    `compile_expressions`. Collective."""
    order, key = {**{c: i for i, c in enumerate(terminals)}, space.domain: 0}, known
    if not known:
        parts = [part for list_ in functions.values() for part in list_]
        key = [compat.expression_signature(_expression(part), order) for part in parts]
    layout = ",".join(f"{slot}" for slot in terminals.values())

    def source() -> str:
        scalarise = Scalariser(terminals, waist=_WAIST)
        written: dict[str, Sequence[int]] = {
            function: [node for part in parts for node in _nodes(scalarise, part)]
            for function, parts in functions.items()
        }
        return write_c(scalarise.graph, written)

    lib = jit.library(jit.digest(generator_version(), name, layout, *key), source, comm)
    sizes = {function: sum(_size(part) for part in parts) for function, parts in functions.items()}
    return {function: Kernel(lib, function, inputs, size) for function, size in sizes.items()}


def _expression(part: Any) -> Any:
    return part.form if isinstance(part, Vector | Matrix) else part


def _size(part: Any) -> int:
    if isinstance(part, Matrix):
        return part.rows * part.columns
    return part.rows if isinstance(part, Vector) else 1


def _nodes(scalarise: Scalariser, part: Any) -> list[int]:
    if not isinstance(part, Vector | Matrix):
        return [scalarise.plain(scalarise.scalar(codegen.expand(ufl.as_ufl(part))))]
    linear = scalarise.flat(scalarise.scalar(codegen.expand(part.form)))
    shape = (part.rows, part.columns) if isinstance(part, Matrix) else (part.rows,)
    return codegen.coefficients(linear, shape, scalarise.graph.zero)
