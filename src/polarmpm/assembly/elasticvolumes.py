"""Elastic volumes of points that dilate as they flow: these follow a patch's functions, not whole volumes.

Where flow keeps the volume, the projected volume t = S e of a point is its elastic one, and one condition a
function is left for each patch (`assembly.patches`). Flow that dilates with what a point shears would bring a
condition for each point back: its pressure rises or falls by what its plastic volume differs from those of
its patch, and loads rise without a limit. So the points of a patch share their volume out,

    S t = S e,        (1 - S) (f - t0) = 0,        f = t + (1 - w) (L_t - L_t^trial) / K,

with t0 at the last converged step, the elastic L_tt, K, and a small w: f - t0 is the elastic part of what the
step adds.
Patches are independent; each is solved by Newton's method for t. Then f_t dt = phi_a dq_a - f_z dz with

    N_ab dq_b = b_a . dx + w_a . dx,   N_ab = sum V0 phi_a phi_b / f_t,   w_a = sum V0 phi_a B^T f_z / f_t.

Where the step's last tangent found a solution, the iteration begins with what these derivatives make of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from ..errors import LocalFailure
from .patches import Patches

if TYPE_CHECKING:
    from ..forms.returnmapping import Yielding

_MOST = 15  # iterations; patches that need more have the whole volume projected
_ACCURACY = 1e-10  # of the step's changes of volume
_LEAST = 1e-13  # a change of volume that is rounding
_STEEPEST = 1.5  # f_t; of stable points it is at most 1
_OWN = 2e-3  # w, for f_t not to vanish where only the volume flows

Evaluate = Callable[[np.ndarray, bool, np.ndarray | None], tuple["Yielding", np.ndarray]]


@dataclass
class Settled:
    """t and f (n,) of the points, and derivatives of f: f_t (n,) and f_z (n, nz); whether stability is lost
    there (n,). `whole`: some patches, on any rank, have the whole volume projected."""

    t: np.ndarray
    f: np.ndarray
    by_t: np.ndarray
    by_z: np.ndarray
    lost: np.ndarray
    whole: bool = False

    def inverse(self, patches: Patches) -> np.ndarray:
        """N^-1 (patches, functions, functions)."""
        products = patches.products((1.0 / self.by_t)[:, None, None])
        at = np.arange(products.shape[1])
        products[:, at, at] += products[:, at, at] == 0.0  # functions that a patch does without
        found: np.ndarray = np.linalg.inv(products)
        return found


class ElasticVolumes:
    """Shares of a batch's points in the volumes of their patches.

    Args:
        evaluate: (t, tangent, among) -> what yields of these rows or of all points, and the elastic L_t, L_tz
            and L_tt (k, 2 + nz) where it yields. Collective.
    """

    def __init__(self, patches: Patches, nz: int, comm: MPI.Comm, evaluate: Evaluate):
        self._patches, self._nz, self._comm, self._evaluate = patches, nz, comm, evaluate

    def _averaged(self, values: np.ndarray) -> np.ndarray:
        found: np.ndarray = self._patches.at_points(self._patches.moments(values[:, None]))[:, 0]
        return found

    def begun(self, e: np.ndarray, before: np.ndarray) -> np.ndarray:
        """t (n,) where each point goes on with the share that it had at `before`, t0."""
        found: np.ndarray = self._averaged(e - before) + before
        return found

    def settle(
        self,
        e: np.ndarray,
        before: np.ndarray,
        bulk: Callable[[], np.ndarray],
        near: tuple[Settled, np.ndarray] | None,
        *,
        tangent: bool,
    ) -> tuple[np.ndarray, Yielding, Settled | None]:
        """t (n,), what yields then, and derivatives of f; None: no point dilates. Collective.

        Args:
            e: of the points (n,).
            bulk: K (n,).
            near: what the step's last tangent has found, and how z has changed since (n, nz).

        Raises:
            LocalFailure: at some points there is no solution.
        """
        if near is not None and not near[0].whole:
            try:
                found = self._solve(e, before, bulk, self._predicted(e, before, *near), tangent=True)
            except LocalFailure:  # begun too far away
                found = None
            if found is not None and found[2] is not None and not found[2].whole:
                return found
        return self._solve(e, before, bulk, self.begun(e, before), tangent=tangent)

    def _predicted(self, e: np.ndarray, before: np.ndarray, near: Settled, dz: np.ndarray) -> np.ndarray:
        """t (n,) of a solution close by; S t = S e holds."""
        f = near.f + np.einsum("nz,nz->n", near.by_z, dz)
        whole = self._patches.moments(e[:, None])
        found: np.ndarray = near.t + self._newton(whole, before, replace(near, f=f))
        return found

    def _newton(self, whole: np.ndarray, before: np.ndarray, s: Settled) -> np.ndarray:
        """Change of t (n,) by which (1 - S) (f - t0) vanishes, and S t is that of `whole`."""
        patches, gain = self._patches, s.f - before
        right = whole + patches.moments((gain / s.by_t - s.t)[:, None])
        to = patches.at_points(s.inverse(patches) @ right)[:, 0]
        change: np.ndarray = (to - gain) / s.by_t
        return change

    def _solve(
        self,
        e: np.ndarray,
        before: np.ndarray,
        bulk: Callable[[], np.ndarray],
        start: np.ndarray,
        *,
        tangent: bool,
    ) -> tuple[np.ndarray, Yielding, Settled | None]:
        """`settle` from this t (n,)."""
        y, elastic = self._evaluate(start, tangent, None)
        gain = y.returned[:, self._nz] - elastic[:, 0]
        if not self._anywhere(np.abs(gain) > _LEAST * np.abs(elastic[:, 1 + self._nz])):
            return start, y, None
        if not tangent:
            y, elastic = self._evaluate(start, True, None)
        K = bulk()
        return self._iterate(e, before, K, start, (y, elastic))

    def _anywhere(self, which: np.ndarray) -> bool:
        return bool(self._comm.allreduce(bool(np.any(which)), op=MPI.LOR))

    def _of(self, t: np.ndarray, y: Yielding, elastic: np.ndarray, K: np.ndarray) -> Settled:
        """f (n,) and its derivatives."""
        nz, rows, n = self._nz, y.rows, len(t)
        f, by_t, by_z = t.copy(), np.ones(n), np.zeros((n, nz))
        moduli = y.returned[:, nz + 1 :].reshape(len(rows), nz + 1, nz + 1)
        taken = (1.0 - _OWN) / K[rows]
        f[rows] += taken * (y.returned[:, nz] - elastic[:, 0])
        by_t[rows] += taken * (moduli[:, nz, nz] - elastic[:, 1 + nz])
        by_z[rows] = taken[:, None] * (moduli[:, nz, :nz] - elastic[:, 1 : 1 + nz])
        lost = (by_t < 0.0) | (by_t > _STEEPEST)
        return Settled(t, f, np.maximum(by_t, 0.5 * _OWN), by_z, lost)

    def _iterate(
        self,
        e: np.ndarray,
        before: np.ndarray,
        K: np.ndarray,
        start: np.ndarray,
        first: tuple[Yielding, np.ndarray],
    ) -> tuple[np.ndarray, Yielding, Settled]:
        patches, (y, elastic), t = self._patches, first, start
        whole = patches.moments(e[:, None])
        s = self._of(t, y, elastic, K)
        size = patches.largest(np.maximum(np.abs(e - before), np.abs(s.f - t)))
        share: np.ndarray = np.ones(patches.count)
        last: np.ndarray = np.full(patches.count, np.inf)
        given_up: np.ndarray = np.zeros(patches.count, dtype=bool)
        for _ in range(_MOST):
            away = patches.largest(np.abs(s.f - before - self._averaged(s.f - before)))
            given_up |= patches.largest(s.lost.astype(float)) > 0.0
            open_ = (away > _LEAST + _ACCURACY * size) & ~given_up
            if not self._anywhere(open_):
                break
            share = np.where(away > last, np.maximum(0.5 * share, 1 / 16), np.minimum(2 * share, 1.0))
            last = away
            change = self._newton(whole, before, s)
            most = patches.largest(np.abs(change))
            share_now = np.minimum(share, 2.0 * size / np.maximum(most, 1e-300))
            t = t + (np.where(open_, share_now, 0.0)[patches.patch]) * change
            try:
                y, elastic = self._again(t, y, elastic, open_)
            except LocalFailure:
                given_up |= open_
                break
            s = self._of(t, y, elastic, K)
        else:
            away = patches.largest(np.abs(s.f - before - self._averaged(s.f - before)))
            given_up |= away > _LEAST + _ACCURACY * size
        if self._anywhere(given_up):
            at = given_up[patches.patch]
            t = np.where(at, self.begun(e, before), t)
            y, elastic = self._again(t, y, elastic, given_up)
            s = self._of(t, y, elastic, K)
            flat = np.where(at[:, None], 0.0, s.by_z)
            s = replace(s, by_t=np.where(at, 1.0, s.by_t), by_z=flat, whole=True)
        return t, y, s

    def _again(
        self, t: np.ndarray, y: Yielding, elastic: np.ndarray, which: np.ndarray
    ) -> tuple[Yielding, np.ndarray]:
        """What yields where the points of some patches have another t."""
        at = which[self._patches.patch]
        new, there = self._evaluate(t, True, np.flatnonzero(at))
        changed = at[y.rows]
        return y.without(changed).joined(new), np.concatenate([elastic[~changed], there])
