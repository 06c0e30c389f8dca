"""Factors of small sparse matrices on one rank, whose entries change while their pattern stays."""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

import numpy as np

from .linear import SingularTangent


class Factor:
    """Cholesky's factor (CHOLMOD), of an indefinite matrix LDL^T and of an unsymmetric one LU (MUMPS).

    Args:
        indptr, indices: rows of the matrix, of a symmetric one from the diagonal on.
        values: its entries, which `renew` may change.
    """

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, values: np.ndarray, symmetric: bool):
        self._symmetric, self._values, n = symmetric, values, len(indptr) - 1
        self._rows = indptr.astype(np.int32), np.ascontiguousarray(indices, dtype=np.int32)
        kind, block = ("SBAIJ", (1,)) if symmetric else ("AIJ", ())
        make = getattr(PETSc.Mat(), f"create{kind}")
        self._matrix = make((n, n), *(block or (None,)), csr=(*self._rows, values), comm=PETSc.COMM_SELF)
        self._right, self._left = self._matrix.createVecs()
        self._pc: Any = None
        self._method = ""

    def renew(self) -> None:
        """Factor the entries as they are.

        Raises:
            SingularTangent: that is not possible.
        """
        self._matrix.setValuesCSR(*self._rows, self._values)
        self._matrix.assemble()
        self._matrix.stateIncrease()
        methods = ("cholmod", "mumps") if self._symmetric else ("mumps",)
        for method in (m for m in methods if m == self._method or self._method in ("", "cholmod")):
            if self._try(method):
                return
        self.release()
        raise SingularTangent("a coarse or a weak part of the tangent can't be factored")

    def _try(self, method: str) -> bool:
        if self._pc is None or method != self._method:
            self.release()
            self._create(method)
        self._pc.setReusePreconditioner(False)
        try:
            self._pc.setUp()
            failed = method == "mumps" and self._pc.getFactorMatrix().getMumpsInfog(1) < 0
        except PETSc.Error:
            failed = True
        return not failed

    def _create(self, method: str) -> None:
        self._matrix.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric)
        self._matrix.setOption(PETSc.Mat.Option.SPD, method == "cholmod")
        self._pc, self._method = PETSc.PC().create(PETSc.COMM_SELF), method
        self._pc.setOperators(self._matrix)
        self._pc.setType(PETSc.PC.Type.CHOLESKY if self._symmetric else PETSc.PC.Type.LU)
        PETSc.Options().setValue("mat_cholmod_print", 0)  # an indefinite matrix is no news
        self._pc.setFactorSolverType(method)
        if method == "mumps":
            self._pc.setFactorSetUpSolverType()
            self._pc.getFactorMatrix().setMumpsIcntl(14, 60)  # spare memory for pivoting, in per cent

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution (n,) for (n,)."""
        self._left.array[:] = right
        self._pc.apply(self._left, self._right)
        found: np.ndarray = self._right.array.copy()
        return found

    def release(self) -> None:
        """Release the factor."""
        if self._pc is not None:
            self._pc.destroy()
        self._pc, self._method = None, ""

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self.release()
        for thing in (self._matrix, self._right, self._left):
            thing.destroy()
