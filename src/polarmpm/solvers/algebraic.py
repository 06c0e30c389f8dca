"""Large systems on meshes: Krylov methods with algebraic multigrid (smoothed aggregation, PETSc's GAMG).

The coarse spaces hold the rigid motions of the body, which a tangent hardly resists where supports are far:
three translations and three rotations, in the plane two and one. A rotation takes the microrotations along.
Rows and columns are scaled by the diagonal, so that neither units nor small cuts matter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from petsc4py import PETSc

import numpy as np

from .linear import NearNullSpace, SingularTangent
from .multigrid import MultigridSolver

# Of the diagonal of weak nodes, whose tangent may be exactly singular: a point alone in its cell. Of 1e-12, a
# factor's rounding is as large as makes a preconditioner unsymmetric, and conjugate gradients slow.
_SHIFT = 1e-8

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


class Aggregates:
    """A hierarchy of aggregates of nodes; see `multigrid.Hierarchy`.

    Args:
        matrix: of PETSc; left as it is.
        near_null_space: see `linear.Tangent`. Collective.
    """

    def __init__(self, matrix: PETSc.Mat, symmetric: bool, near_null_space: Callable[[], NearNullSpace]):
        self._matrix, self._symmetric, self._near_null_space = matrix, symmetric, near_null_space
        self._whole: Any = None
        self._left, self._right = matrix.createVecs()
        self._scale = self._right.duplicate()
        self._preconditioner: Preconditioner | None = None
        self.weight: np.ndarray = np.ones(self._right.getLocalSize())

    def renew(self) -> None:
        """Take the matrix as it is, scaled by its diagonal.

        Raises:
            SingularTangent: no hierarchy can be made of it.
        """
        self._release()
        self._copy()
        diagonal = self._whole.getDiagonal()
        size = np.abs(diagonal.array)
        self._scale.array[:] = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
        diagonal.destroy()
        self._whole.diagonalScale(self._scale, self._scale)
        space = self._near_null_space()
        block = space.motions.shape[2]
        self.weight = np.tile(space.as_force, len(self.weight) // block)
        self._whole.setBlockSizes(block, block)
        self._whole.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric)
        self._whole.setOption(PETSc.Mat.Option.STRUCTURALLY_SYMMETRIC, True)
        self._attach(space.motions.reshape(len(space.motions), -1))
        weak = np.flatnonzero(np.repeat(space.weak, block))
        try:
            self._preconditioner = Preconditioner(self._whole, self._symmetric, weak)
        except PETSc.Error as e:
            raise SingularTangent("no hierarchy can be made of the tangent") from e

    def keep(self) -> None:
        """Take the matrix as it is, scaled as when the hierarchy was made, which stays.

        Raises:
            SingularTangent: the weak nodes' part of it can't be factored.
        """
        assert self._preconditioner is not None
        self._copy()
        self._whole.diagonalScale(self._scale, self._scale)
        try:
            self._preconditioner.update()
        except PETSc.Error as e:
            raise SingularTangent("a weak part of the tangent can't be factored") from e

    def _copy(self) -> None:
        """The matrix with both of its triangles."""
        if self._matrix.getType() in ("seqaij", "mpiaij"):
            if self._whole is None:
                self._whole = self._matrix.duplicate()
            self._matrix.copy(self._whole, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        else:
            self._whole = self._whole or PETSc.Mat()
            if "sbaij" in self._matrix.getType():
                self._matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._matrix.convert("aij", out=self._whole)

    def _attach(self, modes: np.ndarray) -> None:
        """Tell the matrix of its near-null space (k, n)."""
        vectors = self._orthonormal(modes)
        space = PETSc.NullSpace().create(constant=False, vectors=vectors, comm=self._matrix.comm)
        self._whole.setNearNullSpace(space)
        for thing in (space, *vectors):
            thing.destroy()

    def _orthonormal(self, modes: np.ndarray) -> list[PETSc.Vec]:
        """An orthonormal basis of the scaled motions. For motions that supports prevent other vectors stand
        in, as GAMG wants no fewer than a node has unknowns."""
        out: list[PETSc.Vec] = []
        first = self._right.getOwnershipRange()[0]
        for k, mode in enumerate(modes):
            v = self._right.duplicate()
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

    def strengthen(self) -> None:
        """There is nothing that pays."""

    def product(self, x: np.ndarray) -> np.ndarray:
        """The matrix times the owned unknowns (n,). Collective."""
        scale = self._scale.array
        np.divide(x, scale, out=self._right.array)
        self._whole.mult(self._right, self._left)
        found: np.ndarray = self._left.array / scale
        return found

    quick_product = product

    def precondition(self, right: np.ndarray) -> np.ndarray:
        """One cycle for the owned unknowns (n,). Collective.

        Raises:
            SingularTangent: it is not possible.
        """
        assert self._preconditioner is not None
        scale = self._scale.array
        np.multiply(right, scale, out=self._right.array)
        try:
            self._preconditioner.pc.apply(self._right, self._left)
        except PETSc.Error as e:
            raise SingularTangent("a cycle of multigrid is not possible") from e
        found: np.ndarray = self._left.array * scale
        return found

    def _release(self) -> None:
        if self._preconditioner is not None:
            self._preconditioner.destroy()
        self._preconditioner = None

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._release()
        for thing in (self._whole, self._left, self._right, self._scale):
            if thing is not None:
                thing.destroy()


class AlgebraicSolver(MultigridSolver):
    """Multigrid that needs no lattice.

    Args:
        matrix, symmetric, far_from_symmetric: see `DirectSolver`.
        near_null_space: see `linear.Tangent`. Collective.
    """

    def __init__(
        self,
        matrix: PETSc.Mat,
        symmetric: bool,
        near_null_space: Callable[[], NearNullSpace],
        far_from_symmetric: bool = False,
    ):
        super().__init__(lambda: matrix, symmetric, far_from_symmetric, matrix.comm.tompi4py())
        self._near_null_space = near_null_space

    def _finite(self) -> bool:
        return bool(np.isfinite(self.matrix.norm()))

    def _hierarchy_of_rows(self) -> Aggregates:
        return Aggregates(self.matrix, self.symmetric, self._near_null_space)

    def _fill_matrix(self) -> None:
        """It has them."""
