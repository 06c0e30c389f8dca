"""Stiff scalars of finite elements: each element is a patch of its quadrature points (`assembly.patches`)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.elements import Elements
from ..bodies.points import Points
from ..forms.elementkernels import NativeElementForms, Part
from ..kernels import native
from .interpolation import PointBatch
from .patches import Patches
from .stiffscalars import StiffScalars


class ElementPatches(Patches):
    """The elements of a material as patches.

    Args:
        places: reference coordinates (nq, d) of the quadrature points.
        linear: the coordinates are functions, too.
    """

    def __init__(self, part: Part, places: np.ndarray, *, linear: bool):
        e, points = part.elements, len(places)
        self.elements, self.dim, self.scalars, self.reach = e, e.dim, part.form.scalars, 0
        self.block, self.count = e.dim + e.rot, e.nelements
        self.volume = e.kept["volume"]
        self.patch = np.repeat(np.arange(self.count), points)
        self._order = np.arange(len(self.patch))
        self._starts = np.arange(self.count) * points
        self.values = self._functions(np.tile(places, (self.count, 1)), linear)
        self._structure = native.Patches()
        native.fill(
            self._structure,
            npatches=self.count,
            functions=self.values.shape[1],
            scalars=self.scalars,
            modes=self.modes,
            offsets=np.arange(self.count + 1, dtype=np.int64) * e.nodes,
            nodes=np.ascontiguousarray(e.kept["cells"].ravel()),
            patch=self.patch.astype(np.int32),
            values=self.values,
        )
        self._length = self.count * e.nodes * self.block * self.modes

    def vectors(
        self,
        kernels: native.PointKernels,
        work: Sequence[np.ndarray],
        sides: np.ndarray | None = None,
        both: np.ndarray | None = None,
    ) -> np.ndarray:
        out: np.ndarray = np.zeros((len(work), self._length))
        own = ctypes.byref(self.elements), ctypes.byref(self._structure)
        for kind, to in zip(work, out, strict=True):
            rows = np.ascontiguousarray(kind)
            if native.library().polarmpm_element_vectors(*own, rows, rows.shape[1], to):
                raise MemoryError("no memory for the sums over elements")
        return out

    def _add_products(
        self, b: np.ndarray, g: np.ndarray, h: np.ndarray, matrix: native.Matrix, lifted: np.ndarray | None
    ) -> None:
        own = ctypes.byref(self.elements), ctypes.byref(self._structure), b, g, h, ctypes.byref(matrix)
        if native.library().polarmpm_add_element_modes(*own, lifted):
            raise MemoryError("no memory for the sums over elements")


class QuadraturePoints:
    """What `StiffScalars` reads of an interpolation, of elements."""

    def __init__(self, forms: NativeElementForms):
        body = forms.elements
        self._forms, self._rows = forms, {id(part.elements): k for k, part in enumerate(forms.parts)}
        elements: list[Any] = [part.elements for part in forms.parts]
        self.batches = [PointBatch(p.form, p.points, e) for p, e in zip(forms.parts, elements, strict=True)]
        self.patches = [
            ElementPatches(p, body.reference_points, linear=linear(body)) if p.form.scalars else None
            for p in forms.parts
        ]

    def unknowns(self, batch: PointBatch, x: np.ndarray) -> np.ndarray:
        """z (n, nz) of a material's points at nodal increments x (nodes, block)."""
        return self._forms.unknowns(self._rows[id(batch.batch)], x)

    def volume_before(self, batch: PointBatch) -> np.ndarray:
        """t (n,) of a material's points at the last converged step, from which increments count."""
        if batch.volume_before is None:
            batch.volume_before = (), np.zeros(len(batch.rows))
        return batch.volume_before[1]

    @property
    def reference(self) -> Points:
        """The state from which increments count."""
        return self._forms.elements.points


def linear(elements: Elements) -> bool:
    """Whether patches have linear functions, too: quadratic elements could follow dilatations of mean zero
    without any stress."""
    return elements.degree == 2 and elements.body.cell in ("quadrilateral", "hexahedron")


def scalars_of(forms: NativeElementForms, comm: MPI.Comm) -> list[StiffScalars | None]:
    """Of each material; None: its form projects nothing. Collective."""
    points: Any = QuadraturePoints(forms)
    return [
        StiffScalars(points, k, comm) if part.form.scalars else None for k, part in enumerate(forms.parts)
    ]
