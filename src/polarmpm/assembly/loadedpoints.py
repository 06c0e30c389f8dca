"""What all systems of material points have in common: their loads, their yielding points, their boxes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from ..bodies.reference import Increments
from ..conditions.prescribed import Prescribed
from ..geometry.nodes import ActiveNodes
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..tools.timing import Timer
from .initialstress import InitialStress
from .interpolation import Interpolation, PointBatch
from .pointboxes import BoxTangent
from .projectedpoints import ProjectedPoints

if TYPE_CHECKING:
    from ..forms.returnmapping import ReturnMapping


_ACCURACY = 1e-6  # of motions of which initial stresses are made
_WEAK = 0.2  # share of a cell: nodes beyond edges of the body, and beyond faces that hardly enter a cell


@dataclass(frozen=True)
class Shift:
    """What `LoadedPoints.assemble_moduli` adds to the diagonal: factor * share * most.

    Attributes:
        share: of the whole body that a node stands for, (owned nodes, 1).
        most: largest entry of the diagonal over this share, (block,).
    """

    factor: float = 0.0
    share: np.ndarray | None = None
    most: np.ndarray | None = None


class LoadedPoints(ProjectedPoints):
    """Kernels and loads of the points. How their virtual work is summed is left to subclasses.

    Attributes:
        initial: initial stresses of the points; None: there are none.
        carried_by: motions (nodes, block) of which the initial stresses of the last balanced reset are made,
            see `carrying`.
        unresisted: share of the work of the first of them that the material doesn't do, but a small shift
            of its moduli: where it is large, that shift alone says how far points move, and how stresses are
            carried is ill-determined.
        moduli_shift: of the last `assemble_moduli`.
        box_tangent: of the last step, which serves in the next one; None: it is summed anew.
    """

    nodes: ActiveNodes
    initial: InitialStress | None = None
    box_tangent: BoxTangent | None = None
    carried_by: Sequence[np.ndarray] = ()
    unresisted = 0.0
    moduli_shift = Shift()

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
        nodes, sizes = interpolation.nodes, None
        if not grid.equal:
            sizes = grid.sizes_around(nodes.position)
        super().__init__(nodes, layout, prescribed, length, grid.comm, timer, pieces, sizes)
        self.kernels, self.couple_kernel = kernels, couple_kernel
        self.interpolation, self._boxes = interpolation, interpolation.boxes
        self.mappings = [self._mapping(b) for b in interpolation.batches]
        self.project_in(interpolation)
        self._at_points: tuple[np.ndarray, np.ndarray] | None = None  # forces and couples
        self._gathered: tuple[np.ndarray, Increments] | None = None  # increments of nodes, and at points
        self._couples: list[tuple[np.ndarray, np.ndarray]] = [
            (np.full(len(b.rows), -1, dtype=np.int32), np.zeros((1, 3))) for b in interpolation.batches
        ]

    def _mapping(self, batch: PointBatch) -> ReturnMapping | None:
        if not batch.form.material.yields:
            return None
        from ..forms.returnmapping import ReturnMapping  # lazy import: elastic scenes need no plasticity

        return ReturnMapping(batch.form, self.comm, self.interpolation.points.id[batch.rows])

    @property
    def plastic(self) -> bool:
        return any(m is not None for m in self.mappings)

    def start_elastic(self, on: bool) -> bool:
        for mapping in self.mappings:
            if mapping is not None:
                mapping.start_elastic = on
        return self.plastic

    def dissipate(self, share: float) -> None:
        for mapping in self.mappings:
            if mapping is not None:
                mapping.dissipate(share)

    def changing(self) -> Iterator[tuple[Any, tuple[str, ...] | None]]:
        yield from super().changing()
        yield self, ("initial", "_boxes", "_at_points", "_couples", "box_tangent")
        yield self.interpolation, ("reference", "pieces")
        yield self.interpolation.reference, None

    def put_back(self) -> None:
        self.interpolation.pack()
        self.place()
        if self.initial is not None:
            self.initial.pack()

    def keep_boxes(self, first: bool) -> None:
        """A step has converged, maybe the first one since a reset: keep what serves the next one of its
        tangent. Local."""

    def leave_out_boxes(self, on: bool) -> bool:
        self._boxes, self.box_tangent = None if on else self.interpolation.boxes, None
        return self.interpolation.boxes is not None

    def flow_in_boxes(self, on: bool) -> bool:
        if self._boxes is None or not self.plastic:
            return False
        most = False
        for boxes, mapping in zip(self._boxes, self.mappings, strict=True):
            if mapping is not None and on and mapping.yielding is not None:
                most |= boxes.flow(mapping.yielding.rows)
            elif mapping is not None:
                boxes.pack_shares()
        felt: bool = self.comm.allreduce(most, op=MPI.LOR)
        if on and not felt:
            self.flow_in_boxes(False)
        return felt

    @property
    def symmetric(self) -> bool:
        """Whether the tangent is symmetric."""
        elastic = not any(b.form.material.yields for b in self.interpolation.batches)
        return elastic and self.couple_kernel is None and self.terms.symmetric

    def weak_nodes(self) -> np.ndarray:
        i, own = self.interpolation, self.nodes.owned
        size = np.prod(self.sizes, axis=-1)
        if not i.grid.equal:
            size = np.prod(i.basis.extents(i.grid, self.nodes.lattice[:own]), axis=1)
        weak: np.ndarray = self.node_volumes()[:own] < _WEAK * size
        return weak

    def is_large(self) -> bool:
        grid, own = self.nodes.grid, self.nodes.owned
        if grid.equal:
            return super().is_large()
        index = grid.node_index(self.nodes.lattice[:own])  # lines count, however far they are apart
        far = np.iinfo(np.int64).max
        ends = np.stack([index.max(axis=0, initial=-far), -index.min(axis=0, initial=far)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return self._is_large(float(ends.sum(axis=0).max()))

    def node_volumes(self) -> np.ndarray:
        return self.interpolation.spread(self.interpolation.points.volume0[:, None])[:, 0]

    def at_points(self, x: np.ndarray) -> np.ndarray:
        if x is self.x:
            return self.gathered().value
        return self.interpolation.gather(np.ascontiguousarray(x)).value

    def gathered(self) -> Increments:
        """The present increments at the points, which several ask for."""
        if self._gathered is None or self._gathered[0] is not self.x:
            self._gathered = self.x, self.interpolation.gather(self.x)
        return self._gathered[1]

    def from_points(self, values: np.ndarray) -> np.ndarray:
        return self.interpolation.spread(values)

    def point_volumes(self) -> np.ndarray:
        return self.interpolation.points.volume0

    @property
    def point_forces(self) -> np.ndarray:
        """Forces (np, d) at the points, as they were put in last."""
        if self._at_points is None:
            return np.zeros((len(self.interpolation.points), self.layout.dim))
        return self._at_points[0]

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
            if not self.interpolation.forms[k].scalars:  # projected ones are other ones at the end of a step
                self._boxes[k].store(kernels, self.x, first=self.step.initial is None)
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

    def carrying_motion(self, left: np.ndarray, k: int, moduli: Sequence[Any]) -> np.ndarray:
        """The motion w (nodes, block) of K w = -left, K as of the last `assemble_moduli`. Collective.

        Args:
            left: forces (nodes, block), complete on owned rows.
            moduli: of each batch, `carrying.Moduli`.
            k: number of the motion; for the first one K has no factor yet.
        """
        return self.solve_alone(-left, k == 0, _ACCURACY)

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
            z = self.interpolation.unknowns(batch, self.x)
            y = mapping.evaluate(batch.inputs_with(z), tangent)
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
        self.box_tangent = None
