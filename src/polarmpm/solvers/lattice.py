"""Large systems on a lattice: Krylov methods with multigrid on the lattice."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI
from petsc4py import PETSc

from ..kernels import native
from .hierarchy import Lattices
from .linear import LatticeRows
from .multigrid import MultigridSolver


class LatticeSolver(MultigridSolver):
    """Multigrid on the rows of a lattice.

    Args:
        make: makes PETSc's matrix, for the direct solver, when it is asked for first. Collective.
        symmetric, far_from_symmetric: see `DirectSolver`.
        lattice: the rows that are worked on.

    Attributes:
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
        super().__init__(make, symmetric, far_from_symmetric, lattice.comm)
        self._lattice = lattice

    def _finite(self) -> bool:
        values = self._lattice.values[: self._lattice.entries]
        here = bool(native.library().polarmpm_finite(len(values), values))
        return bool(self.comm.allreduce(here, op=MPI.LAND))

    def _hierarchy_of_rows(self) -> Lattices:
        return Lattices(self._lattice, self.symmetric)

    def _fill_matrix(self) -> None:
        self._lattice.put()

    def destroy(self) -> None:
        """Release PETSc's objects, and the entries."""
        super().destroy()
        vars(self).pop("_lattice", None)
