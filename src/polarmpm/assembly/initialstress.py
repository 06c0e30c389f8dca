"""Initial stresses of the points in the sums over them (`forms.initialstress`)."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..forms.initialstress import InitialKernels
from ..kernels import native
from .interpolation import Interpolation


class InitialStress:
    """The initial stresses of an interpolation's points (`Reference.initial_stress`), as kernels take them.

    Between two resets they change where rotations get a new base only.
    """

    def __init__(self, interpolation: Interpolation, kernels: InitialKernels):
        self.interpolation, self.kernels = interpolation, kernels
        self.pack()

    def pack(self) -> None:
        """Take over stresses, or frames, that have changed."""
        stress = self.interpolation.reference.initial_stress
        self._any = bool(np.any(stress))
        pack, batches = self.kernels.form.pack, self.interpolation.batches
        self._packed = [np.ascontiguousarray(pack(stress[b.rows], b.batch.frames)) for b in batches]

    def active(self) -> bool:
        """Whether there are any. Collective."""
        return bool(self.interpolation.grid.comm.allreduce(self._any, op=MPI.LOR))

    def put(self, k: int, tangent: bool, kernels: native.PointKernels) -> None:
        """Let the sums over batch k take them along."""
        if self._any:
            kernel = self.kernels.blocks if tangent else self.kernels.residual
            size = self.kernels.form.size
            native.fill(kernels, initial=kernel.address, initial_stress=self._packed[k], ninitial=size)

    def energy(self, x: np.ndarray) -> float:
        """Their energy (J) at nodal increments x (nodes, block), of this rank's points."""
        if not self._any:
            return 0.0
        total, nz = 0.0, self.interpolation.layout.unknowns
        for b, packed in zip(self.interpolation.batches, self._packed, strict=True):
            z = self.interpolation.kernel_inputs(b, x)[:, :nz]
            total += float(self.kernels.energy(z, b.batch.frames, packed)[:, 0] @ b.batch.kept["volume"])
        return total

    def replace(self, stress: np.ndarray) -> None:
        """Put in stresses (np, b, d)."""
        self.interpolation.reference.initial_stress = stress
        self.pack()
