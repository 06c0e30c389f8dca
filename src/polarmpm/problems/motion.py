"""What dynamic problems share, of material points and of finite elements (docs/dynamics.md).

Kinematics live at the points: each has a velocity, an acceleration and those of its microrotation, and moves
them on by what the nodes have moved it. So neither energy nor momentum changes when the grid is reset. What
is known of the past is a dead force m h, and a dead couple, at each point.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.inertia import Inertia
from ..assembly.system import NodalSystem
from ..assembly.viscosity import Viscosity
from ..bodies.reference import Increments
from ..conditions.amplitudes import Amplitude
from ..errors import InputError, LocalFailure, TrustWarning
from ..forms.gyration import gyration_kernel, momentum_kernel
from ..kinematics.timesteps import TimeStep
from ..solvers.newton import Outcome
from ..solvers.stepping import Schedule, Step
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, warn_on_one_rank
from .kinetics import WithInertia
from .reactions import Equilibrium
from .work import StepStart

_FAR = 8.0  # times the tolerance: the error of half the step is then the tolerance


class Moving(WithInertia):
    """A body in motion. All methods are collective. In all conditions the time (s) stands for the load
    factor: functions get it, and a number grows by its value in a second.
    """

    clock = "time"
    _step: TimeStep | None = None  # the step that is being solved
    _pushed: tuple[np.ndarray, np.ndarray] | None = None  # dead forces and couples of the history
    _found: tuple[tuple[float, float, float], Equilibrium] | None = None  # of the collocated state
    _tolerance: float | None = None  # of a step's error (m)
    _change: tuple[float, np.ndarray] | None = None  # a factor, and the change of mean accelerations
    _mean: np.ndarray | None = None  # accelerations (np, d) of the step, and of the one before
    _mean_before: np.ndarray | None = None
    _told_of_rates = False

    def _follow(self, amplitudes: Sequence[Amplitude]) -> None:
        """Tell, once, of a number that isn't zero: it is a rate, whatever its name looks like."""
        super()._follow(amplitudes)
        growing = [a for a in amplitudes if a.function is None and a.constant.any()]
        if not growing or self._told_of_rates:
            return
        self._told_of_rates = True
        one = growing[0]
        value = f"{one.constant[0]:g}" if one.size == 1 else f"({', '.join(f'{v:g}' for v in one.constant)})"
        times = f"{value} * t" if one.size == 1 else f"t * np.array({value})"
        warn_on_one_rank(
            self.comm,
            f"{one.name} = {value}: in motion a number is a rate, and grows by its value in each second from "
            f"zero on; write lambda t: {value} for what stays, as a weight, or lambda t: {times} for what "
            "grows",
            TrustWarning,
        )

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
        tolerance: float | None = None,
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
            tolerance: with `adaptive`: as large as the error of the displacements in a step (m), the root of
                its mean square by mass, may be; steps are as long as that allows, and one whose error is 8
                times as large is tried again with half the step. It is estimated from the change of the mean
                acceleration from step to step, as far as the grid resolves it (docs/dynamics.md).
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
        if tolerance is not None:
            allowed = "a positive length (m), with adaptive=True"
            if not adaptive:
                raise checks.refuse("tolerance", tolerance, allowed)
            tolerance = checks.number("tolerance", tolerance, above=0.0, allowed=allowed)
        controlled = tolerance is not None
        schedule = Schedule(number, end, adaptive, smallest, largest, easy, progress, controlled)
        self._tolerance = tolerance
        return self._march(schedule)

    def suited(self, size: float) -> float:
        """The length (s) of the next step, after one of `size`, by its error."""
        error = self.error
        if self._tolerance is None or error is None:
            return size
        wanted = (self._tolerance / max(error, 1e-30 * self._tolerance)) ** (1.0 / 3.0)
        return float(size * min(1.5, max(0.5, 0.9 * wanted)))

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

    def _prepare(self) -> Any:
        system = super()._prepare()  # type: ignore[safe-super]
        self._add_inertia(system)
        return system

    def _put_loads(self, system: Any, factor: float | None) -> None:
        at = None if factor is None else self._set_step(system, factor)
        super()._put_loads(system, at)  # type: ignore[safe-super]

    def _commit(self, system: Any, increments: Increments, factor: float) -> None:
        super()._commit(system, increments, factor)  # type: ignore[safe-super]
        self._move(system.inertia, increments)

    def _add_inertia(self, system: NodalSystem) -> None:
        """Give a new system the points' masses."""
        if system.inertia is None:
            kernels = None
            if self._has_tensors:
                kernels = gyration_kernel(self.comm), momentum_kernel(self.comm)
            system.inertia = Inertia(self._masses(), kernels)
            system.viscosity = Viscosity(self.viscosity) if self.viscosity else None

    def _set_step(self, system: NodalSystem, time: float) -> float:
        """Set inertia and history of the step from the present time to another one, and give the time at
        which forces are in balance."""
        now, inertia = self.progress.factor, system.inertia
        if not time > now:
            raise InputError(f"time = {time:g}: a time (s) after {now:g}, that of the last step, is needed")
        # in the first step accelerations aren't known; the midpoint rule does without
        self._step = step = TimeStep(time - now, self.rho_inf if self.progress.step else 1.0)
        assert inertia is not None
        if self.terms:
            with errors_on_all_ranks(self.comm):
                for term in self.terms:
                    term.begin_step(step.theta * step.dt)
                    term.integrate(step)
        if system.viscosity is not None:
            system.viscosity.begin(system, step.theta * step.dt)
        v, a = self._rates()
        tensors = self._tensors() if self._has_tensors else None
        inertia.begin(system, step.acceleration + self.drag * step.rate, step.theta, tensors)
        pushed = inertia.mass * (step.history(v, a) - self.drag * step.rate_history(v, a))
        if tensors is not None:
            turning = self._turning(inertia)
            pushed[:, -3:] = step.history(*turning) - self.drag * step.rate_history(*turning)
        self._pushed = pushed[:, : self.layout.dim], pushed[:, self.layout.dim :]
        return now + step.theta * step.dt

    def _turning(self, inertia: Inertia) -> tuple[np.ndarray, np.ndarray]:
        """Momenta of the points' spins (np, 3), and their rates, at the beginning of the step. Rates are kept
        over the mean moment of inertia, as `spin_rate`: momenta aren't affected by what turns."""
        p = self.points
        momenta = np.einsum("nij,nj->ni", inertia.tensors, p.spin)
        return momenta, inertia.mass[:, -3:] * p.spin_rate

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
            works, on_body = self._nodal_works(system, start.x), self._on_body(system)
            system.terms.balanced(system.x)
            system.dissipate(self._step.theta)
            system.jump(start.x + (system.x - start.x) / self._step.theta)
            self._found = self._works(system, works), on_body
            outcome.reason = self._end_of_step(system)
            outcome.converged = not outcome.reason
        super()._finish(system, start, outcome, factor)

    def _end_of_step(self, system: NodalSystem) -> str:
        """Evaluate the state at the end of a step where that is needed, and estimate the step's error; why it
        isn't acceptable, empty when it is. Collective."""
        try:
            if self._evaluated_at_end:
                system.evaluate(False)
        except LocalFailure as e:
            return str(e)
        step, inertia = self._step, system.inertia
        assert step is not None
        assert inertia is not None
        v, a = self._rates()
        self._mean = ((step.end(inertia.moved(system), v, a)[0] - v) / step.dt)[:, : self.layout.dim]
        self._change = None
        if self._mean_before is not None:
            between = 0.5 * (step.dt + self.progress.factor_change)
            self._change = step.dt**3 / 12.0 / between, self._mean - self._mean_before
        error = None if self._tolerance is None else self.error
        if self._tolerance is not None and error is not None and error > _FAR * self._tolerance:
            return f"the error of the step is {error:.2g} m, the tolerance {self._tolerance:.2g} m"
        return ""

    @property
    @collective("error")
    def error(self) -> float | None:
        """Estimate of the last step's error of the displacements (m), root of the mean square by mass; None
        where there is no step before. Collective.

        Of mean accelerations A over steps it is dt^3/12 of their rate of change, as far as the nodes' lumped
        masses pass it on: points jitter by what the grid doesn't see.
        """
        system, d = self.system, self.layout.dim
        if system is None or system.inertia is None or self._change is None:
            return None
        inertia, (share, difference) = system.inertia, self._change
        change = np.zeros_like(inertia.mass)
        change[:, :d] = share * difference
        mass = system.from_points(inertia.mass)[:, :1]
        nodal = system.from_points(inertia.mass * change) / np.where(mass > 0.0, mass, 1.0)
        system.nodes.update_ghosts(nodal)
        smooth = system.at_points(nodal)[:, :d]
        sums = np.array([np.sum(inertia.mass[:, :d] * smooth**2), inertia.mass[:, 0].sum()])
        self.comm.Allreduce(MPI.IN_PLACE, sums)
        return math.sqrt(sums[0] / sums[1])

    @property
    def _evaluated_at_end(self) -> bool:
        """Whether the state at the end of a step needs the stresses there, too."""
        return self.points.plastic

    def _nodal_works(self, system: NodalSystem, before: np.ndarray) -> np.ndarray:
        """Work (J) in the whole step, from nodal increments `before` on, of loads, history and supports, of
        what resets carry along, and against viscosity, by the nodes' forces in the collocated state. This
        rank's part."""
        step, own = self._step, slice(0, system.nodes.owned)
        assert step is not None
        moved, held = ((system.x - before) / step.theta)[own], system.prescribed.fixed[own]
        end = before + (system.x - before) / step.theta
        by_loads = np.sum(system.working_loads()[own] * moved)
        by_supports = np.sum(system.residual[own][held] * moved[held])
        carried = np.sum(system.carried[own] * moved)
        carried += system.initial_energy(before) - system.initial_energy(end)
        damped = 0.0 if system.viscosity is None else np.sum(system.viscous_forces()[own] * moved)
        return np.array([by_loads + by_supports, carried, damped])

    def _works(self, system: NodalSystem, works: np.ndarray) -> tuple[float, float, float]:
        """The same of all ranks, without the history's and with that against drag, which act at the points;
        at the end of the step. Collective."""
        step, inertia = self._step, system.inertia
        assert step is not None
        assert inertia is not None
        assert self._pushed is not None
        # at the end nodes are asked for by others, too
        moved = inertia.moved(system)
        works[0] -= np.sum(np.hstack(self._pushed) * moved)
        if self.drag:
            v, a = self._rates()
            slow = inertia.mass * (step.theta * step.rate * moved + step.rate_history(v, a))
            if inertia.kernels is not None:
                summed = inertia.summed(moved[:, -3:])
                slow[:, -3:] = step.theta * step.rate * summed + step.rate_history(*self._turning(inertia))
            works[2] += self.drag * np.sum(slow * moved)
        self.comm.Allreduce(MPI.IN_PLACE, works)
        external, carried, damped = works
        return float(external), float(carried), float(damped)

    def _rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities and accelerations (np, block) of the last converged state."""
        p, r = self.points, self.layout.rotations
        if not r:
            return p.velocity, p.acceleration
        v = np.hstack([p.velocity, p.spin[:, 3 - r :]])
        return v, np.hstack([p.acceleration, p.spin_rate[:, 3 - r :]])

    def _put_rates(self, v: np.ndarray, a: np.ndarray) -> None:
        """Give the points velocities and accelerations (np, block)."""
        p, d, r = self.points, self.layout.dim, self.layout.rotations
        p.velocity, p.acceleration = v[:, :d].copy(), a[:, :d].copy()
        if r:
            p.spin, p.spin_rate = (np.zeros((len(p), 3)) for _ in range(2))
            p.spin[:, 3 - r :], p.spin_rate[:, 3 - r :] = v[:, d:], a[:, d:]

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
        step, (v, a) = self._step, self._rates()
        assert step is not None
        before = v
        v, a = step.end(increments.value - inertia.start, v, a)  # positions move by the same
        if step.rho_inf == 1.0:  # it isn't used, but by a step with another rho_inf
            a = (v - before) / step.dt
        if inertia.kernels is not None:
            self._turn_spins(step, inertia, increments, v, a)
        self._put_rates(v, a)
        self._step = self._pushed = self._found = None
        self._mean_before = self._mean

    def _turn_spins(
        self, step: TimeStep, inertia: Inertia, increments: Increments, v: np.ndarray, a: np.ndarray
    ) -> None:
        """Put spins and their rates into v and a (np, block), where inertia isn't alike in all directions."""
        s, rate = self._turning(inertia)
        new, after = step.end(inertia.summed((increments.value - inertia.start)[:, -3:]), s, rate)
        if step.rho_inf == 1.0:
            after = (new - s) / step.dt
        v[:, -3:] = np.linalg.solve(self._tensors(), new[:, :, None])[:, :, 0]
        a[:, -3:] = after / inertia.mass[:, -3:]

    def kept(self) -> dict[str, np.ndarray]:
        mean = {} if self._mean_before is None else {"mean_acceleration": self._mean_before}
        return super().kept() | mean

    def keep(self, rows: dict[str, np.ndarray]) -> None:
        super().keep(rows)
        self._mean_before = rows.get("mean_acceleration")
