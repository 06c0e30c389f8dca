"""Return mapping: which points yield, their stresses and consistent tangents, and their plastic state.

Elastic points cost one evaluation of the yield function. Those that yield are gathered and solved in batches
by compiled code; kernels are compiled when the first point needs them. Where one region of the yield surface
has no admissible solution, the others are tried.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points
from ..errors import LocalFailure
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..materials.plastic import Continuation
from ..tools.parallel import reduced
from .plastic import PlasticForm, entries
from .points import PointForm
from .returns import Return

# Yield function over elastic modulus from which on a point counts as yielding. A point that yielded in the
# last step sits on the surface: its tangent at the start of a step is the elastoplastic one.
_YIELD = -1e-10
_TOLERANCE = 1e-13  # of the local residual, as a strain
_OFF = 1e-4  # of the way to the trial state: start values that another run gives
_LOOSE = 1e-9  # accepted where rounding ends the iteration; T 4.3.3 uses it throughout
_BACKWARDS = -1e-8  # a strain: flow that is no more than rounding
_OUTSIDE = 1e-9  # yield function over elastic modulus that a solution on another surface may have
_MOST = 60  # local iterations, halved steps included


def replaced(array: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A copy with other values in some rows: what was there can be put back."""
    out = array.copy()
    out[rows] = values
    return out


@dataclass
class Yielding:
    """Points that yield in the present state.

    Attributes:
        rows: which of the points (n,).
        inputs, X: kernel inputs and local unknowns, row by row; multipliers that a region lacks are zero.
        region: on which of the material's regions (n,); before they are solved, which is attempted first.
        returned: s and, if asked, the consistent tangent per reference volume, (n, nz (1 + nz)).
        iterations: local iterations (n,).
    """

    rows: np.ndarray
    inputs: np.ndarray
    X: np.ndarray
    region: np.ndarray
    returned: np.ndarray
    iterations: np.ndarray

    def without(self, left_out: np.ndarray) -> Yielding:
        """The others of the points (n,) bool."""
        if not np.any(left_out):
            return self
        keep = ~left_out
        return Yielding(*(getattr(self, f.name)[keep] for f in fields(self)))

    def joined(self, other: Yielding) -> Yielding:
        """Both, of different points."""
        both = (np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self))
        return Yielding(*both)


class Flow(NamedTuple):
    """Of points that yield: sums of their multipliers (n,), what they dissipate (Pa) (n,), after which share
    of a step, and themselves."""

    multipliers: np.ndarray
    work: np.ndarray
    share: float
    of: Yielding


class ReturnMapping:
    """Return mapping for the points of one elastoplastic material. Collective.

    Args:
        form: its form.
        ids: permanent ids of the points (n,), for messages.

    Attributes:
        start_elastic: points on the yield surface, with no flow, are elastic.
        yielding: what the last evaluation found.
        balanced: what the points that yield do where forces are in balance, within the step that ends next;
            None: they are at its end.
        near: gives what another run has found close by, from which the local iterations begin; None: they
            begin from the trial state.
    """

    near: Callable[[], Yielding | None] | None = None

    def __init__(self, form: PointForm, comm: MPI.Comm, ids: np.ndarray):
        assert isinstance(form, PlasticForm)
        self.form, self.comm, self.ids = form, comm, ids
        self._trial: Kernel = form.trial_kernel(comm)
        self.start_elastic = False
        self.yielding: Yielding | None = None
        self.balanced: Flow | None = None

    # evaluation -----------------------------------------------------------------------------------
    def evaluate(self, inputs: np.ndarray, tangent: bool, among: np.ndarray | None = None) -> Yielding:
        """Solve the local problems of the points that yield, for inputs (n, form.inputs) of all points, or of
        some of them (rows `among`).

        Raises:
            LocalFailure: at some points there is no solution; the message has their ids. On every rank.
        """
        form, n, nz = self.form, self.form.local_size, self.form.unknowns
        trial, modulus = self._trial(inputs), form.material.modulus
        known = n + len(form.surfaces)
        f = trial[:, n:known].max(axis=1)
        most = self.form.material.farthest * modulus
        with np.errstate(invalid="ignore"):
            finite = np.all(np.isfinite(trial[:, :known]), axis=1) & (f < most)
        least = -_YIELD if self.start_elastic else _YIELD
        rows = np.flatnonzero((f > least * modulus) & finite)
        ids = self.ids if among is None else self.ids[among]
        lost = ids[~finite]
        y = Yielding(
            rows,
            np.ascontiguousarray(inputs[rows]),
            np.ascontiguousarray(trial[rows, :n]),
            self._first_region(trial[rows, known:]),
            np.zeros((len(rows), nz * (1 + nz) if tangent else nz)),
            np.zeros(len(rows), dtype=np.int32),
        )
        known_near = None if self.near is None else self._begin_near(y, among)
        open_ = self._solve_all(y, tangent, known_near)
        # on the surface to rounding, with no flow to speak of: elastic
        idle = open_ & (f[rows] <= -_YIELD * modulus)
        failed = np.concatenate([lost, ids[rows[open_ & ~idle]]])
        everywhere = np.sort(np.concatenate(self.comm.allgather(failed)))
        if len(everywhere):
            names = ", ".join(map(str, everywhere[:10])) + (" ..." if len(everywhere) > 10 else "")
            raise LocalFailure(f"return mapping failed at {len(everywhere)} point(s): {names}")
        if among is not None:
            y.rows = among[y.rows]
        self.yielding = y.without(idle)
        return self.yielding

    def _first_region(self, likely: np.ndarray) -> np.ndarray:
        """Number of the region that is attempted first (n,); `likely` is the trial kernel's for the others
        than the first one."""
        return np.where(likely.max(axis=1) > 0, 1 + likely.argmax(axis=1), 0)

    def _begin_near(self, y: Yielding, among: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Local unknowns (n, nx) of another run close by, and the regions (n,) on which it has found them; -1
        where it has none. They are a little off, so that one iteration is made at least: what is right to
        the tolerance there isn't here."""
        X, region = y.X.copy(), np.full(len(y.rows), -1)
        assert self.near is not None
        other = self.near()
        if other is not None and len(other.rows):
            rows = y.rows if among is None else among[y.rows]
            order = np.argsort(other.rows)
            at = order[np.minimum(np.searchsorted(other.rows[order], rows), len(order) - 1)]
            there = other.rows[at] == rows
            X[there] = other.X[at[there]] + _OFF * (y.X[there] - other.X[at[there]])
            region[there] = other.region[at[there]]
        return X, region

    def _solve_all(
        self, y: Yielding, tangent: bool, near: tuple[np.ndarray, np.ndarray] | None = None
    ) -> np.ndarray:
        """Solve for all yielding points; which of them are left without a solution (n,). Every rank makes
        the same attempts.

        Args:
            near: what is attempted first, see `_begin_near`.
        """
        open_, start, first = np.ones(len(y.rows), dtype=bool), y.X.copy(), y.region.copy()
        numbers = range(len(self.form.regions))

        def attempt(which: np.ndarray, region: int, afresh: bool = True) -> None:
            if reduced(self.comm, int(which.sum())):
                at = np.flatnonzero(which)
                if afresh:
                    y.X[at] = start[at]
                open_[at] = ~self._solve(y, at, region, tangent)

        if near is not None:
            y.X[:] = near[0]
            for k in numbers:
                attempt(near[1] == k, k, afresh=False)
        for k in numbers:
            attempt(open_ & (first == k), k)
        if len(numbers) > 1:
            for k in numbers:
                attempt(open_ & (first != k), k)
        if reduced(self.comm, int(open_.sum())) and (softer := self.form.material.continuation) is not None:
            self._approach(softer, y, open_, start)
            for k in numbers:
                attempt(open_.copy(), k, afresh=False)
        return open_

    def _approach(self, softer: Continuation, y: Yielding, open_: np.ndarray, trial: np.ndarray) -> None:
        """Start values of points on which no attempt has succeeded: solve on the first region for softer
        values of a number of the material, one after the other."""
        at, form = np.flatnonzero(open_), self.form
        numbers = list(form.material.parameters())
        column = form.inputs - len(numbers) + numbers.index(softer.parameter)
        y.X[at], own = trial[at], y.inputs[at, column]
        for value in softer.values:
            y.inputs[at, column], before = value, y.X[at]
            failed = self._run(y, at, 0, False)
            y.X[at[failed]] = before[failed]
        y.inputs[at, column] = own

    def _kernels(self, region: int) -> Return:
        return self.form.return_kernels(self.form.regions[region], self.comm)

    def _solve(self, y: Yielding, which: np.ndarray, region: int, tangent: bool) -> np.ndarray:
        """Solve for some of the yielding points on a region, in place; which of them succeeded."""
        failed = self._run(y, which, region, tangent)
        good, kernels = ~failed, self._kernels(region)
        solved = which[good]
        flow = kernels.flow(y.inputs[solved], y.X[solved, : kernels.size])
        outside = flow[:, 2:] > _OUTSIDE * self.form.material.modulus
        good[good] = (flow[:, 1] >= _BACKWARDS) & ~np.any(outside, axis=1)
        y.region[which[good]] = region
        return good

    def _run(self, y: Yielding, which: np.ndarray, region: int, tangent: bool) -> np.ndarray:
        """Iterate some points from their X in place; which of them have no solution."""
        kernels, form, n = self._kernels(region), self.form, len(which)
        status, iterations = np.zeros(n, dtype=np.int8), np.zeros(n, dtype=np.int32)
        controls = native.Return()
        native.fill(
            controls,
            local=kernels.local.address,
            stress=kernels.stress.address,
            moduli=kernels.moduli.address,
            row_scale=kernels.row_scale,
            tolerance=_TOLERANCE,
            loose=_LOOSE,
            nin=form.inputs,
            nx=kernels.size,
            nz=form.unknowns,
            most=_MOST,
        )
        out_of_memory = native.library().polarmpm_return(
            ctypes.byref(controls),
            n,
            which.astype(np.int64, copy=False),
            y.inputs,
            int(tangent),
            y.X.shape[1],
            y.X,
            y.returned.shape[1],
            y.returned,
            status,
            iterations,
        )
        if out_of_memory:
            raise MemoryError("no memory for the return mapping")
        y.X[which, kernels.size :] = 0.0
        y.iterations[which] += iterations
        failed: np.ndarray = status != 0
        return failed

    # plastic state --------------------------------------------------------------------------------------
    def dissipate(self, share: float) -> None:
        """Forces are in balance in the state at hand, after a share of the step: what points dissipate in it
        is by its stresses."""
        y = self.yielding
        self.balanced = None if y is None else Flow(self._multipliers(y), self.dissipation(), share, y)

    def _multipliers(self, y: Yielding) -> np.ndarray:
        sums: np.ndarray = y.X[:, self.form.hardening_column + 1 :].sum(axis=1)
        return sums

    def _dissipated(self, y: Yielding) -> tuple[np.ndarray, np.ndarray]:
        """Rows of points, and what they dissipate (Pa) in a step that has converged: the flow of the whole
        step times the stresses at which forces are in balance. Where there is flow at one of the two states
        only, or by other regions, it's what that one says, or the earlier one."""
        then, now, self.balanced = self.balanced, self.dissipation(), None
        if then is None or not len(then.work):
            return y.rows, now
        out, known = np.zeros(len(self.ids)), np.full(len(self.ids), -1)
        out[y.rows], out[then.of.rows] = now, then.work / then.share
        known[then.of.rows] = np.arange(len(then.of.rows))
        at = known[y.rows]
        both = (at >= 0) & (then.of.region[at] == y.region) & (then.multipliers[at] > 0.0)
        rows, at = y.rows[both], at[both]
        out[rows] = then.work[at] * self._multipliers(y)[both] / then.multipliers[at]
        flows = np.flatnonzero(out)
        return flows, out[flows]

    def update_plastic_state(self, points: Points, rows: np.ndarray, base: np.ndarray) -> None:
        """Put the flow of a converged step into the plastic state of the points that yield.

        Args:
            points: with their deformation updated already.
            rows: of all points (n,), in `points`.
            base: microrotations (n, 4) of the state's frame at them.
        """
        y, form = self.yielding, self.form
        if y is None:
            return
        at = rows[y.rows]
        flowed, wryness = self.flowed(y.X, base[y.rows], points.q[at], points.F[at], points.wryness[at])
        if wryness is not None:
            points.plastic_wryness = replaced(points.plastic_wryness, at, wryness)
        points.plastic_F = replaced(points.plastic_F, at, flowed)
        points.hardening = replaced(points.hardening, at, y.X[:, form.hardening_column])
        which, more = self._dissipated(y)
        at = rows[which]
        points.dissipation = replaced(points.dissipation, at, points.dissipation[at] + more)

    def flowed(
        self, X: np.ndarray, base: np.ndarray, q: np.ndarray, F: np.ndarray, wryness: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Fp and Gp (n, 3, 3), the latter None of classical materials, of local unknowns and the points' q,
        F and wryness; `base` as of `update_plastic_state`."""
        stretch, elastic = self._tensors(X)
        if not self.form.material.micropolar:
            return np.linalg.solve(stretch, F), None
        if self.form.material.isotropic:
            turn = rotations.to_tensor(base)
            back = np.swapaxes(turn, 1, 2)
            stretch, elastic = back @ stretch @ turn, back @ elastic @ turn
        return np.linalg.solve(rotations.to_tensor(q) @ stretch, F), wryness - elastic

    def dissipation(self) -> np.ndarray:
        """Plastic dissipation (Pa) of the points that yield, since the last converged step, T (4.23)."""
        y = self.yielding
        assert y is not None
        out = np.zeros(len(y.rows))
        for k in range(len(self.form.regions)):
            which = np.flatnonzero(y.region == k)
            if len(which):
                kernels = self._kernels(k)
                out[which] = kernels.flow(y.inputs[which], y.X[which, : kernels.size])[:, 0]
        return out

    def _tensors(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ue and Ge (n, 3, 3) of local unknowns."""
        deformation, wryness = entries(self.form.layout)
        first: np.ndarray = np.zeros((len(X), 3, 3))
        second = np.zeros_like(first)
        for k, (i, j) in enumerate(deformation):
            first[:, i, j] = X[:, k]
        for k, (i, j) in enumerate(wryness):
            second[:, i, j] = X[:, len(deformation) + k]
        return first, second
