"""Dynamic problems: of material points on a grid, and of finite elements."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..assembly.parts import Parts
from ..assembly.smoothing import projected
from ..basis.base import Basis
from ..bodies.elements import Elements
from ..bodies.points import Points
from ..bodies.reference import Increments
from ..errors import InputError
from ..geometry.grid import Grid
from ..solvers.newton import Controls
from ..solvers.resetting import InMotion, ResetPolicy
from ..terms.ghost import GhostPenalty
from ..tools import checks
from ..tools.meetings import collective
from . import takeover
from .comingnear import CellsThen, meets_supports, pieces_meet
from .elements import QuasiStaticFEM
from .gridpolicies import RegridPolicy
from .motion import Moving
from .points import QuasiStatic

_IN_MOTION = InMotion()
# rho_inf above which resets stop what flips from step to step within boxes: bodies that spin would blow up
_FLIPPING = 0.9


class Dynamic(Moving, QuasiStatic):
    """Motion of material points on a grid. All methods are collective. What isn't said here is as of
    `QuasiStatic`, with the time (s) for the load factor.

    Args:
        grid: background grid.
        points: the body.
        density: mass per reference volume (kg/m^3): a number; one for each of `points.materials`, in a
            sequence or by material; or a function of the initial positions (n, d), which gives (n,).
        microinertia: j (m^2) of the microrotations' moment of inertia rho j, likewise; of a micropolar body
            it is needed. In space also tensors J / rho (3, 3) of the undeformed body, which turn with the
            microrotation: one; one a material; or a function that gives (n, 3, 3).
        rho_inf: by what a step multiplies motions whose period is much shorter than it: 1 keeps them (the
            implicit midpoint rule), 0 ends them at once. Above 0.9 resets of the grid stop, too, what flips
            from step to step within the points' boxes.
        drag: of all velocities and spins relative to their inertia (1/s), the part of Rayleigh damping that
            is proportional to the mass.
        viscosity: stress of a strain rate, over that of the same strain (s): the part that is proportional to
            the stiffness, of the elastic moduli. For bodies that hardly turn in a step: rotations count to
            its second order only, so that it slows down what spins fast.
        filtered: at each reset of the grid let go what velocities, spins and their rates have that the new
            nodes can't move: take their least-squares projection, by mass. Momenta stay; the energy counts as
            `damped`.
        basis, reset, ghost, rebalance, controls, solver, boxes, locking: as of `QuasiStatic`. Resets aren't
            balanced: the forces that a balanced one carries along would stay while the motion goes on. With
            "bspline" and boxes=False a body that spins needs a `GhostPenalty` of 1e-3 of its moduli.
        regrid: as of `QuasiStatic`, a policy that doesn't split points: `FollowBody` without `h`.

    Raises:
        InputError: an argument is out of range; materials that don't go together.
        PointsOutsideGrid: points lie outside the grid; the message names them.
    """

    _most_growth = 1.5  # of the domains of points that fly apart
    _carries_sides = True
    _ghost_beyond = True  # nodes beyond the walls that domains hardly reach hold nothing else
    _pieces: np.ndarray | None = None  # of the body at the beginning, by number, of each local point
    _several = False  # there are several of them in one body
    _then: CellsThen | None = None  # where points were at the last reset
    # a system, and what its nodes did in the last step after forces were in balance
    _since_balance: tuple[LoadedPoints, np.ndarray] | None = None

    @collective("Dynamic", comm=lambda self, grid, *args, **options: grid.comm, compare=True)
    def __init__(
        self,
        grid: Grid,
        points: Points,
        *,
        density: Any,
        microinertia: Any = None,
        rho_inf: float = 0.9,
        drag: float = 0.0,
        viscosity: float = 0.0,
        basis: str | Basis = "bspline",
        reset: int | ResetPolicy | None = _IN_MOTION,
        ghost: str | GhostPenalty | None = None,
        filtered: bool = False,
        rebalance: float | None = 1.1,
        controls: Controls | None = None,
        solver: str = "auto",
        boxes: bool | None = None,
        locking: str | None = "auto",
        regrid: RegridPolicy | None = None,
    ):
        self.filtered = checks.flag("filtered", filtered)
        super().__init__(
            grid,
            points,
            basis=basis,
            reset=reset,
            balanced_reset=False,
            ghost=ghost,
            rebalance=rebalance,
            controls=controls,
            solver=solver,
            boxes=boxes,
            locking=locking,
            regrid=regrid,
        )
        if self.layout.rotations == 3:
            self._rotation_limit = 0.0  # in space rotations count from the beginning of each step
        self._set_motion(density, microinertia, rho_inf, drag, viscosity)
        if self.filtered and self._has_tensors:
            raise checks.refuse("filtered", filtered, "there is none where microinertia is a tensor")

    @classmethod
    def of(
        cls,
        problem: QuasiStatic,
        *,
        density: Any,
        microinertia: Any = None,
        rho_inf: float = 0.9,
        drag: float = 0.0,
        viscosity: float = 0.0,
        reset: int | ResetPolicy | None = _IN_MOTION,
        rebalance: float | None = 1.1,
        controls: Controls | None = None,
    ) -> Dynamic:
        """Go on from a quasi-static problem, whose body is taken on. Collective.

        At time 0 the body is at rest, in the equilibrium of the last load step. Supports hold it where it is,
        loads keep their values, until they are released; what is given from then on counts from now. Initial
        stresses and forces of balanced resets are kept until the grid is reset. Basis, ghost penalty, solver,
        boxes and the cure of locking are those of the problem; `controls`, too, by default.

        Raises:
            InputError: no `QuasiStatic` whose last step is the body's state; conditions on surfaces, terms of
                one's own, or conditions that are fading.
        """
        takeover.check(problem, QuasiStatic)
        ids = problem.points.id
        made = cls(
            problem.grid,
            problem.points,
            density=density,
            microinertia=microinertia,
            rho_inf=rho_inf,
            drag=drag,
            viscosity=viscosity,
            basis=problem.basis,
            reset=reset,
            ghost=problem.ghost,
            rebalance=None,
            controls=controls or problem.controls,
            solver=problem.solver,
            boxes=problem.boxes,
            locking=problem.locking,
        )
        takeover.take_conditions(made, problem)
        takeover.take_progress(made, problem)
        takeover.take_points(made, problem, ids, rebalance)
        return made

    def restore(self, *arguments: Any) -> None:
        """As of `QuasiStatic`; rotations in space count from now on, as at the beginning of each step."""
        super().restore(*arguments)
        s, d = self._system, self.layout.dim
        if (
            s is not None
            and self.layout.rotations == 3
            and self.comm.allreduce(bool(np.any(s.x[:, d:])), op=MPI.LOR)
        ):
            self._with_boxes(s.rebase_rotations)

    def _prepare(self) -> Any:
        again, before = self._system is not None and self.progress.reset_due, self._system
        system = super()._prepare()
        if system is not before:
            self._then = None
        if again and self.filtered:
            self._filter(system)
        return system

    def _reset(self) -> LoadedPoints:
        """As of `QuasiStatic`; the energy within the points' boxes that isn't carried along is let go."""
        p, stored = self.progress, self.box_record.energy(self._system)
        system = super()._reset()
        p.reset_work += stored - self.box_record.energy(system)
        self.box_record.note_let_go(p.reset_work, max(abs(p.external_work), self._kinetic()))
        return system

    def _commit(self, system: LoadedPoints, increments: Increments, factor: float) -> None:
        if self.rho_inf > _FLIPPING and system.inertia is not None and self._step is not None:
            self._since_balance = system, (1.0 - self._step.theta) * system.inertia.gained(system)
        super()._commit(system, increments, factor)

    def _after_balance(self, system: LoadedPoints) -> np.ndarray | None:
        at = self._since_balance
        return at[1] if at is not None and at[0] is system else None

    def _filter(self, system: LoadedPoints) -> None:
        """Project velocities and accelerations. Collective."""
        before = self._kinetic()
        mass = system.inertia.mass if system.inertia is not None else self._masses()
        mass = np.where(mass > 0.0, mass, 1e-9 * mass[:, :1])  # of spins without inertia
        self._put_rates(*(projected(system, mass, rates) for rates in self._rates()))
        self.progress.damped_work += before - self._kinetic()

    def _comes_near(self, system: LoadedPoints, increments: Increments) -> bool:
        policy, p, d = self.policy, self.points, self.layout.dim
        if not isinstance(policy, InMotion):
            return False
        if self._pieces is None:
            found = Parts.of(system, p)
            self._pieces = (found.points if len(found.count) > p.bodies else np.zeros(len(p))).astype(float)
            self._several = len(found.count) > p.bodies
        moved, body = increments.value[:, :d], p.body if p.bodies > 1 else np.zeros(len(p), dtype=np.int32)
        if self._then is None:
            self._then = CellsThen(self.grid, p.x - moved)
        if self._several:
            most = float(np.abs(moved).max(initial=0.0)) / self.cell_size
            far = self.comm.allreduce(most, op=MPI.MAX) > policy.near
            if far and pieces_meet(self.grid, self.comm, p.x, self._pieces.astype(np.int64), body):
                return True
        return meets_supports(self.grid, self.comm, self.supports, p.x, self._then, body)

    def kept(self) -> dict[str, np.ndarray]:
        return super().kept() | ({} if self._pieces is None else {"piece": self._pieces})

    def keep(self, rows: dict[str, np.ndarray]) -> None:
        super().keep(rows)
        self._pieces = rows.get("piece")
        most = 0.0 if self._pieces is None else float(self._pieces.max(initial=0.0))
        self._several = self.comm.allreduce(most, op=MPI.MAX) > 0.0

    @property
    def _evaluated_at_end(self) -> bool:
        return self.points.plastic or any(form.scalars for form in self.forms)


class DynamicFEM(Moving, QuasiStaticFEM):
    """Motion of a mesh of finite elements. All methods are collective. What isn't said here is as of
    `QuasiStaticFEM`, with the time (s) for the load factor; velocities live at the quadrature points.

    Args:
        elements: the body.
        density, microinertia, rho_inf, drag, viscosity: as of `Dynamic`.
        controls, solver, locking: as of `QuasiStaticFEM`.

    Raises:
        InputError: an argument is out of range; materials with second gradients.
    """

    @collective("DynamicFEM", comm=lambda self, elements, *args, **options: elements.comm, compare=True)
    def __init__(
        self,
        elements: Elements,
        *,
        density: Any,
        microinertia: Any = None,
        rho_inf: float = 0.9,
        drag: float = 0.0,
        viscosity: float = 0.0,
        controls: Controls | None = None,
        solver: str = "auto",
        locking: str | None = "auto",
    ):
        super().__init__(elements, controls=controls, solver=solver, locking=locking)
        self._set_motion(density, microinertia, rho_inf, drag, viscosity)
        if any(material.second_gradient for material in self.points.materials):
            raise InputError("elements: a material has second gradients, of which elements have no dynamics")
        cured = any(part.form.scalars for part in getattr(self.forms, "parts", ()))
        if self.viscosity and cured:
            allowed = "on elements with a cure of locking there is none; write locking=None"
            raise checks.refuse("viscosity", viscosity, allowed)

    @classmethod
    def of(
        cls,
        problem: QuasiStaticFEM,
        *,
        density: Any,
        microinertia: Any = None,
        rho_inf: float = 0.9,
        drag: float = 0.0,
        viscosity: float = 0.0,
        controls: Controls | None = None,
    ) -> DynamicFEM:
        """Go on from a quasi-static problem, whose body is taken on; see `Dynamic.of`. Collective."""
        takeover.check(problem, QuasiStaticFEM)
        made = cls(
            problem.elements,
            density=density,
            microinertia=microinertia,
            rho_inf=rho_inf,
            drag=drag,
            viscosity=viscosity,
            controls=controls or problem.controls,
            solver=problem.solver,
            locking=problem.locking,
        )
        takeover.take_conditions(made, problem)
        takeover.take_progress(made, problem)
        made.keep(problem.kept())
        made.restore(made.progress)
        return made

    @property
    def _loaded(self) -> bool:
        return True

    @property
    def _evaluated_at_end(self) -> bool:
        return self.points.plastic or bool(self._system and self._system.projected_F())
