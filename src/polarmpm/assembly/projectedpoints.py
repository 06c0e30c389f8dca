"""Points whose stiff scalars are projected over patches, in a system of nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..forms.projected import ProjectedForm
from ..kernels import native
from ..kernels.kernel import Kernel
from ..materials.base import parameter_values
from .interpolation import Interpolation
from .pointboxes import PointBoxes
from .stiffscalars import Evaluated, StiffScalars
from .system import NodalSystem

if TYPE_CHECKING:
    from ..forms.returnmapping import ReturnMapping


class ProjectedPoints(NodalSystem):
    """What a system does with stiff scalars (`stiffscalars`), before and after its points are summed."""

    interpolation: Interpolation
    kernels: Sequence[tuple[Kernel, Kernel]]
    mappings: list[ReturnMapping | None]
    projected: list[StiffScalars | None]
    _boxes: list[PointBoxes] | None
    _patched: list[Evaluated | None]

    def project_in(self, interpolation: Interpolation) -> None:
        """Begin with the points of a reset. Collective."""
        self.projected = [
            StiffScalars(interpolation, k, self.comm) if b.form.scalars else None
            for k, b in enumerate(interpolation.batches)
        ]
        self._patched = [None] * len(self.projected)

    def _boxes_of(self, k: int) -> PointBoxes | None:
        return None if self._boxes is None else self._boxes[k]

    def place(self) -> None:
        """Let the points' kernels know the projected scalars at the present increments. Local."""
        for k, projected in enumerate(self.projected):
            if projected is not None:
                projected.place(self.x, self._boxes_of(k))

    def project_scalars(self, *, tangent: bool) -> None:
        """Project the points' stiff scalars and what they do work on. Collective."""
        predicted, forms = self.step.projected, self.interpolation.forms
        for k, projected in enumerate(self.projected):
            if projected is None:
                continue
            boxes, mapping = self._boxes_of(k), self.mappings[k]
            measure = projected.place(self.x, boxes)
            linear = None if predicted is None else predicted[k]
            own = measure, boxes, mapping, linear, self.x
            self._patched[k] = projected.evaluate(*own, tangent=tangent, timer=self.timer)
        if tangent and any(form.scalars for form in forms):
            self.step.projected = [None if p is None else p.linear(self.x) for p in self._patched]

    def add_patches(
        self, matrix: native.Matrix | None, internal: np.ndarray, lifted: np.ndarray | None
    ) -> None:
        """What the patches add to forces, and to the tangent."""
        for projected, found in zip(self.projected, self._patched, strict=True):
            if projected is None or found is None:
                continue
            patches = projected.patches
            patches.add_forces(found.b, found.exact - found.taken, internal)
            if matrix is not None:
                assert found.g is not None
                assert found.h is not None
                patches.add_tangent(found.b, found.g, found.h, matrix, lifted, found.row)

    def holding_energy(self, x: np.ndarray) -> float:
        """Energy (J) that holds points to their patches at increments x (nodes, block), on this rank."""
        parts = enumerate(self.projected)
        total = sum(p.energy(x, self._boxes_of(k)) for k, p in parts if p is not None)
        if any(p is not None and p.form.stabilisation for p in self.projected):
            self.place()
        return float(total)

    def put_projected(self) -> None:
        """Let the points have the projected deformation of the last evaluation."""
        points = self.interpolation.points
        for k, projected in enumerate(self.projected):
            if projected is not None:
                projected.place(self.x, self._boxes_of(k))
                rows, F = projected.projected_F()
                moved = points.F.copy()
                moved[rows] = F
                points.F = moved

    def elastic_blocks(self, k: int, x: np.ndarray | None = None) -> np.ndarray:
        """Residual and upper triangle of the tangent of batch k's elastic energy, without any projection, at
        increments x (nodes, block); None: at no increments. Collective."""
        batch, i = self.interpolation.batches[k], self.interpolation
        n, nz = len(batch.rows), self.layout.unknowns
        inputs = (i.kernel_inputs(batch, np.zeros_like(self.x) if x is None else x),)
        still = np.zeros((n, nz)) if x is None else np.ascontiguousarray(inputs[0][:, :nz])
        if isinstance(batch.form, ProjectedForm):
            form, r, rows = batch.form.plain, i.reference, batch.rows
            plastic = i.points.plastic_state(rows)
            radii = np.stack([i.points.X[rows, 0], r.x[rows, 0]], axis=1)
            plastic = plastic if form.material.plastic else ()
            state = form.pack(r.F[rows], r.q[rows], r.wryness[rows], plastic, radii=radii)
            parameters = np.tile(parameter_values(form.material), (n, 1))
            kernel, inputs = batch.form.compile_plain(self.comm), (np.hstack([still, state, parameters]),)
        else:
            form, kernel = batch.form, self.kernels[k][1]
        found: np.ndarray = kernel(*inputs, *((still,) if form.predicts else ()))
        return found

    def scalar_values(self) -> list[np.ndarray | None]:
        """The stiff scalars of each batch's points."""
        return [None if p is None else p.values(self.x) for p in self.projected]

    def go_on(self, before: Sequence[np.ndarray | None]) -> None:
        """Let stiff scalars have the values that they had before the rotations' base."""
        reference = self.interpolation.reference
        base = reference.stiff_scalars.copy()
        for batch, projected, values in zip(self.interpolation.batches, self.projected, before, strict=True):
            if projected is not None and values is not None:
                base[batch.rows, : values.shape[1]] += values - projected.values(self.x)
        if any(p is not None for p in self.projected):
            reference.stiff_scalars = base
            self.interpolation.pack()
            self.place()
