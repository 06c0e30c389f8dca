"""Initial stresses of the points in the sums over them (`forms.initialstress`)."""

from __future__ import annotations

from collections.abc import Mapping

from mpi4py import MPI

import numpy as np

from ..forms.initialstress import InitialKernels
from ..kernels import native
from ..kinematics.layout import Layout
from .interpolation import Interpolation


class InitialStress:
    """The initial stresses of an interpolation's points (`Reference.initial_stress`), as kernels take them.

    Attributes:
        kernels: of each batch.

    Between two resets they change where rotations get a new base only.
    """

    def __init__(self, interpolation: Interpolation, kernels: Mapping[Layout, InitialKernels]):
        self.interpolation = interpolation
        self.kernels = [kernels[b.form.layout] for b in interpolation.batches]
        self.pack()

    def pack(self) -> None:
        """Take over stresses, or frames, that have changed."""
        stress = self.interpolation.reference.initial_stress
        self._any = bool(np.any(stress))
        self._packed = [
            np.ascontiguousarray(own.form.pack(stress[b.rows], b.batch.frames, b.grown))
            for b, own in zip(self.interpolation.batches, self.kernels, strict=True)
        ]

    def active(self) -> bool:
        """Whether there are any. Collective."""
        return bool(self.interpolation.grid.comm.allreduce(self._any, op=MPI.LOR))

    def put(self, k: int, tangent: bool, kernels: native.PointKernels) -> None:
        """Let the sums over batch k take them along."""
        if self._any:
            own = self.kernels[k]
            kernel, size = own.blocks if tangent else own.residual, own.form.size
            native.fill(kernels, initial=kernel.address, initial_stress=self._packed[k], ninitial=size)

    def energy(self, x: np.ndarray) -> float:
        """Their energy (J) at nodal increments x (nodes, block), of this rank's points."""
        if not self._any:
            return 0.0
        total = 0.0
        for b, own, packed in zip(self.interpolation.batches, self.kernels, self._packed, strict=True):
            z = self.interpolation.kernel_inputs(b, x)[:, : b.form.layout.unknowns]
            total += float(own.energy(z, b.batch.frames, packed)[:, 0] @ b.batch.kept["volume"])
        return total

    def replace(self, stress: np.ndarray) -> None:
        """Put in stresses (np, b, d)."""
        self.interpolation.reference.initial_stress = stress
        self.pack()
