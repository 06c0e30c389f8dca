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
from ..terms.base import Term
from ..tools.parallel import warn_on_one_rank
from . import contrast, doubts
from .griddoubts import MANY, GridRecord
from .nearlimit import GIVES_WAY, NearLimit
from .work import StepStart

# shares of a step's work inside the boxes above which an answer may be far off: while no point has flowed,
# where boxes nearly alone hold the body, and then, as the boxes of points that have flowed count for little
DOUBTFUL, DOUBTFUL_FLOW = 0.97, 0.2
# near a limit load: share times how many times as fast as the loads displacements grow, as of two points a
# cell and direction, above which displacements may be a tenth off
NEAR_LIMIT = 0.22
# increments (their gradients) of elastic points of which boxes miss nothing, however large their share is
SMALL = 0.05
MISSED = 0.08  # share that a sum over points without boxes misses: the answer is a tenth off or more
MISSED_GAUSS = 0.15  # of points of quadrature rules, of which what they stand for is guessed, and too large
UNRESISTED = 0.01  # of the work of a balanced reset's motion; 1e-8 to 1e-6 in good runs
LET_GO = 0.03  # of a moving body's energy, lost at resets
HOPELESS = 1.0  # above which the boxes alone hold the body
_REMEDY = "take more points a cell (points_per_cell), or smaller cells"


def unresisted(share: float) -> str:
    """What a balanced reset has done whose motion the material resists with the rest of the work only."""
    return (
        f"{share:.0%} of what a balanced reset has moved to carry stresses on is resisted by nothing, so "
        "that these are ill-determined, as with one point a cell, and answers are noise:"
    )


class BoxRecord:
    """Energy and work inside the points' boxes in the course of a run. All methods are collective.

    Attributes:
        kept: energy (J) in the boxes of this rank's points (np,), put in by a restart for the time until
            there is a system again; else None.
        largest: largest share of a step's work inside the boxes so far, and that step's number.
        in_doubt: some step's share was larger than it should be.
        grid: what strains and stresses say of the grid's own error.
        limit: how far the body is from its limit load.
        sensitive: largest product of that share, as two points a cell and direction would have it, and the
            sensitivity of displacements near a limit load.
    """

    def __init__(self, points: Points, forms: Sequence[PointForm], comm: MPI.Comm):
        self.points, self.forms, self.comm = points, forms, comm
        self.kept: np.ndarray | None = None
        self.largest, self.in_doubt, self.grid = (0.0, 0), False, GridRecord(points, comm)
        self.limit, self.sensitive = NearLimit(), 0.0
        self._as_of_two = 1.0
        self._missed: float | None = None
        self._beside = 0.0
        self._tents = False
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

    def unresolved(
        self, system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None
    ) -> float | None:
        """Share of the work since increments `start` (nodes, block) that is done inside the boxes;
        that of each point goes to `points.unresolved`. None where points have no boxes.

        `gradient`: of the increments at the points (np, d, d), where it is known.

        Signs are left out of the sums, so that softening and snapping structures, whose whole work is near
        zero, don't look as if nothing of it were resolved.
        """
        self.grid.look(system, start, gradient)
        self._beside = 0.0 if self.largest[1] else contrast.beside_stiffer(system, start, gradient)
        if system.interpolation.boxes is None:
            self.grid.weigh(0.0)
            tents = not system.interpolation.basis.fills_boxes
            left_out = system.inertia is not None or self.points.total > MANY
            if not (self.largest[1] or (tents and left_out)):
                self._tents = tents
                self._missed = doubts.missed(system, gradient)
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
        share = float(sums[0]) / most
        self.grid.weigh(share)
        return share

    def refusal(self, share: float | None) -> str:
        """Why a solution with such a share is none; empty where it may be one."""
        if share is None or share <= HOPELESS:
            return ""
        return f"all of the step's work is done inside the points' boxes: there is no equilibrium; {_REMEDY}"

    def note_loads(self, system: LoadedPoints, start: StepStart, terms: Sequence[Term]) -> None:
        """Take note of what loads, some of them `terms`, have done in a step that has converged."""
        if self.points.plastic and system.inertia is None:
            self.limit.note(system, start, terms)
            if self.limit.sensitivity > GIVES_WAY:
                self._as_of_two = _as_of_two(system)
        else:
            self.limit.forget()

    def note(self, share: float | None, step: int, size: float) -> None:
        """Take note of a converged step; warns, once in a run, of an answer that is in doubt.

        Args:
            size: largest gradient of the increments at this rank's points.
        """
        contrast.warn_of_contrast(self.points, self._beside)
        for doubt in self.grid.doubts():
            self._warn(f"step {step}: {doubt}")
        if share is None:
            self._note_missed(step)
        else:
            self._note_share(share, step, size)

    def note_carried(self, share: float) -> None:
        """Take note of the share of the work of a balanced reset's motion that the material doesn't do."""
        if share > UNRESISTED:
            self._warn(f"{unresisted(share)} {_REMEDY}, fewer resets, or another basis")

    def note_let_go(self, energy: float, whole: float) -> None:
        """Take note of the energy (J) that resets of a moving body have let go so far, of a whole."""
        if energy > LET_GO * whole:
            self._warn(
                f"resets have let go {energy / whole:.0%} of the body's energy, which was inside the points' "
                "boxes: the motion loses as much; take smaller cells, or fewer resets (reset=None, "
                "InMotion(limit=...)) where the body doesn't need new nodes"
            )

    def _note_share(self, share: float, step: int, size: float) -> None:
        """Take note of the share inside the boxes."""
        self.largest = max(self.largest, (share, step))
        flowed = self.grid.flows
        large = flowed or self.comm.allreduce(size, op=MPI.MAX) > SMALL
        if share > (DOUBTFUL_FLOW if flowed else DOUBTFUL) and large:
            self._warn(
                f"step {step}: {100 * share:.0f} % of its work is done inside the points' boxes, "
                f"where neither the grid nor the points resolve it; the answer may be far off: {_REMEDY}"
            )
        if flowed:
            self._note_limit(share, step)

    def _note_limit(self, share: float, step: int) -> None:
        """Take note of how near the limit load a body is that flows, with the share inside the boxes."""
        times = self.limit.sensitivity
        if times > GIVES_WAY:
            self.sensitive = max(self.sensitive, times * share * self._as_of_two)
        if self.sensitive > NEAR_LIMIT:
            self._warn(
                f"step {step}: near its limit load the body gives way {times:.1f} times as fast as its loads "
                f"grow, and {100 * share:.2g} % of the step's work is done inside the points' boxes: what "
                "the strength is off, displacements are that many times; take smaller cells, and compare, "
                "or prescribe the motion, and read the load"
            )

    def _note_missed(self, step: int) -> None:
        """Take note of what a sum over points without boxes misses in the first step."""
        if not self.largest[1] and self._missed is not None:
            self.largest = (self._missed, step)
            if self._missed > (MISSED if has_boxes(self.points) else MISSED_GAUSS):
                remedy = (
                    "leave boxes=True, seed without `degree` or layout='gauss', or take more points a cell"
                )
                if self._tents:
                    remedy = "take more points a cell, or the default basis"
                self._warn(
                    f"step {step}: the points have no boxes in this run, and a sum over them misses about "
                    f"{100 * self._missed:.0f} % of the work: the body is too soft; {remedy}"
                )

    def _warn(self, text: str) -> None:
        """Warn, once in a run."""
        if self.in_doubt:
            return
        self.in_doubt = True
        warn_on_one_rank(self.comm, text, TrustWarning)

    def state(self) -> list[float]:
        """For a restart file: largest share, its step, whether the run is in doubt, and whether the share is
        what a sum over the points misses; the grid's."""
        missed = self._missed is not None
        limit = self.sensitive, *self.limit.state()
        return [*self.largest, float(self.in_doubt), float(missed), *limit, *self.grid.state()]

    def restore(self, state: Sequence[float]) -> None:
        """Put in what `state` gave."""
        share, step, doubt, missed, self.sensitive, *rest = map(float, state)
        limit, grid = rest[: len(self.limit.state())], rest[len(self.limit.state()) :]
        self.limit.restore(limit)
        self.largest, self.in_doubt = (float(share), int(step)), bool(doubt)
        self._missed = float(share) if missed else None
        self.grid.restore(grid)

    def summary(self) -> str:
        """How far the run can be trusted, in a line."""
        (share, step), grid = self.largest, self.grid.summary()
        if not (step or grid):
            return "no measure of trust: no step yet in which the body is strained"
        verdict = "in doubt: " + _REMEDY if self.in_doubt else "resolved to the grid's own error"
        most = f"at most {100 * share:.0f} % of a step's work is done inside the points' boxes (step {step})"
        if self._missed is not None:
            most = f"a sum over the points misses about {100 * share:.2g} % of the work (step {step})"
        near = f"near the limit load times the displacements' sensitivity {self.sensitive:.2g}"
        parts = [most] * bool(step) + [near] * bool(self.sensitive) + [grid] * bool(grid)
        return f"{', '.join(parts)}: {verdict}"


def _as_of_two(system: LoadedPoints) -> float:
    """How many times as much of the work would be done inside the boxes with two points a cell and direction,
    of which the grid's own error is the same: that share goes as the squares of the boxes' sizes. Collective.
    """
    i = system.interpolation
    cells = np.prod(i.grid.sizes(i.grid.cells_of(i.reference.x)), axis=1)
    boxes = np.abs(np.linalg.det(2.0 * i.points.half_axes0))
    sums = np.array([cells.sum(), boxes.sum()])
    system.comm.Allreduce(MPI.IN_PLACE, sums)
    return float(max(1.0, 0.25 * (sums[0] / max(sums[1], np.finfo(float).tiny)) ** (2.0 / i.layout.dim)))
