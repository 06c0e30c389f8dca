"""What quasi-static problems share, of material points and of finite elements."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.points import Points
from ..bodies.reference import Increments
from ..conditions.prescribed import Prescribed
from ..conditions.proportional import check_loads, check_supports
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.stresses import MaterialField
from ..geometry.nodes import Nodes
from ..solvers import arclength
from ..solvers.arclength import ArcSchedule, Path
from ..solvers.newton import Controls, Outcome
from ..solvers.stepping import Schedule, Step, march
from ..terms.surfaces import SurfaceSupport
from ..tools.parallel import errors_on_all_ranks
from ..tools.timing import Timer
from . import along, attempts
from .observer import Observer
from .reactions import Balance, Equilibrium, Reaction, point_about, surface_reaction
from .release import Releasable
from .state import Fields, StateFields, choose_fields
from .work import StepStart, step_work


class Problem(Releasable):
    """Equilibrium of a body under slowly changing loads. All methods are collective.

    Attributes:
        progress: load factor and number of steps of the last converged state.
        steps: converged steps so far.
        observers: told what happens in the run, see `Observer`.
        rows: arrays (np, ...) of the script's own by name, one row for each of `points`.
        timer: CPU seconds of this rank by phase.
    """

    def __init__(self, comm: MPI.Comm, points: Points, dim: int, controls: Controls | None):
        super().__init__(comm, points, dim)
        self.controls, self.timer = controls or Controls(), Timer()
        self.observers: list[Observer] = []
        self.rows: dict[str, np.ndarray] = {}
        self.steps: list[Step] = []
        self._fields = StateFields(comm)
        self._last_x: np.ndarray | None = None  # where the points were before the last step

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
    def _check(self, increments: Increments) -> str:
        """Why a solution is not acceptable; empty when it is."""

    def _trust(self, system: Any, start: np.ndarray, outcome: Outcome) -> None:
        """Measure how far an acceptable solution, from increments `start` (nodes, block) on, can be trusted;
        it may be refused."""

    def _close(self, system: Any) -> None:
        """Close what resets have carried along at the positions of a converged step."""

    def _note(self, outcome: Outcome) -> None:
        """Take note of what `_trust` has found, of a step that is converged and committed."""

    @abstractmethod
    def _commit(self, system: Any, increments: Increments, factor: float) -> None:
        """Make a solution the body's state."""

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
    ) -> Iterator[Step]:
        """Raise the load factor in load steps; yields every converged step.

        Args:
            steps: number of equal steps from the present factor to `to`; of adaptive ones the first, and
                largest, step follows from it (default 10).
            to: final load factor.
            adaptive: cut a step that fails and retry from the last converged state, then grow again, up to
                the first step's size or, with `largest`, beyond.
            smallest: smallest adaptive step, relative to the first one.
            largest: load factor increment to which adaptive steps may grow.
            easy: an adaptive step of at most so many iterations lets the next one grow.
            progress: show a progress bar (default: on a terminal).

        Raises:
            InputError: an argument is out of range.
            NotConverged: with what was tried; the last converged state is intact.
            PointsOutsideGrid: points have left the grid and it is to be reset for the next step.
        """
        return march(self, Schedule(steps, to, adaptive, smallest, largest, easy, progress))

    def system_at(self, factor: float) -> NodalSystem:
        """The nodal system in which equilibrium at a load factor is sought, at the increments that the last
        step has led to, with the loads of that factor; `evaluate(True)` makes its residual and tangent."""

        def make() -> NodalSystem:
            system = self._prepare()
            self._put_loads(system, factor)
            system.set_prescribed(self._prescribed_at(system, factor))
            return system

        return self.whole(make)

    def _prescribed_at(self, system: NodalSystem, factor: float) -> np.ndarray:
        return system.prescribed.increments(factor)

    def attempt(self, factor: float) -> Outcome:
        """Try to find equilibrium at a load factor; on failure everything stays as it was."""
        return self.whole(partial(self._attempt_or_fall_back, factor))

    def _attempt_or_fall_back(self, factor: float) -> Outcome:
        outcome = self._attempt(factor)
        if not outcome.converged and self._fall_back():
            tried, outcome = outcome.history, self._attempt(factor)
            outcome.history[:0] = tried
            self._fell_back(outcome.converged)
        return outcome

    def _fall_back(self) -> bool:
        """After a step that has failed: whether it is worth to be tried in another way, which is then set up.
        Collective."""
        return False

    def _fell_back(self, converged: bool) -> None:
        """Go on in that way, or return to the one before."""

    def _attempt(self, factor: float) -> Outcome:
        system = self._prepare()
        with self.timer("conditions"):
            start = self._begin(system, factor)
            increments = self._prescribed_at(system, factor)
            system.set_prescribed(increments)
        outcome = attempts.solve(system, start.x, increments, self.controls)
        self._finish(system, start, outcome, factor)
        return outcome

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
            NotConverged: with what was tried; the last converged state is intact.
            PointsOutsideGrid: points have left the grid and it is to be reset for the next step.
        """
        schedule = ArcSchedule(first, until, largest, smallest, to, steps, progress)
        ready = self.system is not None and not (self._stale or self.progress.reset_due)
        (self.whole if ready else self.tried)(self._check_path)
        return arclength.march(self, schedule)

    def _check_path(self) -> None:
        """Raise InputError unless all loads, terms and supports are such as the arc-length method takes."""
        system = self._prepare()
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
        system, p = self._prepare(), self.progress
        with self.timer("conditions"):
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
        outcome = arclength.solve(path, self.controls, to)
        if outcome.converged:
            self._put_loads(system, path.factor)
        moved = along.moved(self, system, path.start, system.x) if path.settled else None
        self._finish(system, start, outcome, path.factor)
        if outcome.converged and moved is not None:  # what relaxed before tells nothing about the path
            self._last_x = self.points.x - moved
        return outcome, path.factor

    def _begin(self, system: NodalSystem, factor: float) -> StepStart:
        """Set the loads of a step; in the first one they grow from nothing."""
        before = np.zeros_like(system.x)
        if self.progress.step:
            self._put_loads(system, None)
            before = system.working_loads()
        self._put_loads(system, factor)
        return StepStart(system.x.copy(), before, system.working_loads())

    def _finish(self, system: NodalSystem, start: StepStart, outcome: Outcome, factor: float) -> None:
        """Make an acceptable solution the body's state, or put back what was there."""
        with self.timer("update"):
            if outcome.converged:
                at_points = self._increments(system)
                outcome.reason = self._check(at_points)
                outcome.converged = not outcome.reason
            if outcome.converged:
                self._trust(system, start.x, outcome)
            if outcome.converged:
                external, carried = step_work(system, start, system.working_loads(), self._left(system.nodes))
                self.progress.external_work += external
                self.progress.carried_work += carried
                self._close(system)
                self._equilibrium = Equilibrium.of(system)
                self._last_x, self.progress.factor_change = self.points.x, factor - self.progress.factor
                for observer in self.observers:
                    observer.after_convergence(self, factor)
                self._commit_terms(system, start.x)
                base = self.progress.rotation_factor
                self._commit(system, at_points, factor)
                self._note(outcome)
                system.prescribed.start_from(factor, system.x)
                self._settle()
                for observer in self.observers:
                    observer.after_commit(self, self.progress.rotation_factor != base)
            else:
                system.x = start.x

    def _commit_terms(self, system: NodalSystem, start: np.ndarray) -> None:
        """Tell the terms of a step that has converged, from increments (nodes, block) at its start."""
        works = system.terms.work(start, system.x)
        self.progress.ghost_work += works.pop("ghost", 0.0)
        self.progress.term_work += sum(works.values())
        system.terms.commit(system.x)
        for term in self.terms:
            term.committed = True

    def _tell_of_reset(self) -> None:
        for observer in self.observers:
            observer.after_reset(self)

    def _prescribed(self, nodes: Nodes, supports: Sequence[Support] | None = None) -> Prescribed:
        """Prescribed unknowns of some supports; by default of those that act."""
        with self.timer("conditions"):
            acting = self.supports if supports is None else supports
            made = Prescribed(nodes, acting, self.layout, self.comm, self.cell_size)
            made.start_from(self.progress.factor, made.base)
            return made

    # restart --------------------------------------------------------------------------------------
    def kept(self) -> dict[str, np.ndarray]:
        """What is kept for each local point from step to step, beside its state: rows (np, ...) by name."""
        return {f"rows.{name}": a for name, a in self.rows.items()} | self.term_rows() | self.load_rows()

    def keep(self, rows: dict[str, np.ndarray]) -> None:
        """Put in rows such as those of `kept`."""
        self.rows = {name[5:]: a for name, a in rows.items() if name.startswith("rows.")}
        self.restore_term_rows(rows)
        self.restore_load_rows(rows)

    # results --------------------------------------------------------------------------------------
    def fields(self, *names: str | MaterialField) -> Fields:
        """Energy, Cauchy stress and couple stress at the local points, or what is asked for.

        Args:
            *names: any of energy (Pa), stress (Pa), couple_stress (N/m) and mean_pressure (Pa), or a
                `MaterialField`; default: the first three.

        Returns:
            The fields by name; `.energy`, `.stress` and `.couple_stress` for short.

        Raises:
            InputError: an unknown name.
        """
        return self._fields.evaluate(self.points, choose_fields(names, self.points.plastic))

    def energy(self) -> float:
        """Strain energy of the body (J)."""
        energy: float = self.comm.allreduce(float(self.fields("energy").energy @ self.points.volume0))
        return energy

    def energies(self) -> dict[str, float]:
        """Energy balance of the run so far, in J (J per unit thickness in plane strain).

        - external: work of the loads, and of the supports' reactions on prescribed displacements;
        - carried: work of the initial stresses and forces that balanced resets carry along;
        - stored: strain energy, with what hardening stores;
        - dissipated: by plastic flow;
        - ghost: work against the ghost penalty's forces;
        - terms: work against the forces of other terms that aren't loads or supports;
        - residue: external + carried - stored - dissipated - ghost - terms: the error of the trapezoidal
          rule, which falls with the square of the step, and what relaxes at resets that aren't balanced and
          where couples in space meet a new base of the rotations.
        """
        p, dissipated = self.progress, 0.0
        if self.points.plastic:
            dissipated = self.comm.allreduce(float(self.points.dissipation @ self.points.volume0))
        out = {
            "external": p.external_work,
            "carried": p.carried_work,
            "stored": self.energy(),
            "dissipated": dissipated,
            "ghost": p.ghost_work,
            "terms": p.term_work,
        }
        gained = p.external_work + p.carried_work
        return out | {"residue": gained - out["stored"] - dissipated - p.ghost_work - p.term_work}

    def reaction(self, support: Support | SurfaceSupport, about: Any = None) -> Reaction:
        """Force (N), shape (d,), couple (N m), shape (r,), and moment with which a support holds the body in
        the last converged step, by the components that it prescribes: `force, couple = problem.reaction(s)`,
        or `.force`, `.couple` and `.moment`, see `Reaction`.

        The couple sums the nodes' couples. The moment is that of forces and couples about the point `about`
        (default: the origin), where nodes and body are now; couples count in it.

        Where two supports hold the same unknown, its force belongs to the one that was given first; the
        other's `shared` says what that is. So the reactions of all supports add up.

        Raises:
            InputError: nothing has been solved yet, the support has been released, or not what `fix` has
                returned.
        """
        if not isinstance(support, Support | SurfaceSupport):
            raise InputError(f"reaction: support = {support!r} is not what fix has returned")
        point, given = point_about(about, self.layout.dim), self.given.of(support)
        if given is None:
            raise InputError(f"reaction: {support.name} isn't a support of this problem")
        if given.released is not None:
            raise InputError(f"reaction: {support.name} was released at load factor {given.released:g}")
        e = self._equilibrium
        if isinstance(support, SurfaceSupport):
            if e is not None and support.reaction is not None:
                return surface_reaction(support, point)
        elif e is not None and support in e.prescribed.supports:
            return e.reaction(support, point)
        raise InputError(f"reaction: no load step has been solved yet with {support.name}")

    def balance(self, about: Any = None) -> Balance:
        """Loads, reactions and what else acts on the body in the last converged step: forces, and moments
        about the point `about` (default: the origin) in the current configuration. Print it.

        Raises:
            InputError: nothing has been solved yet.
        """
        point = point_about(about, self.layout.dim)
        if self._equilibrium is None:
            raise InputError("balance: no load step has been solved yet")
        return self._equilibrium.balance(point)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the last step, prescribed ones included."""
        return 0 if self.system is None else self.system.nodes.total * self.layout.block
