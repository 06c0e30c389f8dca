"""Linear systems through PETSc: a direct solver that fits the tangent's symmetry."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from .errors import PolarMPMError
from .sparsity import Pattern

_KRYLOV_LIMIT = 60  # GMRES iterations after which an unsymmetric tangent gets its own factor


class SingularTangent(PolarMPMError, ArithmeticError):
    """The tangent could not be factored; the step is cut."""


class DirectSolver:
    """MUMPS, with as little work as the tangent's symmetry allows.

    * symmetric: Cholesky-like on the upper triangle (no pivoting, fastest); when that fails, as it may far from
      equilibrium, LDL^T with pivoting.
    * unsymmetric (dead couples in three dimensions): the symmetric part is factored, which costs a quarter, and
      preconditions GMRES on the tangent itself; where couples are too large for that, LU.
    """

    def __init__(self, pattern: Pattern):
        self.pattern = pattern
        comm, nodes = pattern.nodes.grid.comm, pattern.nodes
        local, total = nodes.owned * pattern.block, nodes.total * pattern.block
        entries = pattern.owned_entries
        self._csr = (pattern.indptr.astype(np.int32), pattern.indices, pattern.values[:entries])
        size = ((local, total), (local, total))
        self.comm, self.serial = comm, comm.size == 1
        if self.serial:
            self.matrix = PETSc.Mat().createAIJWithArrays(size, self._csr, comm=comm)
        else:
            self.matrix = PETSc.Mat().createAIJ(size, csr=self._csr, comm=comm)
        self.solution, self.rhs = self.matrix.createVecs()
        self._factored: PETSc.Mat | None = self.matrix if pattern.symmetric else None
        self._solver: PETSc.KSP | None = None
        self._method = "definite"  # then "symmetric", then "general" for an unsymmetric tangent

    # factors --------------------------------------------------------------------------------------
    def _create(self) -> PETSc.KSP:
        symmetric, definite = self._method != "general", self._method == "definite"
        factored = self._factored if symmetric and self._factored is not None else self.matrix
        if symmetric:
            factored.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            factored.setOption(PETSc.Mat.Option.SPD, definite)
        ksp = PETSc.KSP().create(self.comm)
        ksp.setOperators(self.matrix, factored)
        if symmetric and not self.pattern.symmetric:
            ksp.setType(PETSc.KSP.Type.GMRES)
            ksp.setGMRESRestart(_KRYLOV_LIMIT)
            ksp.setTolerances(rtol=1e-11, atol=0.0, max_it=_KRYLOV_LIMIT)
        else:
            ksp.setType(PETSc.KSP.Type.PREONLY)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        factor = pc.getFactorMatrix()
        factor.setMumpsIcntl(7, 5)  # METIS
        factor.setMumpsIcntl(14, 40)  # spare memory for pivoting, in per cent
        return ksp

    def _symmetric_part(self) -> None:
        transposed = self.matrix.transpose(PETSc.Mat())
        if self._factored is None:
            self._factored = self.matrix.duplicate(copy=True)
        else:
            self.matrix.copy(self._factored, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._factored.axpy(1.0, transposed, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._factored.scale(0.5)
        transposed.destroy()

    def factor(self) -> None:
        """Factor the matrix whose entries stand in the pattern. Collective.

        Raises:
            SingularTangent: the matrix is singular or has entries that are not finite.
        """
        finite = bool(np.isfinite(self._csr[2]).all())
        if not self.comm.allreduce(finite, op=MPI.LAND):
            raise SingularTangent("the tangent has entries that are not finite")
        if not self.serial:
            self.matrix.setValuesCSR(*self._csr)
        self.matrix.assemble()
        if not self.pattern.symmetric and self._method != "general":
            self._symmetric_part()
        while not self._try():
            self._fall_back("the tangent is singular")

    def _fall_back(self, message: str) -> None:
        methods = ["definite", "symmetric", "general"][: 2 if self.pattern.symmetric else 3]
        following = methods.index(self._method) + 1
        if following == len(methods):
            self._method = methods[0]
            raise SingularTangent(message)
        self._method = methods[following]

    def _try(self) -> bool:
        try:
            if self._solver is None:
                self._solver = self._create()
            pc = self._solver.getPC()
            pc.setUp()
            if pc.getFactorMatrix().getMumpsInfog(1) >= 0:
                return True
        except PETSc.Error:
            pass
        self._release_solver()
        return False

    # solution -------------------------------------------------------------------------------------
    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for the owned unknowns, (n,) -> (n,). Collective.

        Raises:
            SingularTangent: no method gave a solution.
        """
        self.rhs.array[:] = rhs
        while True:
            assert self._solver is not None
            self._solver.solve(self.rhs, self.solution)
            if self._solver.getConvergedReason() > 0:
                return self.solution.array.copy()
            self._release_solver()
            self._fall_back("the linear system could not be solved")
            self.factor()

    def _release_solver(self) -> None:
        if self._solver is not None:
            self._solver.destroy()
            self._solver = None

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release_solver()
        for thing in (self._factored, self.matrix, self.rhs, self.solution):
            if thing is not None:
                thing.destroy()
