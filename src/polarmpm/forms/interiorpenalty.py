"""Potentials of second gradients W(F, H) at points of elements whose functions are continuous but not their
slopes, as kernels.

C0 interior penalty (Engel et al. 2002; Hansbo, Larson 2002) from one potential, in the undeformed body:

    cells   int W(F, H) dV
    faces   int [-{t} . [du/dN] + eta/2 {k/h} |[du/dN]|^2] dA,   t_i = dW/dH_iJK N_J N_K

with the jump [.] and the mean {.} of the two sides. Faces of the boundary where the slope is held have the
same with du/dN less what it is held at in the place of the jump. k is the largest stiffness of the material
at rest against second gradients a N N (`slopestiffness`), h the size of the face.

A kernel's unknowns are those of one side, y = (du/dX, d2u/dX2, jump): the rows of a table of derivatives,
each with all components of the displacement u.
"""

from __future__ import annotations

from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

from mpi4py import MPI

import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, compile_expressions, generator_version
from ..materials.base import Material, evaluate_energy, evaluate_measures, named_parameters, parameter_values
from ..tools import compat
from .strains import predicts, stresses, tangent_work, virtual_work


class CellPotential:
    """The energy of a material, at a point of a cell. Inputs: y, numbers of the material; for the tangent,
    where it predicts stresses, y before the last correction, too."""

    kind = "cells"

    def __init__(self, material: Material, dim: int):
        self.material, self.dim = material, dim
        self.pairs = list(combinations_with_replacement(range(dim), 2))
        self.space = PointSpace(compat.point_domain())
        self.size = dim * self.rows
        self.y = self.space.coefficient(self.size)
        self.data = [self.space.coefficient(n) for n in self._data_sizes()]
        self.numbers = self.space.coefficient(len(parameter_values(material)))

    @property
    def rows(self) -> int:
        """Derivatives in y."""
        return self.dim + len(self.pairs)

    @property
    def predicts(self) -> bool:
        return predicts(self.material)

    def _data_sizes(self) -> list[int]:
        return []

    @cached_property
    def terminals(self) -> dict[Any, int]:
        """First input slot of each coefficient."""
        out, at = {}, 0
        for c in (self.y, *self.data, self.numbers):
            out[c], at = at, at + c.ufl_shape[0]
        return out

    @property
    def inputs(self) -> int:
        return self.terminals[self.numbers] + int(self.numbers.ufl_shape[0])

    # UFL ------------------------------------------------------------------------------------------
    def _motion(self, y: Any, shift: Any = None) -> tuple[Any, Any]:
        """F and H, with a shift [i][pair] of the latter."""
        d = self.dim
        known = {pair: d * (d + k) for k, pair in enumerate(self.pairs)}
        F = [[(y[d * j + i] if max(i, j) < d else 0) + (i == j) for j in range(3)] for i in range(3)]
        H: list[Any] = [[[0] * 3 for _ in range(3)] for _ in range(3)]
        for (j, k), at in known.items():
            for i in range(d):
                H[i][j][k] = H[i][k][j] = y[at + i] + (0 if shift is None else shift[i][j][k])
        return ufl.as_tensor(F), ufl.as_tensor(H)

    def _measures(self, y: Any) -> tuple[Any, ...]:
        F, H = self._motion(y)
        return evaluate_measures(self.material, F, H)

    @cached_property
    def energy(self) -> Any:
        """J/m^3, of a face J/m^2."""
        return evaluate_energy(
            self.material, self._measures(self.y), named_parameters(self.material, self.numbers)
        )

    @cached_property
    def residual(self) -> Any:
        return virtual_work(self.material, self._measures(self.y), self.y, self._argument(0), self.numbers)

    @cached_property
    def _correction(self) -> tuple[Any, Any]:
        """y before the last correction, and y itself once more, as what isn't derived by."""
        return self.space.coefficient(self.size), self.space.coefficient(self.size)

    @cached_property
    def tangent(self) -> Any:
        if not self.predicts:
            return ufl.derivative(self.residual, self.y, self._argument(1))
        before, now = self._correction
        unknowns = self.y, before, now - before
        arguments = self._argument(0), self._argument(1)
        return tangent_work(
            self.material, (self._measures(self.y), self._measures(before)), unknowns, arguments, self.numbers
        )

    def _argument(self, number: int) -> Any:
        return ufl.Argument(self.space.function_space(self.size), number)

    # compiled -------------------------------------------------------------------------------------
    def _tangent_terminals(self) -> dict[Any, int]:
        if not self.predicts:
            return self.terminals
        before, now = self._correction
        return {**self.terminals, before: self.inputs, now: 0}

    def _source(self) -> str:
        n, scalarise = self.size, Scalariser(self._tangent_terminals())
        r, k = (scalarise.scalar(codegen.expand(f)) for f in (self.residual, self.tangent))
        rows = codegen.coefficients(r, (n,), scalarise.graph.zero)
        full = codegen.coefficients(k, (n, n), scalarise.graph.zero)
        upper = [full[i * n + j] for i in range(n) for j in range(i, n)]
        return write_c(scalarise.graph, {"residual": rows, "tangent": upper})

    def compile(self, comm: MPI.Comm) -> tuple[Kernel, Kernel]:
        """Derivatives by y, and the upper triangle of the second ones. Collective."""
        known = {c: i for i, c in enumerate(self._tangent_terminals())}
        signature = compat.expression_signature(self.tangent, {**known, self.space.domain: 0})
        lib = jit.library(jit.digest(generator_version(), self.kind, signature), self._source, comm)
        n, more = self.size, self.size if self.predicts else 0
        upper = n * (n + 1) // 2
        return Kernel(lib, "residual", self.inputs, n), Kernel(lib, "tangent", self.inputs + more, upper)

    def compile_energy(self, comm: MPI.Comm) -> Kernel:
        """The potential itself. Collective."""
        return compile_expressions([self.energy], self.terminals, self.inputs, self.space.domain, comm)


class FacePotential(CellPotential):
    """The interior penalty on one side of a face, or where the slope is held on the boundary:
    -c t . g + p/2 |g|^2 with the gap g = m (jump - s). Inputs: y, (N, m, s, c, p), numbers of the material.

    Data: N is the normal, m is 1 or 0 for each component, s the slope at which they are held.
    """

    kind = "faces"

    @property
    def rows(self) -> int:
        return super().rows + 1

    @property
    def predicts(self) -> bool:
        return False

    def _data_sizes(self) -> list[int]:
        return [3 * self.dim + 2]

    @cached_property
    def energy(self) -> Any:
        d, data = self.dim, self.data[0]
        at = d * (self.rows - 1)
        gap = [data[d + i] * (self.y[at + i] - data[2 * d + i]) for i in range(d)]
        return 0.5 * data[3 * d + 1] * sum(g * g for g in gap) - data[3 * d] * self._double_work(gap)

    def _double_work(self, gap: list[Any]) -> Any:
        """t . g: the derivative of the energy by second gradients g N N."""
        d, n, size = self.dim, self.data[0], ufl.variable(ufl.as_ufl(0.0))
        shift = [[[size * g * n[j] * n[k] for k in range(d)] for j in range(d)] for g in gap]
        along = evaluate_measures(self.material, *self._motion(self.y, shift))
        at = stresses(self.material, self._measures(self.y), self.numbers)
        return sum(ufl.inner(s, ufl.diff(e, size)) for s, e in zip(at, along, strict=True))

    @cached_property
    def residual(self) -> Any:
        return ufl.derivative(self.energy, self.y, self._argument(0))
