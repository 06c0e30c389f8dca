"""Points on the grid between two resets: weighting functions, node sets, packed state.

Nodal increments and weighting functions are those since the last reset: the lattice moves with its nodes
until it is reset (T 2.3.3). Everything here is rebuilt at a reset and read-only after it, but for the packed
state when rotations get a new base.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, cast

from mpi4py import MPI

import numpy as np

from ..basis.base import Basis, Weights
from ..bodies.points import Points
from ..bodies.reference import Increments, Reference
from ..errors import InputError
from ..forms.points import PointForm
from ..forms.projected import ProjectedForm
from ..geometry.grid import MARGIN, Grid
from ..geometry.nodes import ActiveNodes
from ..kernels import native
from ..kinematics.layout import Layout
from ..kinematics.motion import Motion
from ..materials.base import parameter_values
from ..terms.base import Boxes, BoxPairs, Piece, Term, pieces_of
from ..terms.settings import GridSetting
from ..tools.checks import shown
from ..tools.parallel import errors_on_all_ranks, reduced
from .bodyweights import patches_of_bodies, weights_of_bodies
from .nodesets import Groups, group_points, node_sets_of, ownership_priorities, reached_cells
from .patches import Patches
from .pointboxes import PointBoxes, has_boxes
from .smoothing import means

if TYPE_CHECKING:
    from ..forms.plastic import PlasticForm


@dataclass
class PointBatch:
    """Points of one material in the order of their node sets."""

    form: PointForm
    rows: np.ndarray
    batch: native.Batch
    _inputs: np.ndarray | None = None
    _of: tuple[np.ndarray, ...] = ()  # state and parameters in them
    volume_before: tuple[tuple[np.ndarray, ...], np.ndarray] | None = None  # of what, see Interpolation

    def inputs_with(self, z: np.ndarray) -> np.ndarray:
        """Inputs (n, form.inputs) of the residual's kernel at z (n, nz), in an array that the next call
        overwrites."""
        kept, nz, ns = self.batch.kept, z.shape[1], self.form.packed_size
        state, param = kept["state"], kept["param"]
        if self._inputs is None or self._of[0] is not state or self._of[1] is not param:
            self._inputs, self._of = np.empty((len(self.rows), self.form.inputs)), (state, param)
            self._inputs[:, nz : nz + ns], self._inputs[:, nz + ns :] = state, param
        self._inputs[:, :nz] = z
        return self._inputs

    @property
    def grown(self) -> np.ndarray | None:
        """Different second gradients H~ (n, d, m) of the state; None without."""
        layout = self.form.layout
        at = layout.state(rotated=False).at_second
        if not layout.second:
            return None
        second: np.ndarray = self.batch.kept["state"][:, at].reshape(
            len(self.rows), layout.dim, layout.dim * (layout.dim + 1) // 2
        )
        return second


class Interpolation:
    """Weighting functions of all points, their node sets and the active nodes. Collective.

    Args:
        forms: point form of each of the points' materials.
        reference: state at the last reset; default: the points' current state, which makes it a reset.
        terms: contributions to the nodal system besides the points' stresses.
        boxes: the points integrate over their own boxes.
        most_growth: by what domains may have grown; points that fly apart don't spread without end.
        carries: resets carry along how the deformation varies within the boxes.

    Attributes:
        pieces: what the terms have made of this reset.
        boxes: of each batch; None: points stand for themselves alone.
        patches: of each batch; None: of forms that project nothing.
    """

    def __init__(
        self,
        grid: Grid,
        points: Points,
        basis: Basis,
        forms: Sequence[PointForm],
        reference: Reference | None = None,
        terms: Sequence[Term] = (),
        boxes: bool = False,
        most_growth: float = np.inf,
        carries: bool = False,
    ):
        self.grid, self.points, self.basis, self.forms = grid, points, basis, forms
        self.layout: Layout = forms[0].layout.with_second(False)
        self.reference = r = reference or Reference.of(points, self.layout.block, sides=carries)
        half = basis.domains(r.F, points.half_length0) if basis.uses_domains else None
        half = half if half is None else np.minimum(half, most_growth * points.half_length0)
        second = any(form.layout.second for form in forms)
        filled = boxes and has_boxes(points)
        w, cells = weights_of_bodies(grid, basis, points, r.x, half, 3 if filled or second else 2)
        order, groups = group_points(points.material, w)
        reached = partial(reached_cells, grid, groups, basis)
        setting = GridSetting(grid, basis, self.layout, points, w, reached, r.x)
        self.pieces: list[Piece] = []
        for term in terms:
            for piece in pieces_of(term, setting):
                piece.fresh = not term.committed
                self.pieces.append(piece)
        with errors_on_all_ranks(grid.comm):
            of_pieces = [b for piece in self.pieces for b in _boxes_of(piece, grid, points.bodies)]
        more = [b.numbers(grid).ravel() for b in of_pieces]
        touched, node_sets, node_offsets = node_sets_of(grid, groups, more)
        priorities = ownership_priorities(grid, groups, touched) if grid.comm.size > 1 else None
        self.nodes = ActiveNodes.build(grid, touched, partial(basis.positions, grid), priorities)
        if grid.comm.size > 1:
            node_sets = self.nodes.local(touched)[node_sets]
        node_sets = node_sets.astype(np.int32)
        self.batches = [
            self._batch(form, m, w, order, groups, (node_sets, node_offsets)) for m, form in enumerate(forms)
        ]
        self.patches = self._patches(cells)
        sides = [int(groups.count.max(initial=2)), *(max(b.count) for b in of_pieces)]
        sides += [p.reach + 1 for p in self.patches if p is not None]
        self.reach = int(reduced(grid.comm, max(sides) - 1, MPI.MAX))
        self.boxes: list[PointBoxes] | None = None
        if filled:
            self.boxes = [PointBoxes(b.batch, b.form.layout, points, b.rows, r) for b in self.batches]
        # forgotten: of rings, of points whose stiff scalars are projected, and where turns about several axes
        # vary, as increments from a base that varies don't add up
        single = not self.layout.axial and self.layout.rotations < 3
        self.carries = carries and filled and single and not all(form.scalars for form in forms)
        self.pack()

    def _batch(
        self,
        form: PointForm,
        material: int,
        w: Weights,
        order: np.ndarray,
        groups: Groups,
        node_sets: tuple[np.ndarray, np.ndarray],
    ) -> PointBatch:
        # groups are sorted by material first
        begin, end = np.searchsorted(groups.material, [material, material + 1])
        offsets = groups.offsets[begin : end + 1]
        nodes, node_offsets = node_sets[0], node_sets[1][begin : end + 1]
        rows = order[offsets[0] : offsets[-1]]
        batch = native.Batch()
        native.fill(
            batch,
            dim=self.layout.dim,
            rot=self.layout.rotations,
            second=form.layout.kind,
            slots=w.table.shape[-1],
            orders=w.table.shape[-2],
            nstate=form.packed_size,
            nparam=len(parameter_values(form.material)),
            npoints=len(rows),
            ngroups=end - begin,
            weights=np.ascontiguousarray(w.table[rows]),
            count=np.ascontiguousarray(groups.count[begin:end], dtype=np.int32),
            volume=np.ascontiguousarray(self.points.volume0[rows]),
            offsets=(offsets - offsets[0]).astype(np.int64),
            node_offsets=node_offsets - node_offsets[0],
            nodes=np.ascontiguousarray(nodes[node_offsets[0] : node_offsets[-1]]),
        )
        return PointBatch(form, rows, batch)

    def _patches(self, cells: np.ndarray | None) -> list[Patches | None]:
        """Patches of the batches whose forms project something. Collective."""
        out: list[Patches | None] = [None] * len(self.batches)
        if not any(form.scalars for form in self.forms):
            return out
        index, places = patches_of_bodies(self.grid, self.basis, self.points, self.reference.x, cells)
        for k, b in enumerate(self.batches):
            if b.form.scalars:
                out[k] = Patches(
                    b.batch,
                    self.grid,
                    self.nodes,
                    index[b.rows],
                    places[b.rows],
                    linear=self.basis.patch_linear,
                    scalars=b.form.scalars,
                )
        return out

    # state --------------------------------------------------------------------------------------
    def pack(self) -> None:
        """Write the reference state into the kernels' input, see `forms.points`."""
        r, p = self.reference, self.points
        for b in self.batches:
            second = r.grad_F[b.rows] if b.form.layout.second else None
            plastic = p.plastic_state(b.rows)
            radii = np.stack([p.X[b.rows, 0], r.x[b.rows, 0]], axis=1)
            state = b.form.pack(r.F[b.rows], r.q[b.rows], r.wryness[b.rows], plastic, second, radii)
            if isinstance(b.form, ProjectedForm):
                base = b.form.in_frame(r.stiff_scalars[b.rows], r.q[b.rows])
                state = b.form.extend(state, base)
            native.fill(b.batch, state=np.ascontiguousarray(state), param=parameter_values(b.form.material))
        for boxes in self.boxes or ():
            boxes.pack(r)

    def pack_flow(self) -> None:
        """The same where only the plastic state of the points has changed since."""
        if any(b.form.scalars for b in self.batches):  # projected ones begin anew
            self.pack()
            return
        for b in self.batches:
            if b.form.material.plastic:  # whose module elastic bodies don't import
                form = cast("PlasticForm", b.form)
                state, plastic = b.batch.kept["state"].copy(), self.points.plastic_state(b.rows)
                state[:, form.elastic_size :] = form.pack_flow(self.reference.q[b.rows], plastic)
                native.fill(b.batch, state=state)
        for boxes in self.boxes or ():
            boxes.pack_shares()

    def put_sides(self, x: np.ndarray, change: np.ndarray | None = None) -> None:
        """Put into the points how their deformation varies within their boxes, at nodal increments x (nodes,
        block); of those without boxes, or that have flowed, it begins anew. Collective.

        Args:
            change: of the increments (nodes, block). What it has changed of the variation unlike its means at
                the nodes is taken out, but not what it has turned along with the points.
        """
        points, d, before = self.points, self.layout.dim, None
        if change is not None:
            self._put_sides(x - change)
            now, then = (np.eye(d) + self.gather(at).gradient for at in (x, x - change))
            turn = now @ np.linalg.inv(then)
            before = {"side_F": turn[:, None] @ points.side_F, "side_gradients": points.side_gradients}
        there = self._put_sides(x)
        for name, earlier in ({} if before is None else before).items():
            now = getattr(points, name)
            setattr(points, name, now - self._rough(now - earlier, there))

    def _put_sides(self, x: np.ndarray) -> np.ndarray:
        """Put into the points how their deformation varies; of which of them it lasts, (np,)."""
        self.points.begin_sides()
        there = np.zeros(len(self.points), dtype=bool)
        for boxes, batch in zip(self.boxes or (), self.batches, strict=False):
            if not batch.form.scalars:
                there[boxes.put_sides(self.reference, x)] = True
        return there

    def _rough(self, sides: np.ndarray, there: np.ndarray) -> np.ndarray:
        """What derivatives along half axes (np, d, ...) differ by from their means at the nodes, of the
        points that are `there`. Collective."""
        axes, volume = self.points.half_axes0, np.where(there, self.points.volume0, 0.0)
        n, d, size = len(sides), sides.shape[1], math.prod(sides.shape[2:])  # there may be no points here
        rows = np.linalg.pinv(axes) @ sides.reshape(n, d, size)
        mean = means(self, volume, rows.reshape(n, d * size)).reshape(rows.shape)
        found: np.ndarray = np.where(there[:, None, None], axes @ (rows - mean), 0.0)
        return found.reshape(sides.shape)

    def rebase_rotations(self, x: np.ndarray) -> None:
        """Count rotation increments from the points' current rotations on, at nodal increments x (nodes,
        block); weights and F stay."""
        if self.boxes is not None:
            self.reference.side_gradients = self.reference.side_gradients.copy()
        for boxes in self.boxes or ():
            boxes.rebase_rotations(self.reference, x)
        self.reference.rebase_rotations(self.points)
        self.pack()

    def kernel_inputs(self, batch: PointBatch, x: np.ndarray) -> np.ndarray:
        """Inputs (n, form.inputs) of the residual's kernel at nodal increments x (nodes, block)."""
        form, b = batch.form, batch.batch
        nz, ns = form.layout.unknowns, form.packed_size
        out, z = np.empty((len(batch.rows), form.inputs)), self.unknowns(batch, x)
        out[:, :nz], out[:, nz : nz + ns], out[:, nz + ns :] = z, b.kept["state"], b.kept["param"]
        return out

    def unknowns(self, batch: PointBatch, x: np.ndarray) -> np.ndarray:
        """z (n, nz) of a batch's points in the frame of its kernels, at nodal increments x (nodes, block)."""
        z = np.empty((len(batch.rows), batch.form.layout.unknowns))
        _gather(batch.batch, x, 1, z, None)
        return z

    # between nodes and points ---------------------------------------------------------------------
    def volume_before(self, batch: PointBatch) -> np.ndarray:
        """The first stiff scalar's projected value (n,) at the last converged step, that of a volume."""
        rows, r, F = batch.rows, self.reference, self.points.F
        of = F, r.F, r.stiff_scalars  # arrays of the state are replaced, never written to
        known = batch.volume_before
        if known is None or any(a is not b for a, b in zip(known[0], of, strict=True)):
            gain = np.linalg.det(F[rows]) / np.linalg.det(r.F[rows])
            known = batch.volume_before = of, np.log(gain) + r.stiff_scalars[rows, 0]
        return known[1]

    def gather(self, x: np.ndarray) -> Increments:
        """Increments at this rank's points from nodal values (nodes, block)."""
        layout, n, second = self.layout, len(self.points), None
        z, value = np.zeros((n, layout.unknowns)), np.zeros((n, layout.block))
        if any(b.form.layout.second for b in self.batches):
            second = np.zeros((n, *[layout.dim] * 3))
        for b in self.batches:
            own = b.form.layout
            zb, vb = np.empty((len(b.rows), own.unknowns)), np.empty((len(b.rows), value.shape[1]))
            _gather(b.batch, x, 0, zb, vb)
            z[b.rows], value[b.rows] = zb[:, : z.shape[1]], vb
            if second is not None and own.second:
                second[b.rows] = own.symmetric(own.part(zb, "displacement", 2))
        return Increments(value, layout.part(z, "displacement", 1), layout.part(z, "rotation", 1), second)

    def spread(self, point_values: np.ndarray) -> np.ndarray:
        """Sums of point values (np, c) with the weighting functions, complete on owned rows. Collective."""
        c = point_values.shape[1]
        out = np.zeros((len(self.nodes), c))
        for b in self.batches:
            f = np.ascontiguousarray(point_values[b.rows])
            native.library().polarmpm_spread(ctypes.byref(b.batch), f, c, out)
        self.nodes.add_to_owners(out)
        return out

    def update_points(self, inc: Increments, motion: Motion) -> None:
        """Set the points' current state from their increments since the reset."""
        self.points.x = self.reference.x + inc.value[:, : self.layout.dim]
        motion.move(self.points, self.reference, inc)


def _boxes_of(piece: Piece, grid: Grid, bodies: int) -> tuple[Boxes, ...]:
    parts = piece.boxes.parts if isinstance(piece.boxes, BoxPairs) else (piece.boxes,)
    last = int(grid.node_number(np.array(grid.shape) + MARGIN)) + (bodies - 1) * grid.numbers
    boxes = []
    for part in parts:
        if not isinstance(part, Boxes) or len(part.count) != grid.dim:
            raise InputError(
                f"{piece.name}: acts on {shown(part)}; on a grid boxes of {grid.dim}-dimensional lattice "
                "nodes are needed"
            )
        numbers = part.numbers(grid)
        if numbers.size and not 0 <= numbers.min() <= numbers.max() <= last:
            raise InputError(f"{piece.name}: acts on nodes that the lattice doesn't have")
        boxes.append(part)
    return tuple(boxes)


def _gather(batch: native.Batch, x: np.ndarray, framed: int, z: np.ndarray, value: np.ndarray | None) -> None:
    if native.library().polarmpm_gather(ctypes.byref(batch), x, framed, z, value):
        raise MemoryError("no memory to interpolate nodal values")
