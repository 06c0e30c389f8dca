"""Large linear systems: Krylov methods with a hierarchy of coarser systems, and what stands in for them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from .direct import DirectSolver
from .krylov import BROKEN, INDEFINITE, LIMIT, Equations, Result, conjugate_gradients, flexible_gmres
from .linear import ACCURACY, SingularTangent
from .memory import free_memory

_LIMIT = 150  # iterations after which a method is given up
_RESTART = 50  # of GMRES
_STALE = 10  # a new hierarchy costs about as much as so many iterations
_FAILURES = 2  # of multigrid, after which the direct solver takes over until the next reset
_SLOW = 25  # iterations from which a stronger cycle pays
_CG, _GMRES = "cg", "gmres"


class Hierarchy(Protocol):
    """Coarser and coarser systems of a tangent's. All methods are collective.

    Attributes:
        weight: by which the residual's entries (n,) count as forces.
    """

    weight: np.ndarray

    def renew(self) -> None:
        """Take the entries as they are.

        Raises:
            SingularTangent: no hierarchy can be made of them; on every rank.
        """

    def keep(self) -> None:
        """Take the entries as they are into what has to follow them; coarser systems stay.

        Raises:
            SingularTangent: that is not possible; on every rank.
        """

    def strengthen(self) -> None:
        """Let a cycle do more, if it can."""

    def product(self, x: np.ndarray) -> np.ndarray:
        """The tangent times the owned unknowns (n,); the next product may overwrite it."""

    def quick_product(self, x: np.ndarray) -> np.ndarray:
        """The same, as exact as numbers in single precision can be, if that is quicker."""

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """One cycle for the owned unknowns (n,); the next one may overwrite it.

        Raises:
            SingularTangent: it is not possible; on every rank.
        """

    def destroy(self) -> None:
        """Release PETSc's objects."""


class MultigridSolver(ABC):
    """Conjugate gradients with a hierarchy; flexible GMRES for tangents that are indefinite or unsymmetric;
    the direct solver where that fails.

    The hierarchy of an earlier tangent serves until it costs more iterations than a new one would.

    Args:
        make: makes PETSc's matrix, when it is asked for first. Collective.
        symmetric, far_from_symmetric: see `DirectSolver`.

    Attributes:
        iterations: of the Krylov methods so far.
        hierarchies: built so far.
        failures: tangents that were left to the direct solver.
    """

    def __init__(
        self, make: Callable[[], PETSc.Mat], symmetric: bool, far_from_symmetric: bool, comm: MPI.Comm
    ):
        self._make, self.symmetric, self._far, self.comm = make, symmetric, far_from_symmetric, comm
        self.iterations = self.hierarchies = self.failures = 0
        self._hierarchy: Hierarchy | None = None
        self._equations: Equations | None = None  # with its maps; None: it is not of use
        self._old = self._worn = False  # the hierarchy: of an earlier tangent; not worth to be kept
        self._rate = 0.0  # iterations for a digit with a new hierarchy
        self._methods = [_CG, _GMRES] if symmetric else [_GMRES]
        self._method = 0
        self._direct: DirectSolver | None = None
        self._to_direct = False

    @cached_property
    def matrix(self) -> PETSc.Mat:
        """PETSc's."""
        return self._make()

    @abstractmethod
    def _finite(self) -> bool:
        """Whether the tangent's entries are finite, on all ranks."""

    @abstractmethod
    def _hierarchy_of_rows(self) -> Hierarchy:
        """A hierarchy, without entries."""

    @abstractmethod
    def _fill_matrix(self) -> None:
        """Give PETSc's matrix the entries, for the direct solver."""

    # hierarchy ------------------------------------------------------------------------------------
    def factor(self) -> None:
        """Take the tangent as it stands. Collective.

        Raises:
            SingularTangent: it has entries that are not finite.
        """
        if not self._finite():
            raise SingularTangent("the tangent has entries that are not finite")
        self._to_direct, self._method = self.failures >= _FAILURES, 0
        if self._to_direct:
            return self._factor_direct()
        self._old = self._equations is not None and not self._worn
        if not self._old:
            self._build()
        elif self._hierarchy is not None:
            try:
                self._hierarchy.keep()
            except SingularTangent:
                self._factor_direct()

    def _build(self) -> None:
        """A hierarchy of this tangent; where there can be none the direct solver stands in."""
        self._equations, self._worn, self._old = None, False, False
        if self._hierarchy is None:
            self._hierarchy = self._hierarchy_of_rows()
        found = self._hierarchy
        try:
            found.renew()
        except SingularTangent:
            return self._factor_direct()
        self._equations = Equations(
            found.product, found.quick_product, found.precondition, found.weight, self.comm
        )
        self._rate = 0.0
        self.hierarchies += 1

    # solution -------------------------------------------------------------------------------------
    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
        """Solve for the owned unknowns, (n,) -> (n,), until the residual is `accuracy` times the right-hand
        side, in the norm of forces and in the energy norm. Collective.

        Raises:
            SingularTangent: no method gave a solution.
        """
        if not np.isfinite(self.comm.allreduce(float(np.abs(rhs).sum()))):
            raise SingularTangent("the residual has entries that are not finite")
        solution = np.zeros(len(rhs))
        while not self._to_direct:
            result = self._iterate(solution, rhs, accuracy)
            self.iterations += result.iterations
            if not result.failed:
                self._judge(result.iterations, accuracy)
                return solution
            if result.failed != LIMIT:
                solution[:] = 0.0
            if self._old and result.failed != INDEFINITE:  # once more with a hierarchy of this tangent
                self._build()
                solution[:] = 0.0
            elif self._method + 1 < len(self._methods):
                self._method += 1
            else:
                self._factor_direct()
        assert self._direct is not None
        return self._direct.solve(rhs, accuracy)

    def solve_again(self, rhs: np.ndarray) -> np.ndarray:
        """See `DirectSolver.solve_again`."""
        if self._to_direct and self._direct is not None:
            return self._direct.solve_again(rhs)
        solution = np.zeros(len(rhs))
        if self._equations is None or self._iterate(solution, rhs, ACCURACY).failed:
            raise SingularTangent("the linear system could not be solved")
        return solution

    def precondition(self, rhs: np.ndarray) -> np.ndarray:
        """See `DirectSolver.precondition`."""
        if self._to_direct and self._direct is not None:
            return self._direct.precondition(rhs)
        if self._equations is None:
            raise SingularTangent("there is no hierarchy")
        return self._equations.precondition(rhs).copy()

    def _iterate(self, solution: np.ndarray, rhs: np.ndarray, accuracy: float) -> Result:
        """Improve the solution by the present method."""
        assert self._equations is not None
        system = self._equations, solution, rhs, accuracy, _LIMIT
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            try:
                if self._methods[self._method] == _CG:
                    return conjugate_gradients(*system)
                return flexible_gmres(*system, _RESTART)
            except SingularTangent:
                return Result(failed=BROKEN)

    def _judge(self, taken: int, accuracy: float) -> None:
        """Whether the hierarchy is still worth to be kept, and is strong enough."""
        digits = -math.log10(accuracy)
        if not self._old:
            self._rate = self._rate or taken / digits
        elif taken > self._rate * digits + _STALE:
            self._worn = True
        if taken > _SLOW and self._hierarchy is not None:
            self._hierarchy.strengthen()

    def _factor_direct(self) -> None:
        if not self._to_direct:
            self.failures, self._to_direct = self.failures + 1, True
        self._release()
        self._fill_matrix()
        if self._direct is None:
            memory = free_memory(self.comm)
            self._direct = DirectSolver(self.matrix, self.symmetric, self._far, memory)
        try:
            self._direct.factor()
        except SingularTangent as e:
            raise SingularTangent(f"multigrid fails, and in the memory that is free {e}") from e

    # memory ---------------------------------------------------------------------------------------
    def _release(self) -> None:
        if self._hierarchy is not None:
            self._hierarchy.destroy()
        self._hierarchy = self._equations = None

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release()
        if self._direct is not None or "matrix" in vars(self):
            (self._direct or self.matrix).destroy()
