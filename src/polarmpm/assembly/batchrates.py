"""Sums over a batch of points, and their derivatives in a direction: for the tangent-linear run.

A point's forces are the product of its weighting functions and of what its stresses do work on. Where nodal
values, the point's state, the material's numbers and, since points have moved by a reset, the weighting
functions and boxes change too, the product rule gives the change of the forces: the kernels' derivatives
(`forms.directional`) with the functions as they are, and stresses as they are with the functions'
changes, one direction of the lattice after the other. Gradients are those in the lattice's axes until the
kernels' frames (the first entries of the state) turn them, as these have changes of their own.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..forms.directional import FormAlong, InitialAlong
from ..forms.initialstress import InitialKernels
from ..forms.projected import ProjectedForm
from ..kernels import native
from ..kernels.kernel import Kernel
from .interpolation import Interpolation
from .patches import Patches
from .pointfunctions import Functions, framed
from .ratemoduli import PointModuli, inverse, regions
from .ratestate import At, Change
from .stiffscalars import Mean

if TYPE_CHECKING:
    from ..forms.returnmapping import ReturnMapping


def _turned(turn: np.ndarray | None, values: np.ndarray) -> np.ndarray:
    return values if turn is None else np.einsum("nij,nj->ni", turn, values)


class BatchRates:
    """The points of a batch between two resets.

    Attributes:
        functions: of the points.
    """

    def __init__(self, interpolation: Interpolation, k: int, along: FormAlong, nodes: int):
        self.batch = batch = interpolation.batches[k]
        self.form, self.layout, self.along = batch.form, batch.form.layout, along
        self.boxes = None if interpolation.boxes is None else interpolation.boxes[k]
        self.patches: Patches | None = interpolation.patches[k]
        self.nodes = nodes
        axes = None if self.boxes is None else self.boxes._axes
        self.functions = Functions(batch, nodes, axes)
        self.share: np.ndarray | None = None
        self.initial: tuple[InitialKernels, InitialAlong] | None = None
        self.turn: np.ndarray | None = None  # of the stiff scalars; None: they are averaged as they are
        if isinstance(self.form, ProjectedForm) and self.form.turned:
            self.turn = self.form.frames(interpolation.reference.q[batch.rows])

    @property
    def numbers(self) -> np.ndarray:
        """The material's (nparam,)."""
        numbers: np.ndarray = self.batch.batch.kept["param"]
        return numbers

    @property
    def projected(self) -> bool:
        return isinstance(self.form, ProjectedForm)

    def _mean(
        self, kernel: Kernel, z: np.ndarray, zk: np.ndarray | None, state: np.ndarray, numbers: np.ndarray
    ) -> Mean:
        """What a kernel gives at the points and in their boxes."""
        n = len(z)
        if zk is None:
            return Mean(kernel(z, state, np.tile(numbers, (n, 1))))
        assert self.share is not None
        (_, d, nz), outputs = zk.shape, kernel.outputs
        here, even, odd = np.empty((n, outputs)), np.empty((n, outputs)), np.empty((n, d, outputs))
        if not np.any(zk):  # as at a reset: the sides are as the points
            found = kernel(z, state, np.tile(numbers, (n, 1)))
            return Mean(found, np.zeros_like(found), np.zeros((n, d, outputs)))
        arrays = [np.ascontiguousarray(a) for a in (z, zk, state)]
        rest = [np.ascontiguousarray(a) for a in (numbers, self.share)]
        sizes = (n, d, nz, state.shape[1], len(numbers))
        means = native.library().polarmpm_box_means
        if means(kernel.address, *sizes, *arrays, None, *rest, outputs, here, even, odd):
            raise MemoryError("no memory for the points' boxes")
        return Mean(here, even, odd)

    # at some nodal values -----------------------------------------------------------------------------
    def at(
        self,
        x: np.ndarray,
        state: np.ndarray,
        kernels: Any,
        mapping: ReturnMapping | None,
        *,
        boxes: bool = True,
    ) -> At:
        """The points at nodal values x (nodes, block).

        Args:
            state: packed, (n, packed size).
            kernels: (residual, residual and tangent).
            mapping: has evaluated them; None: they are elastic.
            boxes: they count.
        """
        if self.boxes is not None:
            self.share = self.boxes.share / 6.0 if boxes else np.zeros_like(self.boxes.share)
        frames, (g, gk) = self.frames(state), self.functions.gather(x)
        z = framed(self.layout, g, frames)
        zk = None if gk is None else framed(self.layout, gk, frames)
        found = At(g, gk, z, zk, state.copy(), np.zeros_like(z))
        found.yielding = None if mapping is None else mapping.yielding
        if found.yielding is not None and not len(found.yielding.rows):
            found.yielding = None
        if self.projected:
            self._project(found)
        mean = self._mean(kernels[0], z, zk, found.state, self.numbers)
        nz = self.layout.unknowns
        if found.yielding is not None:
            mean.at_points[found.yielding.rows] = self._returned(found)[:, :nz]
        found.work, found.sides = mean.whole, mean.odd
        if PointModuli.worth(self, found):
            found.make_moduli = partial(PointModuli, self, found, kernels)
        return found

    def frames(self, state: np.ndarray) -> np.ndarray:
        """(n, d, d) of packed states, or of their changes."""
        d = self.layout.dim
        return state[:, : d * d].reshape(len(state), d, d)

    def turned(self, change: Change) -> np.ndarray:
        """Changes of the kernels' frames (n, d, d)."""
        return self.frames(change.state)

    def take_initial(self, at: At, packed: np.ndarray | None) -> None:
        """Initial stresses (n, size) act, too."""
        at.initial = packed
        if packed is not None:
            assert self.initial is not None
            at.work = at.work + self.initial[0].residual(at.z, self.frames(at.state), packed)

    def take_couples(self, at: At, kernel: Kernel, couples: np.ndarray) -> None:
        """Dead couples in space (n, 3) do work on what the points have turned by, too."""
        at.couples, self._couple = couples, kernel
        at.work = at.work.copy()
        at.work[:, self._rotation] += kernel(at.z[:, self._rotation], couples)[:, :3] / self._volume

    @property
    def _rotation(self) -> slice:
        return self.layout.where("rotation")

    @property
    def _volume(self) -> np.ndarray:
        volume: np.ndarray = self.batch.batch.kept["volume"][:, None]
        return volume

    def _inputs(self, at: At, rows: np.ndarray) -> list[np.ndarray]:
        return [at.z[rows], at.state[rows], np.tile(self.numbers, (len(rows), 1))]

    def _returned(self, at: At) -> np.ndarray:
        """What does work on z (and t) at the points that yield."""
        y, form = at.yielding, self.form
        assert y is not None
        out = np.zeros((len(y.rows), form.unknowns))
        for region in np.unique(y.region):
            which = np.flatnonzero(y.region == region)
            kernels = form.return_kernels(form.regions[region], self.along.comm)  # type: ignore[attr-defined]
            inputs = np.hstack(self._inputs(at, y.rows[which]))
            out[which] = kernels.stress(inputs, np.ascontiguousarray(y.X[which, : kernels.size]))
        if at.measure is not None and at.conjugate is not None:
            nz, m = self.layout.unknowns, form.scalars
            of_e = at.measure.at_points[y.rows, m:].reshape(len(y.rows), m, nz)
            out[:, :nz] += np.einsum("km,kmz->kz", at.conjugate[y.rows], of_e)
        return out

    def _project(self, at: At) -> None:
        """Put the projected scalars, and their conjugates, into the state."""
        form, patches = self.form, self.patches
        assert isinstance(form, ProjectedForm)
        assert patches is not None
        m, kernels = form.scalars, form.compile_scalars(self.along.comm)
        at.measure = self._mean(kernels.measure, at.z, at.zk, at.state, self.numbers)
        of_e = patches.moments(_turned(self.turn, at.measure.whole[:, :m]))
        at.state[:, form.state_size : form.state_size + m] = self._back(patches.at_points(of_e))
        at.by_t = self._by_t(at)
        of_t = patches.moments(_turned(self.turn, at.by_t))
        at.moments, at.conjugate = (of_e, of_t), self._back(patches.at_points(of_t))
        at.state[:, form.state_size + m : form.state_size + 2 * m] = at.conjugate

    def _back(self, values: np.ndarray) -> np.ndarray:
        """Scalars (n, m) in the points' own frames, of ones in the frame of the average."""
        return values if self.turn is None else np.einsum("nij,ni->nj", self.turn, values)

    # changes --------------------------------------------------------------------------------------------
    def change_of_unknowns(
        self, at: At, x: np.ndarray, dx: np.ndarray | None, change: Change | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Of z and zk, where nodal values x change by dx (None: they stay)."""
        dg, dgk = np.zeros_like(at.g), None if at.gk is None else np.zeros_like(at.gk)
        parts = [] if dx is None else [self.functions.gather(dx)]
        still = change is None or not np.any(x)
        parts += [f.gather(x) for f in (change.functions if change is not None and not still else ())]
        for g, gk in parts:
            dg += g
            if dgk is not None and gk is not None:
                dgk += gk
        if change is not None and change.axes is not None and dgk is not None and not still:
            dgk = dgk + change.axes.gather(x)[1]
        frames, layout = self.frames(at.state), self.layout
        dz = framed(layout, dg, frames)
        dzk = None if dgk is None else framed(layout, dgk, frames)
        if change is not None and not still:
            turned = self.turned(change)
            dz += framed(layout, at.g, turned, values=False)
            if dzk is not None and at.gk is not None:
                dzk += framed(layout, at.gk, turned, values=False)
        return dz, dzk

    def forces(self, at: At, x: np.ndarray, dx: np.ndarray | None, change: Change | None) -> np.ndarray:
        """Changes of the forces (nodes, block) on this rank's nodes."""
        dz, dzk = self.change_of_unknowns(at, x, dx, change)
        return self._spread_change(at, self.respond(at, dz, dzk, change), (at.work, at.sides), change)

    def forces_of_initial(self, at: At, packed: np.ndarray, change: Change) -> np.ndarray:
        """Changes of the forces (nodes, block) of packed initial stresses alone, at no increments."""
        assert self.initial is not None
        d, still = self.layout.dim**2, np.zeros_like(at.z)
        frames, turned = at.state[:, :d], change.state[:, :d]
        moved = np.zeros_like(packed) if change.initial is None else change.initial
        work = self.initial[0].residual(still, frames, packed)
        dwork = self.initial[1].residual(still, still, frames, turned, packed, moved)
        return self._spread_change(at, (dwork, None), (work, None), change)

    def _spread_change(
        self,
        at: At,
        changes: tuple[np.ndarray, np.ndarray | None],
        values: tuple[np.ndarray, np.ndarray | None],
        change: Change | None,
    ) -> np.ndarray:
        """Changes of forces (nodes, block), of what does work on z and zk, in the frames, and its changes."""
        layout, frames = self.layout, np.swapaxes(self.frames(at.state), 1, 2)
        (dwork, dsides), (work, sides) = changes, values
        raw = framed(layout, dwork, frames)
        raw_sides = None if dsides is None else framed(layout, dsides, frames)
        if change is None:
            return self.functions.spread(raw, raw_sides)
        turned = np.swapaxes(self.turned(change), 1, 2)
        raw += framed(layout, work, turned, values=False)
        if raw_sides is not None and sides is not None:
            raw_sides += framed(layout, sides, turned, values=False)
        out = self.functions.spread(raw, raw_sides)
        if not change.functions:
            return out
        work = framed(layout, work, frames)
        sides = None if sides is None else framed(layout, sides, frames)
        for functions in change.functions:
            out += functions.spread(work, sides)
        if change.axes is not None and sides is not None:
            out += change.axes.spread(np.zeros_like(work), sides)
        return out

    def respond(
        self, at: At, dz: np.ndarray, dzk: np.ndarray | None, change: Change | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Changes of what does work on z and zk, in the frames."""
        if change is None and at.moduli is not None:
            return self._respond_linearly(at, dz, dzk)
        nz, m = self.layout.unknowns, self.form.scalars
        dstate = np.zeros_like(at.state) if change is None else change.state.copy()
        dnumbers = np.zeros_like(self.numbers) if change is None else change.parameters
        z, numbers = np.hstack([at.z, dz]), np.concatenate([self.numbers, dnumbers])
        zk = None if at.zk is None or dzk is None else np.concatenate([at.zk, dzk], axis=2)
        if m:
            self._project_change(at, (z, zk, numbers), dstate, change)
        state = np.hstack([at.state, dstate])
        mean = self._mean(self.along.residual, z, zk, state, numbers)
        if at.yielding is not None:
            mean.at_points[at.yielding.rows] = self._returned_change(at, dz, dstate, dnumbers, change)
        work, sides = mean.whole[:, :nz], None if mean.odd is None else mean.odd[:, :, :nz]
        if m:
            work, sides = self._with_conjugates(at, work, sides, mean.whole[:, nz:], change)
        if at.initial is not None or (change is not None and change.initial is not None):
            work = work + self._initial_change(at, dz, dstate, change)
        if at.couples is not None:
            work = work + self._couples_change(at, dz, change)
        return work, sides

    def _respond_linearly(
        self, at: At, dz: np.ndarray, dzk: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The same where nothing else changes, of the points' moduli."""
        moduli, dt = at.moduli, None
        assert moduli is not None
        if self.form.scalars:
            assert at.measure is not None
            assert at.moments is not None
            values = at.measure.whole[:, : self.form.scalars]
            dt = self._averaged_change(values, moduli.scalars(dz, dzk), at.moments[0], None)
        work, sides, by_t = moduli.times(dz, dzk, dt)
        if self.form.scalars:
            work, sides = self._with_conjugates(at, work, sides, by_t, None)
        if at.initial is not None:
            work = work + self._initial_change(at, dz, np.zeros_like(at.state), None)
        if at.couples is not None:
            work = work + self._couples_change(at, dz, None)
        return work, sides

    def _with_conjugates(
        self, at: At, work: np.ndarray, sides: np.ndarray | None, by_t: np.ndarray, change: Change | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Changes of what does work on z and zk, with those of pi . e_z as L_t changes by `by_t` (n, m)."""
        n, m, nz = len(work), self.form.scalars, self.layout.unknowns
        dpi = self._conjugate_change(at, by_t, change)
        assert at.measure is not None
        of_e = at.measure.columns(m, m + m * nz)
        work = work + np.einsum("nm,nmz->nz", dpi, of_e.whole.reshape(n, m, nz))
        if sides is not None and of_e.odd is not None:
            odd = of_e.odd.reshape(n, sides.shape[1], m, nz)
            sides = sides + np.einsum("nm,ndmz->ndz", dpi, odd)
        return work, sides

    def settle(self, at: At, x: np.ndarray, dx: np.ndarray, change: Change) -> None:
        """Put the changes of the state, and of what yields, into `change.given`."""
        dz, dzk = self.change_of_unknowns(at, x, dx, change)
        dstate = change.state.copy()
        if self.form.scalars:
            numbers = np.concatenate([self.numbers, change.parameters])
            zk = None if at.zk is None or dzk is None else np.concatenate([at.zk, dzk], axis=2)
            self._project_change(at, (np.hstack([at.z, dz]), zk, numbers), dstate, change)
        if at.yielding is not None:
            self._local_change(at, dz, dstate, change.parameters, change)
        change.given |= {"state": dstate, "z": dz}

    def _initial_change(
        self, at: At, dz: np.ndarray, dstate: np.ndarray, change: Change | None
    ) -> np.ndarray:
        assert self.initial is not None
        size = self.initial[0].form.size
        stress = np.zeros((len(dz), size)) if at.initial is None else at.initial
        moved = None if change is None else change.initial
        moved = np.zeros_like(stress) if moved is None else moved
        d = self.layout.dim**2
        return self.initial[1].residual(at.z, dz, at.state[:, :d], dstate[:, :d], stress, moved)

    def _couples_change(self, at: At, dz: np.ndarray, change: Change | None) -> np.ndarray:
        out, w, couples = np.zeros_like(dz), at.z[:, self._rotation], at.couples
        assert couples is not None
        tangent = self._couple(w, couples)[:, 3:].reshape(len(w), 3, 3)
        moved = np.einsum("nij,nj->ni", tangent, dz[:, self._rotation])
        if change is not None and change.couples is not None:
            moved = moved + self._couple(w, change.couples)[:, :3]  # linear in the couples
        out[:, self._rotation] = moved / self._volume
        return out

    def _project_change(
        self,
        at: At,
        doubled: tuple[np.ndarray, np.ndarray | None, np.ndarray],
        dstate: np.ndarray,
        change: Change | None,
    ) -> None:
        """Put the change of the projected scalars into that of the state."""
        form, (z, zk, numbers) = self.form, doubled
        assert at.moments is not None
        m = form.scalars
        de = self._mean(self.along.measure, z, zk, np.hstack([at.state, dstate]), numbers).whole
        assert at.measure is not None
        dt = self._averaged_change(at.measure.whole[:, :m], de, at.moments[0], change)
        dstate[:, form.state_size : form.state_size + m] = dt

    def _conjugate_change(self, at: At, by_t: np.ndarray, change: Change | None) -> np.ndarray:
        """Of pi, where L_t changes by `by_t` (n, m)."""
        assert at.moments is not None
        assert at.by_t is not None
        return self._averaged_change(at.by_t, by_t, at.moments[1], change)

    def _averaged_change(
        self, values: np.ndarray, changes: np.ndarray, moments: np.ndarray, change: Change | None
    ) -> np.ndarray:
        """Of averages (n, m), of scalars and their changes (n, m); `moments`: of the scalars."""
        patches, turn = self.patches, None if change is None else change.turn
        assert patches is not None
        moved = None if change is None else change.patches
        changes = _turned(self.turn, changes)
        if turn is not None:
            changes = changes + np.einsum("nij,nj->ni", turn, values)
        averaged = patches.moments(changes)
        if moved is not None:
            averaged = averaged + patches.moments(_turned(self.turn, values), moved)
        out = patches.at_points(averaged)
        if moved is not None:
            out = out + patches.at_points(moments, moved)
        out = self._back(out)
        if turn is not None:
            out = out + np.einsum("nij,ni->nj", turn, patches.at_points(moments))
        return out

    def _by_t(self, at: At) -> np.ndarray:
        """L_t (n, m) at the points and in their boxes."""
        form = self.form
        assert isinstance(form, ProjectedForm)
        kernels = form.compile_scalars(self.along.comm)
        mean = self._mean(kernels.slopes, at.z, at.zk, at.state, self.numbers)
        if at.yielding is not None:
            mean.at_points = mean.at_points.copy()
            mean.at_points[at.yielding.rows] = self._returned(at)[:, self.layout.unknowns :]
        return mean.whole

    def _local_change(
        self, at: At, dz: np.ndarray, dstate: np.ndarray, dnumbers: np.ndarray, change: Change | None
    ) -> list[tuple[np.ndarray, int, list[np.ndarray], np.ndarray, np.ndarray]]:
        """At the points that yield, region by region: which of them, the region, kernels' inputs, the local
        unknowns and their changes. These solve the local equations, whatever these depend on."""
        y, form, comm = at.yielding, self.form, self.along.comm
        assert y is not None
        out, moved = [], np.zeros_like(y.X)
        for region, which, here, X in regions(self, at):
            rows, local = y.rows[which], self.along.returned(region)[0]
            there = [dz[rows], dstate[rows], np.tile(dnumbers, (len(rows), 1))]
            both = [a for pair in zip(here, there, strict=True) for a in pair]
            scale = form.return_kernels(form.regions[region], comm).row_scale[:, None]  # type: ignore[attr-defined]
            right = local(*both, X, np.zeros_like(X))[:, :, None] * scale
            moved[which, : X.shape[1]] = dX = -(inverse(self, at, region, here, X) @ right)[:, :, 0]
            out.append((which, region, both, X, dX))
        if change is not None:
            change.given["X"] = moved
        return out

    def _returned_change(
        self, at: At, dz: np.ndarray, dstate: np.ndarray, dnumbers: np.ndarray, change: Change | None
    ) -> np.ndarray:
        """Of stresses at the points that yield."""
        assert at.yielding is not None
        out = np.zeros((len(at.yielding.rows), self.form.unknowns))
        for which, region, both, X, dX in self._local_change(at, dz, dstate, dnumbers, change):
            out[which] = self.along.returned(region)[1](*both, X, dX)
            if self.form.scalars:
                out[which] += self.along.bent(*both)
        return out
