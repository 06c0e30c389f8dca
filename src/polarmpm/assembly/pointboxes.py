"""The points' boxes: the strain energy varies over them, and the points see it (docs/theory.md).

A point stands for a box with half axes d_k, which the deformation at the last reset has stretched and turned.
With z the unknowns at the point and z_k their derivatives along d_k, the energy of the box is that of the
rule of degree 3 with its centre and the centres of its faces,

    W(z) + share / 6 sum_k [W(z + z_k) + W(z - z_k) - 2 W(z)].

In a body of revolution the sides count more outside, and are at other radii (docs/theory.md). The sums over
points hold the first term; what the others add is here. Plastic points take their elastic
energy at frozen flow, with a small share once they have flowed: the energy of points that flow on hardly
grows.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ..bodies.points import Points
from ..bodies.reference import Reference
from ..kernels import native, structures
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout

_BENT, _LANES = structures.constant("_boxes.h", "BENT"), structures.constant("_points.h", "LANES")
_STORED_MOST = 2**27  # bytes that a batch may store of a state for `PointBoxes.work`, twice
_INSIDE = 1.0 - 1e-5  # how far a box reaches to the axis of a body of revolution, over its radius; rounding
# on a side is divided by what is left
FLOWED = 0.003  # share of points that have flowed: what keeps cells from deforming for nothing


def has_boxes(points: Points) -> bool:
    """Whether some point stands for more than itself. Collective."""
    return bool(points.comm.allreduce(int(np.any(points.half_axes0))))


@dataclass
class BoxTangent:
    """What the points' boxes add to a tangent, and where that has been summed.

    Attributes:
        x: increments (nodes, block) at which it was.
        before: those before the correction that led there.
        solutions: linear ones of the first step that has begun with it; 0: none has yet.
        values: of the matrix; None: to be summed.
    """

    x: np.ndarray
    before: np.ndarray
    solutions: int = 0
    values: np.ndarray | None = None


class PointBoxes:
    """The boxes of a batch between two resets.

    Args:
        rows: the batch's points, in their order.
        reference: state at the last reset.
    """

    def __init__(
        self, batch: native.Batch, layout: Layout, points: Points, rows: np.ndarray, reference: Reference
    ):
        self.batch, self.layout, self.points, self.rows = batch, layout, points, rows
        d = layout.dim
        F, self._half_axes0 = reference.F[rows, :d, :d], points.half_axes0[rows]
        axes = np.einsum("pij,pkj->pki", F, self._half_axes0)
        hoop: np.ndarray | None = None
        if layout.axial:  # a box that has been sheared may come to reach over the axis
            hoop = axes[:, :, 0] / reference.x[rows, :1]
            shorter = _INSIDE / np.maximum(np.abs(hoop), _INSIDE)
            axes, hoop = axes * shorter[:, :, None], np.ascontiguousarray(hoop * shorter)
        self._axes, self._hoop = np.ascontiguousarray(axes), hoop
        self._arrays: dict[str, np.ndarray | None] = {"box_axes": self._axes, "box_hoop": hoop}
        self._stored: dict[bool, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._stored_size: int | None = None
        self._frames: np.ndarray | None = None  # how those of the state vary along the half axes

    @property
    def share(self) -> np.ndarray:
        """What counts of the boxes' energy at each point (n,)."""
        share = self._arrays["box_share"]
        assert share is not None
        return share

    def put_shares(self, share: np.ndarray) -> None:
        """Put in what counts of the boxes' energy at each point (n,), until the state is packed anew."""
        self._arrays["box_share"] = share

    def flow(self, rows: np.ndarray) -> bool:
        """Let points (of the batch) count as ones that have flowed until the state is packed anew; whether
        they are most of those that now do, by volume."""
        volume: np.ndarray = self.batch.kept["volume"]
        new = rows[self.share[rows] > FLOWED]
        share = self.share.copy()
        share[new] = FLOWED
        self._arrays["box_share"] = share
        return bool(2.0 * volume[new].sum() > volume[share <= FLOWED].sum())

    def pack(self, reference: Reference) -> None:
        """Take in the state of the points, after the batch has: which of them have flowed, and the base of
        the rotations.

        Nodal rotations count from their base on. Of those before it the points know the derivative along
        their half axes from what their wryness has grown by since the reset, that of their gradients from
        `rebase_rotations`.
        """
        r, d, rows = self.layout.rotations, self.layout.dim, self.rows
        turns, lean = None, None
        if r or self.layout.axial:  # there are values in z
            lean = np.linalg.solve(self.batch.frames, np.swapaxes(self._axes, 1, 2))
            lean = np.ascontiguousarray(np.swapaxes(lean, 1, 2))
        if r:
            turns = np.zeros((len(rows), d, r * (1 + d)))
            grown = (reference.wryness - reference.side_wryness)[rows]
            along = np.einsum("pij,pkj->pki", grown[:, :, :d], self._half_axes0)
            turns[:, :, :r] = (along @ np.swapaxes(rotations.to_tensor(reference.q[rows]), 1, 2))[
                :, :, 3 - r :
            ]
            framed = reference.side_gradients[rows] @ self._to_frame(reference)[:, None]
            turns[:, :, r:] = framed.reshape(len(rows), d, r * d)
            if not turns.any():
                turns = None
        frames, tilt = None, None
        if np.any(reference.side_F[rows]):
            frames = np.ascontiguousarray(reference.side_F[rows] @ self._to_frame(reference)[:, None])
            tilt = np.ascontiguousarray(np.linalg.inv(self.batch.frames)[:, None] @ frames)
        self._frames = frames
        self._arrays |= {"box_turns": turns, "box_lean": lean, "box_frame": frames, "box_tilt": tilt}
        self.pack_shares()

    def pack_shares(self) -> None:
        """Take in which of the points have flowed."""
        share = np.ones(len(self.rows))
        if self.points.plastic:
            share[self.points.hardening[self.rows] > 0.0] = FLOWED
        self._arrays["box_share"] = share

    def _to_frame(self, reference: Reference) -> np.ndarray:
        """F~^-1 T (n, d, d): from gradients in the unloaded body to those in the frame of the state."""
        d = self.layout.dim
        there: np.ndarray = np.linalg.solve(reference.F[self.rows, :d, :d], self.batch.frames)
        return there

    def rebase_rotations(self, reference: Reference, x: np.ndarray) -> None:
        """Put into the reference state how the wryness at the sides has come to differ from that at the
        points; before the rotations get a new base, at nodal increments x (nodes, block)."""
        reference.side_gradients[self.rows] = self._side_gradients(reference, *self.gather(x))

    def _side_gradients(
        self, reference: Reference, z: np.ndarray, zk: np.ndarray, both: np.ndarray | None
    ) -> np.ndarray:
        """The odd part (n, d, r, d) of the wryness at the sides, times the points' present rotation; z, zk,
        both: from `gather`."""
        layout, d, r, n = self.layout, self.layout.dim, self.layout.rotations, len(self.rows)
        back = np.linalg.inv(self._to_frame(reference))
        turn_back = np.swapaxes(rotations.to_tensor(reference.q[self.rows]), 1, 2)
        turn = rotations.to_tensor(self.points.q[self.rows])

        def wryness(at: np.ndarray) -> np.ndarray:
            """What z (n, unknowns) adds to it, (n, 3, d)."""
            w, gradient = np.zeros((n, 3)), np.zeros((n, 3, d))
            w[:, 3 - r :] = layout.part(at, "rotation")
            gradient[:, 3 - r :] = layout.part(at, "rotation", 1) @ back
            added: np.ndarray = turn_back @ rotations.right_tangent(w) @ gradient
            return added

        out = np.empty((n, d, r, d))
        for k in range(d):
            up, down = (self.side(k, sign, z, zk, both)[0] for sign in (1.0, -1.0))
            odd = 0.5 * (wryness(up) - wryness(down))
            out[:, k] = (turn @ odd)[:, 3 - r :]
        return out

    def put_sides(self, reference: Reference, x: np.ndarray) -> np.ndarray:
        """Put into the points how their deformation varies within their boxes at nodal increments x (nodes,
        block), and return their rows; those that have flowed begin anew."""
        p, d, r = self.points, self.layout.dim, self.layout.rotations
        lasts = self.share > FLOWED
        rows = self.rows[lasts]
        if not len(rows):
            return rows
        z, zk, both = self.gather(x)
        grown: np.ndarray = zk[:, :, : d * d].reshape(-1, d, d, d)
        if self._frames is not None:
            grown = grown + self._frames
        grown = grown @ np.linalg.inv(self._to_frame(reference))[:, None]
        p.side_F[rows], p.side_wryness[rows] = grown[lasts], reference.side_wryness[rows]
        if r:
            odd = self._side_gradients(reference, z, zk, both)
            p.side_gradients[rows, :, 3 - r :] = odd[lasts]
        return rows

    def put(self, kernels: native.PointKernels, kernel: Kernel | None) -> None:
        """Put the boxes into the kernels of the batch; without a kernel of the elastic residual there are z_k
        only."""
        address = None if kernel is None else kernel.address
        native.fill(kernels, box_kernel=address, **self._arrays)

    def add_moduli(
        self,
        kernel: Kernel,
        matrix: native.Matrix,
        x: np.ndarray,
        before: np.ndarray | None,
        lifted: np.ndarray | None,
        *,
        lift_only: bool = False,
    ) -> None:
        """Add the boxes' tangent at nodal increments x (nodes, block) to a matrix.

        Args:
            kernel: residual and tangent of the points' elastic energy, see `PointForm.compile`.
            before: x before the last correction, where the kernel predicts stresses.
            lifted: takes what prescribed increments add through the tangent.
            lift_only: the matrix has it already: only what prescribed increments add is meant.
        """
        # right after a reset the sides have the moduli of the points, but of rings at other radii, and where
        # they have brought along strains of their own
        whole = bool(np.any(x)) or self.layout.axial or self._frames is not None
        kernels = native.PointKernels()
        native.fill(kernels, kernel=kernel.address, before=before)
        self.put(kernels, None)
        add = native.library().polarmpm_assemble_boxes
        structures = map(ctypes.byref, (self.batch, kernels, matrix))
        if add(*structures, int(whole), int(lift_only), x, lifted):
            raise MemoryError("no memory for the sums over the points' boxes")

    def gather(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """z (n, unknowns), gradients in the frame of the state, z_k (n, d, unknowns) at nodal increments, and
        what is the same on both sides of half axis k, (n, d, unknowns), of a body of revolution."""
        n, d, nz = len(self.rows), self.layout.dim, self.layout.unknowns
        z, zk = np.empty((n, nz)), np.empty((n, d, nz))
        bent = np.zeros((n, d, _BENT)) if self.layout.axial else None
        kernels = native.PointKernels()
        self.put(kernels, None)
        gather = native.library().polarmpm_gather_boxes
        if gather(ctypes.byref(self.batch), ctypes.byref(kernels), x, z, zk, bent):
            raise MemoryError("no memory for the points' boxes")
        if bent is None:
            return z, zk, None
        both = np.zeros_like(zk)
        both[:, :, self.value_slots] = bent[:, :, : len(self.value_slots)]
        return z, zk, both

    @property
    def value_slots(self) -> list[int]:
        """Slots of values in z, in the order of the compiled loops."""
        fields = ("radial", "rotation")[: 1 + self.layout.rotations]
        return [self.layout.where(field).start for field in fields]

    def side(
        self, k: int, sign: float, z: np.ndarray, zk: np.ndarray, both: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """z and states (n, ...) on a side of half axis k, of what `gather` gives; what the side counts."""
        state: np.ndarray = self.batch.kept["state"]
        there: np.ndarray = z + sign * zk[:, k]
        if self._frames is not None:
            state, at = state.copy(), slice(0, self.layout.dim**2)
            state[:, at] += sign * self._frames[:, k].reshape(len(state), -1)
        if both is None or self._hoop is None:
            return there, state, 1.0
        state, first = state.copy(), self.layout.state(rotated=False).at_hoop.start + 1
        weight = 1.0 + sign * self._hoop[:, k, None]
        state[:, first : first + 1 + self.layout.rotations] /= weight
        return there + both[:, k], state, weight

    def energies(self, kernel: Kernel, x: np.ndarray) -> np.ndarray:
        """Strain energy (J) of the points (n,) that is in the variation over their boxes.

        Args:
            kernel: of the elastic energy, see `PointForm.compile_energy`.
        """
        z, zk, both = self.gather(x)
        weight = self.share * self.batch.kept["volume"] / 6.0
        _, even, *_ = self.means(kernel, z, zk, both, weight, with_odd=False)
        energy: np.ndarray = even[:, 0]
        return energy

    def means(
        self,
        kernel: Kernel,
        z: np.ndarray,
        zk: np.ndarray,
        both: np.ndarray | None,
        weight: np.ndarray,
        *,
        with_odd: bool = True,
        among: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
        """What a kernel of z, state and parameters gives at the points (n, k), and what their boxes add with
        weights (n,): to it (n, k), times the derivatives along the half axes (n, d, k), and in bodies of
        revolution times what is the same on both sides (n, d, k).

        Args:
            z, zk, both: from `gather`.
            among: the points are these of the batch's; not in bodies of revolution.
        """
        if both is not None:
            return self._means_of_rings(kernel, z, zk, both, weight)
        kept, (n, d, nz) = self.batch.kept, zk.shape
        state, param = kept["state"], kept["param"]
        state = state if among is None else np.ascontiguousarray(state[among])
        if nz + state.shape[1] + len(param) != kernel.inputs:
            raise ValueError(
                f"kernel has {kernel.inputs} inputs, {nz + state.shape[1] + len(param)} are given"
            )
        here, even = np.empty((n, kernel.outputs)), np.empty((n, kernel.outputs))
        odd = np.empty((n, d, kernel.outputs)) if with_odd else None
        sizes, given = (n, d, nz, state.shape[1], len(param)), (z, zk, state, self._frames, param)
        if native.library().polarmpm_box_means(
            kernel.address, *sizes, *given, weight, kernel.outputs, here, even, odd
        ):
            raise MemoryError("no memory for the points' boxes")
        return here, even, odd, None

    def _means_of_rings(
        self, kernel: Kernel, z: np.ndarray, zk: np.ndarray, both: np.ndarray, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """`means` of a body of revolution, whose sides count differently."""
        n, d, numbers = len(z), zk.shape[1], np.tile(self.batch.kept["param"], (len(z), 1))
        here = kernel(z, self.batch.kept["state"], numbers)
        even, odd, same = -2.0 * d * here, *np.empty((2, n, d, here.shape[1]))
        for k in range(d):
            found = []
            for sign in (1.0, -1.0):
                there, state, counts = self.side(k, sign, z, zk, both)
                found.append(counts * kernel(there, state, numbers))
            up, down = found
            even += up + down
            odd[:, k], same[:, k] = up - down, up + down
        sides = weight[:, None, None]
        return here, weight[:, None] * even, sides * odd, sides * same

    def store(self, kernels: native.PointKernels, x: np.ndarray, *, first: bool) -> None:
        """Let the sums at nodal increments x (nodes, block) store what `work` needs of them; those at the
        `first` of a step are kept beside the last ones. Local."""
        if self._stored_size is None:
            size = native.library().polarmpm_stored(ctypes.byref(self.batch))
            number = -(-len(self.rows) // _LANES) * size
            kept = number * 8 <= _STORED_MOST and not self.layout.axial
            self._stored_size = number if kept else 0
        if not self._stored_size:
            return
        values = self._stored[first][2] if first in self._stored else np.empty(self._stored_size)
        self._stored[first] = x.copy(), self.batch.kept["state"], values
        native.fill(kernels, box_store=values)

    def _stored_at(self, x: np.ndarray) -> np.ndarray | None:
        """What has been stored at these nodal increments, in the present state."""
        for at, state, values in self._stored.values():
            if state is self.batch.kept["state"] and np.array_equal(at, x):
                return values
        return None

    def work(self, kernel: Kernel, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Work (J) of the change of the elastic stresses on the change of the strains between nodal
        increments (nodes, block), for each point (n,): inside its box, and in all.

        Args:
            kernel: of the elastic residual.
        """
        inside, whole = np.zeros(len(self.rows)), np.zeros(len(self.rows))
        kernels = native.PointKernels()
        native.fill(kernels, kernel=kernel.address)
        self.put(kernels, kernel)
        native.fill(kernels, box_share=np.ones(len(self.rows)))  # what the strains are, not what they count
        ends = start, end, self._stored_at(start), self._stored_at(end)
        work = native.library().polarmpm_box_work
        if work(ctypes.byref(self.batch), ctypes.byref(kernels), *ends, inside, whole):
            raise MemoryError("no memory for the work in the points' boxes")
        return inside, whole
