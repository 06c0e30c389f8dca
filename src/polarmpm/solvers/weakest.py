"""How a tangent answers where it hardly resists: for the diagnosis of a step that has failed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from petsc4py import PETSc

import numpy as np

from .linear import SingularTangent

_SHIFT = 1e-13  # of the diagonal: a factor that exists, and modes weaker than that stand out
_ROUNDS = 2  # of inverse iteration; the gap to the next mode is wide, or there is nothing to tell


@dataclass
class Mode:
    """A motion of the owned unknowns (n,), and the curvature of the energy along it, relative to the
    tangent's diagonal: near rounding where nothing resists; negative where the state is unstable.

    `share`: the part of the forces, relative to all of them, that work on it.
    """

    values: np.ndarray
    curvature: float
    share: float


class WeakTangent:
    """Factor of a tangent that may be singular. Collective.

    Args:
        matrix: of PETSc; left as it is.

    Attributes:
        negative: number of negative eigenvalues of a symmetric tangent; of others 0.

    Raises:
        SingularTangent: it has entries that are not finite, or can't be factored at all.
    """

    def __init__(self, matrix: PETSc.Mat, symmetric: bool):
        self.comm = matrix.comm.tompi4py()
        if not np.isfinite(matrix.norm()):
            raise SingularTangent("the tangent has entries that are not finite")
        if symmetric:
            matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        whole = matrix.getType() in ("seqaij", "mpiaij")
        self._matrix = matrix.copy() if whole else matrix.convert("aij", out=PETSc.Mat())
        diagonal = self._matrix.getDiagonal()
        size = np.abs(diagonal.array)
        self._scale = diagonal
        self._scale.array[:] = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
        self._matrix.diagonalScale(self._scale, self._scale)
        self._shifted = self._matrix.copy()
        self._shifted.shift(_SHIFT)
        self._right, self._left = self._matrix.createVecs()
        self._pc: Any = PETSc.PC().create(matrix.comm)
        self._pc.setOperators(self._shifted)
        if symmetric:
            self._shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._pc.setType(PETSc.PC.Type.CHOLESKY if symmetric else PETSc.PC.Type.LU)
        self._pc.setFactorSolverType("mumps")
        self._pc.setFactorSetUpSolverType()
        factor = self._pc.getFactorMatrix()
        factor.setMumpsIcntl(14, 60)  # spare memory for pivoting, in per cent
        try:
            self._pc.setUp()
            failed = factor.getMumpsInfog(1) < 0
        except PETSc.Error:
            failed = True
        if failed:
            self.destroy()
            raise SingularTangent("the tangent can't be factored")
        self.negative = int(factor.getMumpsInfog(12)) if symmetric else 0

    def _solve(self, scaled: np.ndarray) -> np.ndarray:
        self._left.array[:] = scaled
        self._pc.apply(self._left, self._right)
        found: np.ndarray = self._right.array.copy()
        return found

    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Solution (n,) for forces on the owned unknowns (n,)."""
        scale = self._scale.array
        solution: np.ndarray = scale * self._solve(scale * forces)
        return solution

    def mode(self, forces: np.ndarray) -> Mode | None:
        """The weakest motion on which forces on the owned unknowns (n,) work; None without forces."""
        start = self._scale.array * forces
        size = self._norm(start)
        if not np.isfinite(size) or size == 0.0:
            return None
        now = start / size
        for _ in range(_ROUNDS):
            now = self._solve(now)
            length = self._norm(now)
            if not np.isfinite(length) or length == 0.0:
                return None
            now /= length
        self._right.array[:] = now
        self._matrix.mult(self._right, self._left)
        curvature = self.comm.allreduce(float(np.vdot(now, self._left.array)))
        share = abs(self.comm.allreduce(float(np.vdot(now, start)))) / size
        return Mode(self._scale.array * now, curvature, share)

    def _norm(self, values: np.ndarray) -> float:
        return float(np.sqrt(self.comm.allreduce(float(np.vdot(values, values)))))

    def destroy(self) -> None:
        """Release PETSc's objects."""
        for thing in (self._pc, self._shifted, self._matrix, self._scale, self._right, self._left):
            thing.destroy()
