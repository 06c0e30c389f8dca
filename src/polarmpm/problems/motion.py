"""What dynamic problems share, of material points and of finite elements (docs/dynamics.md).

Kinematics live at the points: each has a velocity, an acceleration and those of its microrotation, and moves
them on by what the nodes have moved it. So neither energy nor momentum changes when the grid is reset. What
is known of the past is a dead force m h, and a dead couple, at each point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.inertia import Inertia
from ..assembly.system import NodalSystem
from ..bodies.reference import Increments
from ..bodies.selection import Selection
from ..errors import InputError, LocalFailure
from ..kinematics.moments import moments
from ..kinematics.timesteps import TimeStep, check_rho
from ..solvers.newton import Outcome
from ..solvers.stepping import Step
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .base import Problem
from .reactions import Equilibrium
from .work import StepStart

Given = float | Sequence[float] | Callable[[np.ndarray], Any]


class Moving(Problem):
    """A body in motion. All methods are collective. In all conditions the time (s) stands for the load
    factor: functions get it, and a number grows by its value in a second.

    Attributes:
        rho_inf: by what a step multiplies motions whose period is much shorter than it.
    """

    _step: TimeStep | None = None  # the step that is being solved
    _pushed: tuple[np.ndarray, np.ndarray] | None = None  # dead forces and couples of the history
    _found: tuple[tuple[float, float, float], Equilibrium] | None = None  # of the collocated state

    def _set_motion(self, density: Any, microinertia: Any, rho_inf: float, drag: float) -> None:
        """Check, and keep, what a user gives."""
        self.rho_inf = rho_inf
        self.drag = checks.number("drag", drag, least=0.0)
        if self.layout.rotations and microinertia is None:
            raise InputError(
                "microinertia = None: of a body with microrotations it is needed, j (m^2) of the moment of "
                "inertia rho j"
            )
        if not self.layout.rotations and microinertia is not None:
            raise checks.refuse("microinertia", microinertia, "the material has no microrotation")
        self._density, self._microinertia = density, microinertia
        with errors_on_all_ranks(self.comm):
            self._of_points("density", density, positive=True)
            if microinertia is not None:
                self._of_points("microinertia", microinertia, positive=False)
        self.points.set_moving()

    @property
    def rho_inf(self) -> float:
        return self._rho_inf

    @rho_inf.setter
    def rho_inf(self, value: float) -> None:
        self._rho_inf = check_rho(value)

    def _of_points(self, name: str, given: Any, *, positive: bool) -> np.ndarray:
        """A number for each local point (np,)."""
        p, materials = self.points, self.points.materials
        if callable(given):
            raw = checks.function(name, given, takes=("positions",))(p.X.copy())
            values = checks.numeric(name, raw, "one number for each position")
            if values.shape not in ((), (len(p),)):
                raise checks.refuse(name, raw, f"one number for each of {len(p)} positions is needed")
            values = np.broadcast_to(values, (len(p),))
        elif isinstance(given, Mapping) or checks.several(given):
            of_material = given.values() if isinstance(given, Mapping) else given
            if isinstance(given, Mapping) and list(given) != list(materials):
                found = [given[m] for m in materials if m in given]
                if len(found) != len(materials) or len(given) != len(materials):
                    raise checks.refuse(name, given, "one number for each of the body's materials")
                of_material = found
            numbers = checks.sequence(name, of_material, len(materials), "numbers, one a material,")
            values = np.array([checks.number(name, v) for v in numbers])[p.material]
        else:
            values = np.full(len(p), checks.number(name, given))
        least = values.min(initial=np.inf)
        if not np.isfinite(values).all() or least < 0.0 or (positive and least == 0.0):
            bad = values[~np.isfinite(values)]
            allowed = "positive numbers" if positive else "numbers that aren't negative"
            raise InputError(f"{name} = {bad[0] if len(bad) else least:g} of a point: {allowed} are allowed")
        return values

    def _masses(self) -> np.ndarray:
        """Masses and moments of inertia of the local points (np, block)."""
        d, r, volume = self.layout.dim, self.layout.rotations, self.points.volume0
        with errors_on_all_ranks(self.comm):
            mass = self._of_points("density", self._density, positive=True) * volume
            turned = mass * self._of_points("microinertia", self._microinertia, positive=False) if r else mass
        return np.column_stack([*[mass] * d, *[turned] * r])

    def inertia(self) -> dict[str, float]:
        """The body's mass (kg) and, with microrotations, the sum of their moments of inertia (kg m^2).
        Collective."""
        mass, d = self._masses(), self.layout.dim
        sums = self.comm.allreduce(np.array([mass[:, 0].sum(), mass[:, d:].sum()]))
        found = {"mass": float(sums[0])}
        return found | (
            {"moment of inertia": float(sums[1]) / self.layout.rotations} if mass.shape[1] > d else {}
        )

    # motion ---------------------------------------------------------------------------------------
    @property
    def time(self) -> float:
        """Time of the last converged state (s)."""
        return self.progress.factor

    @collective("velocity", compare=True)
    def velocity(
        self, where: Selection | None = None, *, v: Given | None = None, spin: Given | None = None
    ) -> None:
        """Give points a velocity, and a spin of their microrotation: before the first step, or later as by a
        blow. The energy that it brings counts as external work.

        Args:
            where: a selection of points; None: all.
            v: (m/s), (d,); or a function of their positions (n, d) now, which gives (n, d).
            spin: (rad/s), one number in plane strain, (3,) in space; or a function of the positions.

        Raises:
            InputError: neither is given, or values of the wrong size; a spin of a body without
                microrotations.
        """
        self._check_outside("velocity")
        self.check_open()
        if v is None and spin is None:
            raise InputError("velocity: neither v nor spin is given")
        if spin is not None and not self.layout.rotations:
            raise checks.refuse("velocity: spin", spin, "the material has no microrotation")
        if where is not None:
            self.points.check(where)
        p, d, r, before = self.points, self.layout.dim, self.layout.rotations, self._kinetic()
        with errors_on_all_ranks(self.comm):
            rows = p.rows(where)
            given = [(v, "v", d, "velocity", slice(0, d)), (spin, "spin", r, "spin", slice(3 - r, 3))]
            made = []
            for value, name, size, field, columns in given:
                if value is not None:
                    new = getattr(p, field).copy()
                    new[rows, columns] = _values(f"velocity: {name}", value, p.x[rows], size)
                    made.append((field, new))
        for field, new in made:
            setattr(p, field, new)
        self.progress.external_work += self._kinetic() - before

    def _kinetic(self) -> float:
        p, d, r, mass = self.points, self.layout.dim, self.layout.rotations, self._masses()
        twice = np.sum(mass[:, :d] * p.velocity**2)
        if r:
            twice += np.sum(mass[:, d:] * p.spin[:, 3 - r :] ** 2)
        return 0.5 * float(self.comm.allreduce(float(twice)))

    @collective("momentum")
    def momentum(self) -> np.ndarray:
        """Linear momentum (N s), (d,)."""
        sums: np.ndarray = np.sum(self._masses()[:, : self.layout.dim] * self.points.velocity, axis=0)
        return np.asarray(self.comm.allreduce(sums))

    @collective("angular_momentum", compare=True)
    def angular_momentum(self, about: Any = None) -> np.ndarray:
        """Angular momentum (N m s) about a point (default: the origin), with that of the microrotations: (1,)
        in the plane, (3,) in space."""
        d, r, p, mass = self.layout.dim, self.layout.rotations, self.points, self._masses()
        point = np.zeros(d) if about is None else checks.vector("about", about, d)
        turning = mass[:, d:] * p.spin[:, 3 - r :] if r else np.zeros((len(p), 0))
        sums: np.ndarray = moments(p.x - point, mass[:, :d] * p.velocity, turning).sum(axis=0)
        return np.asarray(self.comm.allreduce(sums))

    @collective("energies")
    def energies(self) -> dict[str, float]:
        """As of `QuasiStatic`, with

        - external: also the kinetic energy that `velocity` has given;
        - kinetic: of the points, with that of their microrotations;
        - damped: work against drag and viscosity;
        - residue: also what the method in time damps (`rho_inf` below 1), and its error.
        """
        found, kinetic, damped = super().energies(), self._kinetic(), self.progress.damped_work
        return {
            **found,
            "kinetic": kinetic,
            "damped": damped,
            "residue": found["residue"] - kinetic - damped,
        }

    # solving --------------------------------------------------------------------------------------
    def march(  # type: ignore[override]
        self,
        time: float | None = None,
        *,
        steps: int | None = None,
        dt: float | None = None,
        duration: float | None = None,
        adaptive: bool = False,
        smallest: float = 1e-3,
        largest: float | None = None,
        easy: int = 6,
        progress: bool | None = None,
    ) -> Iterator[Step]:
        """March on in time, while it is iterated over; yields every converged step.

        Args:
            time: at which it ends (s).
            duration: how long it lasts from the present time on (s), instead of `time`.
            steps: number of equal steps; of adaptive ones the first follows from it.
            dt: length of a step (s), instead of `steps`; so many equal ones are taken that none is longer.
            adaptive: halve a step that fails and try again from the last converged state, then grow again, up
                to the first step's size or, with `largest`, beyond.
            smallest: smallest adaptive step, relative to the first one.
            largest: length (s) to which adaptive steps may grow.
            easy, progress: as of `QuasiStatic.march`.

        Raises:
            InputError: an argument is out of range; both, or neither, of two that stand for each other.
            NotConverged, PointsOutsideGrid: as of `QuasiStatic.march`.
        """
        end, number = self._until(time, duration), steps
        if (steps is None) == (dt is None):
            raise InputError(f"march: steps = {steps!r} and dt = {dt!r}: one of them is needed")
        if dt is not None:
            dt = checks.number("dt", dt, above=0.0)
            number = max(1, math.ceil((end - self.time) / dt * (1.0 - 1e-9)))
        return super().march(
            number,
            to=end,
            adaptive=adaptive,
            smallest=smallest,
            largest=largest,
            easy=easy,
            progress=progress,
        )

    def _until(self, time: float | None, duration: float | None) -> float:
        if (time is None) == (duration is None):
            raise InputError(f"march: time = {time!r} and duration = {duration!r}: one of them is needed")
        if duration is not None:
            return self.time + checks.number("duration", duration, above=0.0)
        return checks.number("time", time, above=self.time, allowed=f"a time (s) after {self.time:g}, now")

    def march_arc_length(self, *arguments: Any, **options: Any) -> Iterator[Step]:
        """There is none: raises an InputError."""
        raise InputError("march_arc_length: a dynamic problem goes on in time; use march")

    def attempt_along(self, *arguments: Any, **options: Any) -> tuple[Outcome, float]:
        """There is none: raises an InputError."""
        raise InputError("attempt_along: a dynamic problem goes on in time; use attempt")

    @property
    def _couples_act(self) -> bool:
        return bool(self.layout.rotations) or super()._couples_act

    def _add_inertia(self, system: NodalSystem) -> None:
        """Give a new system the points' masses."""
        if system.inertia is None:
            system.inertia = Inertia(self._masses())

    def _set_step(self, system: NodalSystem, time: float) -> float:
        """Set inertia and history of the step from the present time to another one, and give the time at
        which forces are in balance."""
        now, inertia = self.progress.factor, system.inertia
        if not time > now:
            raise InputError(f"time = {time:g}: a time (s) after {now:g}, that of the last step, is needed")
        # in the first step accelerations aren't known; the midpoint rule does without
        self._step = step = TimeStep(time - now, self.rho_inf if self.progress.step else 1.0)
        assert inertia is not None
        v, a = self._rates()
        inertia.begin(system, step.acceleration + self.drag * step.rate)
        pushed = inertia.mass * (step.history(v, a) - self.drag * step.rate_history(v, a))
        self._pushed = pushed[:, : self.layout.dim], pushed[:, self.layout.dim :]
        return now + step.theta * step.dt

    def _loads_at(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """With the history's."""
        forces, couples = super()._loads_at(factor)
        if self._pushed is None:
            return forces, couples
        return forces + self._pushed[0], couples + self._pushed[1]

    def _prescribed_at(self, system: NodalSystem, factor: float) -> np.ndarray:
        found, now = super()._prescribed_at(system, factor), self.progress.factor
        assert self._step is not None
        theta = self._step.theta if factor > now else 1.0
        held: np.ndarray = np.where(system.prescribed.fixed, system.x + theta * (found - system.x), found)
        return held

    def _begin(self, system: NodalSystem, factor: float) -> StepStart:
        self._put_loads(system, factor)
        nothing = np.zeros_like(system.x)
        return StepStart(system.x.copy(), nothing, nothing)

    def _finish(self, system: NodalSystem, start: StepStart, outcome: Outcome, factor: float) -> None:
        if outcome.converged:
            assert self._step is not None
            self._found = self._collocated(system, start.x), self._on_body(system)
            system.terms.balanced(system.x)
            system.jump(start.x + (system.x - start.x) / self._step.theta)
            try:
                if self._evaluated_at_end:
                    system.evaluate(False)
            except LocalFailure as e:
                outcome.converged, outcome.reason = False, str(e)
        super()._finish(system, start, outcome, factor)

    @property
    def _evaluated_at_end(self) -> bool:
        """Whether the state at the end of a step needs the stresses there, too."""
        return self.points.plastic

    def _collocated(self, system: NodalSystem, before: np.ndarray) -> tuple[float, float, float]:
        """Work (J) in the whole step of loads and supports, of what resets carry along, and against drag, by
        the forces in the collocated state. Collective."""
        step, inertia, own = self._step, system.inertia, slice(0, system.nodes.owned)
        assert step is not None
        assert inertia is not None
        assert self._pushed is not None
        at_points = (system.at_points(system.x) - inertia.start) / step.theta
        moved, held = ((system.x - before) / step.theta)[own], system.prescribed.fixed[own]
        end = before + (system.x - before) / step.theta
        pushed, (v, a) = np.hstack(self._pushed), self._rates()
        slow = step.theta * step.rate * at_points + step.rate_history(v, a)
        sums = np.array(
            [
                np.sum(system.working_loads()[own] * moved) - np.sum(pushed * at_points),
                np.sum(system.residual[own][held] * moved[held]),
                np.sum(system.carried[own] * moved)
                + system.initial_energy(before)
                - system.initial_energy(end),
                self.drag * np.sum(inertia.mass * slow * at_points),
            ]
        )
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        return float(sums[0] + sums[1]), float(sums[2]), float(sums[3])

    def _rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities and accelerations (np, block) of the last converged state."""
        p, r = self.points, self.layout.rotations
        v = np.hstack([p.velocity, p.spin[:, 3 - r :]])
        return v, np.hstack([p.acceleration, p.spin_rate[:, 3 - r :]])

    def _on_body(self, system: NodalSystem) -> Equilibrium:
        """What acts on the body in the collocated state, with inertia and drag. Collective."""
        found, inertia = Equilibrium.of(system), system.inertia
        assert inertia is not None
        assert self._pushed is not None
        history = system.from_points(np.hstack(self._pushed))
        found.inertia = history - inertia.forces(system)
        found.loads = found.loads - history
        return found

    def _work(self, system: NodalSystem, start: StepStart) -> tuple[float, float]:
        assert self._found is not None
        external, carried, damped = self._found[0]
        self.progress.damped_work += damped
        return external, carried

    def _forces(self, system: NodalSystem) -> Equilibrium:
        assert self._found is not None
        return self._found[1]

    def _move(self, inertia: Inertia, increments: Increments) -> None:
        """Bring velocities and accelerations to the end of a step."""
        step, p, d, r, (v, a) = self._step, self.points, self.layout.dim, self.layout.rotations, self._rates()
        assert step is not None
        before = v
        v, a = step.end(increments.value - inertia.start, v, a)
        if step.rho_inf == 1.0:  # it isn't used, but by a step with another rho_inf
            a = (v - before) / step.dt
        p.velocity, p.acceleration = v[:, :d].copy(), a[:, :d].copy()
        p.spin, p.spin_rate = (np.pad(w[:, d:], ((0, 0), (3 - r, 0))) for w in (v, a))
        self._step = self._pushed = self._found = None


def _values(name: str, value: Any, x: np.ndarray, size: int) -> np.ndarray:
    """What a user gives for positions (n, d), as (n, size)."""
    if callable(value):
        value = checks.function(name, value, takes=("positions",))(x.copy())
    found = checks.numeric(name, value, f"{size} number{'s' * (size > 1)}")
    n = len(x)
    if found.shape == (n,) and size == 1:
        found = found[:, None]
    if found.shape not in ((size,), (n, size)) and not (size == 1 and found.shape == ()):
        allowed = f"{size} number{'s' * (size > 1)}, or a function of positions that gives ({n}, {size}),"
        raise checks.refuse(name, value, f"{allowed} needed")
    if not np.isfinite(found).all():
        raise checks.refuse(name, value, "finite numbers are needed")
    return np.broadcast_to(found, (n, size))
