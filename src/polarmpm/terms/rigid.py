"""Rigid bodies with a mass, which contact pushes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.amplitudes import Amplitude
from ..errors import InputError
from ..forms.gyration import momentum_kernel
from ..forms.rigidcontact import motions
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..kinematics.timesteps import TimeStep
from ..tools import checks
from .base import Piece, Setting
from .rigidgiven import constant, held_motions, inertia_tensor, names_of
from .settling import Settling, Sums

_KEPT = ("position", "turns", "velocity", "acceleration", "momenta", "rates", "contact", "held", "held_by")


class RigidBody(Settling):
    """A rigid body that moves freely, pushed by contact with bodies that aren't rigid; give it to
    `problem.obstacle(shape, body=...)`, for several shapes if it has such. In the plane masses, forces and
    moments are per metre of thickness; with a body of revolution it is one, too, whole, and moves along the
    axis. Its attributes are those of the last converged step, the same on all ranks.

    Args:
        centre: of mass, at the beginning (m), (d,).
        mass: (kg). It may be left out in quasi-statics without gravity, and where all motions are held.
        inertia: moment of inertia about the centre (kg m^2): a number; in space also three, about the axes,
            or a tensor (3, 3). It may be left out where there is no turn, or no inertia.
        velocity, spin: at the beginning (m/s, rad/s): (d,), and a number in the plane, (3,) in space.
        force, moment: on it besides those of contact (N, N m; about the centre), as values of `load`: a
            number grows with the load factor or the time, a function gives it.
        gravity: acceleration (m/s^2), likewise, times the mass.
        held: motions of the centre, `"ux"`, `"uy"`, `"uz"`, and turns, `"w"` in the plane, `"wx"`, `"wy"`,
            `"wz"` in space, that are given: a sequence of those that are none, or their values by name (m,
            rad; from the beginning on) as values of `fix`. Turns in space can be none only.
        name: for messages and results.

    Attributes:
        centre, displacement: of the centre (m), (d,).
        rotation: tensor (d, d) that has turned it since the beginning; turn: of a body in the plane, the
            angle (rad).
        velocity, spin: (m/s, rad/s).
        contact_force, contact_moment: of contact on it (N, N m; about the centre); in dynamics where forces
            are in balance, within the step.
        reaction: of what holds it, forces and moments.

    Raises:
        InputError: an argument is out of range.
    """

    carried = False
    proportional = False
    _axial = False

    def __init__(
        self,
        centre: Any,
        *,
        mass: float | None = None,
        inertia: Any = None,
        velocity: Any = None,
        spin: Any = None,
        force: Any = None,
        moment: Any = None,
        gravity: Any = None,
        held: Sequence[str] | Mapping[str, Any] = (),
        name: str = "rigid body",
    ):
        self.name = name = checks.text("RigidBody: name", name)
        first = checks.numeric(f"{name}: centre", centre, "a place (m)")
        if first.shape not in ((2,), (3,)):
            raise checks.refuse(f"{name}: centre", centre, "a place (m), two or three numbers, is needed")
        d = self.dim = len(first)
        self._first = self.position = checks.vector(f"{name}: centre", centre, d)
        self.mass = None if mass is None else checks.number(f"{name}: mass", mass, above=0.0)
        self.inertia = inertia_tensor(name, inertia, d)
        turns = motions(d) - d
        zero = (0.0,) * d
        self.velocity = checks.vector(f"{name}: velocity", zero if velocity is None else velocity, d)
        given_spin = np.zeros(turns) if spin is None else np.atleast_1d(checks.numeric(f"{name}: spin", spin))
        self._first_spin = checks.vector(f"{name}: spin", given_spin, turns)
        if gravity is not None and self.mass is None:
            raise checks.refuse(f"{name}: gravity", gravity, "it needs a mass")
        given = {"force": (force, d), "moment": (moment, turns), "gravity": (gravity, d)}
        self._loads = {
            key: Amplitude(f"{name}: {key}", (0.0,) * size if value is None else value, size)
            for key, (value, size) in given.items()
        }
        self._held = held_motions(name, held, d)
        free = np.ones(motions(d), dtype=bool)
        free[list(self._held)] = False
        self.free = free
        self._put_arrays()

    def _put_arrays(self) -> None:
        k, turns = motions(self.dim), motions(self.dim) - self.dim
        self.turns = np.zeros(4) if self.dim == 3 else np.zeros(1)
        if self.dim == 3:
            self.turns[0] = 1.0
        self.moved, self.held, self.contact, self.held_by = (np.zeros(k) for _ in range(4))
        self.acceleration, self.rates = np.zeros(self.dim), np.zeros(turns)
        self.momenta = self._tensor() @ self._first_spin
        self.step: TimeStep | None = None
        self.now = self._at = 0.0  # time or factor of the last converged step, and that of the forces
        self.active = self.frozen = False
        self._settled: tuple[np.ndarray, Any] | None = None
        self._kernel: Kernel | None = None
        self._targets = self._outer = np.zeros(k)

    def __repr__(self) -> str:
        mass = "no mass" if self.mass is None else f"{self.mass:g} kg"
        return f"RigidBody({self.name!r}: {mass}, centre {tuple(float(c) for c in self.centre)})"

    # what it is ---------------------------------------------------------------------------------------
    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        if layout.dim != self.dim:
            raise InputError(
                f"{self.name}: centre has {self.dim} numbers, the body has {layout.dim} dimensions"
            )
        self.layout, self.comm = layout, comm
        if self.dim == 3:
            self._kernel = momentum_kernel(comm)

    def revolve(self) -> None:
        """It is of revolution, and moves along the axis alone.

        Raises:
            InputError: its centre isn't on the axis, or it is given another motion.
        """
        across = "of revolution it is on the axis, x = 0, and moves along it alone"
        given = (("centre", self._first[0]), ("velocity", self.velocity[0]), ("spin", self._first_spin[0]))
        for key, value in given:
            if value != 0.0:
                raise checks.refuse(f"{self.name}: {key}", float(value), across)
        for key, k in (("ux", 0), ("w", 2)):
            held = self._held.get(k)
            if held is not None and (held.function is not None or held.constant.any()):
                raise checks.refuse(f"{self.name}: held", key, across)
            if held is None:
                self._held[k] = Amplitude(f"{self.name}: held: {key}", 0.0, 1)
                self.free[k] = False
        self._axial = True

    def check_motion(self, moving: bool) -> None:
        """Raise InputError unless it has what a problem with, or without, inertia needs."""
        d = self.dim
        if not moving:
            for key, value in (("velocity", self.velocity), ("spin", self._first_spin)):
                if np.any(value):
                    raise checks.refuse(
                        f"{self.name}: {key}", value, "in a quasi-static problem there is none"
                    )
            return
        if self.mass is None and self.free[:d].any():
            raise InputError(
                f"{self.name}: mass = None: in a dynamic problem a body that moves freely needs one"
            )
        if self.inertia is None and self.free[d:].any():
            raise InputError(
                f"{self.name}: inertia = None: in a dynamic problem a body that turns freely needs one; hold "
                f"its turns otherwise, held={names_of(d)[d:]!r}"
            )

    def begin_at(self, factor: float, counts: str | None) -> None:
        self.now = self._at = factor
        for amplitude in self._loads.values():
            amplitude.begin(factor, counts)
        for amplitude in self._held.values():
            amplitude.begin(factor, counts or "total")

    def pieces(self, setting: Setting) -> Sequence[Piece]:
        return []

    def _tensor(self) -> np.ndarray:
        """Moment of inertia (1, 1), or the tensor in space as it is turned now (3, 3)."""
        turns = motions(self.dim) - self.dim
        if self.inertia is None:  # for the spin
            return np.eye(turns)
        if self.dim == 2:
            return self.inertia
        turned: np.ndarray = self.rotation @ self.inertia @ self.rotation.T
        return turned

    # a step -------------------------------------------------------------------------------------------
    def integrate(self, step: TimeStep) -> None:
        self.step, self.frozen = step, False
        self._release_place()

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        self.active, self._at = not carrying, factor
        if carrying:
            return
        self.frozen, nowhere = False, np.zeros((1, self.dim))
        d, theta = self.dim, 1.0 if self.step is None else self.step.theta
        end = factor if self.step is None else self.now + self.step.dt
        self._targets = np.zeros(motions(d))
        for k, amplitude in self._held.items():
            self._targets[k] = theta * (amplitude.at(end, nowhere)[0, 0] - self.held[k])
        force, moment, gravity = (a.at(factor, nowhere)[0] for a in self._loads.values())
        if self.mass is not None:
            force = force + self.mass * gravity
        self._outer = np.concatenate([force, moment])
        self._release_place()

    def _release_place(self) -> None:
        """It has to be found anew, from that at the beginning of the step."""
        self._settled, self.moved = None, np.where(self.free, 0.0, self._targets)

    def unsettle(self) -> None:
        """Forces on it have changed."""
        self._settled = None

    def _inertial(self, q: np.ndarray) -> Sums:
        k, d = motions(self.dim), self.dim
        force, tangent, size = np.zeros(k), np.zeros((k, k)), np.zeros(k)
        step = self.step
        if step is None:
            return force, tangent, size
        if self.mass is not None:
            past = self.mass * step.history(self.velocity, self.acceleration)
            force[:d] = self.mass * step.acceleration * q[:d] - past
            size[:d] = np.abs(past) + np.abs(force[:d])
            tangent[range(d), range(d)] = self.mass * step.acceleration
        if self.inertia is None:
            return force, tangent, size
        past = step.history(self.momenta, self.rates)
        moment, slope = self._summed(q[d:] / step.theta)
        force[d:] = step.acceleration * step.theta * moment - past
        size[d:] = np.abs(past) + np.abs(force[d:])
        tangent[d:, d:] = step.acceleration * slope
        return force, tangent, size

    def _summed(self, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The integral of the spin's momentum over a step in which it turns, and its derivative."""
        tensor = self._tensor()
        if self.dim == 2:
            return tensor @ turn, tensor
        assert self._kernel is not None
        found = self._kernel(turn[None], tensor.reshape(1, 9))[0]
        return found[:3], found[3:].reshape(3, 3)

    def freeze(self) -> None:
        """Forces are in balance, and `moved` is what it has moved until then: go to the end of the step."""
        if not self.frozen:
            self.contact, self.held_by = -self._pushed, self._reactions
            if self._axial:  # around the axis others are in balance
                self.contact = np.array([0.0, self.contact[1], 0.0])
                self.held_by = np.array([0.0, self.held_by[1], 0.0])
            self.at_balance = self.moved
            self.moved = self.moved / (1.0 if self.step is None else self.step.theta)
            self.frozen = True

    def end_at(self, factor: float) -> None:
        self._end = factor

    def finished(self) -> None:
        if not self.active:
            return
        self.freeze()
        d, moved, step = self.dim, self.moved, self.step
        self.held = self.held + moved
        if step is not None:
            v, a = self.velocity, self.acceleration
            self.velocity, self.acceleration = step.end(moved[:d], v, a)
            s = self.momenta
            self.momenta, self.rates = step.end(self._summed(moved[d:])[0], s, self.rates)
            if step.rho_inf == 1.0:  # they aren't used, but by a step with another rho_inf
                self.acceleration, self.rates = (self.velocity - v) / step.dt, (self.momenta - s) / step.dt
        self.position = self.position + moved[:d]
        self.turns = (
            rotations.turned(self.turns[None], moved[None, d:])[0] if d == 3 else self.turns + moved[d:]
        )
        self.now, self.step, self.active, self.frozen = self._end, None, False, False
        self.moved, self._settled = np.zeros_like(moved), None

    def still(self, factor: float) -> RigidBody:
        """The same body at rest where it is, with the loads of a load factor, for a problem that goes on from
        time 0."""
        made = type(self).__new__(type(self))
        made.__dict__.update(self.__dict__)
        made._loads = {key: constant(amplitude, factor) for key, amplitude in self._loads.items()}
        made._held = {k: constant(amplitude, factor) for k, amplitude in self._held.items()}
        made.now = made._at = 0.0
        return made

    # results ------------------------------------------------------------------------------------------
    @property
    def centre(self) -> np.ndarray:
        return self.position.copy()

    @property
    def displacement(self) -> np.ndarray:
        found: np.ndarray = self.position - self._first
        return found

    @property
    def turn(self) -> float:
        if self.dim == 3:
            raise InputError(f"{self.name}: turn: of a body in space it is no number; rotation tells it")
        return float(self.turns[0])

    @property
    def rotation(self) -> np.ndarray:
        if self.dim == 3:
            found: np.ndarray = rotations.to_tensor(self.turns[None])[0]
            return found
        c, s = np.cos(self.turns[0]), np.sin(self.turns[0])
        return np.array([[c, -s], [s, c]])

    @property
    def spin(self) -> np.ndarray:
        """(1,) in the plane, (3,) in space (rad/s)."""
        found: np.ndarray = np.linalg.solve(self._tensor(), self.momenta)
        return found

    @property
    def contact_force(self) -> np.ndarray:
        return self.contact[: self.dim].copy()

    @property
    def contact_moment(self) -> np.ndarray:
        return self.contact[self.dim :].copy()

    @property
    def reaction(self) -> dict[str, float]:
        return {names_of(self.dim)[k]: float(self.held_by[k]) for k in self._held}

    @property
    def momentum(self) -> np.ndarray:
        """(N s), (d,)."""
        found: np.ndarray = (0.0 if self.mass is None else self.mass) * self.velocity
        return found

    def angular_momentum(self, about: Any = None) -> np.ndarray:
        """(N m s) about a point (default: the origin), (1,) in the plane, (3,) in space."""
        point = np.zeros(self.dim) if about is None else checks.vector("about", about, self.dim)
        arm, p = self.position - point, self.momentum
        if self.dim == 2:
            arm, p = (np.append(v, 0.0) for v in (arm, p))
        own = 0.0 if self.inertia is None else self.momenta
        found: np.ndarray = own + np.cross(arm, p)[-len(self.momenta) :]
        return found

    @property
    def kinetic(self) -> float:
        """Energy of its motion (J)."""
        turning = 0.0 if self.inertia is None else self.momenta @ self.spin
        return 0.5 * float(self.momentum @ self.velocity + turning)

    def as_dict(self) -> dict[str, Any]:
        """Columns of a table."""
        turn = {"turn": self.turn} if self.dim == 2 else {"turn": rotations.to_vector(self.turns[None])[0]}
        return {
            **{"displacement": self.displacement, **turn, "velocity": self.velocity, "spin": self.spin},
            **{"force": self.contact_force, "moment": self.contact_moment, "kinetic": self.kinetic},
        }

    # restart ------------------------------------------------------------------------------------------
    def state(self) -> dict[str, np.ndarray]:
        kept = {name: getattr(self, name) for name in _KEPT}
        return {**kept, "now": np.array([self.now])}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        for name, old in self.state().items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != old.shape:
                raise InputError(
                    f"{self.name}: the saved {name} has the shape {found}; {old.shape} is needed"
                )
        for name in _KEPT:
            setattr(self, name, np.array(arrays[name], dtype=float))
        self.now = float(arrays["now"][0])
