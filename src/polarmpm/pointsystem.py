"""Systems of the active nodes: what the points bring with them, and the direct sum over the points."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from . import native, sparsity
from .conditions import Prescribed
from .interpolation import Interpolation, PointBatch
from .linear import DirectSolver
from .nodes import ActiveNodes
from .pointforms import Kernel
from .system import NodalSystem
from .timing import Timer


class LoadedPoints(NodalSystem):
    """Laws and loads of the points. How their virtual work is summed is left to subclasses."""

    nodes: ActiveNodes

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
    ):
        grid, layout = interpolation.grid, interpolation.layout
        super().__init__(interpolation.nodes, layout, prescribed, np.array(grid.cell), grid.comm, timer)
        self.interpolation, self.kernels, self.couple_kernel = interpolation, kernels, couple_kernel
        self._couples: list[tuple[np.ndarray, np.ndarray]] = [
            (np.full(len(b.rows), -1, dtype=np.int32), np.zeros((1, 3))) for b in interpolation.batches
        ]

    def set_loads(self, forces: np.ndarray, couples: np.ndarray) -> None:
        """Forces (np, d) and couples (np, r) at the points. Collective."""
        self.external = self.interpolation.spread(np.concatenate([forces, couples], axis=1))
        if self.couple_kernel is not None:
            for k, b in enumerate(self.interpolation.batches):
                mine = couples[b.rows]
                loaded = np.any(mine != 0.0, axis=1)
                row = np.where(loaded, np.cumsum(loaded) - 1, -1).astype(np.int32)
                table = np.concatenate([mine[loaded], np.zeros((1, 3))])  # never empty
                self._couples[k] = (row, np.ascontiguousarray(table))

    def _law(self, k: int, tangent: bool) -> native.Law:
        """Compiled kernels of batch k."""
        law = native.Law()
        native.fill(law, kernel=self.kernels[k][tangent].address)
        if self.couple_kernel is not None:
            rows, couples = self._couples[k]
            native.fill(law, couple=self.couple_kernel.address, couple_of=rows, couples=couples)
        return law

    def _dead_forces(self) -> np.ndarray:
        """External forces (nodes, block) that the kernels' residual doesn't hold already, as it does dead
        couples in three dimensions."""
        external = self.external.copy()
        if self.couple_kernel is not None:
            external[:, self.layout.dim :] = 0.0
        return external


class PointSystem(LoadedPoints):
    """Residual and tangent as sums over the points, scattered by compiled code."""

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
    ):
        super().__init__(interpolation, kernels, couple_kernel, prescribed, timer)
        symmetric = couple_kernel is None
        batches = [b.batch for b in interpolation.batches]
        with timer("pattern"):
            self.pattern = sparsity.build(
                self.nodes, batches, self.layout.block, symmetric, interpolation.reach
            )
            self._fixed = np.ascontiguousarray(prescribed.fixed, dtype=np.uint8)
            native.fill(self.pattern.matrix, fixed=self._fixed)
            owned = prescribed.fixed[: self.nodes.owned].ravel()
            self._fixed_diagonal = self.pattern.diagonal[owned]
            self._rows = self.pattern.rows()
            self.solver = DirectSolver(self.pattern.petsc_matrix(), symmetric)

    # assembly ---------------------------------------------------------------------------------------
    def assemble(self, tangent: bool) -> np.ndarray:
        internal, self._lift_forces = np.zeros_like(self.x), np.zeros_like(self.x)
        matrix = self.pattern.matrix
        if tangent:
            self.pattern.values[:] = 0.0
            native.fill(matrix, lift=self._lift if self._pending else None)
        for k, batch in enumerate(self.interpolation.batches):
            self._assemble(k, batch, matrix if tangent else None, internal)
        self.nodes.add_to_owners(internal)
        if tangent:
            self.pattern.collect()
            if self._pending:
                self.nodes.add_to_owners(self._lift_forces)
        return internal - self._dead_forces()

    def _assemble(
        self, k: int, batch: PointBatch, matrix: native.Matrix | None, internal: np.ndarray
    ) -> None:
        failed = native.library().polarmpm_assemble(
            ctypes.byref(batch.batch),
            ctypes.byref(self._law(k, matrix is not None)),
            ctypes.byref(matrix) if matrix is not None else None,
            self.x.ctypes.data,
            internal.ctypes.data,
            self._lift_forces.ctypes.data,
        )
        if failed:
            raise MemoryError("no memory for the sums over material points")

    def diagonal(self) -> np.ndarray:
        return self.pattern.values[self.pattern.diagonal].reshape(-1, self.layout.block)

    def solve(self, right: np.ndarray, fresh: bool) -> np.ndarray:
        if fresh:
            values = self.pattern.values
            at = self._fixed_diagonal[values[self._fixed_diagonal] == 0.0]
            values[at] = 1.0
            with self.timer("factor"):
                self.solver.matrix.setValuesCSR(*self._rows)
                self.solver.matrix.assemble()
                self.solver.factor()
        with self.timer("solve"):
            return self.solver.solve(right.ravel()).reshape(right.shape)

    def destroy(self) -> None:
        self.solver.destroy()
