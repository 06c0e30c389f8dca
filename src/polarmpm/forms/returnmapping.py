"""Return mapping: which points yield, their stresses and consistent tangents, and their plastic history.

Elastic points cost one evaluation of the yield function. Those that yield are gathered and solved in batches
by compiled code; kernels are compiled when the first point needs them. Where the smooth part of the yield
surface has no admissible solution, the apex is tried, and the other way round.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points
from ..errors import LocalFailure
from ..kernels import native
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from .plastic import PlasticForm, Return, entries
from .points import PointForm

# Yield function over elastic modulus from which on a point counts as yielding. A point that yielded in the
# last step sits on the surface: its tangent at the start of a step is the elastoplastic one.
_YIELD = -1e-10
_HOPELESS = 10.0  # what an iterate that runs away asks of a point; not worth an attempt
_TOLERANCE = 1e-13  # of the local residual, as a strain
_LOOSE = 1e-9  # accepted where rounding ends the iteration; T 4.3.3 uses it throughout
_BACKWARDS = -1e-8  # a strain: flow that is no more than rounding
_TIPS = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)  # rounded tips over k, see `_round_tip`
_MOST = 60  # local iterations, halved steps included


@dataclass
class Yielding:
    """Points that yield in the present state.

    Attributes:
        rows: which of the points (n,).
        inputs, X: kernel inputs and local unknowns, row by row.
        apex: on which part of the yield surface (n,) bool.
        blocks: s and, if asked, the consistent tangent per reference volume, (n, nz (1 + nz)).
        iterations: local iterations (n,).
    """

    rows: np.ndarray
    inputs: np.ndarray
    X: np.ndarray
    apex: np.ndarray
    blocks: np.ndarray
    iterations: np.ndarray

    def without(self, left_out: np.ndarray) -> Yielding:
        """The others of the points (n,) bool."""
        if not np.any(left_out):
            return self
        keep = ~left_out
        return Yielding(*(getattr(self, f.name)[keep] for f in fields(self)))


class ReturnMapping:
    """Return mapping for the points of one elastoplastic material. Collective.

    Args:
        form: its form.
        ids: permanent ids of the points (n,), for messages.

    Attributes:
        start_elastic: points on the yield surface, with no flow, are elastic.
        yielding: what the last evaluation found.
    """

    def __init__(self, form: PointForm, comm: MPI.Comm, ids: np.ndarray):
        assert isinstance(form, PlasticForm)
        self.form, self.comm, self.ids = form, comm, ids
        self._trial: Kernel = form.trial_kernel(comm)
        self.start_elastic = False
        self.yielding: Yielding | None = None

    # evaluation -----------------------------------------------------------------------------------
    def evaluate(self, inputs: np.ndarray, tangent: bool) -> Yielding:
        """Solve the local problems of the points that yield, for inputs (n, form.inputs) of all points.

        Raises:
            LocalFailure: at some points there is no solution; the message has their ids. On every rank.
        """
        form, n = self.form, self.form.local_size
        trial = self._trial(inputs)
        f = trial[:, n]
        with np.errstate(invalid="ignore"):
            finite = np.all(np.isfinite(trial[:, : n + 1]), axis=1) & (f < _HOPELESS * form.material.modulus)
        least = -_YIELD if self.start_elastic else _YIELD
        rows = np.flatnonzero((f > least * form.material.modulus) & finite)
        lost = self.ids[~finite]
        nz = form.layout.unknowns
        y = Yielding(
            rows,
            np.ascontiguousarray(inputs[rows]),
            np.ascontiguousarray(trial[rows, :n]),
            (trial[rows, n + 1] > 0) if form.material.has_apex else np.zeros(len(rows), dtype=bool),
            np.zeros((len(rows), nz * (1 + nz) if tangent else nz)),
            np.zeros(len(rows), dtype=np.int32),
        )
        open_ = self._solve_all(y, tangent)
        # on the surface to rounding, with no flow to speak of: elastic
        idle = open_ & (f[rows] <= -_YIELD * form.material.modulus)
        failed = np.concatenate([lost, self.ids[rows[open_ & ~idle]]])
        everywhere = np.sort(np.concatenate(self.comm.allgather(failed)))
        if len(everywhere):
            names = ", ".join(map(str, everywhere[:10])) + (" ..." if len(everywhere) > 10 else "")
            raise LocalFailure(f"return mapping failed at {len(everywhere)} point(s): {names}")
        self.yielding = y.without(idle)
        return self.yielding

    def _solve_all(self, y: Yielding, tangent: bool) -> np.ndarray:
        """Solve for all yielding points; which of them are left without a solution (n,)."""
        open_, start = np.ones(len(y.rows), dtype=bool), y.X.copy()

        def attempt(which: np.ndarray, apex: bool, afresh: bool = True) -> None:
            if self.comm.allreduce(int(which.sum())):
                at = np.flatnonzero(which)
                if afresh:
                    y.X[at] = start[at]
                open_[at] = ~self._solve(y, at, apex, tangent)

        first = y.apex.copy()
        attempt(~first, False)
        has_apex = self.form.material.has_apex
        if has_apex:
            attempt(first, True)
            attempt(first & open_, False)
            attempt(open_.copy(), True)
        if "tip" in self.form.material.parameters() and self.comm.allreduce(int(open_.sum())):
            self._round_tip(y, open_, start)
            attempt(open_.copy(), False, afresh=False)
            if has_apex:
                attempt(open_.copy(), True, afresh=False)
        return open_

    def _round_tip(self, y: Yielding, open_: np.ndarray, trial: np.ndarray) -> None:
        """Start values close to the apex: solve for a rounded tip, and sharpen it step by step.

        There the direction of flow on the sharp cone turns with the smallest change of stress, and Newton's
        method gets nowhere from the trial state.
        """
        at, form = np.flatnonzero(open_), self.form
        numbers = form.material.parameters()
        column = form.inputs - len(numbers) + list(numbers).index("tip")
        X, inputs = trial[at], y.inputs[at]
        for tip in [share * numbers["k"] for share in _TIPS if share * numbers["k"] > numbers["tip"]]:
            inputs[:, column] = tip
            new, _, failed, iterations = self._run(False, inputs, X, False)
            X = np.where(failed[:, None], X, new)
            y.iterations[at] += iterations
        y.X[at] = X

    def _kernels(self, apex: bool) -> Return:
        return self.form.return_kernels(apex, self.comm)

    def _solve(self, y: Yielding, which: np.ndarray, apex: bool, tangent: bool) -> np.ndarray:
        """Solve for some of the yielding points on one part of the surface; which of them succeeded."""
        inputs = y.inputs[which]
        X, blocks, failed, iterations = self._run(apex, inputs, y.X[which], tangent)
        good = ~failed
        flow = self._kernels(apex).flow(inputs[good], X[good])
        good[good] = flow[:, 1] >= _BACKWARDS
        solved = which[good]
        y.X[which] = X
        y.blocks[solved], y.apex[solved] = blocks[good], apex
        y.iterations[which] += iterations
        return good

    def _run(
        self, apex: bool, inputs: np.ndarray, X: np.ndarray, tangent: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """X, blocks, whether it failed, and iterations of points from initial values of X."""
        kernels, form, n = self._kernels(apex), self.form, len(inputs)
        nz = form.layout.unknowns
        X, inputs = X.copy(), np.ascontiguousarray(inputs)
        blocks = np.zeros((n, nz * (1 + nz) if tangent else nz))
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
            nx=form.local_size,
            nz=nz,
            most=_MOST,
        )
        out_of_memory = native.library().polarmpm_return(
            ctypes.byref(controls),
            n,
            inputs,
            int(tangent),
            X,
            blocks,
            status,
            iterations,
        )
        if out_of_memory:
            raise MemoryError("no memory for the return mapping")
        return X, blocks, status != 0, iterations

    # history --------------------------------------------------------------------------------------
    def update_history(self, points: Points, rows: np.ndarray, base: np.ndarray) -> None:
        """Put the flow of a converged step into the history of the points that yield.

        Args:
            points: with their deformation updated already.
            rows: of the points that yield, in `points`.
            base: microrotations (n, 4) of the state's frame at them.
        """
        y, form = self.yielding, self.form
        assert y is not None
        stretch, wryness = self._tensors(y.X)
        if form.material.micropolar:
            if form.material.isotropic:
                turn = rotations.to_tensor(base)
                back = np.swapaxes(turn, 1, 2)
                stretch, wryness = back @ stretch @ turn, back @ wryness @ turn
            stretch = rotations.to_tensor(points.q[rows]) @ stretch
            points.plastic_wryness[rows] = points.wryness[rows] - wryness
        points.plastic_F[rows] = np.linalg.solve(stretch, points.F[rows])
        points.hardening[rows] = y.X[:, form.local_size - 2]
        points.dissipation[rows] += self.dissipation()

    def dissipation(self) -> np.ndarray:
        """Plastic dissipation (Pa) of the points that yield, since the last converged step, T (4.23)."""
        y = self.yielding
        assert y is not None
        out = np.zeros(len(y.rows))
        for apex in (False, True):
            which = np.flatnonzero(y.apex == apex)
            if len(which):
                flow = self._kernels(apex).flow
                out[which] = flow(y.inputs[which], y.X[which])[:, 0]
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
