"""The nonlinear system of the active nodes: sums over points, supports, linear solver."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from . import native, sparsity
from .conditions import Prescribed
from .interpolation import Interpolation, PointBatch
from .linear import DirectSolver
from .pointforms import Kernel
from .timing import Timer

_ROUNDING = 16 * float(np.finfo(float).eps)


class PointSystem:
    """Implements `newton.System` between two resets.

    Attributes:
        x: nodal increments since the reset (nodes, block), ghosts included.
        residual: internal minus external forces of the last evaluation; complete on owned rows.
    """

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
    ):
        self.interpolation, self.nodes, self.timer = interpolation, interpolation.nodes, timer
        self.layout, self.comm = interpolation.layout, interpolation.grid.comm
        self.kernels, self.couple_kernel, self.prescribed = kernels, couple_kernel, prescribed
        shape = (len(self.nodes), self.layout.block)
        self.x, self._last = np.zeros(shape), np.zeros(shape)
        self.residual: np.ndarray = np.zeros(shape)
        self.external: np.ndarray = np.zeros(shape)
        self._lift: np.ndarray = np.zeros(shape)
        self._lift_forces: np.ndarray = np.zeros(shape)
        self._pending, self._rounding = False, 0.0
        symmetric = couple_kernel is None
        with timer("pattern"):
            self.pattern = sparsity.build(
                self.nodes,
                [b.batch for b in interpolation.batches],
                self.layout.block,
                symmetric,
                interpolation.reach,
            )
            self._fixed = np.ascontiguousarray(prescribed.fixed, dtype=np.uint8)
            native.fill(self.pattern.matrix, fixed=self._fixed)
            owned = prescribed.fixed[: self.nodes.owned].ravel()
            self._fixed_diagonal = self.pattern.diagonal[owned]
            self.solver = DirectSolver(self.pattern)
        self._couples: list[tuple[np.ndarray, np.ndarray]] = [
            (np.full(len(b.rows), -1, dtype=np.int32), np.zeros((1, 3))) for b in interpolation.batches
        ]

    # loads and supports ---------------------------------------------------------------------------
    def set_loads(self, forces: np.ndarray, couples: np.ndarray) -> None:
        """Forces (np, d) and couples (np, r) at the points; begins a step. Collective."""
        self._rounding = 0.0
        self.external = self.interpolation.spread(np.concatenate([forces, couples], axis=1))
        if self.couple_kernel is not None:
            for k, b in enumerate(self.interpolation.batches):
                mine = couples[b.rows]
                loaded = np.any(mine != 0.0, axis=1)
                row = np.where(loaded, np.cumsum(loaded) - 1, -1).astype(np.int32)
                table = np.concatenate([mine[loaded], np.zeros((1, 3))])  # never empty
                self._couples[k] = (row, np.ascontiguousarray(table))

    def set_prescribed(self, increments: np.ndarray) -> None:
        """Target of the prescribed unknowns, as increments since the reset (nodes, block). Collective."""
        self._lift = np.where(self.prescribed.fixed, increments - self.x, 0.0)
        self._pending = bool(self.comm.allreduce(bool(np.any(self._lift)), op=MPI.LOR))

    def pending(self) -> bool:
        return self._pending

    # evaluation -----------------------------------------------------------------------------------
    def evaluate(self, tangent: bool) -> None:
        with self.timer("assembly"):
            self._evaluate(tangent)

    def _evaluate(self, tangent: bool) -> None:
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
            if self._rounding == 0.0:  # at the start of the step: iterates that run away must not set it
                self._rounding = self._rounding_level()
        # dead couples in three dimensions are part of the kernels' residual already
        external = self.external.copy()
        if self.couple_kernel is not None:
            external[:, self.layout.dim :] = 0.0
        self.residual = internal - external

    def _assemble(
        self, k: int, batch: PointBatch, matrix: native.Matrix | None, internal: np.ndarray
    ) -> None:
        law = native.Law()
        native.fill(law, kernel=self.kernels[k][matrix is not None].address)
        if self.couple_kernel is not None:
            rows, couples = self._couples[k]
            native.fill(law, couple=self.couple_kernel.address, couple_of=rows, couples=couples)
        failed = native.library().polarmpm_assemble(
            ctypes.byref(batch.batch),
            ctypes.byref(law),
            ctypes.byref(matrix) if matrix is not None else None,
            self.x.ctypes.data,
            internal.ctypes.data,
            self._lift_forces.ctypes.data,
        )
        if failed:
            raise MemoryError("no memory for the sums over material points")

    def measures(self) -> tuple[float, float]:
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges is told by the numbers
            return self._measures()

    def _measures(self) -> tuple[float, float]:
        own = slice(0, self.nodes.owned)
        free = ~self.prescribed.fixed[own]
        r, external = self.residual[own], self.external[own]
        # |f_ext + f_rct|: at supports the reaction makes it the internal force
        total = np.where(free, external, r + external)
        sums = np.array(
            [
                np.sum((r * free) ** 2),
                np.sum(total**2),
                abs(np.sum((r * free) * self._last[own])),
                np.sum(total * self.x[own]),
            ]
        )
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        out, loads = np.sqrt(sums[:2])
        if out <= self._rounding:
            return 0.0, 0.0
        force = out / loads if loads > 0 else np.inf
        energy = sums[2] / abs(sums[3]) if sums[3] != 0 else np.inf
        return float(force), float(energy)

    def _rounding_level(self) -> float:
        """Out-of-balance force that a relative rounding of strains and rotations makes. Collective.

        Loads so small that their strains are near rounding can't be balanced more closely than this.
        """
        diagonal = self.pattern.values[self.pattern.diagonal].reshape(-1, self.layout.block)
        length = np.ones(self.layout.block)  # a rotation is a strain, a displacement one over a cell
        length[: self.layout.dim] = self.interpolation.grid.cell
        square = self.comm.allreduce(float(np.sum((diagonal * length) ** 2)))
        return float(_ROUNDING * np.sqrt(square))

    def advance(self) -> None:
        fixed = self.prescribed.fixed
        values, own = self.pattern.values, self.nodes.owned
        at = self._fixed_diagonal[values[self._fixed_diagonal] == 0.0]
        values[at] = 1.0
        right = -(self.residual + self._lift_forces)[:own]
        right[fixed[:own]] = 0.0
        with self.timer("factor"):
            self.solver.factor()
        with self.timer("solve"):
            change = self.solver.solve(right.ravel()).reshape(own, self.layout.block)
        step = np.zeros_like(self.x)
        step[:own] = change
        self.nodes.update_ghosts(step)
        step[fixed] = self._lift[fixed] if self._pending else 0.0
        self.x += step
        self._last, self._pending = step, False
        self._lift[:] = 0.0
