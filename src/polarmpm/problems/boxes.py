"""What a problem keeps of the points' boxes: their energy, and the share of the work that is done inside
them."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..assembly.pointboxes import has_boxes
from ..bodies.points import Points
from ..errors import TrustWarning
from ..forms.points import PointForm
from ..kernels.kernel import Kernel
from ..tools.caller import warn
from ..tools.parallel import errors_on_all_ranks
from . import doubts

# shares of a step's work inside the boxes above which an answer may be far off: while no point has flowed,
# and then, as the boxes of points that have flowed count for little
DOUBTFUL, DOUBTFUL_FLOW = 0.5, 0.2
# increments (their gradients) of elastic points of which boxes miss nothing, however large their share is
SMALL = 0.05
MISSED = 0.08  # share that a sum over points without boxes misses: the answer is a tenth off or more
MISSED_GAUSS = 0.15  # of points of quadrature rules, of which what they stand for is guessed, and too large
ROUGH = 0.17  # of strain increments of bodies that flow (`doubts.roughness`): the grid's own error
COARSE = 0.1  # roughness of an elastic body in the first step, by tents: about the answer's error
HOPELESS = 1.0  # above which the boxes alone hold the body
SLIGHT = 0.1  # of the largest strain increments of a step: of what is less the roughness means nothing
_REMEDY = "take more points a cell (points_per_cell), or smaller cells"


class BoxRecord:
    """Energy and work inside the points' boxes in the course of a run. All methods are collective.

    Attributes:
        kept: energy (J) in the boxes of this rank's points (np,), put in by a restart for the time until
            there is a system again; else None.
        largest: largest share of a step's work inside the boxes so far, and that step's number.
        in_doubt: some step's share was larger than it should be.
        rough: largest roughness of a step's strains so far, looked at in a body that flows: in the first of
            its steps, the second, fourth, eighth ...
    """

    def __init__(self, points: Points, forms: Sequence[PointForm], comm: MPI.Comm):
        self.points, self.forms, self.comm = points, forms, comm
        self.kept: np.ndarray | None = None
        self.largest, self.in_doubt, self.rough = (0.0, 0), False, 0.0
        self._missed: float | None = None
        self._flowing, self._rough, self._strained = 0, 0.0, 0.0
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
        self._doubt(system, start)
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

    def _doubt(self, system: LoadedPoints, start: np.ndarray) -> None:
        """Estimate what the share inside the boxes doesn't know: of splines only."""
        if not system.interpolation.basis.fills_boxes:
            self._look_at_tents(system, start)
            return
        if system.interpolation.boxes is None and not self.largest[1]:
            self._missed = doubts.missed(system)
        if not self.points.plastic:
            return
        flows = any(m is not None and m.yielding is not None for m in system.mappings)
        if self.comm.allreduce(flows or bool(np.any(self.points.hardening > 0.0)), op=MPI.LOR):
            self._flowing += 1
            if self._flowing & (self._flowing - 1) == 0:
                rough, size = doubts.roughness(system, start)
                self._strained = max(self._strained, size)
                if size > SLIGHT * self._strained:  # or there is little but rounding
                    self._rough = rough

    def _look_at_tents(self, system: LoadedPoints, start: np.ndarray) -> None:
        """How rough the strains of an elastic body are in its first step in which it is strained: where
        gradients jump between cells, the jumps tell how stiff the body is made."""
        if self.points.plastic or self._flowing or system.inertia is not None:
            return
        rough, size = doubts.roughness(system, start)
        if size > doubts.ROUNDING:
            self._flowing, self._rough = 1, rough

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
            self._note_missed(step)
            return
        self.largest = max(self.largest, (share, step))
        flowed = self._flowing > 0
        large = flowed or self.comm.allreduce(size, op=MPI.MAX) > SMALL
        if share > (DOUBTFUL_FLOW if flowed else DOUBTFUL) and large:
            self._warn(
                f"step {step}: {100 * share:.0f} % of its work is done inside the points' boxes, "
                f"where neither the grid nor the points resolve it; the answer may be far off: {_REMEDY}"
            )
        self._note_rough(step)

    def _note_missed(self, step: int) -> None:
        """Take note of what a sum over points without boxes misses in the first step."""
        if not self.largest[1] and self._missed is not None:
            self.largest = (self._missed, step)
            if self._missed > (MISSED if has_boxes(self.points) else MISSED_GAUSS):
                self._warn(
                    f"step {step}: the points have no boxes, and a sum over them misses about "
                    f"{100 * self._missed:.0f} % of the work: the body is too soft; leave boxes=True, seed "
                    "without `degree` or layout='gauss', or take more points a cell"
                )
        self._note_rough(step)

    def _note_rough(self, step: int) -> None:
        """Take note of how rough the strains of a body that flows are."""
        if not self.points.plastic and self._rough > COARSE >= self.rough:
            self._warn(
                f"step {step}: {100 * self._rough:.0f} % of the strains' squares are rough over two cells, "
                "and the body is about as much too stiff: take smaller cells, or the default basis"
            )
        elif self.points.plastic and self._rough > ROUGH >= self.rough:
            self._warn(
                f"step {step}: the body flows, and {100 * self._rough:.0f} % of its strains' squares aren't "
                "smooth over two cells: loads may be more than a tenth off; take smaller cells, and compare"
            )
        self.rough = max(self.rough, self._rough)

    def _warn(self, text: str) -> None:
        """Warn, once in a run."""
        warned, self.in_doubt = self.in_doubt, True
        with errors_on_all_ranks(self.comm):  # of warnings a script may make errors
            if self.comm.rank == 0 and not warned:
                warn(text, TrustWarning)

    def state(self) -> list[float]:
        """For a restart file: largest share, its step, whether the run is in doubt; roughness, number of
        steps of a body that flows, and their largest strain."""
        return [*self.largest, float(self.in_doubt), self.rough, float(self._flowing), self._strained]

    def restore(self, state: Sequence[float]) -> None:
        """Put in what `state` gave."""
        share, step, doubt, rough, flowing, strained = state
        self.largest, self.in_doubt = (float(share), int(step)), bool(doubt)
        self.rough, self._rough = float(rough), float(rough)
        self._flowing, self._strained = int(flowing), float(strained)

    def summary(self) -> str:
        """How far the run can be trusted, in a line."""
        share, step = self.largest
        if not step and self.rough and not self.points.plastic:
            doubt = "in doubt: take smaller cells" if self.in_doubt else "no more is known of this basis"
            return f"{100 * self.rough:.2g} % of the strains' squares aren't smooth over two cells: {doubt}"
        if not step:
            return "no measure of trust: points without boxes, or no step yet"
        verdict = "in doubt: " + _REMEDY if self.in_doubt else "resolved to the grid's own error"
        most = f"at most {100 * share:.0f} % of a step's work is done inside the points' boxes (step {step})"
        if self._missed:
            most = (
                f"a sum over points without boxes misses about {100 * share:.2g} % of the work (step {step})"
            )
        if self.rough and self.points.plastic:
            most += f", strains of the flowing body are rough by {100 * self.rough:.2g} %"
        return f"{most}: {verdict}"
