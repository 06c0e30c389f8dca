"""Sums over elements, and their derivatives in a direction: `batchrates` for quadrature points.

Nodes carry an element's functions along, so that these stay; what changes is the frame in which kernels take
gradients, and, of points whose deformation is projected, what takes gradients by X to the projected state.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from ..forms.directional import FormAlong
from ..forms.elementkernels import NativeElementForms
from ..forms.projected import ProjectedForm
from ..kernels import native
from ..kinematics import rotations
from ..kinematics.layout import Layout
from .batchrates import BatchRates
from .elementscalars import QuadraturePoints
from .ratestate import Change


class ElementFunctions:
    """The functions of a material's elements on their own, as `Functions` of points.

    Args:
        elements: of the material.
        nodes: how many this rank has.
        axes: dxi/dx (n, d, d) of the gradients.
        values: the functions themselves count, else their gradients alone.
    """

    def __init__(
        self, layout: Layout, elements: native.Elements, nodes: int, axes: np.ndarray, *, values: bool = True
    ):
        self.layout, self._nodes, self._own = layout, nodes, native.Elements()
        for each in native.Elements._fields_:
            setattr(self._own, each[0], getattr(elements, each[0]))
        self._own.kept.update(elements.kept)
        native.fill(self._own, axes=np.ascontiguousarray(axes))
        if not values:
            table = elements.kept["table"].copy()
            table[:, 0] = 0.0
            native.fill(self._own, table=table)
        self._points = len(axes)

    def _gathered(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z, value = np.empty((self._points, self.layout.unknowns)), np.empty((self._points, self.layout.block))
        given = np.ascontiguousarray(x)
        if native.library().polarmpm_gather_elements(ctypes.byref(self._own), given, z, value):
            raise MemoryError("no memory to interpolate nodal values")
        return z, value

    def gather(self, x: np.ndarray) -> tuple[np.ndarray, None]:
        """z (n, nz) of nodal values (nodes, block); there are no boxes."""
        return self._gathered(x)[0], None

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (n, block) at the points."""
        return self._gathered(x)[1]

    def spread(self, work: np.ndarray, sides: np.ndarray | None) -> np.ndarray:
        """Forces (nodes, block) on this rank's nodes of what does work on z (n, nz), per volume."""
        out, kernels = np.zeros((self._nodes, self.layout.block)), native.PointKernels()
        native.fill(
            kernels,
            returned_of=np.arange(self._points, dtype=np.int32),
            returned=np.ascontiguousarray(work),
        )
        own = ctypes.byref(self._own), ctypes.byref(kernels)
        if native.library().polarmpm_assemble_elements(*own, None, np.zeros_like(out), out, None):
            raise MemoryError("no memory for the sums over elements")
        return out


class ElementRates(BatchRates):
    """The quadrature points of a material's elements."""

    def __init__(self, forms: NativeElementForms, k: int, along: FormAlong, nodes: int):
        points: Any = QuadraturePoints(forms)
        self._forms, self._part, self._k = forms, forms.parts[k], k
        self.batch = points.batches[k]
        self.form, self.layout, self.along = self.batch.form, self.batch.form.layout, along
        self.boxes, self.patches, self.nodes = None, points.patches[k], nodes
        self.share = self.initial = self.turn = None
        self._inverse = forms._inverse[self._part.points]

    def begin(self, q: np.ndarray, total: np.ndarray, F: np.ndarray) -> None:
        """A step begins at microrotations q (np, 4), displacements (nodes, block; of rotations zero) and F
        (np, 3, 3)."""
        self._forms.bound(self._k)
        rows, d, form = self.batch.rows, self.layout.dim, self.form
        projected = isinstance(form, ProjectedForm)
        axes, self._bent = self._inverse, None
        if projected:
            self._true = self._start + self._gradient(total)
            self._bent = np.linalg.solve(self._true, F[rows][:, :d, :d])
            axes = axes @ self._bent
        self.functions = ElementFunctions(self.layout, self._part.elements, self.nodes, axes)  # type: ignore[assignment]
        self._frames = self._turned_back(q[rows])
        if isinstance(form, ProjectedForm) and form.turned:
            self.turn = form.frames(q[rows])

    @property
    def _start(self) -> np.ndarray:
        placed, d = self._forms.elements.placed, self.layout.dim
        start: np.ndarray = np.eye(d) if placed is None else placed[self._part.points]
        return start

    def _gradient(self, nodal: np.ndarray) -> np.ndarray:
        """By X (n, d, d), of displacements among nodal values (nodes, block)."""
        functions = ElementFunctions(self.layout, self._part.elements, self.nodes, self._inverse)
        gradient: np.ndarray = self.layout.part(functions.gather(nodal)[0], "displacement", 1)
        return gradient

    def _turned_back(self, q: np.ndarray) -> np.ndarray:
        """Frames (n, d, d) of microrotations (n, 4)."""
        d = self.layout.dim
        if not (self.layout.rotations and self.form.rotated):
            return np.tile(np.eye(d), (len(q), 1, 1))
        back: np.ndarray = np.swapaxes(rotations.to_tensor(q), 1, 2)[:, :d, :d]
        return back

    def frames(self, state: np.ndarray) -> np.ndarray:
        return self._frames

    def turned(self, change: Change) -> np.ndarray:
        assert change.frames is not None
        return change.frames

    def bent_functions(self, moved: np.ndarray, dF: np.ndarray) -> list[Any]:
        """What the functions change by, as displacements (nodes, block) and F (np, 3, 3) do."""
        if self._bent is None:
            return []
        d, rows = self.layout.dim, self.batch.rows
        off = dF[rows][:, :d, :d] - self._gradient(moved) @ self._bent
        axes = self._inverse @ np.linalg.solve(self._true, off)
        return [ElementFunctions(self.layout, self._part.elements, self.nodes, axes, values=False)]
