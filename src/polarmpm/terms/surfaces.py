"""Conditions on surfaces that don't follow the grid: tractions, pressures and supports."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.amplitudes import Amplitude, Fade
from ..conditions.loads import no_microrotation
from ..conditions.prescribed import TOO_FAR, turns_too_far
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.surfaces import DeadTraction, FollowerPressure, FollowerTraction, Penalty, SurfaceForm
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..kinematics.moments import moments
from ..tools import checks
from .surfaceterms import SurfaceCondition

METHODS = ("penalty", "nitsche", "nitsche-unsymmetric")  # how supports hold a surface


class Traction(SurfaceCondition):
    """A traction (N/m^2) and couple traction (N/m), dead and per undeformed area, or following the surface.

    Args:
        follows: per current area, see `kinematics.tensors.convected`.
        share: a factor on both; 1 over the area where totals are given.
    """

    def __init__(
        self,
        name: str,
        surface: Surface,
        force: Any,
        couple: Any,
        *,
        follows: bool = False,
        share: float = 1.0,
    ):
        super().__init__(name, surface)
        self.follows = checks.flag(f"{name}: follows", follows)
        if force is None and couple is None:
            raise InputError(f"{name}: neither force nor couple is given")
        self._given, self._share = (force, couple), share
        self._values: list[Amplitude] = []

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        force, couple = self._given
        if couple is not None and not layout.rotations:
            raise no_microrotation(self.name, couple)
        self._values = [Amplitude(f"{self.name}, force", 0.0 if force is None else force, layout.dim)]
        if couple is not None:
            self._values.append(Amplitude(f"{self.name}, couple", couple, layout.rotations))
        super().attach(layout, comm)
        self.linear = self.form.symmetric
        self.proportional = self.form.symmetric  # couples in space turn with the spin

    def amplitudes(self) -> list[Amplitude]:
        return self._values

    def make_form(self) -> SurfaceForm:
        couples = len(self._values) > 1
        return FollowerTraction(self.layout, couples) if self.follows else DeadTraction(self.layout, couples)

    def values(self, factor: float) -> list[np.ndarray]:
        loads = [a.at(factor, self.surface.x) * self._share for a in self._values]
        before = [self._at["F"].reshape(len(self.surface), -1), self.surface.normal] if self.follows else []
        return (self.hoop() if self.follows else []) + before + loads


class Pressure(SurfaceCondition):
    """A pressure (Pa) against the current normal."""

    linear = False
    proportional = False

    def __init__(self, name: str, surface: Surface, p: Any):
        super().__init__(name, surface)
        self._pressure = Amplitude(f"{name}, p", p, 1)

    def amplitudes(self) -> list[Amplitude]:
        return [self._pressure]

    def make_form(self) -> SurfaceForm:
        return FollowerPressure(self.layout)

    def values(self, factor: float) -> list[np.ndarray]:
        before = self._at["F"].reshape(len(self.surface), -1)
        return [*self.hoop(), self._pressure.at(factor, self.surface.x), before, self.surface.normal]


class SurfaceSupport(SurfaceCondition):
    """Springs that hold a surface at prescribed displacements and rotations.

    Args:
        support: prescribed components, or None.
        normal: displacement along the undeformed normals (m), or None.
        stiffness, rotation_stiffness: springs per area (Pa/m, N/m), or one (n,) for each point.
        augment: after each converged step the springs' forces are kept, so that the gap of a load that stays
            vanishes over steps (augmented Lagrange method).

    Attributes:
        reaction: force (N) and couple (N m) on the body in the last step; None before the first one.
        moment: of them about the origin (N m), couples included.
        gap: how far the prescribed displacements were missed then (n,) (m).
        method: one of `METHODS`.
    """

    method = METHODS[0]

    def __init__(
        self,
        name: str,
        surface: Surface,
        *,
        support: Support | None,
        normal: Any,
        stiffness: float | np.ndarray,
        rotation_stiffness: float | np.ndarray,
        augment: bool = False,
    ):
        super().__init__(name, surface)
        self._columns = support.columns if support else {}
        self._normal = None if normal is None else Amplitude(f"{name}, normal", normal, 1)
        self._stiffness, self._rotation_stiffness, self.augment = stiffness, rotation_stiffness, augment
        self.proportional = not augment
        self.reaction: tuple[np.ndarray, np.ndarray] | None = None
        self.moment: np.ndarray | None = None
        self._faded: Fade | None = None
        self.gap: np.ndarray = np.zeros(0)

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        super().attach(layout, comm)
        self._springs = self._on_held(self._stiffness, self._rotation_stiffness)
        self._from_now = False
        self._last: np.ndarray = np.zeros((len(self.surface), layout.block))
        self.multiplier: np.ndarray = np.zeros((len(self.surface), layout.block))
        self._offset: np.ndarray = np.zeros((len(self.surface), layout.dim))

    def amplitudes(self) -> list[Amplitude]:
        of_columns = [amplitude for amplitude, _ in self._columns.values()]
        return of_columns + ([] if self._normal is None else [self._normal])

    def begin_at(self, factor: float, counts: str | None) -> None:
        super().begin_at(factor, counts)
        self._from_now = counts == "from now"

    def start_from(self, u: np.ndarray, F: np.ndarray) -> None:
        super().start_from(u, F)
        if self._from_now:
            self._offset = u.copy()

    def fade(self, begin: float, end: float) -> None:
        """The springs' forces of the last step are kept, and fade."""
        self._faded = Fade(begin, end)

    def end_at(self, factor: float) -> None:
        if self._faded is not None:
            self._faded = self._faded.after(factor)

    def make_form(self) -> SurfaceForm:
        return Penalty(self.layout)

    def _on_held(self, displaced: float | np.ndarray, turned: float | np.ndarray) -> np.ndarray:
        """A number on what is held of displacements, another on what is held of rotations, (n, b, b)."""
        n, d, b = len(self.surface), self.layout.dim, self.layout.block
        p = np.zeros((n, b, b))
        for column in self._columns:
            p[:, column, column] = displaced if column < d else turned
        if self._normal is not None:
            normal = self.surface.normal
            along = normal[:, :, None] * normal[:, None, :]
            p[:, :d, :d] += np.broadcast_to(displaced, n)[:, None, None] * along
        return p

    def _target(self, factor: float) -> np.ndarray:
        """Increments (n, b) since the last reset, of rotations since their base, that leave no gap."""
        x, d, r = self.surface.x, self.layout.dim, self.layout.rotations
        total = np.zeros((len(x), self.layout.block))
        for column, (amplitude, component) in self._columns.items():
            total[:, column] = amplitude.at(factor, x)[:, component]
        moved = self._at["u"] - self._offset
        target: np.ndarray = total - np.hstack([moved, self._at["theta"]])
        if r == 3 and all(c in self._columns for c in range(d, d + 3)):
            if np.any(turns_too_far(self._at["theta"], total[:, d:])):
                raise InputError(f"{self.name}: {TOO_FAR}")
            there = rotations.from_vector(total[:, d:])
            way = rotations.multiply(there, rotations.conjugate(self._at["q"]))
            target[:, d:] = rotations.to_vector(np.where(way[:, :1] < 0, -way, way))
        if self._normal is not None:
            normal = self.surface.normal
            along = self._normal.at(factor, x)[:, 0] - np.sum(normal * moved, axis=1)
            target[:, :d] = along[:, None] * normal
        return target

    def values(self, factor: float) -> list[np.ndarray]:
        springs = self._springs.reshape(len(self.surface), -1)
        if self._faded is not None:
            forces = self._last * self._faded.share(factor)
            return [np.zeros_like(springs), np.zeros_like(forces), forces]
        if self._carrying and self.augment:  # the step has converged with this force before it was kept
            springs = np.zeros_like(springs)
        return [springs, self._target(factor), self.multiplier]

    def rebase_rotations(self) -> None:
        d, w = self.layout.dim, self.theta - self._at["theta"]
        if self.layout.rotations == 3:  # what does work on Dw now does it on the spin
            turned = rotations.couples_on_spins(w, self.multiplier[:, d:])
            self.multiplier = np.hstack([self.multiplier[:, :d], turned])
        super().rebase_rotations()

    def converged(self, y: np.ndarray) -> None:
        d, b = self.layout.dim, self.layout.block
        force = self.evaluate(y, np.arange(len(y)))[:, :b]
        self.gap = self._gap(y)
        on_body = -self.area[:, None] * force
        if self.layout.rotations == 3:
            on_body[:, d:] = rotations.couples_on_spins(self.form.slots.part(y, "rotation"), on_body[:, d:])
        self.reaction = on_body[:, :d].sum(axis=0), on_body[:, d:].sum(axis=0)
        place, couples = self.surface.x + self.u, on_body[:, d:]
        self.moment = moments(place, on_body[:, :d], couples).sum(axis=0) + self._moment_of_gradients(y)
        if self._faded is None:
            self._last = force
        if self.augment and self._faded is None:
            self.multiplier = force

    def _moment_of_gradients(self, y: np.ndarray) -> np.ndarray | float:
        """Of what does work on the displacement's gradient (N m)."""
        return 0.0

    @property
    def _aim(self) -> np.ndarray:
        """What `_target` gave for the present load factor."""
        return self._data[1]

    def _gap(self, y: np.ndarray) -> np.ndarray:
        """How far the prescribed displacements are missed (n,) (m)."""
        d, target = self.layout.dim, self._aim
        miss = self.form.slots.part(y, "displacement") - target[:, :d]
        if self._normal is not None:
            distance: np.ndarray = np.abs(np.sum(miss * self.surface.normal, axis=1))
            return distance
        held = [c for c in range(d) if c in self._columns]
        return np.asarray(np.linalg.norm(miss[:, held], axis=1))

    def state(self) -> dict[str, np.ndarray]:
        return {
            **super().state(),
            "multiplier": self.multiplier,
            "offset": self._offset,
            "last": self._last,
            "gap": np.zeros(len(self.surface)) if self.reaction is None else self.gap,
            "reaction": self._reaction_row(),
            "method": np.array([float(METHODS.index(self.method))]),
        }

    def _reaction_row(self) -> np.ndarray:
        """Force, couple and moment in a row; not a number before the first step."""
        d, r = self.layout.dim, self.layout.rotations
        if self.reaction is None or self.moment is None:
            return np.full(d + r + (1 if d == 2 else 3), np.nan)
        return np.concatenate([*self.reaction, self.moment])

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        saved = METHODS[int(arrays["method"][0])] if "method" in arrays else METHODS[0]
        if saved != self.method:
            raise InputError(
                f"{self.name}: method = {self.method!r}, in the saved run {saved!r}; give fix that method"
            )
        super().restore({**arrays, "method": np.zeros(1)})
        self.multiplier = np.array(arrays["multiplier"], dtype=float)
        self._offset, self._last = (np.array(arrays[name], dtype=float) for name in ("offset", "last"))
        row, ends = arrays["reaction"], np.cumsum([self.layout.dim, self.layout.rotations])
        if np.all(np.isfinite(row)):
            force, couple, self.moment = np.split(np.array(row, dtype=float), ends)
            self.reaction, self.gap = (force, couple), np.array(arrays["gap"], dtype=float)
