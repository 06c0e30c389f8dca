"""Contact of a body with rigid obstacles: sites on its boundary, and the forces on them (docs/contact.md)."""

from __future__ import annotations

from copy import copy
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.amplitudes import Amplitude
from ..errors import InputError, LocalFailure, TrustWarning
from ..forms.contact import CONSTANTS, ContactForm, Law, pose_row
from ..geometry.shapes import Level, Shape
from ..geometry.surfaces import Surface
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..kinematics.moments import moments
from ..tools import checks
from ..tools.parallel import warn_on_one_rank
from .base import Piece, Setting
from .obstaclepieces import SitePiece
from .settings import GridSetting
from .sites import Sites
from .surfaceterms import undeformed_area

_REACH = 2.0  # cells: sites that are nearer to the obstacle when increments begin to count may touch it
_WITHIN = 0.45  # cells by which sites may lie in the obstacle at first, and points deeper than these
_LEAST = 0.1  # share of a corner's area, at least, that an obstacle beside it sees


class Obstacle(Sites):
    """A rigid obstacle that the body touches; made by `problem.obstacle`.

    Arrays are those of the last converged step, the same on all ranks, with one row for each of the sites:
    places on the body's boundary that it carries.

    Attributes:
        force: of the obstacle on the body (N), (d,).
        moment: of both about the origin (N m), (1,) in the plane or (3,).
        gap: distances of the sites (m), (n,); negative in the obstacle.
        pressure: (Pa) per undeformed area, (n,).
        traction: force on the body per undeformed area (Pa), (n, d), friction included.
        couple: couple traction on it per undeformed area (N/m), (n, r).
        x: where the sites are (m), (n, d).
        area: of the undeformed body that they stand for (m^2; m in the plane), (n,); of corners what faces
            the
            obstacle.
        touching: sites with a pressure, (n,) bool.
    """

    linear = False
    external = True
    proportional = False
    renew = False
    whole = False  # its sites are all of the body's boundary
    piece: type[SitePiece] = SitePiece

    def __init__(
        self,
        name: str,
        shape: Shape,
        surface: Surface,
        parents: np.ndarray | None,
        law: Law,
        constants: dict[str, float],
        size: float,
        gap: float | None,
        motion: Any = None,
        rotation: Any = None,
        about: Any = None,
        aslant: bool = False,
    ):
        super().__init__(name, surface)
        self.aslant = aslant
        self.shape, self.law, self.parents, self.tolerance = shape, law, parents, gap
        self._constants = np.array([constants[key] for key in CONSTANTS])
        self._size, self._given = size, (motion, rotation, about)
        self._teller: Kernel | None = None

    def __repr__(self) -> str:
        return f"Obstacle({self.name!r}: {self.shape!r}, {len(self.surface)} sites)"

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        if self.shape.dim not in (None, layout.dim):
            raise InputError(
                f"{self.name}: {self.shape!r} has {self.shape.dim} dimensions, the body has {layout.dim}"
            )
        d, turns = layout.dim, 1 if layout.dim == 2 else 3
        motion, rotation, about = self._given
        zero = 0.0 if d == 2 else (0.0, 0.0, 0.0)
        self._motion = Amplitude(f"{self.name}, motion", 0.0 if motion is None else motion, d)
        self._rotation = Amplitude(f"{self.name}, rotation", zero if rotation is None else rotation, turns)
        self._about = np.zeros(d) if about is None else checks.vector(f"{self.name}: about", about, d)
        super().attach(layout, comm)
        self._put_arrays()
        self._factor = self._now = 0.0  # of the last converged step, and of the present one
        self._balanced: tuple[np.ndarray, np.ndarray, list[np.ndarray]] | None = None
        self._checked = False

    def make_form(self) -> ContactForm:
        return ContactForm(self.layout, self.shape, self.law)

    def amplitudes(self) -> list[Amplitude]:
        return [self._motion, self._rotation]

    def begin_at(self, factor: float, counts: str | None) -> None:
        super().begin_at(factor, counts or "total")
        self._factor = factor

    def fade(self, begin: float, end: float) -> None:
        raise InputError(f"{self.name}: an obstacle can be released at once only; move it away by its motion")

    def start_from(self, u: np.ndarray, F: np.ndarray) -> None:
        self.u, self.F, self._u_at, self._F_at = u, F, u, F

    @property
    def timed(self) -> bool:
        """Its level set depends on the load factor."""
        return isinstance(self.shape, Level) and self.shape.timed

    def still(self, factor: float) -> Obstacle:
        """The same obstacle at rest where it is at a load factor, for a problem that goes on from time 0."""
        made = copy(self)
        where = np.zeros((1, self.layout.dim))
        made._motion, made._rotation = copy(self._motion), copy(self._rotation)
        for now, before in ((made._motion, self._motion), (made._rotation, self._rotation)):
            value = before.at(factor, where)[0]
            now.function, now.field = (lambda time, value=value: value), False
            now.begin(0.0, "total")
        made._factor = made._now = 0.0
        return made

    # between two resets -------------------------------------------------------------------------------
    def _pose(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Where the point `about` is (d,), and the rotation tensor (d, d)."""
        nowhere = np.zeros((1, self.layout.dim))
        w = self._rotation.at(factor, nowhere)
        turn = rotations.to_tensor(rotations.from_vector(rotations.in_space(w)))[0]
        d = self.layout.dim
        return self._about + self._motion.at(factor, nowhere)[0], turn[:d, :d]

    def _turned(self, factor: float) -> np.ndarray:
        """Rotation vector of the obstacle's turn since the last converged step."""
        if not self.law.turning:
            return np.zeros(max(1, self.layout.rotations))
        nowhere = np.zeros((1, self.layout.dim))
        now, before = (rotations.in_space(self._rotation.at(f, nowhere)) for f in (factor, self._factor))
        way = rotations.multiply(
            rotations.from_vector(now), rotations.conjugate(rotations.from_vector(before))
        )
        vector: np.ndarray = rotations.to_vector(np.where(way[:, :1] < 0, -way, way))[0]
        return vector[-1:] if self.layout.dim == 2 else vector

    def values(self, factor: float) -> list[np.ndarray]:
        n, r = len(self.surface), self.layout.rotations
        centre, turn = self._pose(factor)
        pose = pose_row(centre, self._about, turn, factor, self._turned(factor))
        place = self.surface.x + self._u_at
        unseen = np.isnan(self.seen[:, :1])
        last_centre, last_turn = self._pose(self._factor)
        seen = (self.surface.x + self.u - last_centre) @ last_turn + self._about
        history = np.hstack([self._trial[:, None], self.slip, np.where(unseen, seen, self.seen)])
        turns = np.hstack([self.turn, self.w]) if r else np.zeros((n, 2))
        return [
            place,
            np.tile(pose, (n, 1)),
            np.tile(self._constants, (n, 1)),
            history,
            turns,
            np.zeros((n, 0)),
        ]

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        self._trial = self.multiplier
        # the forces of the last step had the area of that
        self.area_now = self.seen_area if factor == self._factor else self.next_area
        self._data, self._now = self.values(factor), factor

    def _columns(self, y: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        """Inputs of the kernels for sites `rows` at increments y."""
        place, pose, *rest, _ = (a[rows] for a in self._data)
        d = self.layout.dim
        moved = place + y[:, :d]
        centre, about, turn = self._pose_parts(pose)
        seen = np.einsum("ni,nij->nj", moved - centre, turn) + about
        numbers = self.shape.at(seen)
        return [y, place, pose, *rest, numbers if numbers.shape[1] else np.zeros((len(rows), 1))]

    def _pose_parts(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        d = self.layout.dim
        return pose[:, :d], pose[:, d : 2 * d], pose[:, 2 * d : 2 * d + d * d].reshape(-1, d, d)

    def evaluate(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        assert self._kernel is not None
        if not len(rows):
            return np.zeros((0, self._outputs))
        return self._kernel(*self._columns(y, rows))

    def tell(self, y: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
        """What the form tells of sites `rows` at increments y, each (m, size)."""
        assert self._teller is not None
        assert isinstance(self.form, ContactForm)
        sizes = self.form.told
        out = np.zeros((0, sum(sizes.values())))
        if len(rows):
            out = self._teller(*self._columns(y, rows))
        parts = np.split(out, np.cumsum(list(sizes.values()))[:-1], axis=1)
        return dict(zip(sizes, parts, strict=True))

    def pieces(self, setting: Setting) -> list[Piece]:
        """Sites that may touch the obstacle until increments count anew, and others that are only moved."""
        if self._kernel is None:
            assert isinstance(self.form, ContactForm)
            self._kernel, self._teller = self.form.compile(self.comm), self.form.teller(self.comm)
        if isinstance(setting, GridSetting) and self.aslant and np.array_equal(self.u, self._u_at):
            # a corner's own gradients, of functions continued beyond the body, would grow reset by reset
            assert self.parents is not None
            self.F = self._F_at = setting.deformations(self.parents)
        self._data = self.values(self._factor)
        every = np.arange(len(self.surface))
        y = np.zeros((len(every), self.layout.block))
        y[:, : self.layout.dim] = self.u - self._u_at
        told = self.tell(y, every)
        gap = told["gap"][:, 0]
        if not self._checked:
            self._check_start(gap)
            self._check_within(setting, max(0.0, -float(np.nanmin(gap))))
            self.seen_area = self.next_area = self._area_towards(told["normal"])
        self.area_now = self.seen_area
        self._near, self.renew = gap < _REACH * self._size, False
        self._moved = np.zeros((len(every), self.layout.block + self.layout.dim**2))
        if isinstance(setting, GridSetting) and self.parents is not None:
            carried = setting.beside(self.name, self.parents, self.surface.x + self._u_at)
        else:
            carried = setting.carry(self)
        near = self._near[carried.rows]
        # the last one to be told of a converged step tells its obstacle
        return [self.piece(self, carried, at, near=which) for at, which in ((near, True), (~near, False))]

    def _check_start(self, gap: np.ndarray) -> None:
        """Raise InputError where the body begins inside of the obstacle."""
        self._checked = True
        if not np.any(np.isfinite(gap)):
            raise InputError(f"{self.name}: phi isn't a finite number at any site of the body")
        deepest = int(np.nanargmin(gap))
        place = tuple(float(round(c, 9)) for c in self.x[deepest])
        if gap[deepest] < -self._size:
            share = float(np.mean(gap < 0.0))
            hint = "; is the sign of phi right? It is positive outside of the obstacle" if share > 0.5 else ""
            raise InputError(
                f"{self.name}: the body begins inside of it: its site at {place} lies {-gap[deepest]:.4g} m "
                f"deep, more than a cell ({self._size:.4g} m){hint}"
            )
        if gap[deepest] < -_WITHIN * self._size:
            text = (
                f"{self.name}: the body begins inside of it: its site at {place} lies {-gap[deepest]:.4g} m "
                f"deep, {-gap[deepest] / self._size:.2g} cells; it is pushed out at once"
            )
            warn_on_one_rank(self.comm, text, TrustWarning)
        if self.law.barrier and gap[deepest] <= 0.0:
            raise InputError(
                f"{self.name}: barrier: the body touches it from the start: its site at {place} has the gap "
                f"{gap[deepest]:.4g} m; a barrier needs a positive one"
            )

    def _check_within(self, setting: Setting, deepest: float) -> None:
        """Raise InputError where the obstacle begins within the body, whose boundary doesn't see it.
        Collective.

        Args:
            deepest: depth of the deepest site in the obstacle (m).
        """
        if not self.whole:
            return
        points = setting.points
        found: list[float] = [-np.inf]
        if len(points):
            y = np.zeros((len(points), self.layout.block))
            y[:, : self.layout.dim] = points.x - self._data[0][0]
            gap = self.tell(y, np.zeros(len(points), dtype=np.int64))["gap"][:, 0]
            depth = np.nan_to_num(-gap, nan=-np.inf)
            at = int(np.argmax(depth))
            found = [float(depth[at]), *points.x[at].tolist()]
        found = max(self.comm.allgather(found))
        if found[0] > deepest + _WITHIN * self._size:
            place = tuple(float(round(c, 9)) for c in found[1:])
            raise InputError(
                f"{self.name}: it begins within the body: {place} lies {found[0]:.4g} m deep in it, "
                f"the body's surface {deepest:.4g} m; cut a hole there, or give the sites that may touch (on)"
            )

    # a step -------------------------------------------------------------------------------------------
    def admits(self, y: np.ndarray, rows: np.ndarray) -> bool:
        """Whether there are forces at increments y of sites `rows`: a barrier can't be crossed."""
        return not (self.law.barrier and np.any(self.tell(y, rows)["gap"] <= 0.0))

    def balance(self, y: np.ndarray, rows: np.ndarray) -> None:
        """In dynamics: sites `rows` are in balance at increments y before the end of the step."""
        self._balanced = y, rows, list(self._data)

    def end_at(self, factor: float) -> None:
        if factor != self._now:
            self._data, self._now = self.values(factor), factor

    def refine(self, y: np.ndarray, rows: np.ndarray, near: bool) -> bool:
        """After iterations have converged: improve the multipliers; whether they have changed.

        Raises:
            LocalFailure: a site that was far from the obstacle has gone through its surface.
        """
        told = self.tell(y, rows)
        gap, pressure = told["gap"][:, 0], told["pressure"][:, 0]
        if not near:
            if np.any(gap < 0.0):
                raise LocalFailure(
                    f"{self.name}: a place of the body that was farther than {_REACH:g} cells from it is now "
                    f"{-gap.min():.3g} m inside; smaller steps are needed"
                )
            return False
        return self._improved(gap, pressure, rows)

    def put_multipliers(self) -> None:
        """Those that `refine` has found count from now on."""
        history = self._data[3].copy()
        history[:, 0] = self._trial
        self._data[3] = history

    def commit(self, y: np.ndarray, rows: np.ndarray) -> None:
        """Take note of increments of sites `rows`, with gradients of the displacement behind them."""
        self._moved[rows] = y

    def _area_towards(self, normal: np.ndarray) -> np.ndarray:
        """Areas that face the obstacle: of a corner, where its faces end, as much as their sum does."""
        if not self.aslant:
            return undeformed_area(self.surface, self.layout)
        now = np.linalg.solve(np.swapaxes(self.F, 1, 2), self.surface.normal[:, :, None])[:, :, 0]
        now = now / np.linalg.norm(now, axis=1, keepdims=True)
        shares = np.clip(-np.sum(now * normal, axis=1), _LEAST, 1.0)
        whole = undeformed_area(self.surface, self.layout)
        areas: np.ndarray = whole * np.where(np.isfinite(shares), shares, 1.0)
        return areas

    def finish(self) -> None:
        """All pieces have told of their sites: the step has converged. Collective."""
        moved = self._moved.copy()
        self.comm.Allreduce(MPI.IN_PLACE, moved)
        trial: np.ndarray = np.where(self._trial != self.multiplier, self._trial, -np.inf)
        self.comm.Allreduce(MPI.IN_PLACE, trial, op=MPI.MAX)
        multiplier: np.ndarray = np.where(np.isfinite(trial), trial, self.multiplier)
        self._trial = multiplier
        self.put_multipliers()
        self._moved = np.zeros_like(moved)
        n, d, r = len(moved), self.layout.dim, self.layout.rotations
        every, gradient = moved[:, : d + r], moved[:, d + r :].reshape(n, d, d)
        told = self.tell(every, np.arange(n))
        self.u = self._u_at + every[:, :d]
        self.F = (np.eye(d) + gradient) @ self._F_at
        self.w = every[:, d:]
        self.gap, self.pressure = told["gap"][:, 0], told["pressure"][:, 0]
        touching = self.pressure[:, None] > 0.0
        self.multiplier = np.where(touching[:, 0], multiplier, 0.0)
        self.seen = told["seen"]
        self.slip = np.where(touching, told["slip"], 0.0)
        if r:
            self.turn = np.where(touching, told["turn"], 0.0)
        self._factor, self.next_area = self._now, self._area_towards(told["normal"])
        told = self._in_balance(told)
        self.pressure, self.traction = told["pressure"][:, 0], told["traction"]
        if r:
            self.couple = told["couple"]
        self.seen_area = self.area_now
        force, couple = self.area[:, None] * self.traction, self.area[:, None] * self.couple
        total = moments(self.x, force, couple).sum(axis=0)
        self.sums = np.concatenate([force.sum(axis=0), couple.sum(axis=0), total])
        self.renew = bool(np.any(self.gap[~self._near] < 0.5 * _REACH * self._size))

    def _in_balance(self, told: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What is told where forces are in balance; by default at the end of the step. Collective."""
        every = self.comm.allgather(self._balanced is not None)
        if not any(every):
            return told
        y, rows, data = self._balanced or (np.zeros((0, self.form.size)), np.zeros(0, dtype=int), self._data)
        self._data, self._balanced = data, None
        out, here = {}, self.tell(y, rows)
        for name, values in told.items():
            out[name] = np.zeros_like(values)
            out[name][rows] = here[name]
            self.comm.Allreduce(MPI.IN_PLACE, out[name])
        return out
