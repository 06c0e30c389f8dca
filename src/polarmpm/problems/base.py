"""What quasi-static problems share, of material points and of finite elements."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.points import Points, Selection
from ..bodies.reference import Increments
from ..conditions import supports as conditions
from ..conditions.amplitudes import Amplitude
from ..conditions.loads import Load, make_loads
from ..conditions.prescribed import Prescribed
from ..conditions.proportional import check_loads, check_supports
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.stresses import MaterialField
from ..geometry.nodes import Nodes
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..solvers import arclength, newton
from ..solvers.arclength import ArcSchedule, Path
from ..solvers.newton import Controls, Outcome
from ..solvers.stepping import Schedule, Step, march
from ..tools.parallel import together
from ..tools.timing import Timer
from .state import Fields, Progress, StateFields, choose_fields
from .work import StepStart, step_work


class Problem:
    """Equilibrium of a body under slowly changing loads. All methods are collective.

    Attributes:
        points: where the body's state lives: material points, or the elements' quadrature points.
        progress: load factor and number of steps of the last converged state.
        steps: converged steps so far.
        timer: CPU seconds of this rank by phase.
    """

    def __init__(self, comm: MPI.Comm, points: Points, dim: int, controls: Controls | None):
        self.comm, self.points, self.controls = comm, points, controls or Controls()
        layouts = {Layout.of(m, dim) for m in points.materials}
        if len(layouts) > 1:
            raise InputError("points: micropolar and classical materials can't be mixed in one body")
        self.layout = layouts.pop()
        self.supports: list[Support] = []
        self.loads: list[Load] = []
        self.progress, self.timer = Progress(), Timer()
        self.steps: list[Step] = []
        self._stale = False  # conditions have changed since the system was built
        self._fields = StateFields(comm)
        # nodes, out-of-balance forces and rotational increments of the last converged step
        self._equilibrium: tuple[Nodes, np.ndarray, np.ndarray] | None = None
        self._last_x: np.ndarray | None = None  # where the points were before the last step

    # what the methods differ in -------------------------------------------------------------------
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        """Predicate of node positions, and its name, of what the user gives to `fix`."""
        raise NotImplementedError

    def _prepare(self) -> NodalSystem:
        """The system in which the next step is to be solved."""
        raise NotImplementedError

    def _set_loads(self, system: Any, factor: float) -> None:
        """Put the loads of a load factor into the system."""
        raise NotImplementedError

    def _loads_before(self, system: Any) -> np.ndarray:
        """Forces of the last converged state's loads, (nodes, block), that do work on the increments. Called
        before the new loads are set."""
        raise NotImplementedError

    def _loads_now(self, system: Any) -> np.ndarray:
        """The same of the loads that are set."""
        raise NotImplementedError

    def _load_places(self) -> list[tuple[Amplitude, np.ndarray]]:
        """All loads, and the positions (n, d) of this rank where they act.

        Raises:
            InputError: the arc-length method can't deal with a load; the message names it.
        """
        spatial = [load.name for load in self.loads if load.couple and self.layout.rotations == 3]
        if spatial:
            raise InputError(
                f"{spatial[0]}: couples in space turn with the spin; the arc-length method takes forces only"
            )
        return [(load.amplitude, self.points.X[self.points.rows(load.selection)]) for load in self.loads]

    def _nodal_volumes(self, system: Any) -> np.ndarray:
        """Shares of the body's volume, (nodes,), complete on owned rows."""
        raise NotImplementedError

    def _increments(self, system: Any) -> Increments:
        """Increments at the local points."""
        raise NotImplementedError

    def _fault(self, increments: Increments) -> str:
        """Why a solution is not acceptable; empty when it is."""
        raise NotImplementedError

    def _commit(self, system: Any, increments: Increments, factor: float) -> None:
        """Make a solution the body's state."""
        raise NotImplementedError

    @property
    def system(self) -> NodalSystem | None:
        """Nodes, their increments and residual as of the last step; None before the first one."""
        raise NotImplementedError

    # conditions -----------------------------------------------------------------------------------
    def fix(self, where: Any, **components: Any) -> Support:
        """Prescribe components of nodes.

        Args:
            where: `plane(x=0.0)` or a predicate of node positions (n, d) -> (n,) bool; for finite elements
                also facets, or the name of a physical group.
            **components: u, theta (all components), or ux, uy, uz, theta_x, theta_y, theta_z (theta in
                plane strain), in m and rad. A number is ramped with the load factor; a function of the
                factor, or of (factor, positions), gives the total displacement or rotation; positions are
                those of the nodes at the last reset. In one step a rotation in space may change by less
                than pi.

        Returns:
            The support, for `reaction`.

        Raises:
            InputError: unknown component, plane without nodes, value that isn't finite.
        """
        predicate, label = self._place(where)
        support = conditions.make_support(predicate, label, components, self.layout, len(self.supports) + 1)
        self._admit(where, support)
        self.supports.append(support)
        self._stale = True
        return support

    def _admit(self, where: Any, support: Support) -> None:
        """Take note of a support that the user has put on `where`, or refuse it."""

    def body_load(self, *, force: Any = None, couple: Any = None, on: Selection | None = None) -> None:
        """A dead force (N/m^3) and couple (N/m^2) per reference volume, on all points or a selection.

        Values as in `fix`; functions of two arguments get (factor, initial positions of the points (n, d)).
        """
        self._add_loads(f"body load {len(self.loads) + 1}", on, force, couple, True, 1.0)

    def _add_loads(
        self, name: str, selection: Selection | None, force: Any, couple: Any, density: bool, share: float
    ) -> None:
        self.loads += make_loads(name, selection, force, couple, self.layout, density, share)
        self._stale = True

    # solving --------------------------------------------------------------------------------------
    def march(self, steps: int | None = None, **options: Any) -> Iterator[Step]:
        """Raise the load factor to 1 in load steps; yields every converged step. See `stepping.Schedule`.

        Args:
            steps: number of equal steps from the present factor to `to`.
            to: final load factor (default 1).
            adaptive: cut a step that fails and retry from the last converged state, then grow again, up to
                the first step's size or, with `largest`, beyond.
            progress: show a progress bar (default: on a terminal).

        Raises:
            NotConverged: with what was tried; the last converged state is intact.
            PointsOutsideGrid: points have left the grid and it is to be reset for the next step.
        """
        return march(self, Schedule.make(steps, **options))

    def attempt(self, factor: float) -> Outcome:
        """Try to find equilibrium at a load factor; on failure everything stays as it was."""
        system, p = self._prepare(), self.progress
        with self.timer("conditions"):
            start = self._begin(system, factor)
            with together(self.comm):
                increments = system.prescribed.increments(factor, p.reset_factor, p.rotation_factor)
            system.set_prescribed(increments)
        outcome = newton.solve(system, self.controls)
        if not outcome.converged and system.start_elastic(True):
            # where points unload, the elastic tangent is the better one to begin with
            tried, system.x = outcome.history, start.x
            system.set_prescribed(increments)
            outcome = newton.solve(system, self.controls)
            outcome.history[:0] = tried
            system.start_elastic(False)
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
        system = self._prepare()
        with together(self.comm):
            places = self._load_places()
        check_loads(self.comm, places)
        check_supports(self.comm, system.prescribed)
        return arclength.march(self, schedule)

    def attempt_along(
        self, length: float, to: float | None = None, kink: bool = False
    ) -> tuple[Outcome, float]:
        """Try a step of a length (m) along the path, which ends at the load factor `to` if it meets it; on
        failure everything stays as it was. With `kink` the step may turn off its tangent. Returns the load
        factor found, too. That loads and supports are such as they have to be is checked by
        `march_arc_length`."""
        system, p = self._prepare(), self.progress
        with self.timer("conditions"):
            ends = []
            for factor in (0.0, 1.0):
                self._set_loads(system, factor)
                ends.append(system.external.copy())
            start = self._begin(system, p.factor)
            system.set_prescribed(system.prescribed.increments(p.factor, p.reset_factor, p.rotation_factor))
            volumes = self._nodal_volumes(system)
        loads = ends[0], ends[1] - ends[0]
        path = Path(system, loads, volumes, length, p.factor, lambda x: self._sense(system, x))
        path.bend = arclength.least_cosine(kink)
        outcome = arclength.solve(path, self.controls, to)
        if outcome.converged:
            self._set_loads(system, path.factor)
        moved = self._moved(system, path.start, system.x) if path.settled else None
        self._finish(system, start, outcome, path.factor)
        if outcome.converged and moved is not None:  # what relaxed before tells nothing about the path
            self._last_x = self.points.x - moved
        return outcome, path.factor

    def _moved(self, system: NodalSystem, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Displacements (np, d) of the local points between two states of the increments (nodes, block)."""
        x, d = system.x, self.layout.dim
        system.x = start
        before = self._increments(system).value[:, :d]
        system.x = end
        moved = self._increments(system).value[:, :d] - before
        system.x = x
        return moved

    def _sense(self, system: NodalSystem, direction: np.ndarray) -> float:
        """Positive where nodal increments (nodes, block) lead on in the direction of the last step."""
        along, p = 0.0, self.points
        if self._last_x is not None:
            moved = self._moved(system, system.x, system.x + direction)
            along = float(np.einsum("n,ni,ni->", p.volume0, p.x - self._last_x, moved))
        along = self.comm.allreduce(along)
        return along or self.progress.factor_change or 1.0

    def _begin(self, system: NodalSystem, factor: float) -> StepStart:
        """Set the loads of a step; in the first one they grow from nothing."""
        before = self._loads_before(system) if self.progress.step else np.zeros_like(system.x)
        self._set_loads(system, factor)
        return StepStart(system.x.copy(), before, self._loads_now(system))

    def _finish(self, system: NodalSystem, start: StepStart, outcome: Outcome, factor: float) -> None:
        """Make an acceptable solution the body's state, or put back what was there."""
        with self.timer("update"):
            if outcome.converged:
                at_points = self._increments(system)
                outcome.reason = self._fault(at_points)
                outcome.converged = not outcome.reason
            if outcome.converged:
                external, carried = step_work(system, start, self._loads_now(system))
                self.progress.external_work += external
                self.progress.carried_work += carried
                self._equilibrium = system.nodes, system.residual, system.x[:, self.layout.dim :].copy()
                self._last_x, self.progress.factor_change = self.points.x, factor - self.progress.factor
                self._commit(system, at_points, factor)
            else:
                system.x = start.x

    def _prescribed(self, nodes: Nodes) -> Prescribed:
        with self.timer("conditions"), together(self.comm):
            return Prescribed(nodes, self.supports, self.layout)

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
        return self.comm.allreduce(float(self.fields("energy").energy @ self.points.volume0))

    def energies(self) -> dict[str, float]:
        """Energy balance of the run so far, in J (J per unit thickness in plane strain).

        - external: work of the loads, and of the supports' reactions on prescribed displacements;
        - carried: work of the forces that balanced resets carry along;
        - stored: strain energy, with what hardening stores;
        - dissipated: by plastic flow;
        - ghost: work against the ghost penalty's forces;
        - residue: external + carried - stored - dissipated - ghost: the error of the trapezoidal rule, which
          falls with the square of the step, and what relaxes at resets that aren't balanced and where
          couples in space meet a new base of the rotations.
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
        }
        gained = p.external_work + p.carried_work
        return out | {"residue": gained - out["stored"] - dissipated - p.ghost_work}

    def reaction(self, support: Support) -> tuple[np.ndarray, np.ndarray]:
        """Force (N), shape (d,), and couple (N m), shape (r,), with which a support holds the body, by the
        components that it prescribes.

        The couple sums the nodes' couples; it has no moment of the forces.

        Raises:
            InputError: nothing has been solved yet.
        """
        if self._equilibrium is None:
            raise InputError("reaction: no load step has been solved yet")
        nodes, residual, w = self._equilibrium
        own, d, held = nodes.owned, self.layout.dim, sorted(support.columns)
        forces = np.zeros((own, self.layout.block))
        forces[:, held] = np.where(support.mask(nodes)[:own, None], residual[:own, held], 0.0)
        if self.layout.rotations == 3:  # what does work on Dw is J_l(Dw)^T times the couple
            forces[:, d:] = np.linalg.solve(rotations.right_tangent(w[:own]), forces[:, d:, None])[:, :, 0]
        total = self.comm.allreduce(forces.sum(axis=0))
        return total[:d], total[d:]

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the last step, prescribed ones included."""
        return 0 if self.system is None else self.system.nodes.total * self.layout.block
