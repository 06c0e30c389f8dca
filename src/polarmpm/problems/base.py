"""What quasi-static problems share, of material points and of finite elements."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.points import Points
from ..bodies.reference import Increments
from ..conditions.loads import point_loads
from ..conditions.prescribed import Prescribed
from ..conditions.proportional import check_loads, check_supports
from ..conditions.supports import Support
from ..errors import InputError, LocalFailure
from ..geometry.nodes import Nodes
from ..solvers import arclength
from ..solvers.arclength import ArcSchedule, Path
from ..solvers.newton import Controls, Outcome
from ..solvers.stepping import Schedule, Step, march
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, reduced
from ..tools.timing import Timer
from . import along, attempts, ranks
from .marching import March
from .observer import Observer
from .reactions import Equilibrium
from .results import Results
from .state import StateFields, check_rows
from .work import StepStart, step_work


class Problem(Results):
    """Equilibrium of a body under slowly changing loads. All methods are collective.

    Attributes:
        progress: load factor and number of steps of the last converged state.
        steps: converged steps so far.
        observers: told what happens in the run, see `Observer`.
        rows: arrays (np, ...) of the script's own by name, one row for each of `points`.
        report: a march says in a line, on standard error, how far it has come and how far to trust the
            answer, unless it is called with progress=False; False turns that off. The level of the logger
            "polarmpm" silences all lines.
        timer: CPU seconds of this rank by phase.
        failed_at: increments (nodes, block) at which the last attempt has failed, for its diagnosis.
        search: how the equilibrium of a step is found.
    """

    def __init__(self, comm: MPI.Comm, points: Points, dim: int, controls: Controls | None):
        super().__init__(comm, points, dim)
        self._note_materials()
        if controls is not None:
            checks.instance("controls", controls, Controls, "polarmpm.Controls(...), or None, is")
        self.controls, self.timer = controls or Controls(), Timer()
        self.observers: list[Observer] = []
        self._probes: dict[str, Any] = {}
        self.report = True
        self.rows: dict[str, np.ndarray] = {}
        self.steps: list[Step] = []
        self._fields = StateFields(comm)
        self._last_x: np.ndarray | None = None  # where the points were before the last step
        self.failed_at: np.ndarray | None = None
        self.search = attempts.Search()

    # what the methods differ in -------------------------------------------------------------------
    @abstractmethod
    def _prepare(self) -> NodalSystem:
        """The system in which the next step is to be solved."""

    @abstractmethod
    def _put_loads(self, system: Any, factor: float | None) -> None:
        """Put the loads of a load factor into the system; None: those of the last converged step."""

    @abstractmethod
    def _increments(self, system: Any) -> Increments:
        """Increments at the local points."""

    @abstractmethod
    def volume_ratios(self, increments: Increments) -> np.ndarray:
        """J (np,) after increments of the local points, relative to some state in which it is positive."""

    @abstractmethod
    def _check(self, increments: Increments) -> str:
        """Why a solution is not acceptable; empty when it is."""

    def _trust(self, system: Any, start: StepStart, at_points: Increments, outcome: Outcome) -> None:
        """Measure how far an acceptable solution, from a step's `start` on to increments `at_points`, can be
        trusted; it may be refused."""

    def _close(self, system: Any) -> None:
        """Close what resets have carried along at the positions of a converged step."""

    def _note(self, outcome: Outcome) -> None:
        """Take note of what `_trust` has found, of a step that is converged and committed."""

    @abstractmethod
    def _commit(self, system: Any, increments: Increments, factor: float) -> None:
        """Make a solution the body's state."""

    @property
    def _couples_act(self) -> bool:
        """Whether there are dead couples at points."""
        return any(load.couple for load in self.loads)

    def _loads_at(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Dead forces (np, d) and couples (np, r) at the local points at a load factor."""
        with errors_on_all_ranks(self.comm):
            return point_loads(self.loads, self.points, self.layout, factor)

    # solving --------------------------------------------------------------------------------------
    def march(
        self,
        steps: int | None = None,
        *,
        to: float = 1.0,
        adaptive: bool = False,
        smallest: float = 1e-3,
        largest: float | None = None,
        easy: int = 6,
        progress: bool | None = None,
        creep: bool = True,
    ) -> Iterator[Step]:
        """Raise the load factor in load steps, while it is iterated over; yields every converged step.

        Args:
            steps: number of equal steps from the present factor to `to`; of adaptive ones the first, and
                largest, step follows from it (default 10).
            to: final load factor.
            adaptive: cut a step that fails and retry from the last converged state, then grow again, up to
                the first step's size or, with `largest`, beyond.
            smallest: smallest adaptive step, relative to the first one.
            largest: load factor increment to which adaptive steps may grow.
            easy: an adaptive step of at most so many iterations lets the next one grow.
            progress: show a progress bar (default: on a terminal and in notebooks); False also leaves the
                line at the end out, see `report`.
            creep: follow a plastic body as it creeps where its step can't be cut any more.

        Raises:
            InputError: an argument is out of range; another march has taken steps since, or another problem
                has taken the body on.
            NotConverged: with what was tried and found; the last converged state is intact.
            PointsOutsideGrid: points have left the grid, and it is to be reset.
        """
        return self._march(Schedule(steps, to, adaptive, smallest, largest, easy, progress, creep=creep))

    def _march(self, schedule: Schedule) -> Iterator[Step]:
        return March(self, march, schedule, "adaptive" if schedule.adaptive else "equal")

    @collective("system_at")
    def system_at(self, factor: float) -> NodalSystem:
        """The nodal system in which equilibrium at a load factor is sought, at the increments that the last
        step has led to, with the loads of that factor; `evaluate(True)` makes its residual and tangent."""
        factor = _factor(factor)

        def make() -> NodalSystem:
            self._use_materials(self._settled)
            system = self._ready()
            self._change_materials(factor)
            self._put_loads(system, factor)
            system.set_prescribed(self._prescribed_at(system, factor))
            return system

        with self._solving("system_at"):
            return self.whole(make)

    @contextmanager
    def _solving(self, what: str) -> Iterator[None]:
        """While a load step is prepared or solved; what a script may have put in wrongly is checked first."""
        with self._turn(what):
            checks.instance("controls", self.controls, Controls, "polarmpm.Controls(...) is")
            checks.instance("rows", self.rows, dict, "a dict of arrays by name is")
            what = "objects of a class of polarmpm.Observer are"
            for observer in checks.instance("observers", self.observers, list, "a list is"):
                checks.instance("observers", observer, Observer, what).check()
            if self.rows:
                with errors_on_all_ranks(self.comm):
                    for name, rows in self.rows.items():
                        check_rows(name, rows, len(self.points))
            yield

    def _prescribed_at(self, system: NodalSystem, factor: float) -> np.ndarray:
        return system.prescribed.increments(factor)

    def suited(self, size: float) -> float:
        """The size of the next step where errors are controlled; here they aren't."""
        return size

    def attempt(self, factor: float) -> Outcome:
        """Try to find equilibrium at a load factor; on failure everything stays as it was.

        Raises:
            InputError: not a finite load factor; the body or the progress have been changed since the last
                step, such as by another problem; or this is called from within a load step.
        """
        factor = _factor(factor)
        with ranks.step(self, f"the step to load factor {factor:.9g}", factor), self._solving("attempt"):
            return self.whole(partial(self._attempt_or_fall_back, factor))

    def attempt_creeping(self, factor: float) -> Outcome:
        """The same where `attempt` has failed, by `attempts.creep`; bodies that don't yield fail at once."""
        factor = _factor(factor)
        with ranks.step(self, f"the step to load factor {factor:.9g}", factor), self._solving("attempt"):
            return self.whole(partial(attempts.creeping, self, partial(self._attempt, factor)))

    def _attempt_or_fall_back(self, factor: float) -> Outcome:
        outcome = self._attempt(factor)
        if not outcome.converged and self._fall_back():
            tried, outcome = outcome.history, self._attempt(factor)
            outcome.history[:0] = tried
            self._fell_back(outcome.converged)
        return outcome

    def _fall_back(self) -> bool:
        """After a step that has failed: whether another way is worth trying; sets it up. Collective."""
        return False

    def _fell_back(self, converged: bool) -> None:
        """Go on in that way, or return to the one before."""

    def _attempt(self, factor: float) -> Outcome:
        self._check_fades(factor)
        self._use_materials(self._settled)
        system = self._ready()
        with self.timer("conditions"):
            self._change_materials(factor)
            start = self._begin(system, factor)
            increments = self._prescribed_at(system, factor)
            system.set_prescribed(increments)
        outcome = self.search.at_factor(system, start.x, increments, self.controls)
        self._finish(system, start, outcome, factor)
        self._settle_materials(outcome.converged)
        return outcome

    @collective("march_arc_length", compare=True)
    def march_arc_length(
        self,
        first: float,
        *,
        until: Callable[[Step], bool] | None = None,
        largest: float | None = None,
        smallest: float = 1e-3,
        to: float | None = None,
        steps: int | None = None,
        progress: bool | None = None,
    ) -> Iterator[Step]:
        """Follow the path of equilibrium past limit points of the load; yields every converged step.

        The load factor is found; a step has a length, the root of the mean square displacement increment of
        the body (docs/theory.md). The path goes on in the direction of the last step; from the unloaded
        state the load factor grows. Loads are linear in the load factor, supports don't depend on it.

        Args:
            first: length of the first step (m).
            until: called with each converged step on all ranks; the march ends when rank 0 gets True.
            largest: to which steps may grow (m); default: `first`.
            smallest: smallest step to try, relative to the first one.
            to: load factor at which the march ends, exactly.
            steps: number of steps after which it ends.
            progress: show a progress line (default: on a terminal).

        Raises:
            InputError: none of `until`, `to` and `steps` is given; an argument is out of range; couples in
                space, followers, or conditions on surfaces of material points; loads or supports that depend
                on the load factor in another way than said.
            NotConverged: with what was tried and found; the last converged state is intact.
            PointsOutsideGrid: points have left the grid and it is to be reset for the next step.
        """
        schedule = ArcSchedule(first, until, largest, smallest, to, steps, progress)
        with self._solving("march_arc_length"):
            ready = self.system is not None and not (self._stale or self.progress.reset_due)
            (self.whole if ready else self.tried)(self._check_path)
        return March(self, arclength.march, schedule, "arc length")

    def _check_path(self) -> None:
        """Raise InputError unless all loads, terms and supports are such as the arc-length method takes."""
        system = self._prepare()
        self._check_changes_at_once()
        with errors_on_all_ranks(self.comm):
            places = self._load_places()
        apart = [term.name for term in self.terms if not term.proportional]
        if apart:
            raise InputError(
                f"{apart[0]}: the arc-length method takes terms only whose forces are linear in the load "
                "factor and whose growth with it doesn't depend on the displacements"
            )
        check_loads(self.comm, places, along.growth_of_terms(self, system))
        check_supports(self.comm, system.prescribed)

    def attempt_along(
        self, length: float, to: float | None = None, kink: bool = False
    ) -> tuple[Outcome, float]:
        """Try a step of a length (m) along the path, which ends at the load factor `to` if it meets it; on
        failure everything stays as it was. With `kink` the step may turn off its tangent. Returns the load
        factor found, too. That loads and supports are such as they have to be is checked by
        `march_arc_length`."""
        length = arclength.check_length("length", length)
        to, kink = None if to is None else _factor(to, "to"), checks.flag("kink", kink)
        with (
            ranks.step(self, f"the step of length {length:.9g} m", 1.0),
            self._solving("attempt_along"),
        ):
            return self.whole(partial(self._along_or_fall_back, length, to, kink))

    def _along_or_fall_back(self, length: float, to: float | None, kink: bool) -> tuple[Outcome, float]:
        outcome, found = self._attempt_along(length, to, kink)
        if not outcome.converged and self._fall_back():
            tried = outcome.history
            outcome, found = self._attempt_along(length, to, kink)
            outcome.history[:0] = tried
            self._fell_back(outcome.converged)
        return outcome, found

    def _attempt_along(self, length: float, to: float | None, kink: bool) -> tuple[Outcome, float]:
        self._use_materials(self._settled)
        system, p = self._ready(), self.progress
        with self.timer("conditions"):
            self._change_materials(p.factor)
            ends = []
            for factor in (0.0, 1.0):
                self._put_loads(system, factor)
                ends.append(system.loads.copy())
            start = self._begin(system, p.factor)
            system.set_prescribed(self._prescribed_at(system, p.factor))
            loads = ends[0], ends[1] - ends[0] - along.growth_of_terms(self, system)
            volumes = system.node_volumes()
        path = Path(system, loads, volumes, length, p.factor, lambda x: along.sense(self, system, x))
        path.bend = arclength.least_cosine(kink)
        outcome = self.search.along(path, self.controls, to)
        if outcome.converged:
            self._put_loads(system, path.factor)
        moved = along.moved(self, system, path.start, system.x) if path.settled else None
        self._finish(system, start, outcome, path.factor)
        self._settle_materials(outcome.converged)
        if outcome.converged and moved is not None:  # what relaxed before tells nothing about the path
            self._last_x = self.points.x - moved
        return outcome, path.factor

    def _ready(self) -> NodalSystem:
        """The system of the next step, whose terms know where it begins."""
        system = self._prepare()
        system.terms.starts(system.x)
        return system

    def _begin(self, system: NodalSystem, factor: float) -> StepStart:
        """Set the loads of a step; in the first one they grow from nothing, but for a body at rest."""
        before = np.zeros_like(system.x)
        if self.progress.step or self.at_rest:
            self._put_loads(system, None)
            with system.terms.as_they_are():
                before = system.working_loads()
        self._put_loads(system, factor)
        try:
            new = system.working_loads()
        except LocalFailure:  # there are none; the iterations will say so
            with system.terms.as_they_are():
                new = system.working_loads()
        return StepStart(system.x.copy(), before, new)

    def _finish(self, system: NodalSystem, start: StepStart, outcome: Outcome, factor: float) -> None:
        """Make an acceptable solution the body's state, or put back what was there."""
        with self.timer("update"):
            if outcome.converged:
                at_points = self._increments(system)
                outcome.reason = self._check(at_points)
                outcome.converged = not outcome.reason
            if outcome.converged:
                self._trust(system, start, at_points, outcome)
            if outcome.converged:
                external, carried = self._work(system, start)
                self.progress.external_work += external
                self.progress.carried_work += carried
                self._close(system)
                self._equilibrium = self._forces(system)
                self._last_x, self.progress.factor_change = self.points.x, factor - self.progress.factor
                ranks.tell(self, "after_convergence", factor)
                for term in self.terms:
                    term.end_at(factor)
                self._commit_terms(system, start.x)
                base = self.progress.rotation_factor
                self._commit(system, at_points, factor)
                self._leave(changed=True)
                self._note(outcome)
                system.prescribed.start_from(factor, system.x)
                self._settle()
                ranks.tell(self, "after_commit", self.progress.rotation_factor != base)
            else:
                self.failed_at, system.x = system.x, start.x
                system.flow_in_boxes(False)

    def _work(self, system: NodalSystem, start: StepStart) -> tuple[float, float]:
        """Work (J) of a step that has converged, see `step_work`. Collective."""
        return step_work(system, start, system.working_loads(), self._left(system.nodes))

    def _forces(self, system: NodalSystem) -> Equilibrium:
        """What acts on the body at the end of a step that has converged. Collective."""
        return Equilibrium.of(system)

    def _commit_terms(self, system: NodalSystem, start: np.ndarray) -> None:
        """Tell the terms of a step that has converged, from increments (nodes, block) at its start."""
        works = system.terms.work(start, system.x)
        self.progress.ghost_work += works.pop("ghost", 0.0)
        held = system.holding_energy(system.x) - system.holding_energy(start)
        self.progress.patch_work += reduced(self.comm, held)
        self.progress.term_work += sum(works.values())
        system.terms.commit(system.x)
        for term in self.terms:
            term.committed = True
            term.finished()

    def _tell_of_reset(self) -> None:
        ranks.tell(self, "after_reset")

    def _prescribed(self, nodes: Nodes, supports: Sequence[Support] | None = None) -> Prescribed:
        """Prescribed unknowns of some supports; by default of those that act."""
        with self.timer("conditions"):
            acting = self.supports if supports is None else supports
            made = Prescribed(nodes, acting, self.layout, self.comm, self.cell_size)
            ranks.check_masks(made, nodes)
            made.start_from(self.progress.factor, made.base)
            return made

    # restart --------------------------------------------------------------------------------------
    def kept(self) -> dict[str, np.ndarray]:
        """What is kept for each local point from step to step, beside its state: rows (np, ...) by name.

        Raises:
            InputError: the body isn't any more as this problem has left it.
        """
        self._check_left()
        last = {} if self._last_x is None else {"last_x": self._last_x}
        return last | {f"rows.{k}": a for k, a in self.rows.items()} | self.term_rows() | self.load_rows()

    def keep(self, rows: dict[str, np.ndarray]) -> None:
        """Put in rows such as those of `kept`."""
        self.rows = {name[5:]: a for name, a in rows.items() if name.startswith("rows.")}
        self.restore_term_rows(rows)
        self.restore_load_rows(rows)
        self._last_x = rows.get("last_x")


def _factor(value: Any, name: str = "factor") -> float:
    return checks.number(name, value, allowed="a finite load factor")
