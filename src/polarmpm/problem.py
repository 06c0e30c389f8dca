"""Quasi-static problems of material points: the object that a user's script talks to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from . import conditions, newton
from .conditions import Load, PlaneSpec, Prescribed, Support
from .errors import InputError
from .grid import Grid
from .interpolation import Increments, Interpolation, Reference
from .materials.base import parameter_values
from .newton import Controls, Outcome
from .nodes import ActiveNodes
from .parallel import look_up, together
from .pointforms import CoupleForm, FieldForm, Kernel, Layout, PointForm
from .points import Points, Selection
from .pointsystem import PointSystem
from .resetting import ResetPolicy, make_policy
from .seeding import check_inside
from .stepping import Schedule, Step, march
from .timing import Timer
from .weighting import check_basis

_ROTATION_LIMIT = 1.0  # rad; larger increments than this get a new base after a step


@dataclass
class Progress:
    """How far a run has come.

    Attributes:
        factor: load factor of the last converged state.
        step: number of converged steps.
        since_reset: converged steps since the last reset.
        reset_factor, rotation_factor: load factor at the last reset and rotation base.
        reset_due: the grid is to be reset before the next step.
    """

    factor: float = 0.0
    step: int = 0
    since_reset: int = 0
    reset_factor: float = 0.0
    rotation_factor: float = 0.0
    reset_due: bool = True


@dataclass
class Fields:
    """Stresses of the current state, for output.

    Attributes:
        energy: strain energy per reference volume (Pa), scalar.
        stress: Cauchy stress (Pa), tensor.
        couple_stress: Cauchy couple stress (N/m), tensor.
    """

    energy: np.ndarray
    stress: np.ndarray
    couple_stress: np.ndarray


@dataclass
class _Compiled:
    kernels: list[tuple[Kernel, Kernel]] = field(default_factory=list)
    couple: Kernel | None = None
    fields: list[Callable[..., np.ndarray]] = field(default_factory=list)


class QuasiStatic:
    """Equilibrium of material points on a grid under slowly changing loads. All methods are collective.

    Args:
        grid: background grid.
        points: the body.
        basis: weighting functions, "gimpm" or "mpm" (T 2.3.2).
        reset: when the grid is reset: every n steps (1: the papers' method), a policy such as
            `WhenDistorted(0.2)`, or None for never.
        controls: tolerances of Newton's method.

    Raises:
        InputError: an argument is out of range; materials that don't go together.
        PointsOutsideGrid: points lie outside the grid; the message names them.
    """

    def __init__(
        self,
        grid: Grid,
        points: Points,
        *,
        basis: str = "gimpm",
        reset: int | ResetPolicy | None = 1,
        controls: Controls | None = None,
    ):
        self.grid, self.points, self.comm = grid, points, grid.comm
        self.basis, self.policy = check_basis(basis), make_policy(reset)
        self.controls = controls or Controls()
        if points.dim != grid.dim:
            raise InputError(f"points have {points.dim} dimensions, the grid has {grid.dim}")
        check_inside(grid, points)
        layouts = {Layout.of(m, grid.dim) for m in points.materials}
        if len(layouts) > 1:
            raise InputError("points: micropolar and classical materials can't be mixed in one body")
        self.layout = layouts.pop()
        self.forms = [PointForm(m, grid.dim) for m in points.materials]
        for form in self.forms:
            _ = form.energy  # evaluated now, so that a mistake in a user's energy shows here
        self.supports: list[Support] = []
        self.loads: list[Load] = []
        self.progress, self.timer = Progress(), Timer()
        self.steps: list[Step] = []
        self._compiled = _Compiled()
        self._system: PointSystem | None = None
        self._stale = False  # conditions have changed since the system was built
        # nodes, what was prescribed, and out-of-balance forces of the last converged step
        self._equilibrium: tuple[ActiveNodes, np.ndarray, np.ndarray] | None = None

    # conditions -----------------------------------------------------------------------------------
    def fix(self, where: PlaneSpec | Callable[[np.ndarray], np.ndarray], **components: Any) -> Support:
        """Prescribe components of grid nodes.

        Args:
            where: `plane(x=0.0)` or a predicate of node positions (n, d) -> (n,) bool.
            **components: u, theta (all components), or ux, uy, uz, theta_x, theta_y, theta_z (theta in
                plane strain), in m and rad. A number is ramped with the load factor; a function of the
                factor, or of (factor, positions), gives the total displacement or rotation. In one step a
                rotation in space may change by less than pi.

        Returns:
            The support, for `reaction`.

        Raises:
            InputError: unknown component, plane that isn't one of the grid, value that isn't finite.
        """
        support = conditions.make_support(
            where, components, self.layout, self.grid, self.points, len(self.supports) + 1
        )
        self.supports.append(support)
        self._stale = True
        return support

    def load(self, selection: Selection, *, force: Any = None, couple: Any = None) -> None:
        """A dead force (N) and couple (N m) in total, shared equally by the selected points.

        Values as in `fix`: numbers are ramped, functions of the load factor give the value. In plane strain
        they count per unit thickness, and the couple is one number.
        """
        if not isinstance(selection, Selection):
            raise InputError(
                f"selection = {selection!r}: use points.where, points.farthest or points.nearest"
            )
        share = 1.0 / max(1, len(selection))
        self._add_loads(f"load {len(self.loads) + 1}", selection, force, couple, False, share)

    def body_load(self, *, force: Any = None, couple: Any = None, on: Selection | None = None) -> None:
        """A dead force (N/m^3) and couple (N/m^2) per reference volume, on all points or a selection.

        Values as in `fix`; functions of two arguments get (factor, initial positions of the points (n, d)).
        """
        self._add_loads(f"body load {len(self.loads) + 1}", on, force, couple, True, 1.0)

    def _add_loads(
        self, name: str, selection: Selection | None, force: Any, couple: Any, density: bool, share: float
    ) -> None:
        self.loads += conditions.make_loads(name, selection, force, couple, self.layout, density, share)
        self._stale = True

    # solving --------------------------------------------------------------------------------------
    def march(self, steps: int | None = None, **options: Any) -> Iterator[Step]:
        """Raise the load factor to 1 in load steps; yields every converged step. See `stepping.Schedule`.

        Args:
            steps: number of equal steps from the present factor to `to`.
            to: final load factor (default 1).
            adaptive: cut a step that fails and retry from the last converged state, then grow again.
            progress: show a progress bar (default: on a terminal).

        Raises:
            NotConverged: with what was tried; the last converged state is intact.
            PointsOutsideGrid: points have left the grid and it is to be reset for the next step.
        """
        return march(self, Schedule.make(steps, **options))

    def attempt(self, factor: float) -> Outcome:
        """Try to find equilibrium at a load factor; on failure everything stays as it was."""
        system = self._prepare()
        start = system.x.copy()
        p = self.progress
        with self.timer("conditions"):
            with together(self.comm):
                forces, couples = conditions.point_loads(self.loads, self.points, self.layout, factor)
                increments = system.prescribed.increments(factor, p.reset_factor, p.rotation_factor)
            system.set_loads(forces, couples)
            system.set_prescribed(increments)
        outcome = newton.solve(system, self.controls)
        with self.timer("update"):
            if outcome.converged:
                at_points = system.interpolation.gather(system.x)
                inverted = self._inverted(at_points)
                if inverted:
                    outcome.converged = False
                    outcome.reason = f"{inverted} material point(s) turned inside out"
            if outcome.converged:
                self._commit(system, at_points, factor)
            else:
                system.x = start
        return outcome

    def _inverted(self, increments: Increments) -> int:
        bad = np.linalg.det(np.eye(self.grid.dim) + increments.gradient) <= 0
        return self.comm.allreduce(int(np.sum(bad)))

    def _commit(self, system: PointSystem, increments: Increments, factor: float) -> None:
        system.interpolation.update_points(increments)
        self._equilibrium = system.nodes, system.prescribed.fixed, system.residual
        p = self.progress
        p.factor, p.step, p.since_reset = factor, p.step + 1, p.since_reset + 1
        p.reset_due = self.policy.due(p.since_reset, increments.gradient, self.comm)
        if not p.reset_due and self.layout.rotations:
            largest = float(np.abs(system.x[:, self.layout.dim :]).max(initial=0.0))
            if self.comm.allreduce(largest, op=MPI.MAX) > _ROTATION_LIMIT:
                system.interpolation.rebase_rotations()
                system.x[:, self.layout.dim :] = 0.0
                p.rotation_factor = factor

    def _prepare(self) -> PointSystem:
        """The system of the present grid; reset if that is due, renewed if conditions have changed."""
        p, old = self.progress, self._system
        if old is not None and not p.reset_due and not self._stale:
            return old
        self._compile()
        if old is None or p.reset_due:
            check_inside(self.grid, self.points)
            with self.timer("reset"):
                interpolation = Interpolation(self.grid, self.points, self.basis, self.forms)
            self._system = self._build(interpolation)
            p.reset_due, p.since_reset = False, 0
            p.reset_factor = p.rotation_factor = p.factor
        else:
            self._system = self._build(old.interpolation)
            self._system.x[:] = old.x
        if old is not None:
            old.destroy()
        self._stale = False
        return self._system

    def _build(self, interpolation: Interpolation) -> PointSystem:
        with self.timer("conditions"), together(self.comm):
            prescribed = Prescribed(interpolation.nodes, self.supports, self.layout)
        c = self._compiled
        return PointSystem(interpolation, c.kernels, c.couple, prescribed, self.timer)

    def _compile(self) -> None:
        c = self._compiled
        with self.timer("compile"):
            if not c.kernels:
                c.kernels = [form.compile(self.comm) for form in self.forms]
            unsymmetric = self.layout.rotations == 3 and any(load.couple for load in self.loads)
            if unsymmetric and c.couple is None:
                c.couple = CoupleForm().compile(self.comm)

    # restart --------------------------------------------------------------------------------------
    def increments(self) -> tuple[Reference, np.ndarray, np.ndarray] | None:
        """What a restart needs between two resets: reference state, lattice numbers of the owned nodes and
        their increments (n, block); None when the grid is to be reset before the next step."""
        s = self._system
        if s is None or self.progress.reset_due:
            return None
        own = s.nodes.owned
        return s.interpolation.reference, s.nodes.lattice[:own], s.x[:own]

    def restore(
        self, progress: Progress, increments: tuple[Reference, np.ndarray, np.ndarray] | None
    ) -> None:
        """Continue from a state whose points have been put in already; see `io.restart`."""
        self.progress, self._equilibrium = progress, None
        if self._system is not None:
            self._system.destroy()
            self._system = None
        if increments is None:
            progress.reset_due = True
            return
        self._compile()
        reference, lattice, values = increments
        interpolation = Interpolation(self.grid, self.points, self.basis, self.forms, reference)
        self._system, self._stale = self._build(interpolation), False
        self._system.x[:] = look_up(self.comm, lattice, values, interpolation.nodes.lattice)

    # results --------------------------------------------------------------------------------------
    def fields(self) -> Fields:
        """Energy, Cauchy stress and couple stress at the local points."""
        c, p = self._compiled, self.points
        if not c.fields:
            c.fields = [FieldForm(m).compile(self.comm) for m in p.materials]
        out = np.zeros((len(p), 19))
        for m, (material, kernel) in enumerate(zip(p.materials, c.fields, strict=True)):
            rows = np.flatnonzero(p.material == m)
            if len(rows):
                numbers = np.tile(parameter_values(material), (len(rows), 1))
                out[rows] = kernel(p.F[rows], p.q[rows], p.wryness[rows], numbers)
        return Fields(out[:, 0], out[:, 1:10].reshape(-1, 3, 3), out[:, 10:].reshape(-1, 3, 3))

    def energy(self) -> float:
        """Strain energy of the body (J)."""
        return self.comm.allreduce(float(self.fields().energy @ self.points.volume0))

    def reaction(self, support: Support) -> tuple[np.ndarray, np.ndarray]:
        """Force (N), shape (d,), and couple (N m), shape (r,), with which a support holds the body.

        The couple sums the nodes' couples; it has no moment of the forces.

        Raises:
            InputError: nothing has been solved yet.
        """
        if self._equilibrium is None:
            raise InputError("reaction: no load step has been solved yet")
        nodes, fixed, residual = self._equilibrium
        own = nodes.owned
        held = fixed[:own] & support.mask(nodes)[:own, None]
        total = self.comm.allreduce(np.sum(residual[:own] * held, axis=0))
        return total[: self.layout.dim], total[self.layout.dim :]

    @property
    def system(self) -> PointSystem | None:
        """Active nodes, their increments and residual as of the last step; None before the first one."""
        return self._system

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the last step, prescribed ones included."""
        return 0 if self._system is None else self._system.nodes.total * self.layout.block
