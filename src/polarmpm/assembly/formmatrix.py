"""Matrix of bilinear forms that dolfinx assembles, and its solver."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from ..solvers.choice import make_solver
from ..solvers.linear import NearNullSpace, Tangent
from ..tools import compat


class FormMatrix:
    """Matrix of bilinear forms with prescribed unknowns, and its solver.

    Args:
        forms: compiled bilinear forms whose sum is the matrix; the first has the whole pattern.
        fixed: prescribed unknowns (nodes, block) of this rank, bool.
        symmetric: the matrix is symmetric.
        far_from_symmetric: see `DirectSolver`.
        solver: its name; large, near_null_space: see `solvers.linear.Tangent`.
    """

    def __init__(
        self,
        forms: Sequence[Any],
        fixed: np.ndarray,
        symmetric: bool,
        owned: int,
        far_from_symmetric: bool,
        solver: str,
        large: bool,
        near_null_space: Callable[[], NearNullSpace],
    ):
        self.forms, self.owned, self.block = forms, owned, fixed.shape[1]
        self.matrix = made = compat.create_matrix(forms[0])
        rows = np.flatnonzero(fixed[:owned].ravel())
        self._fixed = (rows + self.matrix.getOwnershipRange()[0]).astype(np.int32)
        tangent = Tangent(lambda: made, symmetric, near_null_space, far_from_symmetric, large)
        self.solver = make_solver(solver, tangent)
        self._vector = self.matrix.createVecRight()

    def assemble(
        self, lift: np.ndarray | None, dense: Iterable[tuple[np.ndarray, np.ndarray]] = ()
    ) -> np.ndarray | None:
        """Fill the matrix, with dense parts (global nodes (n,), entries (n block, n block)) beside the forms.
        Returns its product with `lift` (nodes, block), from before rows and columns of prescribed unknowns
        are left out. Collective."""
        self.matrix.zeroEntries()
        for form in self.forms:
            compat.add_to_matrix(self.matrix, form)
        for nodes, entries in dense:
            at = nodes.astype(np.int32)
            self.matrix.setValuesBlocked(at, at, entries, PETSc.InsertMode.ADD_VALUES)
        self.matrix.assemble()
        product = None
        if lift is not None:
            self._vector.array[:] = lift[: self.owned].ravel()
            moved = self.matrix.createVecLeft()
            self.matrix.mult(self._vector, moved)
            product = np.zeros_like(lift)
            product[: self.owned] = moved.array.reshape(-1, self.block)
            moved.destroy()
        self.diagonal = self._diagonal()
        scale = float(self.diagonal.max(initial=0.0)) or 1.0
        self.matrix.zeroRowsColumns(self._fixed, self.matrix.comm.tompi4py().allreduce(scale, op=MPI.MAX))
        return product

    def _diagonal(self) -> np.ndarray:
        diagonal = self.matrix.getDiagonal()
        values: np.ndarray = diagonal.array.reshape(-1, self.block).copy()
        diagonal.destroy()
        return values

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._vector.destroy()
        self.solver.destroy()
