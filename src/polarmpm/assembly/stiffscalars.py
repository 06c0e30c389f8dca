"""Stiff scalars of a batch's points in the sums over them: projected over patches (`assembly.patches`).

Before points are summed, their scalars e are projected, which gives t; then, of the derivatives L_t, pi. Both
stand in the state that the points' kernels read. Where points integrate over boxes, e and the derivatives are
means of the boxes' rule (`assembly.pointboxes`), at one t and one pi for the box.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from ..forms.projected import ProjectedForm
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..tools.rows import flat
from .elasticvolumes import ElasticVolumes, Settled
from .interpolation import Interpolation, PointBatch
from .patches import Patches
from .pointboxes import FLOWED, PointBoxes

if TYPE_CHECKING:
    from ..forms.returnmapping import ReturnMapping, Yielding


@dataclass
class Mean:
    """What a kernel gives at the points (n, k), and what their boxes add: to it, and times the derivatives
    along the half axes (n, d, k); None without boxes. Of bodies of revolution also times what is the same on
    both sides of a half axis (n, d, k)."""

    at_points: np.ndarray
    even: np.ndarray | None = None
    odd: np.ndarray | None = None
    both: np.ndarray | None = None

    def columns(self, first: int, end: int) -> Mean:
        """Some of the columns."""
        even = None if self.even is None else self.even[:, first:end]
        odd = None if self.odd is None else self.odd[:, :, first:end]
        both = None if self.both is None else self.both[:, :, first:end]
        return Mean(self.at_points[:, first:end], even, odd, both)

    def over(self, slopes: np.ndarray) -> Mean:
        """The same over one number for each point (n,)."""
        parts = (self.at_points, self.even, self.odd, self.both)
        return Mean(*(None if a is None else a / slopes.reshape(-1, *[1] * (a.ndim - 1)) for a in parts))  # type: ignore[arg-type]

    def turned(self, turn: np.ndarray | None, nz: int) -> Mean:
        """The same of turned scalars s' = turn s (turn (n, m, m); None: they stay): columns are those of m
        scalars, of their m nz derivatives by z and, where there are more, of m m second ones."""
        if turn is None:
            return self
        parts = (
            None if a is None else _turned(turn, a, nz)
            for a in (self.at_points, self.even, self.odd, self.both)
        )
        return Mean(*parts)  # type: ignore[arg-type]

    @property
    def whole(self) -> np.ndarray:
        """Points and boxes (n, k)."""
        return self.at_points if self.even is None else self.at_points + self.even


@dataclass
class Moduli:
    """L_tz, L_zt, which elastic points have alike, and L_tt."""

    tz: Mean
    zt: Mean
    tt: Mean


@dataclass
class Linear:
    """Of a tangent: pi and its derivative by the nodal values x.

    Attributes:
        x: nodal values (nodes, block).
        factors: of pi, (patches, modes).
        by_x: vectors of the modes.
        shared: how points shared volumes out, and their z (n, nz); None: they didn't.
    """

    x: np.ndarray
    factors: np.ndarray
    by_x: np.ndarray
    shared: tuple[Settled, np.ndarray] | None = None


@dataclass
class Evaluated:
    """What the patches add to forces and tangent.

    Attributes:
        b, g, h: vectors of the modes, see `patches`; the latter two with a tangent only.
        row: what g is multiplied by in the place of b, where points dilate.
        shared: see `Linear`.
        exact: factors (patches, modes) of pi.
        taken: of the pi that the points' kernels take.
        returned: of points that yield, in the place of the kernels: rows of the batch, and what `native`
            takes; None where there are none.
    """

    b: np.ndarray
    exact: np.ndarray
    taken: np.ndarray
    g: np.ndarray | None = None
    h: np.ndarray | None = None
    returned: tuple[np.ndarray, np.ndarray] | None = None
    row: np.ndarray | None = None
    shared: tuple[Settled, np.ndarray] | None = None

    def linear(self, x: np.ndarray) -> Linear | None:
        """Of this tangent, at nodal values x (nodes, block); None: there is none."""
        return None if self.h is None else Linear(x, self.exact, self.h, self.shared)


class StiffScalars:
    """Stiff scalars of a batch between two resets; `dilates`: whether its points share volumes out.

    Args:
        k: number of the batch.
    """

    def __init__(self, interpolation: Interpolation, k: int, comm: MPI.Comm):
        self._batch: PointBatch = interpolation.batches[k]
        form, patches = self._batch.form, interpolation.patches[k]
        assert isinstance(form, ProjectedForm)
        assert isinstance(patches, Patches)
        self.form, self.patches, self._interpolation = form, patches, interpolation
        self.kernels = form.compile_scalars(comm)
        n = len(self._batch.rows)
        self._tiled: np.ndarray = np.zeros((0, 0))
        self._z: np.ndarray = np.zeros((n, form.layout.unknowns))
        self._zk: np.ndarray | None = None
        self._both: np.ndarray | None = None
        self._value_slots: list[int] = []
        self._turns: tuple[np.ndarray, np.ndarray] | None = None  # of these microrotations
        self._comm = comm
        self.dilates = False  # points did so, and shared volumes out, in the last evaluation
        self._shared: tuple[np.ndarray, np.ndarray] | None = None  # nodal values, and t of points that dilate
        self._bulk: tuple[tuple[np.ndarray, ...], np.ndarray] | None = None  # of what, K

    # at the points --------------------------------------------------------------------------------
    @property
    def _state(self) -> np.ndarray:
        state: np.ndarray = self._batch.batch.kept["state"]
        return state

    def _put(self, which: int, values: np.ndarray) -> None:
        """Put t (0) or pi (1) into the state."""
        m, turn = self.form.scalars, self._turn
        first = self.form.state_size + which * m
        self._state[:, first : first + m] = values if turn is None else np.einsum("pij,pi->pj", turn, values)

    @property
    def _parameters(self) -> np.ndarray:
        """The material's numbers (n, nparam), which may change between steps."""
        own = self._batch.batch.kept["param"]
        if self._tiled.shape != (len(self._batch.rows), len(own)) or not np.array_equal(
            self._tiled[:1].ravel(), own
        ):
            self._tiled = np.tile(own, (len(self._batch.rows), 1))
        return self._tiled

    @property
    def _turn(self) -> np.ndarray | None:
        """What takes the points' scalars into the frame in which they are averaged; None: they are in it."""
        if not self.form.turned:
            return None
        q = self._interpolation.reference.q  # arrays of the state are replaced, never written to
        if self._turns is None or self._turns[0] is not q:
            self._turns = q, self.form.frames(q[self._batch.rows])
        return self._turns[1]

    def _inputs(self, z: np.ndarray) -> tuple[np.ndarray, ...]:
        return z, self._state, self._parameters

    def _mean(self, kernel: Kernel, boxes: PointBoxes | None) -> Mean:
        nz = self.form.layout.unknowns
        if boxes is None or self._zk is None:
            return Mean(kernel(*self._inputs(self._z))).turned(self._turn, nz)
        mean = Mean(*boxes.means(kernel, self._z, self._zk, self._both, boxes.share / 6.0))
        return mean.turned(self._turn, nz)

    def place(self, x: np.ndarray, boxes: PointBoxes | None) -> Mean:
        """Put t at nodal values x (nodes, block) into the state; e and e_z at the points."""
        if boxes is None:
            self._z, self._zk, self._both = self._interpolation.unknowns(self._batch, x), None, None
        else:
            self._z, self._zk, self._both = boxes.gather(x)
            self._value_slots = [] if self._both is None else boxes.value_slots
        measure = self._mean(self.kernels.measure, boxes)
        values = measure.whole[:, : self.form.scalars]
        t = self.patches.at_points(self.patches.moments(values))
        if self.shares:
            if self._shared is not None and np.array_equal(self._shared[0], x):
                t = self._shared[1][:, None]
            else:
                before = self._interpolation.volume_before(self._batch)[:, None]
                t += before - self.patches.at_points(self.patches.moments(before))
        self._put(0, t)
        return measure

    @property
    def shares(self) -> bool:
        """Whether points share the volumes of their patches out (`elasticvolumes`): of patches with linear
        functions they needn't."""
        one = self.form.scalars == 1 and self.patches.values.shape[1] == 1
        return one and self.form.material.yields

    # sums -----------------------------------------------------------------------------------------
    def _vectors(self, kernels: native.PointKernels, *means: Mean) -> np.ndarray:
        """Vectors (means, :) of the modes; all means have boxes or none."""
        m, nz, n = self.form.scalars, self.form.layout.unknowns, len(self._z)
        kinds, sides, both = len(means), None, None
        odd = [mean.odd for mean in means if mean.odd is not None]
        bent = [mean.both for mean in means if mean.both is not None]
        if odd:
            sides = np.stack(odd).reshape(kinds, n, odd[0].shape[1], m, nz)
        if bent:
            both = np.stack(bent).reshape(kinds, n, bent[0].shape[1], m, nz)[..., self._value_slots]
        return self.patches.vectors(kernels, [mean.whole for mean in means], sides, both)

    def evaluate(
        self,
        measure: Mean,
        boxes: PointBoxes | None,
        mapping: ReturnMapping | None,
        before: Linear | None,
        x: np.ndarray,
        *,
        tangent: bool,
        timer: Callable[[str], AbstractContextManager[None]],
    ) -> Evaluated:
        """Put t and pi into the state, and find what patches add. Collective.

        Args:
            measure: from `place`.
            before: where the last tangent is at hand, its prediction of pi is taken.
        """
        m, nz, n = self.form.scalars, self.form.layout.unknowns, len(self._z)
        yielding, settled = None, None
        if mapping is not None:
            with timer("return mapping"):
                if self.shares:
                    yielding, settled = self._settle(mapping, measure, x, before, tangent=tangent)
                else:
                    yielding = mapping.evaluate(np.hstack(self._inputs(self._z)), tangent)
        kernels = native.PointKernels()
        if boxes is not None:
            boxes.put(kernels, None)
        by_t, moduli = self._conjugates(boxes, tangent=tangent)
        if yielding is not None and len(yielding.rows):
            _put_yielding(yielding, by_t, moduli, nz, self._turn)
        exact = self.patches.moments(by_t.whole)
        own = [measure.columns(m, m + m * nz)]
        if moduli is not None and settled is None:
            own += [moduli.zt] if moduli.zt is moduli.tz else [moduli.zt, moduli.tz]
        b, *others = self._vectors(kernels, *own)
        taken = exact
        if tangent and before is not None:
            moved = self.patches.times(before.by_x, x - before.x)
            taken = (before.factors + moved).reshape(exact.shape)
        self._put(1, self.patches.at_points(taken))
        modes = len(exact), self.patches.modes
        found = Evaluated(b, exact.reshape(modes), taken.reshape(modes))
        local = None
        if moduli is not None and settled is not None:
            local, found.shared = self._share(found, settled, moduli, kernels), (settled, self._z)
        elif moduli is not None:
            matrices = self.patches.products(moduli.tt.whole.reshape(n, m, m))
            found.g, found.h = others[0], others[-1] + self.patches.combined(matrices, b)
        if yielding is not None and len(yielding.rows):
            found.returned = yielding.rows, self._returned(yielding, measure, local, tangent=tangent)
        return found

    def _settle(
        self, mapping: ReturnMapping, measure: Mean, x: np.ndarray, linear: Linear | None, *, tangent: bool
    ) -> tuple[Yielding, Settled | None]:
        """Put t into the state; what yields, and what `elasticvolumes` finds. Collective."""
        nz, conjugate = self.form.layout.unknowns, self.kernels.conjugate

        def evaluate(t: np.ndarray, tangent: bool, among: np.ndarray | None) -> tuple[Yielding, np.ndarray]:
            self._put(0, t[:, None])
            inputs = self._inputs(self._z)
            taken = inputs if among is None else tuple(np.ascontiguousarray(a[among]) for a in inputs)
            y = mapping.evaluate(np.hstack(taken), tangent, among)
            return y, conjugate(*(a[y.rows] for a in inputs))

        def bulk() -> np.ndarray:
            of = before, self._state, self._batch.batch.kept["param"]
            if self._bulk is None or any(a is not b for a, b in zip(self._bulk[0], of, strict=True)):
                self._put(0, before[:, None])
                self._bulk = of, conjugate(*self._inputs(np.zeros_like(self._z)))[:, 1 + nz]
            return self._bulk[1]

        before = self._interpolation.volume_before(self._batch)
        volumes = ElasticVolumes(self.patches, nz, self._comm, evaluate)
        near = None if linear is None else linear.shared
        moved = None if near is None else (near[0], self._z - near[1])
        t, y, settled = volumes.settle(measure.whole[:, 0], before, bulk, moved, tangent=tangent)
        self._put(0, t[:, None])
        self._shared, mapping.yielding, self.dilates = (x.copy(), t), y, settled is not None
        return y, settled

    def _conjugates(self, boxes: PointBoxes | None, *, tangent: bool) -> tuple[Mean, Moduli | None]:
        """L_t, and with the tangent its derivatives, in which the sides of boxes are left out that count for
        little, as of points that have flowed."""
        m, nz, k = self.form.scalars, self.form.layout.unknowns, self.kernels
        if not tangent:
            return self._mean(k.slopes, boxes), None
        felt = None
        if boxes is not None and self._zk is not None and self._both is None:
            felt = np.flatnonzero(boxes.share > FLOWED)
        if boxes is None or self._zk is None or felt is None or len(felt) == len(self._z):
            mean = self._mean(k.conjugate, boxes)
            by_t = mean.columns(0, m)
        else:
            by_t, here = self._mean(k.slopes, boxes), k.conjugate(*self._inputs(self._z))
            even, odd = np.zeros_like(here), np.zeros((len(here), self._zk.shape[1], here.shape[1]))
            if len(felt):
                at = self._z[felt], self._zk[felt], None, boxes.share[felt] / 6.0
                _, even[felt], odd[felt], _ = boxes.means(k.conjugate, *at, among=felt)
            mean = Mean(here, even, odd).turned(self._turn, nz)
        tz, tt = mean.columns(m, m + m * nz), mean.columns(m + m * nz, m * (1 + nz + m))
        return by_t, Moduli(tz, tz, tt)

    def _share(self, found: Evaluated, s: Settled, of: Moduli, kernels: native.PointKernels) -> np.ndarray:
        """The patches' part of the tangent where points share volumes out; L_zt f_z / f_t (n, nz, nz)."""
        patches, plain = self.patches, native.PointKernels()
        tz, zt, tt = of.tz, of.zt, of.tt
        by_z = s.by_z / s.by_t[:, None]
        found.g, of_z = self._vectors(kernels, zt.over(s.by_t), tz)
        f_z, of_t = self._vectors(plain, Mean(by_z), Mean(tt.whole * by_z))
        found.row = patches.combined(s.inverse(patches), found.b + f_z)
        matrices = patches.products(tt.whole[:, :, None] / s.by_t[:, None, None])
        found.h = of_z - of_t + patches.combined(matrices, found.row)
        local: np.ndarray = zt.at_points[:, :, None] * by_z[:, None, :]
        return local

    def _returned(self, y: Yielding, measure: Mean, local: np.ndarray | None, *, tangent: bool) -> np.ndarray:
        """Of the points that yield: L_z (k, nz), with the tangent also L_zz (k, nz nz) less `local`."""
        m, nz, k = self.form.scalars, self.form.layout.unknowns, len(y.rows)
        first = self.form.state_size + m
        pi = self._state[y.rows, first : first + m]
        if self._turn is not None:
            pi = np.einsum("pij,pj->pi", self._turn[y.rows], pi)
        of_e = measure.at_points[y.rows, m:].reshape(k, m, nz)
        residual = y.returned[:, :nz] + np.einsum("km,kmz->kz", pi, of_e)
        if not tangent:
            return np.ascontiguousarray(residual)
        moduli = y.returned[:, nz + m :].reshape(k, nz + m, nz + m)[:, :nz, :nz].copy()
        if local is not None:
            moduli -= local[y.rows]
        bent = self.kernels.curvature(*(a[y.rows] for a in self._inputs(self._z)))
        upper = np.triu_indices(nz)
        curvature = np.zeros((k, nz, nz))
        curvature[:, upper[0], upper[1]] = curvature[:, upper[1], upper[0]] = bent
        return np.ascontiguousarray(np.concatenate([residual, (moduli + curvature).reshape(k, -1)], axis=1))

    # results --------------------------------------------------------------------------------------
    def projected_F(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the points and their projected F, at the increments of the last evaluation."""
        rows, form = self._batch.rows, self.form
        F = self.kernels.moved(*self._inputs(self._z)).reshape(-1, 3, 3)
        if form.rotated and form.material.micropolar:
            F = F @ rotations.to_tensor(self._interpolation.reference.q[rows])
        return rows, F

    def energy(self, x: np.ndarray, boxes: PointBoxes | None) -> float:
        """Energy (J) that holds these points to their patches, at nodal values x (nodes, block)."""
        if not self.form.stabilisation:
            return 0.0
        self.place(x, boxes)
        t = self._state[:, self.form.state_size]

        def away(z: np.ndarray, state: np.ndarray, *_: object) -> np.ndarray:
            found: np.ndarray = (self.kernels.measure(z, state, self._parameters)[:, 0] - t) ** 2
            return found

        total = away(self._z, self._state)
        if boxes is not None and self._zk is not None:
            d, weight, here = self._zk.shape[1], boxes.share / 6.0, total
            at = self._z, self._zk, self._both
            sides = (boxes.side(k, s, *at) for k in range(d) for s in (1.0, -1.0))
            there = sum(np.ravel(side[2]) * away(*side) for side in sides)
            total = here + weight * (there - 2.0 * d * here)
        return 0.5 * self.form.stabilisation * float(total @ self.patches.volume)

    def values(self, x: np.ndarray) -> np.ndarray:
        """e (n, scalars) at the points at nodal values x (nodes, block)."""
        z = self._interpolation.unknowns(self._batch, x)
        found: np.ndarray = self.kernels.measure(*self._inputs(z))[:, : self.form.scalars]
        return found if self._turn is None else np.einsum("pij,pj->pi", self._turn, found)


def _turned(turn: np.ndarray, a: np.ndarray, nz: int) -> np.ndarray:
    """Columns of `Mean.turned`, in the last axis of an array (n, ..., k)."""
    n, m = turn.shape[:2]
    columns = a.reshape(n, int(np.prod(a.shape[1:-1], dtype=int)), a.shape[-1])
    ends, out = np.cumsum([m, m * nz, m * m]), []
    for part, width in zip(np.split(columns, ends[:2], axis=2), (1, nz, m), strict=True):
        of_scalars = part.reshape(n, part.shape[1], part.shape[2] // width, width)
        if of_scalars.shape[2]:
            of_scalars = np.einsum("pij,pajw->paiw", turn, of_scalars)
            if width == m:
                of_scalars = np.einsum("pajw,pvw->pajv", of_scalars, turn)
        out.append(of_scalars.reshape(part.shape))
    found: np.ndarray = np.concatenate(out, axis=2).reshape(a.shape)
    return found


def _put_yielding(y: Yielding, by_t: Mean, moduli: Moduli | None, nz: int, turn: np.ndarray | None) -> None:
    """Put what the return mapping gives at the points that yield in the place of L_t and its derivatives."""
    rows, n = y.rows, nz + by_t.at_points.shape[1]
    by_t.at_points = by_t.at_points.copy()
    of_t = y.returned[:, nz:n]
    by_t.at_points[rows] = of_t if turn is None else np.einsum("pij,pj->pi", turn[rows], of_t)
    if moduli is None:
        return
    found = y.returned[:, n:].reshape(len(rows), n, n)
    if turn is not None:
        found = found.copy()
        found[:, nz:] = turn[rows] @ found[:, nz:]
        found[:, :, nz:] = found[:, :, nz:] @ np.swapaxes(turn[rows], 1, 2)
    of_both, moduli.tz, moduli.zt = moduli.tz, replace(moduli.tz), replace(moduli.tz)
    for mean in (moduli.tz, moduli.zt):
        mean.at_points = of_both.at_points.copy()
    moduli.tt.at_points = moduli.tt.at_points.copy()
    moduli.zt.at_points[rows] = flat(np.swapaxes(found[:, :nz, nz:], 1, 2))
    moduli.tz.at_points[rows] = flat(found[:, nz:, :nz])
    moduli.tt.at_points[rows] = flat(found[:, nz:, nz:])
