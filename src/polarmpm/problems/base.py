"""What quasi-static problems share, of material points and of finite elements."""

from __future__ import annotations

from abc import ABC, abstractmethod
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
from ..conditions.proportional import check_linear, check_loads, check_supports
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.stresses import MaterialField
from ..geometry.nodes import Nodes
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..solvers import arclength, newton
from ..solvers.arclength import ArcSchedule, Path
from ..solvers.newton import Controls, Outcome
from ..solvers.stepping import Schedule, Step, march
from ..terms.base import Term
from ..terms.surfaces import SurfaceSupport
from ..terms.surfaceterms import SurfaceCondition
from ..tools.parallel import together
from ..tools.timing import Timer
from . import surfaces
from .state import Fields, Progress, StateFields, choose_fields
from .work import StepStart, step_work


class Problem(ABC):
    """Equilibrium of a body under slowly changing loads. All methods are collective.

    Attributes:
        terms: what acts on the body besides its stresses, supports and dead loads; see `add`.
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
        self.terms: list[Term] = []
        self.term_works: dict[str, float] = {}  # work (J) done against each term that is no load, by name
        self.progress, self.timer = Progress(), Timer()
        self.steps: list[Step] = []
        self._stale = False  # conditions have changed since the system was built
        self._fields = StateFields(comm)
        # nodes, out-of-balance forces and rotational increments of the last converged step
        self._equilibrium: tuple[Nodes, np.ndarray, np.ndarray] | None = None
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

    @abstractmethod
    def _commit(self, system: Any, increments: Increments, factor: float) -> None:
        """Make a solution the body's state."""

    @abstractmethod
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        """Predicate of node positions, and its name, of what the user gives to `fix`."""

    @property
    @abstractmethod
    def cell_size(self) -> float:
        """Size of a cell or an element (m), the smallest one. Collective."""

    @property
    @abstractmethod
    def system(self) -> NodalSystem | None:
        """Nodes, their increments and residual as of the last step; None before the first one."""

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

    # conditions -----------------------------------------------------------------------------------
    def fix(
        self,
        where: Any,
        *,
        stiffness: float | None = None,
        rotation_stiffness: float | None = None,
        augment: bool = False,
        normal: Any = None,
        **components: Any,
    ) -> Support | SurfaceSupport:
        """Prescribe displacements and rotations, of nodes or by springs on a surface.

        Args:
            where: `plane(x=0.0)` or a predicate of node positions (n, d) -> (n,) bool; for finite elements
                also facets, or the name of a physical group. Or a `Surface` (also one that doesn't follow the
                grid; `elements.surface(...)`), which the body carries: springs hold it.
            **components: u, theta (all components), or ux, uy, uz, theta_x, theta_y, theta_z (theta in
                plane strain), in m and rad. A number is ramped with the load factor; a function of the
                factor, or of (factor, positions), gives the total displacement or rotation; positions are
                those of the nodes at the last reset, of a surface the undeformed ones. In one step a rotation
                in space may change by less than pi.
            stiffness: of a surface's springs (Pa/m): the virtual work per undeformed area is
                stiffness (u - prescribed u) . du, and the same for rotations. Default: 1000 times the
                stiffest material's lam + 2 mu over the size of a cell: they give way like a layer of a
                thousandth of a cell.
            rotation_stiffness: (N/m); default: 1000 times gamma over the size of a cell, plus mu times it.
            augment: keep the springs' forces after each converged step and let the springs start anew, so
                that what they give way under a load that stays vanishes over steps (augmented Lagrange
                method).
            normal: displacement along a surface's undeformed normals (m): rollers. Not together with other
                displacements.

        Returns:
            The support, for `reaction`. Of a surface, `support.gap` (n,) tells by how much (m) the prescribed
            displacements were missed in the last step.

        Raises:
            InputError: unknown component or none, plane without nodes, value that isn't finite; of a surface,
                a stiffness that isn't positive, materials that don't name their moduli; springs elsewhere.
        """
        springs = {"stiffness": stiffness, "rotation_stiffness": rotation_stiffness, "normal": normal}
        if isinstance(where, Surface):
            return surfaces.add_support(self, where, components, augment=augment, **springs)
        given = [name for name, value in springs.items() if value is not None] + ["augment"] * bool(augment)
        if given:
            raise InputError(f"fix: {given[0]} belongs to springs on a Surface; where = {where!r}")
        predicate, label = self._place(where)
        support = conditions.make_support(predicate, label, components, self.layout, len(self.supports) + 1)
        self._admit(where, support)
        self.supports.append(support)
        self._stale = True
        return support

    def _admit(self, where: Any, support: Support) -> None:  # noqa: B027
        """Take note of a support that the user has put on `where`, or refuse it."""

    def add(self, term: Term) -> None:
        """Add a term: a contribution to the nodal system, such as a `SurfaceTerm` of one's own. In mid-run it
        acts from the next step on, which begins with a reset of the grid.

        Raises:
            InputError: not a term, one that is in a problem already, or one that doesn't fit this problem.
        """
        if not isinstance(term, Term):
            raise InputError(
                f"term = {term!r} is not a Term; derive from polarmpm.Term or polarmpm.SurfaceTerm"
            )
        if term in self.terms:
            raise InputError(f"term = {term.name!r} has been added already")
        term.attach(self.layout, self.comm)
        self.terms.append(term)
        self._stale = self.progress.reset_due = True

    @property
    def surfaces(self) -> list[SurfaceCondition]:
        """Tractions, pressures, supports and terms of one's own on surfaces."""
        return [term for term in self.terms if isinstance(term, SurfaceCondition)]

    def traction(self, where: Surface, *, force: Any = None, couple: Any = None) -> None:
        """A dead traction (N/m^2) and couple traction (N/m; one number in plane strain) per undeformed area
        on a surface that the body carries. Values as in `fix`.

        Raises:
            InputError: neither is given, values of the wrong size, a surface of another dimension; at the
                next step: points of the surface outside of the body.
        """
        surfaces.add_traction(self, "traction", where, force, couple)

    def pressure(self, where: Surface, p: Any) -> None:
        """A pressure (Pa) against the current normal of a surface that the body carries, -p cof(F) N dA.

        Raises:
            InputError: as `traction`.
        """
        surfaces.add_pressure(self, where, p)

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

    def system_at(self, factor: float) -> NodalSystem:
        """The nodal system in which equilibrium at a load factor is sought, at the increments that the last
        step has led to, with the loads of that factor; `evaluate(True)` makes its residual and tangent."""
        system = self._prepare()
        self._put_loads(system, factor)
        system.set_prescribed(self._prescribed_at(system, factor))
        return system

    def _prescribed_at(self, system: NodalSystem, factor: float) -> np.ndarray:
        p = self.progress
        with together(self.comm):
            return system.prescribed.increments(factor, p.reset_factor, p.rotation_factor)

    def attempt(self, factor: float) -> Outcome:
        """Try to find equilibrium at a load factor; on failure everything stays as it was."""
        system = self._prepare()
        with self.timer("conditions"):
            start = self._begin(system, factor)
            increments = self._prescribed_at(system, factor)
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
        apart = [term.name for term in self.terms if not term.proportional]
        if apart:
            raise InputError(
                f"{apart[0]}: the arc-length method takes terms only whose forces are linear in the load "
                "factor and whose growth with it doesn't depend on the displacements"
            )
        check_loads(self.comm, places, self._growth_of_terms(system))
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
                self._put_loads(system, factor)
                ends.append(system.loads.copy())
            start = self._begin(system, p.factor)
            system.set_prescribed(self._prescribed_at(system, p.factor))
            loads = ends[0], ends[1] - ends[0] - self._growth_of_terms(system)
            volumes = system.node_volumes()
        path = Path(system, loads, volumes, length, p.factor, lambda x: self._sense(system, x))
        path.bend = arclength.least_cosine(kink)
        outcome = arclength.solve(path, self.controls, to)
        if outcome.converged:
            self._put_loads(system, path.factor)
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
        before = np.zeros_like(system.x)
        if self.progress.step:
            self._put_loads(system, None)
            before = system.working_loads()
        self._put_loads(system, factor)
        return StepStart(system.x.copy(), before, system.working_loads())

    def _set_terms(self, factor: float, carrying: bool = False) -> None:
        with together(self.comm):
            for term in self.terms:
                term.set_factor(factor, carrying)

    def _growth_of_terms(self, system: NodalSystem) -> np.ndarray:
        """What the residual forces (nodes, block) of the terms, complete on owned rows, gain while the load
        factor grows from 0 to 1. The terms are left at 0. Collective.

        Raises:
            InputError: a term's forces aren't linear in the load factor.
        """
        found = []
        for factor in (2.0, 1.0, 0.0):
            self._set_terms(factor)
            found.append(system.terms.forces(system.x, lambda piece: True))
        two, one, zero = found
        check_linear(self.comm, [term.name for term in self.terms], zero, one, two)
        system.nodes.add_to_owners(growth := one - zero)
        return growth

    def _finish(self, system: NodalSystem, start: StepStart, outcome: Outcome, factor: float) -> None:
        """Make an acceptable solution the body's state, or put back what was there."""
        with self.timer("update"):
            if outcome.converged:
                at_points = self._increments(system)
                outcome.reason = self._check(at_points)
                outcome.converged = not outcome.reason
            if outcome.converged:
                external, carried = step_work(system, start, system.working_loads())
                self.progress.external_work += external
                self.progress.carried_work += carried
                self._equilibrium = system.nodes, system.residual, system.x[:, self.layout.dim :].copy()
                self._last_x, self.progress.factor_change = self.points.x, factor - self.progress.factor
                self._commit_terms(system, start.x)
                self._commit(system, at_points, factor)
            else:
                system.x = start.x

    def _commit_terms(self, system: NodalSystem, start: np.ndarray) -> None:
        """Tell the terms of a step that has converged, from increments (nodes, block) at its start."""
        for name, work in system.terms.work(start, system.x).items():
            self.term_works[name] = self.term_works.get(name, 0.0) + work
        self.progress.ghost_work = self.term_works.get("ghost", 0.0)
        self.progress.term_work = sum(self.term_works.values()) - self.progress.ghost_work
        system.terms.commit(system.x)

    def term_state(self) -> dict[str, np.ndarray]:
        """What a restart needs of the terms, the same on every rank, by names such as "0/u"."""
        return {f"{k}/{name}": a for k, term in enumerate(self.terms) for name, a in term.state().items()}

    def restore_terms(self, arrays: dict[str, np.ndarray]) -> None:
        """Put in what `term_state` gave, before `restore`; the problem has the same terms.

        Raises:
            InputError: other terms.
        """
        with_state = [k for k, term in enumerate(self.terms) if term.state()]
        saved = {int(key.split("/")[0]) for key in arrays}
        if saved != set(with_state):
            raise InputError(
                f"the saved state has {len(saved)} term(s) with a state of their own, the problem has "
                f"{len(with_state)}"
            )
        for k in with_state:
            start = f"{k}/"
            of_this = {key[len(start) :]: a for key, a in arrays.items() if key.startswith(start)}
            self.terms[k].restore(of_this)

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

    def reaction(self, support: Support | SurfaceSupport) -> tuple[np.ndarray, np.ndarray]:
        """Force (N), shape (d,), and couple (N m), shape (r,), with which a support holds the body, by the
        components that it prescribes.

        The couple sums the nodes' couples; it has no moment of the forces.

        Raises:
            InputError: nothing has been solved yet, or not what `fix` has returned.
        """
        if not isinstance(support, Support | SurfaceSupport):
            raise InputError(f"reaction: support = {support!r} is not what fix has returned")
        if self._equilibrium is None or (isinstance(support, SurfaceSupport) and support.reaction is None):
            raise InputError("reaction: no load step has been solved yet")
        if isinstance(support, SurfaceSupport):
            assert support.reaction is not None
            return support.reaction
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
