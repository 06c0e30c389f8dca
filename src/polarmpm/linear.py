"""Linear systems through PETSc: a direct solver that fits the tangent's symmetry."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from .errors import PolarMPMError
from .sparsity import Pattern


class SingularTangent(PolarMPMError, ArithmeticError):
    """The tangent could not be factored; the step is cut."""


class DirectSolver:
    """MUMPS on the pattern's rows: Cholesky-like on the upper triangle, else LDL^T, else LU.

    A symmetric tangent is first taken for positive definite (no pivoting, fastest); when that fails,
    as it may far from equilibrium, it is factored with pivoting.
    """

    def __init__(self, pattern: Pattern):
        self.pattern = pattern
        comm, nodes = pattern.nodes.grid.comm, pattern.nodes
        local, total = nodes.owned * pattern.block, nodes.total * pattern.block
        n = pattern.owned_entries
        self._csr = (pattern.indptr.astype(np.int32), pattern.indices, pattern.values[:n])
        size = ((local, total), (local, total))
        self.serial = comm.size == 1
        if self.serial:
            self.matrix = PETSc.Mat().createAIJWithArrays(size, self._csr, comm=comm)
        else:
            self.matrix = PETSc.Mat().createAIJ(size, csr=self._csr, comm=comm)
        self.solution, self.rhs = self.matrix.createVecs()
        self._solver: PETSc.KSP | None = None
        self._definite = pattern.symmetric

    def _create(self) -> PETSc.KSP:
        symmetric = self.pattern.symmetric
        if symmetric:
            self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self.matrix.setOption(PETSc.Mat.Option.SPD, self._definite)
        ksp = PETSc.KSP().create(self.matrix.getComm())
        ksp.setOperators(self.matrix)
        ksp.setType(PETSc.KSP.Type.PREONLY)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        factor = pc.getFactorMatrix()
        factor.setMumpsIcntl(7, 5)  # METIS
        factor.setMumpsIcntl(14, 40)  # spare memory for pivoting, in per cent
        return ksp

    def factor(self) -> None:
        """Factor the matrix whose entries stand in the pattern. Collective.

        Raises:
            SingularTangent: the matrix is singular or has entries that are not finite.
        """
        finite = bool(np.isfinite(self._csr[2]).all())
        if not self.matrix.getComm().tompi4py().allreduce(finite, op=MPI.LAND):
            raise SingularTangent("the tangent has entries that are not finite")
        if self.serial:
            self.matrix.assemble()
        else:
            self.matrix.setValuesCSR(*self._csr)
            self.matrix.assemble()
        if self._try():
            return
        if self._definite:
            self._definite, self._solver = False, None
            if self._try():
                return
        raise SingularTangent("the tangent is singular")

    def _try(self) -> bool:
        if self._solver is None:
            self._solver = self._create()
        try:
            self._solver.getPC().setUp()
        except PETSc.Error:
            self._solver = None
            return False
        ok = self._solver.getPC().getFactorMatrix().getMumpsInfog(1) >= 0
        if not ok:
            self._solver = None
        return ok

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for the owned unknowns, (n,) -> (n,). Collective."""
        assert self._solver is not None
        self.rhs.array[:] = rhs
        self._solver.solve(self.rhs, self.solution)
        return self.solution.array.copy()

    def destroy(self) -> None:
        """Release PETSc's objects."""
        for thing in (self._solver, self.matrix, self.rhs, self.solution):
            if thing is not None:
                thing.destroy()
