"""Systems of the active nodes: what the points bring with them, and the direct sum over the points."""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..errors import LocalFailure
from ..geometry.nodes import ActiveNodes
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..solvers.choice import make_solver, solver_of
from ..solvers.linear import Tangent
from ..tools.disposal import dispose_with, weakly
from ..tools.parallel import errors_on_all_ranks
from ..tools.timing import Timer
from . import sparsity
from .folding import Folding
from .inertia import MassSets, point_sets
from .initialstress import InitialStress
from .interpolation import Interpolation, PointBatch
from .onpattern import OnPattern
from .projectedpoints import ProjectedPoints
from .system import Assembled

if TYPE_CHECKING:
    from ..forms.returnmapping import ReturnMapping


_RENEWED = 3  # tangent of a step from which on that of the boxes is summed each time
_UNFELT = 1e-12  # of a tangent's diagonal, added to it where there are fewer points than nodes
_WEAK = 0.2  # share of a cell: nodes beyond edges of the body, and beyond faces that hardly enter a cell


class LoadedPoints(ProjectedPoints):
    """Kernels and loads of the points. How their virtual work is summed is left to subclasses.

    Attributes:
        initial: initial stresses of the points; None: there are none.
    """

    nodes: ActiveNodes
    initial: InitialStress | None = None

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
    ):
        grid, layout = interpolation.grid, interpolation.layout
        length, pieces = np.array(grid.smallest), interpolation.pieces
        super().__init__(interpolation.nodes, layout, prescribed, length, grid.comm, timer, pieces)
        self.kernels, self.couple_kernel = kernels, couple_kernel
        self.interpolation, self._boxes = interpolation, interpolation.boxes
        self.mappings = [self._mapping(b) for b in interpolation.batches]
        self.project_in(interpolation)
        self._at_points: tuple[np.ndarray, np.ndarray] | None = None  # forces and couples
        self._couples: list[tuple[np.ndarray, np.ndarray]] = [
            (np.full(len(b.rows), -1, dtype=np.int32), np.zeros((1, 3))) for b in interpolation.batches
        ]

    def _mapping(self, batch: PointBatch) -> ReturnMapping | None:
        if not batch.form.material.plastic:
            return None
        from ..forms.returnmapping import ReturnMapping  # lazy import: elastic scenes need no plasticity

        return ReturnMapping(batch.form, self.comm, self.interpolation.points.id[batch.rows])

    def start_elastic(self, on: bool) -> bool:
        plastic = [m for m in self.mappings if m is not None]
        for mapping in plastic:
            mapping.start_elastic = on
        return bool(plastic)

    def changing(self) -> Iterator[tuple[Any, tuple[str, ...] | None]]:
        yield from super().changing()
        yield self, ("initial", "_boxes", "_at_points", "_couples")
        yield self.interpolation, ("reference", "pieces")
        yield self.interpolation.reference, None

    def put_back(self) -> None:
        self.interpolation.pack()
        self.place()
        if self.initial is not None:
            self.initial.pack()

    def leave_out_boxes(self, on: bool) -> bool:
        self._boxes = None if on else self.interpolation.boxes
        return self.interpolation.boxes is not None

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric."""
        elastic = not any(b.form.material.plastic for b in self.interpolation.batches)
        return elastic and self.couple_kernel is None and self.terms.symmetric

    def weak_nodes(self) -> np.ndarray:
        weak: np.ndarray = self.node_volumes()[: self.nodes.owned] < _WEAK * np.prod(self.length)
        return weak

    def node_volumes(self) -> np.ndarray:
        return self.interpolation.spread(self.interpolation.points.volume0[:, None])[:, 0]

    def at_points(self, x: np.ndarray) -> np.ndarray:
        return self.interpolation.gather(np.ascontiguousarray(x)).value

    def from_points(self, values: np.ndarray) -> np.ndarray:
        return self.interpolation.spread(values)

    def point_volumes(self) -> np.ndarray:
        return self.interpolation.points.volume0

    def set_loads(self, forces: np.ndarray, couples: np.ndarray) -> None:
        """Forces (np, d) and couples (np, r) at the points. Collective."""
        self._at_points = forces, couples
        self.put_external(self.interpolation.spread(np.concatenate([forces, couples], axis=1)))
        if self.couple_kernel is not None:
            for k, b in enumerate(self.interpolation.batches):
                mine = couples[b.rows]
                loaded = np.any(mine != 0.0, axis=1)
                row = np.where(loaded, np.cumsum(loaded) - 1, -1).astype(np.int32)
                table = np.concatenate([mine[loaded], np.zeros((1, 3))])  # never empty
                self._couples[k] = (row, np.ascontiguousarray(table))

    def working_loads(self) -> np.ndarray:
        """In space a couple m does work on the increments as J_r(Dw) m."""
        if self.couple_kernel is None:
            return super().working_loads()
        assert self._at_points is not None
        forces, couples = self._at_points
        w = self.interpolation.gather(self.x).value[:, self.layout.dim :]
        turned = np.einsum("nij,nj->ni", rotations.right_tangent(w), couples)
        return self.with_terms(self.interpolation.spread(np.concatenate([forces, turned], axis=1)))

    def _point_kernels(self, k: int, tangent: bool) -> native.PointKernels:
        """Compiled kernels of batch k."""
        kernels = native.PointKernels()
        before = self.before if tangent and self.interpolation.forms[k].predicts else None
        native.fill(kernels, kernel=self.kernels[k][tangent].address, before=before)
        if self.couple_kernel is not None:
            rows, couples = self._couples[k]
            native.fill(kernels, couple=self.couple_kernel.address, couple_of=rows, couples=couples)
        if self._boxes is not None:
            self._boxes[k].put(kernels, self.kernels[k][0])
        mapping = self.mappings[k]
        if mapping is not None:
            self._put_yielding(mapping, k, tangent, kernels)
        if self.initial is not None:
            self.initial.put(k, tangent, kernels)
        return kernels

    def initial_energy(self, x: np.ndarray) -> float:
        return 0.0 if self.initial is None else self.initial.energy(x)

    @abstractmethod
    def assemble_moduli(self, blocks: Sequence[np.ndarray], shift: float) -> None:
        """Put the sum over the points of given tangents into the matrix, without any terms. Collective.

        Args:
            blocks: of each batch (n, nz (1 + nz)), per volume, as of a return mapping.
            shift: what is added to the diagonal, over its largest entry.
        """

    def _given(self, blocks: np.ndarray) -> native.PointKernels:
        kernels = native.PointKernels()
        native.fill(kernels, returned_of=np.arange(len(blocks), dtype=np.int32), returned=blocks)
        return kernels

    def _put_yielding(
        self, mapping: ReturnMapping, k: int, tangent: bool, kernels: native.PointKernels
    ) -> None:
        """Return the stresses of the points that yield; their results stand for the kernels. Collective.

        Raises:
            LocalFailure: at some points there is no solution.
        """
        batch, patched = self.interpolation.batches[k], self._patched[k]
        if patched is not None:
            if patched.returned is None:
                return
            rows, returned = patched.returned
            returned_of = np.full(len(batch.rows), -1, dtype=np.int32)
            returned_of[rows] = np.arange(len(rows))
            native.fill(kernels, returned_of=returned_of, returned=returned)
            return
        with self.timer("return mapping"):
            y = mapping.evaluate(self.interpolation.kernel_inputs(batch, self.x), tangent)
        returned_of = np.full(len(batch.rows), -1, dtype=np.int32)
        returned_of[y.rows] = np.arange(len(y.rows))
        native.fill(kernels, returned_of=returned_of, returned=y.returned)

    def _dead_forces(self) -> np.ndarray:
        """External forces (nodes, block) that the kernels' residual doesn't hold already, as it does dead
        couples in three dimensions."""
        external = self.loads.copy()
        if self.couple_kernel is not None:
            external[:, self.layout.dim :] = 0.0
        return external

    def rebase_rotations(self) -> None:
        """Count rotation increments from the points' current rotations on. Collective."""
        before = self.scalar_values()
        self.interpolation.rebase_rotations(self.x)
        if self.initial is not None:
            self.initial.pack()
        self.forget_rotations()
        self.go_on(before)


class PointSystem(OnPattern, LoadedPoints):
    """Residual and tangent as sums over the points, scattered by compiled code."""

    def __init__(
        self,
        interpolation: Interpolation,
        kernels: Sequence[tuple[Kernel, Kernel]],
        couple_kernel: Kernel | None,
        prescribed: Prescribed,
        timer: Timer,
        solver: str = "auto",
    ):
        super().__init__(interpolation, kernels, couple_kernel, prescribed, timer)
        symmetric = self.symmetric
        batches = [b.batch for b in interpolation.batches] + self.terms.batches()
        with timer("pattern"):
            large = self.is_large()
            # multigrid wants whole rows, which PETSc gets from a half only slowly on several ranks
            whole = self.comm.size > 1 and solver_of(solver, large).whole_rows
            self.pattern = sparsity.build(
                self.nodes,
                batches,
                self.layout.block,
                symmetric,
                interpolation.reach,
                whole,
                [patches for patches in interpolation.patches if patches is not None],
            )
            self._fixed = np.ascontiguousarray(prescribed.fixed, dtype=np.uint8)
            native.fill(self.pattern.matrix, fixed=self._fixed)
            self.terms.bind(self.pattern.matrix, prescribed.fixed)
            self._folding: Folding | None = None
            if prescribed.ties is not None:
                with errors_on_all_ranks(self.comm):
                    self._folding = Folding(self.pattern, prescribed.ties)
            plastic = any(m is not None for m in self.mappings)
            shared = (self.pattern.values, self.pattern.diagonal) if self.pattern.shared else None
            matrix = self.pattern.petsc_matrix()
            self.solver = make_solver(
                solver, Tangent(matrix, symmetric, weakly(self.near_null_space), plastic, large, shared)
            )
            self._dispose = dispose_with(self, self.comm, self.solver.destroy)
        self._few = interpolation.points.total < self.nodes.total

    # assembly ---------------------------------------------------------------------------------------
    @property
    def batches(self) -> int:
        return len(self.interpolation.batches)

    def unknowns(self, k: int) -> np.ndarray:
        batch = self.interpolation.batches[k]
        z = self.interpolation.kernel_inputs(batch, self.x)[:, : batch.form.layout.unknowns]
        return np.ascontiguousarray(z)

    def elastic_tangent(self, k: int) -> tuple[np.ndarray, int]:
        return self.elastic_blocks(k, self.x), self.interpolation.forms[k].layout.unknowns

    def add_given(
        self, k: int, blocks: np.ndarray, tangent: bool, internal: np.ndarray, lifted: np.ndarray | None
    ) -> None:
        matrix = ctypes.byref(self.pattern.matrix) if tangent else None
        arguments = ctypes.byref(self.interpolation.batches[k].batch), ctypes.byref(self._given(blocks))
        if native.library().polarmpm_assemble(*arguments, matrix, self.x, internal, lifted):
            raise MemoryError("no memory for the sums over material points")

    def mass_sets(self, mass: np.ndarray) -> Iterator[MassSets]:
        for batch in self.interpolation.batches:
            yield from point_sets(batch, mass[batch.rows], self.pattern.matrix)

    def assemble(self, tangent: bool, lift: np.ndarray | None = None) -> Assembled:
        internal = np.zeros_like(self.x)
        lifted = None if lift is None else np.zeros_like(self.x)
        matrix = self.pattern.matrix
        self.project_scalars(tangent=tangent)
        if tangent:
            native.fill(matrix, lift=lift)
            self._begin_tangent(lifted)
        for k, batch in enumerate(self.interpolation.batches):
            self._assemble(k, batch, matrix if tangent else None, internal, lifted)
        self.add_patches(matrix if tangent else None, internal, lifted)
        self._check_sides(internal)
        self._add_viscosity(tangent, internal, lifted)
        self.nodes.add_to_owners(internal)
        self.external = self.loads
        if len(self.terms):
            internal += self.term_forces()
        if tangent:
            self.pattern.mirror()
            self.terms.add_tangents(self.x, self.pattern.values)
        if lift is not None and lifted is not None:
            lifted += self.lifted_by_terms(lift)
            self.nodes.add_to_owners(lifted)
        if self.inertia is not None:
            self.add_inertia(self.inertia, tangent, lift, internal, lifted)
        if tangent:
            self._collect()
        return Assembled(internal - self._dead_forces(), lifted)

    def _collect(self) -> None:
        """Complete the rows of the matrix. Collective."""
        if self._folding is not None:
            self._folding.fold(self.pattern.values)
        self.pattern.collect()

    def _begin_tangent(self, lifted: np.ndarray | None) -> None:
        """Begin the tangent's sums with what the points' boxes add; where that is at hand from an earlier
        iteration, it is good enough. Nothing is kept from step to step: a restart couldn't repeat it."""
        values, boxes, step = self.pattern.values, self._boxes, self.step
        step.tangents += 1
        due = step.boxes is None or lifted is not None or step.tangents >= _RENEWED
        values[:] = 0.0 if boxes is None or due else step.boxes
        if boxes is None or not due:
            return
        whole = bool(np.any(self.x))  # right after a reset the sides have the moduli of the points
        for own, form, (_, kernel) in zip(boxes, self.interpolation.forms, self.kernels, strict=True):
            before = self.before if form.predicts else None
            own.add_moduli(kernel, self.pattern.matrix, self.x, before, lifted, whole=whole)
        step.boxes = values.copy()

    def _check_sides(self, internal: np.ndarray) -> None:
        """A correction may be too large for the sides of boxes before it is for the points: they have no
        energy where they are turned inside out.

        Raises:
            LocalFailure: some have none; on every rank.
        """
        if self._boxes is not None:
            lost = not np.all(np.isfinite(internal))
            if self.comm.allreduce(lost, op=MPI.LOR):
                raise LocalFailure("the box of a material point is turned inside out")

    def _assemble(
        self,
        k: int,
        batch: PointBatch,
        matrix: native.Matrix | None,
        internal: np.ndarray,
        lifted: np.ndarray | None,
    ) -> None:
        failed = native.library().polarmpm_assemble(
            ctypes.byref(batch.batch),
            ctypes.byref(self._point_kernels(k, matrix is not None)),
            ctypes.byref(matrix) if matrix is not None else None,
            self.x,
            internal,
            lifted,
        )
        if failed:
            raise MemoryError("no memory for the sums over material points")

    def assemble_moduli(self, blocks: Sequence[np.ndarray], shift: float) -> None:
        pattern, nothing = self.pattern, np.zeros_like(self.x)
        pattern.values[:] = 0.0
        native.fill(pattern.matrix, lift=None)
        for batch, given in zip(self.interpolation.batches, blocks, strict=True):
            arguments = batch.batch, self._given(given), pattern.matrix
            if native.library().polarmpm_assemble(
                *map(ctypes.byref, arguments), nothing, nothing.copy(), None
            ):
                raise MemoryError("no memory for the sums over material points")
        pattern.mirror()
        self._collect()
        if shift:
            share, ties = np.ones((self.nodes.owned, 1)), self.prescribed.ties
            if ties is not None:  # as of the whole body that planes of symmetry stand for
                share[:, 0] = ties.share[: self.nodes.owned]
            most = (self.diagonal() / share).max(axis=0, initial=0.0)
            self.comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
            pattern.values[pattern.diagonal] += shift * (share * most).ravel()

    @property
    def diagonal_shift(self) -> float:
        # there are motions of nodes that no point feels: rounding must not choose them
        return _UNFELT if self._few else 0.0

    def destroy(self) -> None:
        self._dispose()
        self.pattern.release()
        self.step.boxes = None
