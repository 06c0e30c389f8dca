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
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
    """Derivatives of f at the points: f_t (n,) and f_z (n, nz); whether stability is lost there (n,)."""

    by_t: np.ndarray
    by_z: np.ndarray
    lost: np.ndarray

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
        evaluate: (t, tangent, among) -> what yields, and the elastic L_t, L_tz and L_tt (k, 2 + nz), of these
            rows or of all points. Collective.
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
        self, e: np.ndarray, before: np.ndarray, bulk: Callable[[], np.ndarray], *, tangent: bool
    ) -> tuple[np.ndarray, Yielding, Settled | None]:
        """t (n,), what yields then, and derivatives of f; None: no point dilates. Collective.

        Args:
            e: of the points (n,).
            bulk: K (n,).

        Raises:
            LocalFailure: at some points there is no solution.
        """
        t = start = self.begun(e, before)
        y, elastic = self._evaluate(t, tangent, None)
        gain = y.returned[:, self._nz] - elastic[y.rows, 0]
        small = _LEAST * np.abs(elastic[y.rows, 1 + self._nz])
        if not self._anywhere(np.abs(gain) > small):
            return t, y, None
        if not tangent:
            y, elastic = self._evaluate(t, True, None)
        K = bulk()
        return self._iterate(e, before, K, start, (y, elastic))

    def _anywhere(self, which: np.ndarray) -> bool:
        return bool(self._comm.allreduce(bool(np.any(which)), op=MPI.LOR))

    def _of(
        self, t: np.ndarray, y: Yielding, elastic: np.ndarray, K: np.ndarray
    ) -> tuple[np.ndarray, Settled]:
        """f (n,) and its derivatives."""
        nz, rows, n = self._nz, y.rows, len(t)
        f, by_t, by_z = t.copy(), np.ones(n), np.zeros((n, nz))
        moduli = y.returned[:, nz + 1 :].reshape(len(rows), nz + 1, nz + 1)
        taken = (1.0 - _OWN) / K[rows]
        f[rows] += taken * (y.returned[:, nz] - elastic[rows, 0])
        by_t[rows] += taken * (moduli[:, nz, nz] - elastic[rows, 1 + nz])
        by_z[rows] = taken[:, None] * (moduli[:, nz, :nz] - elastic[rows, 1 : 1 + nz])
        lost = (by_t < 0.0) | (by_t > _STEEPEST)
        return f, Settled(np.maximum(by_t, 0.5 * _OWN), by_z, lost)

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
        f, settled = self._of(t, y, elastic, K)
        size = patches.largest(np.maximum(np.abs(e - before), np.abs(f - t)))
        share: np.ndarray = np.ones(patches.count)
        last: np.ndarray = np.full(patches.count, np.inf)
        given_up: np.ndarray = np.zeros(patches.count, dtype=bool)
        for _ in range(_MOST):
            away = patches.largest(np.abs(f - before - self._averaged(f - before)))
            given_up |= patches.largest(settled.lost.astype(float)) > 0.0
            open_ = (away > _LEAST + _ACCURACY * size) & ~given_up
            if not self._anywhere(open_):
                break
            share = np.where(away > last, np.maximum(0.5 * share, 1 / 16), np.minimum(2 * share, 1.0))
            last = away
            right = whole + patches.moments(((f - before) / settled.by_t - t)[:, None])
            to = patches.at_points(settled.inverse(patches) @ right)[:, 0]
            change = (to - (f - before)) / settled.by_t
            most = patches.largest(np.abs(change))
            share_now = np.minimum(share, 2.0 * size / np.maximum(most, 1e-300))
            t = t + (np.where(open_, share_now, 0.0)[patches.patch]) * change
            try:
                y, elastic = self._again(t, y, elastic, open_)
            except LocalFailure:
                given_up |= open_
                break
            f, settled = self._of(t, y, elastic, K)
        else:
            away = patches.largest(np.abs(f - before - self._averaged(f - before)))
            given_up |= away > _LEAST + _ACCURACY * size
        if self._anywhere(given_up):
            at = given_up[patches.patch]
            t = np.where(at, start, t)
            y, elastic = self._again(t, y, elastic, given_up)
            f, settled = self._of(t, y, elastic, K)
            flat = np.where(at[:, None], 0.0, settled.by_z)
            settled = Settled(np.where(at, 1.0, settled.by_t), flat, settled.lost)
        return t, y, settled

    def _again(
        self, t: np.ndarray, y: Yielding, elastic: np.ndarray, which: np.ndarray
    ) -> tuple[Yielding, np.ndarray]:
        """What yields where the points of some patches have another t."""
        at = which[self._patches.patch]
        new, there = self._evaluate(t, True, np.flatnonzero(at))
        elastic = elastic.copy()
        elastic[at] = there
        return y.without(at[y.rows]).joined(new), elastic
