"""Systems of the active nodes as sums over the points."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, partial

from mpi4py import MPI

import numpy as np

from ..conditions.prescribed import Prescribed
from ..errors import LocalFailure
from ..kernels import native
from ..kernels.kernel import Kernel
from ..solvers.choice import make_solver, solver_of
from ..solvers.linear import Tangent
from ..tools.disposal import dispose_with, weakly
from ..tools.parallel import errors_on_all_ranks
from ..tools.timing import Timer
from . import sparsity
from .folding import Folding
from .inertia import MassSets, point_sets
from .interpolation import Interpolation, PointBatch
from .latticerows import on_lattice
from .loadedpoints import LoadedPoints, Shift
from .onpattern import OnPattern
from .pointboxes import BoxTangent
from .stepstate import Assembled

_UNFELT = 1e-12  # of a tangent's diagonal, added to it where there are fewer points than nodes


class PointSystem(OnPattern, LoadedPoints):
    """Residual and tangent as sums over the points, scattered by compiled code."""

    on_lattice = True

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
                self.terms.crossing(),
            )
            self._hold_unreached()
            self._fixed = np.ascontiguousarray(prescribed.fixed, dtype=np.uint8)
            native.fill(self.pattern.matrix, fixed=self._fixed)
            pattern = self.pattern
            self.terms.bind(pattern.matrix, prescribed.fixed, crossing=pattern.crossing_column)
            self._folding: Folding | None = None
            if prescribed.ties is not None:
                with errors_on_all_ranks(self.comm):
                    self._folding = Folding(self.pattern, prescribed.ties)
            plastic = any(m is not None for m in self.mappings)
            shared = (self.pattern.values, self.pattern.diagonal) if self.pattern.shared else None
            matrix = cache(self.pattern.petsc_matrix)
            space = weakly(self.near_null_space)
            rows = self.pattern, self.nodes, matrix, weakly(self.weak_nodes), self.as_force
            lattice = partial(on_lattice, *rows)
            rows_here = pattern.rows(matrix) if shared else None
            tangent = Tangent(matrix, symmetric, space, plastic, large, shared, lattice, rows_here)
            self.solver = make_solver(solver, tangent)
            self._dispose = dispose_with(self, self.comm, self.solver.destroy)
        self._few = interpolation.points.total < self.nodes.total
        # flow and projection change the energy in boxes from step to step: no restart could repeat its sums
        projects = any(form.scalars for form in interpolation.forms)
        self._keeps_boxes = not plastic and not projects
        # nearly incompressible bodies take an iteration more with boxes of the one before
        self._fresh_boxes = projects and not plastic

    def _hold_unreached(self) -> None:
        """Nodes that nothing reaches any more, as those of a term that has been released in empty space, stay
        where they are until the next reset leaves them out."""
        reached = self.pattern.reached
        assert reached is not None
        if self.comm.size == 1:
            self.prescribed.fixed[~reached] = True
            return
        count = reached[:, None].astype(float)
        self.nodes.add_to_owners(count)
        self.nodes.update_ghosts(count)
        self.prescribed.fixed[count[:, 0] == 0.0] = True

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
        matrix = self.pattern.matrix if tangent else None
        self.project_scalars(tangent=tangent)
        if matrix is not None:
            native.fill(matrix, lift=lift)
            self._begin_tangent(lifted)
        for k, batch in enumerate(self.interpolation.batches):
            self._assemble(k, batch, matrix, internal, lifted)
        self.add_patches(matrix, internal, lifted)
        self._check_sides(internal)
        self._add_viscosity(tangent, internal, lifted)
        self.nodes.add_to_owners(internal)
        self.external = self.loads
        if len(self.terms):
            internal += self.term_forces()
        if tangent:
            self.pattern.mirror(whole=not self._in_place or self._folding is not None)
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
        """Begin the tangent's sums with what the points' boxes add, or have added before: that is good enough
        unless iterations have gone on for a while. Where it was summed is kept for a restart."""
        values, boxes, step = self.pattern.values, self._boxes, self.step
        step.tangents += 1
        if boxes is None:
            values[:] = 0.0
            return
        of_boxes = self.box_tangent if step.tangents == 1 else step.boxes
        if of_boxes is None or self._renews(step.tangents):
            of_boxes = BoxTangent(self.x, self.before)
            if self.box_tangent is not None:  # no more than one of them needs memory
                self.box_tangent.values = None
        step.boxes, known = of_boxes, of_boxes.values is not None
        if step.tangents == 1:
            step.began_with = of_boxes
        values[:] = of_boxes.values if known else 0.0
        if known and lifted is None:
            return
        for own, form, (_, kernel) in zip(boxes, self.interpolation.forms, self.kernels, strict=True):
            before = of_boxes.before if form.predicts else None
            own.add_moduli(kernel, self.pattern.matrix, of_boxes.x, before, lifted, lift_only=known)
        if not known:
            of_boxes.values = values.copy()

    def keep_boxes(self, first: bool) -> None:
        # what boxes add to a state without increments lacks much of what they add later, and where a step
        # took more iterations than the first one with it, it has grown old
        step, kept = self.step, self.step.boxes
        if not self._keeps_boxes or kept is None:
            return
        if step.began_with is kept:
            old = first or 0 < kept.solutions < step.solutions
            kept = None if old else replace(kept, solutions=kept.solutions or step.solutions)
        self.box_tangent = kept

    def _renews(self, tangents: int) -> bool:
        """Whether such a tangent of a step has the boxes' part summed anew."""
        return tangents > 2 or self._fresh_boxes or (tangents == 1 and not self._keeps_boxes)

    def waits(self) -> bool:
        return self._boxes is not None and self._keeps_boxes and self._renews(self.step.tangents + 1)

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
        self.moduli_shift = Shift()
        if shift:
            share, ties = np.ones((self.nodes.owned, 1)), self.prescribed.ties
            if ties is not None:  # as of the whole body that planes of symmetry stand for
                share[:, 0] = ties.share[: self.nodes.owned]
            self.unshifted = self.diagonal() / share
            most = self.unshifted.max(axis=0, initial=0.0)
            self.comm.Allreduce(MPI.IN_PLACE, most, op=MPI.MAX)
            pattern.values[pattern.diagonal] += shift * (share * most).ravel()
            self.moduli_shift = Shift(shift, share, most)

    @property
    def diagonal_shift(self) -> float:
        # there are motions of nodes that no point feels: rounding must not choose them
        return _UNFELT if self._few else 0.0

    def destroy(self) -> None:
        self._dispose()
        self.pattern.release()
        self.step.boxes = None
        if (
            self.box_tangent is not None
        ):  # where it was summed stays: after an interrupt it is summed again there
            self.box_tangent.values = None
