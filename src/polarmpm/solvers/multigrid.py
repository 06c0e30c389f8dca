"""Large linear systems: Krylov methods with algebraic multigrid (smoothed aggregation, PETSc's GAMG).

The coarse spaces hold the rigid motions of the body, which a tangent hardly resists where supports are far:
three translations and three rotations, in the plane two and one. A rotation takes the microrotations along.
Rows and columns are scaled by the diagonal, so that neither units nor small cuts matter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from .direct import DirectSolver
from .linear import ACCURACY, NearNullSpace, SingularTangent
from .memory import free_memory

_LIMIT = 150  # iterations after which a method is given up
_RESTART = 50  # of GMRES
_STALE = 10  # a new hierarchy costs about as much as so many iterations
_ROUNDS = 4  # solutions for what is left of the residual
# Of the diagonal of weak nodes, whose tangent may be exactly singular: a point alone in its cell. Of 1e-12, a
# factor's rounding is as large as makes a preconditioner unsymmetric, and conjugate gradients slow.
_SHIFT = 1e-8
_FAILURES = 2  # of multigrid, after which the direct solver takes over until the next reset

_PREFIX, _FINEST = "polarmpm_multigrid_", "polarmpm_finest_"
_HIERARCHY = {
    "pc_gamg_type": "agg",
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_threshold": 0.0,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "jacobi",
}
_RELAXATION = {"ksp_max_it": 1, "pc_type": "sor"}
# Symmetric relaxation of a definite matrix has no eigenvalue beyond 1: on one rank none has to be estimated.
_ONE_RANK, _RANKS = {"ksp_chebyshev_eigenvalues": "0.1,1.1"}, {"esteig_ksp_type": "cg"}


def rigid_motions(
    position: np.ndarray, turned: np.ndarray, comm: MPI.Comm, centre: np.ndarray | None = None
) -> np.ndarray:
    """Rigid motions of nodes as changes of their unknowns, (k, n, block). Collective.

    Where the microrotation has been turned by exp(Dw), a further spin b changes Dw by J_l(Dw)^-1 b, which is
    b + b x Dw / 2 up to the square of Dw. To that order it is linear in the nodal increments, and right at
    points between nodes, whatever the increments of nodes that the points hardly reach. Rotations are about
    `centre`, the nodes' by default.

    Args:
        position: current positions (n, d) (m).
        turned: increments of the microrotation (n, r) (rad), r = 0 for classical materials.
    """
    (n, d), r = position.shape, turned.shape[1]
    if centre is None:
        centre = comm.allreduce(position.sum(axis=0)) / max(1, comm.allreduce(n))
    arm = np.pad(position - centre, ((0, 0), (0, 3 - d)))
    spins = np.eye(3)[2:] if d == 2 else np.eye(3)
    out: np.ndarray = np.zeros((d + len(spins), n, d + r))
    for k in range(d):
        out[k, :, k] = 1.0
    for motion, spin in zip(out[d:], spins, strict=True):
        motion[:, :d] = np.cross(spin, arm)[:, :d]
        if r == 3:
            motion[:, d:] = spin + 0.5 * np.cross(spin, turned)
        elif r:
            motion[:, d] = 1.0
    return out


class Preconditioner:
    """Multigrid between two corrections of weak nodes, each for what the one before leaves.

    A few points in a cell give motions of its outer nodes hardly any stiffness. There are too many of them
    for Krylov methods, and relaxation doesn't reduce them: each rank factors the tangent of its weak nodes.

    Args:
        matrix: with a diagonal of 1, and with its near-null space.
        weak: unknowns of weak nodes, counted on this rank.
    """

    def __init__(self, matrix: PETSc.Mat, symmetric: bool, weak: np.ndarray):
        self._symmetric, self._weak, comm = symmetric, None, matrix.comm
        self.pc = hierarchy = PETSc.PC().create(comm)
        self.pc.setOperators(matrix)
        if comm.tompi4py().allreduce(len(weak)):
            self.pc.setType(PETSc.PC.Type.COMPOSITE)
            self.pc.setCompositeType(PETSc.PC.CompositeType.SYMMETRIC_MULTIPLICATIVE)
            for kind in (PETSc.PC.Type.ASM, PETSc.PC.Type.GAMG):
                self.pc.addCompositePCType(kind)
            self._weak, hierarchy = self.pc.getCompositePC(0), self.pc.getCompositePC(1)
            unknowns = PETSc.IS().createGeneral(
                (weak + matrix.getOwnershipRange()[0]).astype(np.int32), comm=PETSc.COMM_SELF
            )
            self._weak.setASMLocalSubdomains(1, [unknowns])
            self._weak.setASMOverlap(0)
            self._weak.setOperators(matrix)
            unknowns.destroy()
        self._hierarchy = hierarchy
        hierarchy.setType(PETSc.PC.Type.GAMG)
        hierarchy.setOperators(matrix)
        _put_options(_PREFIX, _HIERARCHY)
        hierarchy.setOptionsPrefix(_PREFIX)
        hierarchy.setFromOptions()
        hierarchy.setUp()
        levels = hierarchy.getMGLevels()
        if levels > 1:
            self._relax_by_rows(hierarchy.getMGSmoother(levels - 1))
        self.pc.setReusePreconditioner(True)  # until a new one is made
        self.pc.setUp()
        self.update()

    def _relax_by_rows(self, finest: PETSc.KSP) -> None:
        """Choose the relaxation. Small cuts and short characteristic lengths need more than the diagonal on
        the finest level. Coarse operators may have empty rows, where a node without microrotation is an
        aggregate: there it's the diagonal."""
        _put_options(_FINEST, _RELAXATION | (_ONE_RANK if finest.comm.size == 1 else _RANKS))
        finest.setOptionsPrefix(_FINEST)
        for kind in (PETSc.KSP.Type.RICHARDSON, PETSc.KSP.Type.CHEBYSHEV):  # forget bounds of eigenvalues
            finest.setType(kind)
        finest.setFromOptions()

    def update(self) -> None:
        """Take the weak nodes' part of the matrix as it stands; the hierarchy stays. Collective."""
        if self._weak is None:
            return
        self._weak.setReusePreconditioner(False)
        self._weak.setUp()
        for ksp in self._weak.getASMSubKSP():
            ksp.setType(PETSc.KSP.Type.PREONLY)
            part = ksp.getOperators()[0]
            part.shift(_SHIFT)
            part.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric)
            part.setOption(PETSc.Mat.Option.SPD, self._symmetric)
            pc = ksp.getPC()
            pc.setType(PETSc.PC.Type.CHOLESKY if self._symmetric else PETSc.PC.Type.LU)
            pc.setFactorSolverType("mumps")
            ksp.setUp()

    def destroy(self) -> None:
        """Release PETSc's objects."""
        for pc in (self._weak, self._hierarchy, self.pc):
            if pc is not None:
                pc.destroy()


def _put_options(prefix: str, values: dict[str, Any]) -> None:
    options = PETSc.Options(prefix)
    for name, value in values.items():
        options[name] = value


class MultigridSolver:
    """Conjugate gradients with multigrid; GMRES where the tangent isn't positive definite or not symmetric;
    the direct solver where that fails.

    The hierarchy of an earlier tangent serves until it costs more iterations than a new one would.

    Args:
        matrix, symmetric, far_from_symmetric: see `DirectSolver`.
        near_null_space: see `linear.Tangent`. Collective.

    Attributes:
        iterations: of the Krylov methods so far.
        hierarchies: built so far.
        failures: tangents that were left to the direct solver.
    """

    def __init__(
        self,
        matrix: PETSc.Mat,
        symmetric: bool,
        near_null_space: Callable[[], NearNullSpace],
        far_from_symmetric: bool = False,
    ):
        self.matrix, self.symmetric, self._near_null_space = matrix, symmetric, near_null_space
        self.comm: MPI.Comm = matrix.comm.tompi4py()
        self.iterations = self.hierarchies = 0
        self._far = far_from_symmetric
        self._whole: Any = None
        self.solution, self.rhs = matrix.createVecs()
        self._scale, self._rest = self.rhs.duplicate(), self.rhs.duplicate()
        self._methods: list[PETSc.KSP] = []  # that share the hierarchy, the first one is tried first
        self._method = 0
        self._preconditioner: Preconditioner | None = None
        self._as_force: np.ndarray = np.ones(1)
        self._rate = 0.0  # iterations for a digit with a new hierarchy
        self._old = self._worn = False  # the hierarchy: of an earlier tangent; not worth to be kept
        self._direct: DirectSolver | None = None
        self.failures, self._to_direct = 0, False

    # hierarchy ------------------------------------------------------------------------------------
    def factor(self) -> None:
        """Take the matrix as it stands. Collective.

        Raises:
            SingularTangent: it has entries that are not finite.
        """
        if not np.isfinite(self.matrix.norm()):
            raise SingularTangent("the tangent has entries that are not finite")
        self._to_direct = self.failures >= _FAILURES
        if self._to_direct:
            return self._factor_direct()
        self._method, self._old = 0, bool(self._methods)
        if self._worn:
            self._release()
        self._copy()
        if not self._methods:
            self._build()
        elif self._preconditioner is not None:
            self._preconditioner.update()

    def _copy(self) -> None:
        """The whole matrix, scaled as when the hierarchy was built."""
        if self.matrix.getType() in ("seqaij", "mpiaij"):
            if self._whole is None:
                self._whole = self.matrix.duplicate()
            self.matrix.copy(self._whole, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        else:
            self._whole = self._whole or PETSc.Mat()
            if "sbaij" in self.matrix.getType():
                self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self.matrix.convert("aij", out=self._whole)
        if not self._methods:
            diagonal = self._whole.getDiagonal()
            size = np.abs(diagonal.array)
            self._scale.array[:] = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
            diagonal.destroy()
        self._whole.diagonalScale(self._scale, self._scale)

    def _build(self) -> None:
        space = self._near_null_space()
        modes, weak, self._as_force = space.motions, space.weak, space.as_force
        self._whole.setBlockSizes(modes.shape[2], modes.shape[2])
        self._whole.setOption(PETSc.Mat.Option.SYMMETRIC, self.symmetric)
        self._whole.setOption(PETSc.Mat.Option.STRUCTURALLY_SYMMETRIC, True)
        vectors = self._orthonormal(modes.reshape(len(modes), -1))
        space = PETSc.NullSpace().create(constant=False, vectors=vectors, comm=self.comm)
        self._whole.setNearNullSpace(space)
        for thing in (space, *vectors):
            thing.destroy()
        rows = np.flatnonzero(np.repeat(weak, modes.shape[2]))
        try:
            self._preconditioner = Preconditioner(self._whole, self.symmetric, rows)
        except PETSc.Error:
            return self._factor_direct()
        self._methods = self._create()
        self._rate, self._old, self._worn = 0.0, False, False
        self.hierarchies += 1

    def _orthonormal(self, modes: np.ndarray) -> list[PETSc.Vec]:
        """An orthonormal basis of the scaled motions. For motions that supports prevent other vectors stand
        in, as GAMG wants no fewer than a node has unknowns."""
        out: list[PETSc.Vec] = []
        first = self.rhs.getOwnershipRange()[0]
        for k, mode in enumerate(modes):
            v = self.rhs.duplicate()
            v.array[:] = mode / self._scale.array
            if not self._add_to_basis(v, out):
                v.array[:] = np.cos((k + 1.0) * (first + np.arange(len(mode))))
                self._add_to_basis(v, out)
            out.append(v)
        return out

    def _add_to_basis(self, v: PETSc.Vec, basis: list[PETSc.Vec]) -> bool:
        size = v.norm()
        for _ in range(2):
            for u in basis:
                v.axpy(-u.dot(v), u)
        independent = bool(v.norm() > 1e-8 * size)
        if independent:
            v.normalize()
        return independent

    def _create(self) -> list[PETSc.KSP]:
        assert self._preconditioner is not None
        out: list[PETSc.KSP] = []
        for kind in (PETSc.KSP.Type.CG, PETSc.KSP.Type.GMRES)[0 if self.symmetric else 1 :]:
            ksp = PETSc.KSP().create(self.comm)
            ksp.setPC(self._preconditioner.pc)
            ksp.setOperators(self._whole)
            ksp.setType(kind)
            if kind == PETSc.KSP.Type.CG:
                ksp.setNormType(PETSc.KSP.NormType.NATURAL)
            else:
                ksp.setPCSide(PETSc.PC.Side.RIGHT)
                ksp.setGMRESRestart(_RESTART)
            out.append(ksp)
        return out

    # solution -------------------------------------------------------------------------------------
    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
        """Solve for the owned unknowns, (n,) -> (n,), until the residual is `accuracy` times the right-hand
        side, in the norm of forces and in the energy norm. Collective.

        Raises:
            SingularTangent: no method gave a solution.
        """
        if not np.isfinite(self.comm.allreduce(float(np.abs(rhs).sum()))):
            raise SingularTangent("the residual has entries that are not finite")
        while not self._to_direct:
            if self._iterate(rhs, accuracy):
                solution: np.ndarray = self.solution.array * self._scale.array
                return solution
            self._fall_back()
        assert self._direct is not None
        return self._direct.solve(rhs, accuracy)

    def solve_again(self, rhs: np.ndarray) -> np.ndarray:
        """See `DirectSolver.solve_again`."""
        if self._to_direct and self._direct is not None:
            return self._direct.solve_again(rhs)
        if not self._methods:
            raise SingularTangent("there is no hierarchy")
        kept = self.iterations, self._rate, self._worn
        done = self._iterate(rhs, ACCURACY)
        self.iterations, self._rate, self._worn = kept
        if not done:
            raise SingularTangent("the linear system could not be solved")
        solution: np.ndarray = self.solution.array * self._scale.array
        return solution

    def precondition(self, rhs: np.ndarray) -> np.ndarray:
        """See `DirectSolver.precondition`."""
        if self._to_direct and self._direct is not None:
            return self._direct.precondition(rhs)
        if self._preconditioner is None:
            raise SingularTangent("there is no hierarchy")
        self.rhs.array[:] = rhs * self._scale.array
        self._preconditioner.pc.apply(self.rhs, self.solution)
        solution: np.ndarray = self.solution.array * self._scale.array
        return solution

    def _iterate(self, rhs: np.ndarray, accuracy: float) -> bool:
        """Whether the present method gives a solution."""
        ksp, scale = self._methods[self._method], self._scale.array
        self.rhs.array[:] = rhs * scale
        allowed, aim, taken = accuracy * self._norm(rhs), accuracy, 0
        if self._method == 0:  # else from where the method before has come to
            self.solution.set(0.0)
        for k in range(_ROUNDS):
            ksp.setInitialGuessNonzero(k + self._method > 0)
            ksp.setTolerances(rtol=aim, atol=0.0, divtol=1e30, max_it=_LIMIT - taken)
            try:
                ksp.solve(self.rhs, self.solution)
            except PETSc.Error:
                return False
            taken += ksp.getIterationNumber()
            self.iterations += ksp.getIterationNumber()
            if ksp.getConvergedReason() <= 0:
                return False
            self._whole.mult(self.solution, self._rest)
            left = self._norm((self.rhs.array - self._rest.array) / scale)
            if left <= allowed:
                self._judge(taken, aim)
                return True
            aim *= 0.5 * allowed / left
        return False

    def _norm(self, owned: np.ndarray) -> float:
        forces = owned.reshape(-1, len(self._as_force)) * self._as_force
        return math.sqrt(self.comm.allreduce(float(np.vdot(forces, forces))))

    def _judge(self, taken: int, aim: float) -> None:
        """Whether the hierarchy is still worth to be kept."""
        digits = -math.log10(aim)
        if not self._old:
            self._rate = self._rate or taken / digits
        elif taken > self._rate * digits + _STALE:
            self._worn = True

    def _fall_back(self) -> None:
        reason = self._methods[self._method].getConvergedReason()
        definite = reason != PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
        if self._old and definite:  # once more with a hierarchy of this tangent
            self._release()
            self._copy()
            self._build()
        elif self._method + 1 < len(self._methods):
            self._method += 1
        else:
            self._factor_direct()

    def _factor_direct(self) -> None:
        if not self._to_direct:
            self.failures, self._to_direct = self.failures + 1, True
        self._release()
        if self._direct is None:
            self._direct = DirectSolver(self.matrix, self.symmetric, self._far, free_memory(self.comm))
        try:
            self._direct.factor()
        except SingularTangent as e:
            raise SingularTangent(f"multigrid fails, and in the memory that is free {e}") from e

    # memory ---------------------------------------------------------------------------------------
    def _release(self) -> None:
        for ksp in self._methods:
            ksp.destroy()
        if self._preconditioner is not None:
            self._preconditioner.destroy()
        self._methods, self._preconditioner, self._worn = [], None, False

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release()
        owner = self._direct or self.matrix
        for thing in (self._whole, self.solution, self.rhs, self._scale, self._rest, owner):
            if thing is not None:
                thing.destroy()
