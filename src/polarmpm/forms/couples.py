"""Dead couples in space."""

from __future__ import annotations

from mpi4py import MPI

import ufl

from ..kernels import codegen, jit
from ..kernels.codegen import Scalariser
from ..kernels.csource import write_c
from ..kernels.kernel import Kernel, PointSpace, generator_version
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
        space = self.space.function_space(3)
        test, trial = ufl.TestFunction(space), ufl.TrialFunction(space)
        w, m = (ufl.as_vector([c[i] for i in range(3)]) for c in (self.w, self.m))
        self.residual = -kin.couple_work(m, w, test) * ufl.dx(domain=self.space.domain, degree=1)
        self.tangent = ufl.derivative(self.residual, self.w, trial)

    def _source(self) -> str:
        scalarise = Scalariser({self.w: 0, self.m: 3})
        r, k = (scalarise.scalar(codegen.expand(codegen.integrand(f))) for f in (self.residual, self.tangent))
        zero = scalarise.graph.zero
        nodes = codegen.coefficients(r, (3,), zero) + codegen.coefficients(k, (3, 3), zero)
        return write_c(scalarise.graph, {"couple": nodes})

    def compile(self, comm: MPI.Comm) -> Kernel:
        """Kernel (w, m) -> residual (3) and tangent (3 x 3). Collective."""
        terminals = {self.w: 0, self.m: 1, self.space.domain: 0}
        signature = compat.expression_signature(codegen.integrand(self.tangent), terminals)
        lib = jit.library(jit.digest(generator_version(), "couple", signature), self._source, comm)
        return Kernel(lib, "couple", 6, 12)
