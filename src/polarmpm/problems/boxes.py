"""What a problem keeps of the points' boxes: their energy, and the share of the work that is done inside
them."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..bodies.points import Points
from ..errors import TrustWarning
from ..forms.points import PointForm
from ..kernels.kernel import Kernel
from ..tools.caller import warn
from ..tools.parallel import errors_on_all_ranks

# shares of a step's work inside the boxes above which an answer may be far off: while no point has flowed,
# and then, as the boxes of points that have flowed count for little
DOUBTFUL, DOUBTFUL_FLOW = 0.5, 0.2
SMALL = 0.05  # increments (their gradients) of which boxes miss nothing, however large their share is
HOPELESS = 1.0  # above which the boxes alone hold the body
_REMEDY = "take more points a cell (points_per_cell), or smaller cells"


class BoxRecord:
    """Energy and work inside the points' boxes in the course of a run. All methods are collective.

    Attributes:
        kept: energy (J) in the boxes of this rank's points (np,), put in by a restart for the time until
            there is a system again; else None.
        largest: largest share of a step's work inside the boxes so far, and that step's number.
        in_doubt: some step's share was larger than it should be.
    """

    def __init__(self, points: Points, forms: Sequence[PointForm], comm: MPI.Comm):
        self.points, self.forms, self.comm = points, forms, comm
        self.kept: np.ndarray | None = None
        self.largest, self.in_doubt = (0.0, 0), False
        self._kernels: list[Kernel] = []

    def renew(self, forms: Sequence[PointForm]) -> None:
        """Go on with the forms of more materials."""
        if self._kernels:
            more = [form.compile_energy(self.comm) for form in forms[len(self._kernels) :]]
            self._kernels = [*self._kernels, *more]
        self.forms = forms

    def energies(self, system: LoadedPoints | None) -> np.ndarray:
        """Strain energy (J) in the variation over the boxes of this rank's points (np,)."""
        out = np.zeros(len(self.points))
        if system is None:
            return out if self.kept is None else self.kept
        if system.interpolation.boxes is None:
            return out
        if not self._kernels:
            self._kernels = [form.compile_energy(self.comm) for form in self.forms]
        for boxes, kernel in zip(system.interpolation.boxes, self._kernels, strict=False):  # some may be new
            out[boxes.rows] = boxes.energies(kernel, system.x)
        return out

    def energy(self, system: LoadedPoints | None) -> float:
        """The same of all points."""
        total: float = self.comm.allreduce(float(self.energies(system).sum()))
        return total

    def unresolved(self, system: LoadedPoints, start: np.ndarray) -> float | None:
        """Share of the work since increments `start` (nodes, block) that is done inside the boxes;
        that of each point goes to `points.unresolved`. None where points have no boxes.

        Signs are left out of the sums, so that softening and snapping structures, whose whole work is near
        zero, don't look as if nothing of it were resolved.
        """
        if system.interpolation.boxes is None:
            return None
        inside, whole = np.zeros(len(self.points)), np.zeros(len(self.points))
        for boxes, (kernel, _) in zip(system.interpolation.boxes, system.kernels, strict=True):
            inside[boxes.rows], whole[boxes.rows] = boxes.work(kernel, start, system.x)
        own, (initial, residual) = slice(0, system.nodes.owned), (system.step.initial, system.residual)
        assert initial is not None
        moved = (residual - initial)[own] * (system.x - start)[own]
        sums = np.array([np.abs(inside).sum(), np.abs(whole).sum(), moved.sum()])
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        # springs and other terms work, too: a body that moves on them as a whole is no matter of its boxes
        most = max(float(sums[1]), abs(float(sums[2])), np.finfo(float).tiny)
        tiny = 1e-12 * most / max(1, self.points.total)  # points on which nothing happens
        self.points.unresolved = np.minimum(np.abs(inside) / np.maximum(np.abs(whole), tiny), HOPELESS)
        return float(sums[0]) / most

    def refusal(self, share: float | None) -> str:
        """Why a solution with such a share is none; empty where it may be one."""
        if share is None or share <= HOPELESS:
            return ""
        return f"all of the step's work is done inside the points' boxes: there is no equilibrium; {_REMEDY}"

    def note(self, share: float | None, step: int, size: float) -> None:
        """Take note of a converged step; warns, once in a run, of an answer that is in doubt.

        Args:
            size: largest gradient of the increments at this rank's points.
        """
        if share is None:
            return
        self.largest = max(self.largest, (share, step))
        flowed = self.points.plastic and bool(np.any(self.points.hardening > 0.0))
        limit = DOUBTFUL_FLOW if self.comm.allreduce(flowed, op=MPI.LOR) else DOUBTFUL
        if share > limit and self.comm.allreduce(size, op=MPI.MAX) > SMALL:
            warned, self.in_doubt = self.in_doubt, True
            with errors_on_all_ranks(self.comm):  # of warnings a script may make errors
                if self.comm.rank == 0 and not warned:
                    warn(
                        f"step {step}: {100 * share:.0f} % of its work is done inside the points' boxes, "
                        "where neither the grid nor the points resolve it; the answer may be far off: "
                        f"{_REMEDY}",
                        TrustWarning,
                    )

    def state(self) -> list[float]:
        """For a restart file: largest share, its step, and whether the run is in doubt."""
        return [*self.largest, float(self.in_doubt)]

    def restore(self, state: Sequence[float]) -> None:
        """Put in what `state` gave."""
        share, step, doubt = state
        self.largest, self.in_doubt = (float(share), int(step)), bool(doubt)

    def summary(self) -> str:
        """How far the run can be trusted, in a line."""
        share, step = self.largest
        if not step:
            return "no measure of trust: points without boxes, or no step yet"
        verdict = "in doubt: " + _REMEDY if self.in_doubt else "resolved to the grid's own error"
        most = f"at most {100 * share:.0f} % of a step's work is done inside the points' boxes (step {step})"
        return f"{most}: {verdict}"
