"""Linear systems through PETSc: a direct solver that fits the tangent's symmetry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from .band import Band
from .linear import ACCURACY, Rows, SingularTangent

# Relative shift of the factored matrix' diagonal. A node set seen by a single point has fewer constraints
# than unknowns, and its tangent is exactly singular; slivers of points' domains in a cell come close to that.
_DIAGONAL = 1e-12
# The shift stays out of the tangent itself: FGMRES with the shifted factor solves with the tangent, in one
# iteration unless a mode is as weak as the shift.
_KRYLOV_LIMIT = 60  # iterations after which the factor is given up
_METHODS = ["definite", "symmetric", "general"]  # the last one for unsymmetric tangents only
# Operations for a factor per entry of it, which is to say per part of a solution: from here on a factor of an
# earlier tangent is worth its iterations, of which it may take a few before it's given up.
_KEEP, _OLD, _OLD_LIMIT = 500.0, 5, 25
_STRICTER = 0.01  # norms of forces and of energy tell too little in bending, and Newton's method would stall
# Unknowns up to which CHOLMOD, on one rank, takes less time than MUMPS, and of compact bodies, whose factors
# MUMPS keeps; where rows are too long for a band MUMPS takes less whatever their number
_SMALL, _SMALL_COMPACT = 5500, 1500


class DirectSolver:
    """Factors, with as little work as the tangent allows: where the order of its rows is good, as of slender
    bodies and in the plane, `Band`; else, and where that fails, MUMPS.

    * symmetric and small, its rows not at hand: CHOLMOD, while the tangent is definite.
    * symmetric: Cholesky-like on the upper triangle (no pivoting, fastest); when that fails, as it may far
      from equilibrium, LDL^T with pivoting.
    * unsymmetric (dead couples in three dimensions): the symmetric part is factored, at half the memory, and
      preconditions the tangent itself; where couples are too large for that, LU.

    Where a factor costs much more than a solution, it serves following tangents as a preconditioner.
    """

    def __init__(
        self,
        matrix: PETSc.Mat | Callable[[], PETSc.Mat],
        symmetric: bool,
        far_from_symmetric: bool = False,
        memory: int = 0,
        stored: tuple[np.ndarray, np.ndarray] | None = None,
        compact: bool = False,
        rows: Rows | None = None,
    ):
        """Take over a matrix, whose entries may change before each `factor`.

        Args:
            matrix: whole, or its upper triangle when symmetric; it belongs to the solver from now on. A
                function that makes it is called when it is needed first.
            far_from_symmetric: the symmetric part is no help (plastic flow).
            memory: that a rank may use (MB); 0: all.
            stored: the entries that the matrix uses, and where those of the diagonal are; None: it has
                its own.
            compact: the body has many nodes in a layer.
            rows: of the matrix, on one rank; None: they aren't at hand.
        """
        self._made: PETSc.Mat | None = matrix if isinstance(matrix, PETSc.Mat) else None
        self._make: Callable[[], PETSc.Mat] = matrix
        self.symmetric, self._stored, self._memory, self._compact = symmetric, stored, memory, compact
        self._solver: PETSc.KSP | None = None
        self._conjugate: PETSc.KSP | None = None  # gradients, for tangents that a factor isn't of
        self._kept = self._old = False  # the factor: is worth to be kept; is of an earlier tangent
        self._given_up = False  # tangents change too much for a factor to be kept
        self._methods = ["general"] if far_from_symmetric else _METHODS[: 2 if symmetric else 3]
        self._band: Band | None = None
        self._factored: Band | None = None  # what holds the factor, unless that is `_solver`
        if rows is not None:
            band = Band(rows, symmetric)
            if band.pays:
                self._band = band
        elif symmetric and self._is_small():
            self._methods = ["small", *self._methods]
        self._method = self._methods[0]

    def _is_small(self) -> bool:
        blocked = self._blocked and self.matrix.getBlockSize() > 1  # CHOLMOD takes none; PETSc's error leaks
        most = _SMALL_COMPACT if self._compact else _SMALL
        return self.matrix.comm.size == 1 and self.matrix.size[0] <= most and not blocked

    @property
    def matrix(self) -> PETSc.Mat:
        """PETSc's; in which only `put` puts the entries. Collective where it is asked for first."""
        if self._made is None:
            self._made = self._make()
        return self._made

    @cached_property
    def comm(self) -> MPI.Comm:
        """The matrix' communicator."""
        comm: MPI.Comm = self.matrix.comm.tompi4py()
        return comm

    @cached_property
    def _blocked(self) -> bool:
        return self.matrix.getType() in ("seqbaij", "mpibaij")

    @property
    def _alone(self) -> bool:
        """Whether the matrix itself is factored, shifted for a while, not a copy."""
        return self.symmetric and not self._blocked

    @cached_property
    def _shifted(self) -> Any:
        """What is factored; a copy is made when the matrix has its entries."""
        return self.matrix if self._alone else None

    @cached_property
    def _vectors(self) -> tuple[PETSc.Vec, PETSc.Vec]:
        """PETSc's solution and right-hand side."""
        solution, right = self.matrix.createVecs()
        return solution, right

    @property
    def solution(self) -> PETSc.Vec:
        return self._vectors[0]

    @property
    def rhs(self) -> PETSc.Vec:
        return self._vectors[1]

    @property
    def in_place(self) -> bool:
        """Whether entries are taken from the rows, and the matrix needs none."""
        return self._band is not None

    # factors --------------------------------------------------------------------------------------
    def _create(self) -> PETSc.KSP:
        symmetric = self._method != "general"
        if symmetric:
            self._shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._shifted.setOption(PETSc.Mat.Option.SPD, self._method in ("small", "definite"))
        ksp = PETSc.KSP().create(self.comm)
        ksp.setOperators(self.matrix, self._shifted)
        ksp.setType(PETSc.KSP.Type.FGMRES)
        ksp.setGMRESRestart(_KRYLOV_LIMIT)
        ksp.setTolerances(rtol=ACCURACY, atol=0.0, divtol=1e30, max_it=_KRYLOV_LIMIT)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        if self._method == "small":
            PETSc.Options().setValue("mat_cholmod_print", 0)  # an indefinite tangent is no news
            pc.setFactorSolverType("cholmod")
            return ksp
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        factor = pc.getFactorMatrix()
        factor.setMumpsIcntl(7, 5)  # METIS
        factor.setMumpsIcntl(14, 40)  # spare memory for pivoting, in per cent
        if self._memory:
            factor.setMumpsIcntl(23, self._memory)
        return ksp

    @contextmanager
    def _shift(self) -> Iterator[None]:
        """Shift the diagonal of the matrix to factor, the tangent's symmetric part or the tangent; of the
        tangent itself for the duration of the factorisation only."""
        if self._alone and self._stored is not None:
            entries, at = self._stored
            kept = entries[at]
            entries[at] = (1.0 + _DIAGONAL) * kept
            try:
                yield
            finally:
                entries[at] = kept
            return
        if not self._alone:
            self._copy()
        diagonal = self._shifted.getDiagonal()
        shifted = diagonal.copy()
        shifted.scale(1.0 + _DIAGONAL)
        self._shifted.setDiagonal(shifted)
        try:
            yield
        finally:
            if self._alone:
                self._shifted.setDiagonal(diagonal)
            shifted.destroy()
            diagonal.destroy()

    def _copy(self) -> None:
        same = PETSc.Mat.Structure.SAME_NONZERO_PATTERN
        if self._shifted is None:
            self._shifted = PETSc.Mat() if self._blocked else self.matrix.duplicate()
        if self._blocked:  # MUMPS factors no such matrix by Cholesky's method
            self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, self.symmetric)
            self.matrix.convert("sbaij" if self.symmetric else "aij", out=self._shifted)
        else:
            self.matrix.copy(self._shifted, structure=same)
        if not self.symmetric and self._method != "general":
            transposed = self.matrix.transpose(PETSc.Mat())
            self._shifted.axpy(1.0, transposed, structure=same)
            self._shifted.scale(0.5)
            transposed.destroy()

    def factor(self) -> None:
        """Factor the matrix as it stands. Collective.

        Raises:
            SingularTangent: the matrix is singular or has entries that are not finite.
        """
        self._factored = self._band if self._band is not None and self._band.factor() else None
        if self._factored is None:
            self._factor_matrix()

    def _factor_matrix(self) -> None:
        """Factor PETSc's matrix; of a tangent whose band can't be factored, without what is left from others:
        a run that is restarted has nothing of them."""
        if self._band is not None:
            self._factored, self._kept = None, False
            if self._method != self._methods[0]:
                self._release_solver()
                self._method = self._methods[0]
            self._band.rows.put()
        if not np.isfinite(self.matrix.norm()):
            raise SingularTangent("the tangent has entries that are not finite")
        self._old = self._kept and self._solver is not None
        if not self._old:
            self._factor()

    def _factor(self) -> None:
        self._kept = self._old = False
        while not self._try():
            self._fall_back("the tangent is singular")
        self._kept = self._worth_keeping()

    def _worth_keeping(self) -> bool:
        assert self._solver is not None
        if self._method == "small" or self._given_up:
            return False
        factor = self._solver.getPC().getFactorMatrix()
        entries = factor.getMumpsInfog(29)  # millions where it's negative
        return bool(factor.getMumpsRinfog(3) > _KEEP * max(entries, -1e6 * entries))

    def _fall_back(self, message: str) -> None:
        following = self._methods.index(self._method) + 1
        if following == len(self._methods):
            self._method = self._methods[0]
            raise SingularTangent(message)
        self._method = self._methods[following]

    def _try(self) -> bool:
        try:
            with self._shift():
                if self._solver is None:
                    self._solver = self._create()
                pc = self._solver.getPC()
                pc.setReusePreconditioner(False)
                pc.setUp()
                pc.setReusePreconditioner(True)  # the diagonal will change, not the factor
                # CHOLMOD raises an error where the tangent isn't definite
                if self._method == "small" or pc.getFactorMatrix().getMumpsInfog(1) >= 0:
                    return True
        except PETSc.Error:
            pass
        self._release_solver()
        return False

    # solution -------------------------------------------------------------------------------------
    def _solution(self) -> np.ndarray:
        values: np.ndarray = self.solution.array.copy()
        return values

    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
        """Solve for the owned unknowns, (n,) -> (n,): with a factor of this tangent to `ACCURACY`, with an
        older one to `accuracy`. Collective.

        Raises:
            SingularTangent: no method gave a solution.
        """
        if self._factored is not None:
            found = self._factored.solve(rhs)
            if found is not None:
                return found
            self._factor_matrix()
        self.rhs.array[:] = rhs
        if self._old:
            if self._solve_with_old(accuracy):
                return self._solution()
            self._factor()
        while True:
            assert self._solver is not None
            self._solver.solve(self.rhs, self.solution)
            if self._solver.getConvergedReason() > 0:
                return self._solution()
            self._release_solver()
            self._fall_back("the linear system could not be solved")
            self._factor()

    def _solve_with_old(self, accuracy: float) -> bool:
        """Whether an earlier tangent's factor leads to a solution."""
        assert self._solver is not None
        ksp = self._solver
        if self.symmetric and self._method == "definite":
            if self._conjugate is None:
                self._conjugate = PETSc.KSP().create(self.comm)
                self._conjugate.setPC(ksp.getPC())
                self._conjugate.setOperators(self.matrix, self._shifted)
                self._conjugate.setType(PETSc.KSP.Type.CG)
                self._conjugate.setNormType(PETSc.KSP.NormType.NATURAL)
            ksp = self._conjugate
        ksp.setTolerances(rtol=_STRICTER * accuracy, atol=0.0, divtol=1e30, max_it=_OLD_LIMIT)
        ksp.solve(self.rhs, self.solution)
        self._kept = ksp.getIterationNumber() <= _OLD
        self._given_up = not self._kept
        self._solver.setTolerances(rtol=ACCURACY, max_it=_KRYLOV_LIMIT)
        return bool(ksp.getConvergedReason() > 0)

    def solve_again(self, rhs: np.ndarray) -> np.ndarray:
        """Solve once more, as well as for the last right-hand side, and leave all as it is, also what decides
        on following factors. Collective.

        Raises:
            SingularTangent: there is no solution with the factor at hand.
        """
        if self._factored is not None:
            found = self._factored.solve(rhs)
            if found is None:
                raise SingularTangent("the linear system could not be solved")
            return found
        if self._solver is None:
            raise SingularTangent("there is no factor")
        ksp, self.rhs.array[:] = self._solver, rhs
        if self._old and self._conjugate is not None:
            ksp = self._conjugate
            ksp.setTolerances(rtol=_STRICTER * ACCURACY, atol=0.0, divtol=1e30, max_it=_KRYLOV_LIMIT)
        ksp.solve(self.rhs, self.solution)
        if ksp.getConvergedReason() <= 0:
            raise SingularTangent("the linear system could not be solved")
        return self._solution()

    def precondition(self, rhs: np.ndarray) -> np.ndarray:
        """What the factor alone makes of a right-hand side (n,), its shift and all. Collective.

        Raises:
            SingularTangent: there is none.
        """
        if self._factored is not None:
            return self._factored.apply(np.ascontiguousarray(rhs))
        if self._solver is None:
            raise SingularTangent("there is no factor")
        self.rhs.array[:] = rhs
        self._solver.getPC().apply(self.rhs, self.solution)
        return self._solution()

    def _release_solver(self) -> None:
        for ksp in (self._conjugate, self._solver):
            if ksp is not None:
                ksp.destroy()
        self._conjugate = self._solver = None

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release_solver()
        self._stored = self._band = self._factored = None
        if self._made is None:
            return
        for thing in (None if self._alone else self._shifted, self._made, *vars(self).get("_vectors", ())):
            if thing is not None:
                thing.destroy()
