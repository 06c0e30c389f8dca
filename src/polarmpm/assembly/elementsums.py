"""The nonlinear system of a finite element mesh, summed over the elements by compiled code.

Sparse rows are those of material points' systems: of symmetric tangents the upper triangle, in arrays that
PETSc's matrix uses on one rank. Loads that depend on the unknowns come from dolfinx.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ..forms.elementkernels import NativeElementForms
from ..kernels import native
from ..solvers.choice import make_solver, solver_of
from ..solvers.linear import Tangent
from ..terms.base import Piece
from ..tools import compat
from ..tools.disposal import dispose_with, weakly
from .elements import ElementSystem
from .elementscalars import scalars_of
from .inertia import MassSets
from .meshpattern import MeshPattern
from .onpattern import OnPattern
from .stepstate import Assembled
from .stiffscalars import Evaluated

if TYPE_CHECKING:
    from ..forms.returnmapping import Yielding


class SummedElements(OnPattern, ElementSystem):
    """Residual and tangent as sums over the elements, scattered by compiled code."""

    forms: NativeElementForms

    def _build(self, solver: str) -> None:
        forms, symmetric = self.forms, self.symmetric
        with self.timer("compile"):
            self._kernels, self._mappings = forms.compiled
        with self.timer("pattern"):
            large = self.is_large()
            several = self.comm.size > 1 and solver_of(solver, large).whole_rows
            cells = forms.elements.live_nodes.astype(np.int64)
            sums, whole = forms.symmetric, several or not symmetric
            self._mesh = MeshPattern(self.nodes, cells, self.terms.rows, self.layout.block, sums, whole)
            self.pattern = self._mesh.pattern
            self._fixed = np.ascontiguousarray(self.prescribed.fixed, dtype=np.uint8)
            native.fill(self.pattern.matrix, fixed=self._fixed)
            self._columns = [np.ascontiguousarray(self._mesh.columns[p.cells]) for p in forms.parts]
            self._bind_terms()
            self.projected = scalars_of(forms, self.comm)
            self._patched: list[Evaluated | None] = [None] * len(self.projected)
            self._of_loads = [LoadTangent(v.tangent, self._mesh, self._fixed) for v in self._varying]
            shared = (self.pattern.values, self.pattern.diagonal) if self.pattern.shared else None
            matrix, plastic = cache(self.pattern.petsc_matrix), not forms.symmetric
            rows, space = self.pattern.rows(matrix) if shared else None, weakly(self.near_null_space)
            tangent = Tangent(matrix, symmetric, space, plastic, large, shared, rows=rows)
            self.solver = make_solver(solver, tangent)
            self._dispose = dispose_with(
                self, self.comm, _Together([self.solver.destroy, *(t.destroy for t in self._of_loads)])
            )

    def _bind_terms(self) -> None:
        self.terms.bind(self.pattern.matrix, self.prescribed.fixed, self._mesh.block_columns)

    def put_pieces(self, pieces: Sequence[Piece]) -> None:
        super().put_pieces(pieces)
        self._bind_terms()

    # assembly ---------------------------------------------------------------------------------------
    @property
    def batches(self) -> int:
        return len(self.forms.parts)

    def unknowns(self, k: int) -> np.ndarray:
        return self.forms.unknowns(k, np.ascontiguousarray(self.x))

    def elastic_tangent(self, k: int) -> tuple[np.ndarray, int]:
        form = self.forms.parts[k].form
        still = self.forms.unknowns(k, np.zeros_like(self.x))
        inputs = self.forms.kernel_inputs(k, still)
        found: np.ndarray = self._kernels[k][1](inputs, *((still,) if form.predicts else ()))
        return found, form.layout.unknowns

    def add_given(
        self, k: int, blocks: np.ndarray, tangent: bool, internal: np.ndarray, lifted: np.ndarray | None
    ) -> None:
        elements, kernels = self.forms.bound(k), native.PointKernels()
        native.fill(elements, columns=self._columns[k])
        native.fill(kernels, returned_of=np.arange(len(blocks), dtype=np.int32), returned=blocks)
        matrix = ctypes.byref(self.pattern.matrix) if tangent else None
        arguments = ctypes.byref(elements), ctypes.byref(kernels), matrix, np.ascontiguousarray(self.x)
        if native.library().polarmpm_assemble_elements(*arguments, internal, lifted):
            raise MemoryError("no memory for the sums over elements")

    def mass_sets(self, mass: np.ndarray) -> Iterator[MassSets]:
        e, functions = self.forms.elements, self._functions
        rows = e.live_nodes.astype(np.int64)
        products = np.einsum("qi,qj->qij", functions, functions).reshape(len(functions), -1)
        of_cells = mass.T.reshape(mass.shape[1], len(rows), len(functions)) @ products
        n = rows.shape[1]
        yield MassSets(rows, self._mesh.block_columns(rows), of_cells.reshape(mass.shape[1], len(rows), n, n))

    def assemble(self, tangent: bool, lift: np.ndarray | None = None) -> Assembled:
        internal = np.zeros_like(self.x)
        lifted = None if lift is None else np.zeros_like(self.x)
        if tangent:
            self.pattern.values[:] = 0.0
            native.fill(self.pattern.matrix, lift=lift)
        self._project(tangent)
        for k in range(len(self._kernels)):
            self._add_elements(k, tangent, internal, lifted)
        self._add_viscosity(tangent, internal, lifted)
        self.nodes.add_to_owners(internal)
        self._put(self.x)
        loads = self.external = self._body_loads()
        if len(self.terms):
            internal += self.term_forces()
        if tangent:
            self.pattern.mirror()
            self.terms.add_tangents(self.x, self.pattern.values)
        if self.inertia is not None:
            self.add_inertia(self.inertia, tangent, None, internal, None)
        if tangent:
            self._complete_tangent(lift, lifted)
        return Assembled(internal - loads, lifted)

    def _add_elements(self, k: int, tangent: bool, internal: np.ndarray, lifted: np.ndarray | None) -> None:
        """Sum over the elements of a material. Collective."""
        elements, kernels = self.forms.bound(k), native.PointKernels()
        native.fill(elements, columns=self._columns[k])
        form, mapping = self.forms.parts[k].form, self._mappings[k]
        # beside plastic materials an elastic one has the tangent itself
        predicts, before = tangent and form.predicts, self.before if self.forms.symmetric else self.x
        native.fill(kernels, kernel=self._kernels[k][tangent].address)
        native.fill(kernels, before=np.ascontiguousarray(before) if predicts else None)
        patched = self._patched[k]
        yielding = None if patched is None else patched.returned
        if patched is None and mapping is not None:
            y = self._return(k, tangent)
            yielding = y.rows, y.returned
        if yielding is not None:
            returned_of = np.full(len(self.forms.parts[k].points), -1, dtype=np.int32)
            returned_of[yielding[0]] = np.arange(len(yielding[0]))
            native.fill(kernels, returned_of=returned_of, returned=yielding[1])
        failed = native.library().polarmpm_assemble_elements(
            ctypes.byref(elements),
            ctypes.byref(kernels),
            ctypes.byref(self.pattern.matrix) if tangent else None,
            np.ascontiguousarray(self.x),
            internal,
            lifted,
        )
        if failed:
            raise MemoryError("no memory for the sums over elements")
        scalars = self.projected[k]
        if scalars is not None and patched is not None:
            scalars.patches.add_forces(patched.b, patched.exact - patched.taken, internal)
            if tangent:
                assert patched.g is not None
                assert patched.h is not None
                own = patched.b, patched.g, patched.h
                scalars.patches.add_tangent(*own, self.pattern.matrix, lifted, patched.row)

    def _return(self, k: int, tangent: bool) -> Yielding:
        """What of a material's points yields. Collective.

        Raises:
            LocalFailure: at some points there is no solution.
        """
        mapping = self._mappings[k]
        assert mapping is not None
        with self.timer("return mapping"):
            inputs = self.forms.kernel_inputs(k, self.forms.unknowns(k, self.x))
            return mapping.evaluate(inputs, tangent)

    def _project(self, tangent: bool) -> None:
        """Project the points' stiff scalars and what they do work on. Collective."""
        predicted = self.step.projected
        for k, scalars in enumerate(self.projected):
            if scalars is None:
                continue
            self.forms.bound(k)
            measure = scalars.place(self.x, None)
            linear, mapping = None if predicted is None else predicted[k], self._mappings[k]
            own = measure, None, mapping, linear, self.x
            self._patched[k] = scalars.evaluate(*own, tangent=tangent, timer=self.timer)
        if tangent and any(scalars is not None for scalars in self.projected):
            self.step.projected = [None if p is None else p.linear(self.x) for p in self._patched]

    def holding_energy(self, x: np.ndarray) -> float:
        """See `NodalSystem`."""
        return float(sum(scalars.energy(x, None) for scalars in self.projected if scalars is not None))

    def projected_F(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of points whose deformation is projected, and the projected F at the present increments."""
        found = []
        for scalars in self.projected:
            if scalars is not None:
                scalars.place(self.x, None)
                found.append(scalars.projected_F())
        return found

    def _complete_tangent(self, lift: np.ndarray | None, lifted: np.ndarray | None) -> None:
        """Add the other ranks' parts, and what loads add that depend on the unknowns."""
        self.pattern.collect()
        if lift is not None and lifted is not None:
            lifted += self.lifted_by_terms(lift)
            self.nodes.add_to_owners(lifted)
            if self.inertia is not None:
                lifted += self.inertia.products(self, lift)
        for tangent in self._of_loads:
            tangent.add(self.pattern.values, lift, lifted)

    def destroy(self) -> None:
        super().destroy()
        self.pattern.release()


class LoadTangent:
    """What dolfinx assembles of a load that depends on the unknowns, as entries of a pattern. Collective.

    Args:
        form: compiled, of minus the derivative of the load's work.
        fixed: prescribed unknowns (nodes, block).
    """

    def __init__(self, form: Any, mesh: MeshPattern, fixed: np.ndarray):
        self._form, self._mesh = form, mesh
        self._matrix = compat.create_matrix(form)
        self._vector = self._matrix.createVecRight()
        self._owned = mesh.nodes.owned
        self._columns: np.ndarray = np.zeros(0, dtype=np.int32)
        self._at: np.ndarray = np.zeros(0, dtype=np.int64)
        self._kept: np.ndarray = self._at
        self._free = _everywhere(mesh, fixed) == 0.0

    def add(self, values: np.ndarray, lift: np.ndarray | None, lifted: np.ndarray | None) -> None:
        """Add the tangent to the pattern's values, and its product with `lift` (nodes, block), from before
        rows and columns of prescribed unknowns are left out, to `lifted`. Collective."""
        self.renew()
        indptr, columns, entries = self._matrix.getValuesCSR()
        if not np.array_equal(columns, self._columns):
            self._columns = columns
            self._find(np.asarray(indptr, dtype=np.int64), np.asarray(columns, dtype=np.int64))
        values[self._at] += entries[self._kept]
        if lift is not None and lifted is not None:
            self.multiply(lift, lifted)

    def renew(self) -> None:
        """Assemble it at the present increments. Collective."""
        self._matrix.zeroEntries()
        compat.add_to_matrix(self._matrix, self._form)
        self._matrix.assemble()

    def multiply(self, x: np.ndarray, out: np.ndarray) -> None:
        """Add its product with x (nodes, block) to owned rows of `out`. Collective."""
        self._vector.array[:] = x[: self._owned].ravel()
        moved = self._matrix.createVecLeft()
        self._matrix.mult(self._vector, moved)
        out[: self._owned] += moved.array.reshape(-1, x.shape[1])
        moved.destroy()

    def _find(self, indptr: np.ndarray, columns: np.ndarray) -> None:
        first = self._matrix.getOwnershipRange()[0]
        rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        at = self._mesh.entries(indptr, columns)
        free = self._free
        kept = (free[rows + first] & free[columns]) | (rows + first == columns)
        self._kept = np.flatnonzero(kept & (at >= 0))  # nodes of elements that aren't in the body have none
        self._at = at[self._kept]

    def destroy(self) -> None:
        """Release PETSc's objects."""
        self._vector.destroy()
        self._matrix.destroy()


def _everywhere(mesh: MeshPattern, fixed: np.ndarray) -> np.ndarray:
    """Prescribed unknowns of all ranks, by global number. Collective."""
    own = np.asarray(fixed[: mesh.nodes.owned], dtype=np.uint8).ravel()
    return np.concatenate(mesh.nodes.comm.allgather(own))


class _Together:
    """Calls several functions; keeps nothing else alive."""

    def __init__(self, functions: Sequence[Any]):
        self._functions = list(functions)

    def __call__(self) -> None:
        for function in self._functions:
            function()
