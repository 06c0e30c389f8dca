"""Dead couples in space."""

from __future__ import annotations

from functools import cached_property

from mpi4py import MPI

import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, generator_version
from ..kernels.recall import recalled
from ..kinematics import tensors as kin
from ..tools import compat


class CoupleForm:
    """Virtual work of dead couples in three dimensions, -m . J_l(w) dw, and its derivative.

    Spatially constant couples do work on the spin, not on the rotation vector's increment; that makes
    the tangent unsymmetric. In plane strain the two agree and a couple is a plain nodal load.
    """

    def __init__(self) -> None:
        self.space = PointSpace(compat.point_domain())
        self.w, self.m = self.space.coefficient(3), self.space.coefficient(3)

    @cached_property
    def residual(self) -> ufl.Form:
        w, m = (ufl.as_vector([c[i] for i in range(3)]) for c in (self.w, self.m))
        test = ufl.TestFunction(self.space.function_space(3))
        return -kin.couple_work(m, w, test) * ufl.dx(domain=self.space.domain, degree=1)

    @cached_property
    def tangent(self) -> ufl.Form:
        return ufl.derivative(self.residual, self.w, ufl.TrialFunction(self.space.function_space(3)))

    def _source(self) -> str:
        scalarise = Scalariser({self.w: 0, self.m: 3})
        r, k = (scalarise.scalar(codegen.expand(codegen.integrand(f))) for f in (self.residual, self.tangent))
        zero = scalarise.graph.zero
        nodes = codegen.coefficients(r, (3,), zero) + codegen.coefficients(k, (3, 3), zero)
        return write_c(scalarise.graph, {"couple": nodes})

    def _named(self) -> str:
        terminals = {self.w: 0, self.m: 1, self.space.domain: 0}
        signature = compat.expression_signature(codegen.integrand(self.tangent), terminals)
        return jit.digest(generator_version(), "couple", signature)

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (w, m) -> residual (3) and tangent (3 x 3). Collective."""
        lib = jit.library(recalled("couple", self._named), self._source, comm)
        return Kernel(lib, "couple", 6, 12)
