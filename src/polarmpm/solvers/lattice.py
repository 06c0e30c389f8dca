"""Large systems on a lattice: Krylov methods with multigrid on the lattice."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from ..kernels import native
from .direct import DirectSolver
from .hierarchy import Hierarchy
from .krylov import INDEFINITE, LIMIT, Equations, Result, conjugate_gradients, flexible_gmres
from .linear import ACCURACY, LatticeRows, SingularTangent
from .memory import free_memory

_LIMIT = 150  # iterations after which a method is given up
_RESTART = 50  # of GMRES
_STALE = 10  # a new hierarchy costs about as much as so many iterations
_FAILURES = 2  # of multigrid, after which the direct solver takes over until the next reset
_SLOW = 25  # iterations from which a second sweep of relaxation pays
_CG, _GMRES = "cg", "gmres"


class LatticeSolver:
    """Conjugate gradients with a hierarchy of lattices; flexible GMRES for tangents that are indefinite or
    unsymmetric; the direct solver where that fails.

    The hierarchy of an earlier tangent serves until it costs more iterations than a new one would.

    Args:
        make: makes PETSc's matrix, for the direct solver, when it is asked for first. Collective.
        symmetric, far_from_symmetric: see `DirectSolver`.
        lattice: the rows that are worked on.

    Attributes:
        iterations: of the Krylov methods so far.
        hierarchies: built so far.
        failures: tangents that were left to the direct solver.
        in_place: entries are taken from the rows; the matrix needs none.
    """

    in_place = True

    def __init__(
        self,
        make: Callable[[], PETSc.Mat],
        symmetric: bool,
        lattice: LatticeRows,
        far_from_symmetric: bool = False,
    ):
        self._make, self.symmetric, self._lattice, self.comm = make, symmetric, lattice, lattice.comm
        self.iterations = self.hierarchies = self.failures = 0
        self._far = far_from_symmetric
        self._hierarchy: Hierarchy | None = None
        self._equations: Equations | None = None
        self._ready = self._old = self._worn = False
        self._rate = 0.0  # iterations for a digit with a new hierarchy
        self._methods = [_CG, _GMRES] if symmetric else [_GMRES]
        self._direct: DirectSolver | None = None
        self._to_direct = False

    @cached_property
    def matrix(self) -> PETSc.Mat:
        """PETSc's."""
        return self._make()

    # hierarchy ------------------------------------------------------------------------------------
    def factor(self) -> None:
        """Take the rows as they stand. Collective.

        Raises:
            SingularTangent: they have entries that are not finite.
        """
        if not self._finite(self._lattice.values[: int(self._lattice.indptr[-1])]):
            raise SingularTangent("the tangent has entries that are not finite")
        self._to_direct = self.failures >= _FAILURES
        if self._to_direct:
            return self._factor_direct()
        self._old = self._ready and not self._worn
        if not self._old:
            self._build()
        elif self._hierarchy is not None:
            try:
                self._hierarchy.renew_weak()
            except SingularTangent:
                self._factor_direct()

    def _finite(self, values: np.ndarray) -> bool:
        here = bool(native.library().polarmpm_finite(len(values), values))
        return bool(self.comm.allreduce(here, op=MPI.LAND))

    def _build(self) -> None:
        """A hierarchy of this tangent; where there can be none the direct solver stands in."""
        self._ready = self._worn = self._old = False
        lattice = self._lattice
        if self._hierarchy is None:
            self._hierarchy = Hierarchy(lattice, self.comm, self.symmetric)
            weight = np.tile(lattice.as_force, len(lattice.nodes))
            maps = self._hierarchy.product, self._hierarchy.precondition
            self._equations = Equations(*maps, weight, self.comm)
        try:
            self._hierarchy.renew()
        except SingularTangent:
            return self._factor_direct()
        self._ready, self._rate = True, 0.0
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
        methods = list(self._methods)
        while not self._to_direct:
            result = self._iterate(methods[0], solution, rhs, accuracy)
            if not result.failed:
                return solution
            if result.failed != LIMIT:
                solution[:] = 0.0
            if self._old and result.failed != INDEFINITE:  # once more with a hierarchy of this tangent
                self._build()
                solution[:] = 0.0
            elif len(methods) > 1:
                methods.pop(0)
            else:
                self._factor_direct()
        assert self._direct is not None
        return self._direct.solve(rhs, accuracy)

    def _iterate(self, method: str, solution: np.ndarray, rhs: np.ndarray, accuracy: float) -> Result:
        assert self._equations is not None
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            if method == _CG:
                result = conjugate_gradients(self._equations, solution, rhs, accuracy, _LIMIT)
            else:
                result = flexible_gmres(self._equations, solution, rhs, accuracy, _LIMIT, _RESTART)
        self.iterations += result.iterations
        if not result.failed:
            self._judge(result.iterations, accuracy)
        return result

    def _judge(self, taken: int, accuracy: float) -> None:
        """Whether the hierarchy is still worth to be kept, and is strong enough."""
        digits = -math.log10(accuracy)
        if not self._old:
            self._rate = self._rate or taken / digits
        elif taken > self._rate * digits + _STALE:
            self._worn = True
        if taken > _SLOW and self._hierarchy is not None:
            self._hierarchy.sweeps = 2

    def _factor_direct(self) -> None:
        if not self._to_direct:
            self.failures, self._to_direct = self.failures + 1, True
        self._release()
        self._lattice.put()
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
        self._hierarchy, self._equations, self._ready = None, None, False

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release()
        if self._direct is not None or "matrix" in vars(self):
            (self._direct or self.matrix).destroy()
        vars(self).pop("_lattice", None)  # which holds the entries
