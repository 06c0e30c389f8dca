"""Compiled returns: from a region's local equations in UFL to the kernels that the return mapping calls."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, Slots, generator_version
from ..kernels.recall import recalled
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
        space: of the coefficients.
    """

    name: str
    z: Any
    X: Any
    terminals: Slots
    inputs: int
    residual: list[Any]
    flow: list[Any]
    work: Any
    space: PointSpace

    @cached_property
    def _programs(self) -> dict[str, Functions]:
        space, nz, nx, s = self.space, self.z.ufl_shape[0], self.X.ufl_shape[0], self.work
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
        return {"local": local, "work": work, "flow": {"flow": self.flow}}

    def program(self, part: str) -> Program:
        """The region's kernels share three libraries, "local", "work" and "flow"."""
        return Program(self._programs[part], self.terminals, self.inputs, self.space)


def compile_return(
    name: str, problem: Callable[[], LocalProblem], row_scale: np.ndarray, comm: MPI.Comm, of: Hashable
) -> Return:
    """A region's kernels; what makes its problem isn't asked for where they are known by `of`, see `recall`.
    Collective."""
    made = cache(problem)
    kernels: dict[str, Kernel] = {}
    for part in ("local", "work", "flow"):
        kernels |= compile_functions(f"{name}_{part}", partial(_program, made, part), comm, of=of)
    return Return(kernels["local"], kernels["stress"], kernels["moduli"], kernels["flow"], row_scale)


def _program(problem: Callable[[], LocalProblem], part: str) -> Program:
    return problem().program(part)


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


@dataclass
class Program:
    """C functions of one library, and the coefficients of their input."""

    functions: Functions
    terminals: Slots
    inputs: int
    space: PointSpace

    def recipe(self, name: str, known: Sequence[str]) -> Recipe:
        """What tells the library from others are signatures, or `known` as of `compile_expressions`."""
        order, key = {**{c: i for i, c in enumerate(self.terminals)}, self.space.domain: 0}, known
        if not known:
            parts = [part for list_ in self.functions.values() for part in list_]
            key = [compat.expression_signature(_expression(part), order) for part in parts]
        layout = ",".join(f"{slot}" for slot in self.terminals.values())
        sizes = {f: sum(_size(part) for part in parts) for f, parts in self.functions.items()}
        return Recipe(jit.digest(generator_version(), name, layout, *key), self.inputs, sizes)

    def source(self) -> str:
        scalarise = Scalariser(self.terminals, waist=_WAIST)
        written: dict[str, Sequence[int]] = {
            function: [node for part in parts for node in _nodes(scalarise, part)]
            for function, parts in self.functions.items()
        }
        return write_c(scalarise.graph, written)


class Recipe(NamedTuple):
    """Name of a library's code, length of its functions' input, and how many numbers each gives."""

    code: str
    inputs: int
    outputs: dict[str, int]


def compile_functions(
    name: str,
    program: Callable[[], Program],
    comm: MPI.Comm,
    known: Sequence[str] = (),
    of: Hashable = None,
) -> dict[str, Kernel]:
    """Kernels of functions that are lists of UFL scalars or of forms' coefficients. What makes the program
    isn't asked for where it is known by `of`, see `recall`. Collective."""
    made = cache(program)
    recipe = recalled(of and (name, of), lambda: made().recipe(name, known))
    lib = jit.library(recipe.code, lambda: made().source(), comm)
    return {function: Kernel(lib, function, recipe.inputs, n) for function, n in recipe.outputs.items()}


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
