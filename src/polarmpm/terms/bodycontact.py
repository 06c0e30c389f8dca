"""Contact of bodies with each other: sites on their surfaces, each against the other's (docs/contact.md)."""

from __future__ import annotations

from copy import copy
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, LocalFailure
from ..forms.bodycontact import CONSTANTS, BodyContactForm
from ..geometry.surfaces import Surface
from ..kernels.kernel import Kernel
from ..kinematics.layout import Layout
from ..kinematics.moments import moments
from . import partners
from .base import Piece, Setting
from .bodypieces import FacingPiece, MovedPiece
from .settings import GridSetting
from .sites import Sites
from .surfaceterms import undeformed_area

_REACH = 1.0  # cells: sites that are nearer to another body when a step begins may touch it in the step
_FAR = 1.6  # cells: so far other sites are looked for
_BEHIND = 0.5  # cells behind a surface: functions of the cell there tell how the surface moves
_CORRECTIONS = 3  # by Newton's method, of the places that sites face
_DEEP = 0.25  # cells by which a site may be in a body at the end of a step without having been watched
_PART = 0.9  # of the way to a body that is far away that a site may move in a step
_SPAN = 1.05  # of a site's piece of the surface, beyond which it isn't there


class BodyContact(Sites):
    """Contact of bodies with each other; made by `problem.contact`.

    Each site presses against the tangent plane of the nearest site of another body; as both bodies have
    sites, each of them stands for half of its area.

    Arrays are those of the last converged step, the same on all ranks, with one row for each of the sites:
    places on the bodies' surfaces that they carry.

    Attributes:
        force, moment: of the other bodies on the first one (N), (d,), and about the origin (N m), (1,) in
            the plane or (3,); on the first of the two selections, where some have been given.
        forces, moments: the same for each body, (bodies, d) and (bodies, 1 or 3): their sum is zero.
        gap: distances of the sites from the body that they face (m), (n,); negative in it, infinite where
            there is none within a cell.
        pressure: (Pa) per undeformed area, (n,).
        traction: force on the site's body per undeformed area (Pa), (n, d), friction included.
        x: where the sites are (m), (n, d).
        area: of the undeformed body that they stand for (m^2; m in the plane), (n,).
        body: number of each site's body, (n,), see `Points.body`.
        partner: number of the site that each one faces, (n,); -1: there is none.
        touching: sites with a pressure, (n,) bool.
    """

    linear = False
    external = True  # its forces count in convergence measures, and its work as an obstacle's
    proportional = False
    parents: np.ndarray
    sums: np.ndarray
    _balanced: np.ndarray | None

    def __init__(
        self,
        name: str,
        surface: Surface,
        parents: np.ndarray,
        sides: np.ndarray,
        body: np.ndarray,
        constants: dict[str, float],
        size: float,
        gap: float | None,
        current: bool,
    ):
        super().__init__(name, surface)
        self.parents, self.sides, self.body, self.tolerance = parents, sides, body, gap
        self._constants = np.array([constants[key] for key in CONSTANTS])
        self._friction, self._size, self._current = constants["friction"] > 0.0, size, current
        self._teller: Kernel | None = None

    def __repr__(self) -> str:
        return f"BodyContact({self.name!r}: {len(set(self.body))} bodies, {len(self.surface)} sites)"

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        super().attach(layout, comm)
        self._put_arrays()
        n, d = len(self.surface), layout.dim
        whole = undeformed_area(self.surface, layout)
        self.seen_area = self.next_area = self.area_now = 0.5 * whole
        self.sums = np.full((int(self.body.max()) + 1, d + (1 if d == 2 else 3)), np.nan)
        self._span = _SPAN * np.sqrt(d - 1) * self.surface.area ** (1.0 / (d - 1))
        self.partner, self.gap = np.full(n, -1, dtype=np.int64), np.full(n, np.inf)
        self._told, self._balanced = self._nothing_told(), None
        self._factor = 0.0

    def still(self, factor: float) -> BodyContact:
        """The same for a problem that goes on from time 0."""
        return copy(self)

    def make_form(self) -> BodyContactForm:
        return BodyContactForm(self.layout, self._friction)

    # results ------------------------------------------------------------------------------------------
    @property
    def reaction(self) -> tuple[np.ndarray, np.ndarray] | None:
        return None if np.isnan(self.sums[0, 0]) else (self.force, np.zeros(self.layout.rotations))

    @property
    def forces(self) -> np.ndarray:
        return self.sums[:, : self.layout.dim].copy()

    @property
    def moments(self) -> np.ndarray:
        return self.sums[:, self.layout.dim :].copy()

    @property
    def _first(self) -> np.ndarray:
        """Numbers of the bodies of the first side."""
        first: np.ndarray = np.unique(self.body[self.sides == self.sides.min()])
        return first

    @property
    def force(self) -> np.ndarray:
        force: np.ndarray = self.forces[self._first].sum(axis=0)
        return force

    @property
    def moment(self) -> np.ndarray:
        moment: np.ndarray = self.moments[self._first].sum(axis=0)
        return moment

    def as_dict(self) -> dict[str, Any]:
        """Columns of a table: force and moment on the first body, number of sites that touch, deepest
        penetration."""
        found = {"force": self.force, "moment": self.moment, "touching": int(self.touching.sum())}
        return {**found, "penetration": self.penetration}

    # between two resets -------------------------------------------------------------------------------
    def _nothing(self) -> np.ndarray:
        d = self.layout.dim
        return np.zeros((len(self.surface), d + d * d))

    def _nothing_told(self) -> np.ndarray:
        assert isinstance(self.form, BodyContactForm)
        return np.zeros((len(self.surface), sum(self.form.told.values())))

    def normals(self, F: np.ndarray | None = None) -> np.ndarray:
        """Outward unit normals of the sites (n, d), by deformation gradients; by default as they are now."""
        F = self.F if F is None else F
        n = np.linalg.solve(np.swapaxes(F, 1, 2), self.surface.normal[:, :, None])[:, :, 0]
        unit: np.ndarray = n / np.linalg.norm(n, axis=1, keepdims=True)
        return unit

    def _found(self, x: np.ndarray, F: np.ndarray) -> partners.Partners:
        """Partners of the sites at places (n, d), with deformation gradients."""
        deepest = max(0.0, -float(self.gap.min()))  # soft springs let sites in by more than cells
        reach, far = _REACH * self._size, _FAR * self._size + 1.5 * deepest
        return partners.find(x, self.normals(F), self._span, self.sides, self.body, reach, far)

    def _look(self) -> None:
        """Find the sites' partners, and the places of the other bodies that they face."""
        x, normal, found = self.x, self.normals(), self._found(self.x, self.F)
        self.partner, self._free, self._nearest = found.site, found.free, found.nearest
        self.gap = found.gap
        at = np.flatnonzero(found.site >= 0)
        j = found.site[at]
        moved = self.F[j] @ np.linalg.inv(self._F_at[j])
        away = x[at] - found.gap[at, None] * normal[j] - x[j]
        back = np.linalg.solve(moved, away[:, :, None])[:, :, 0]
        self.facing, self.against, self.target = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
        self.target[at] = x[at] - found.gap[at, None] * normal[j]
        self.facing[at], self.against[at] = (self.surface.x + self._u_at)[j] + back, normal[j]

    def _cells_faced(self) -> np.ndarray:
        """Lowest cells of those that carry what the sites face (n, d); without a partner none."""
        missing, lowest = np.iinfo(np.int64).min, np.minimum(self._cells, self._behind)
        return np.where(self.partner[:, None] >= 0, lowest[self.partner], missing)

    def pieces(self, setting: Setting) -> list[Piece]:
        assert isinstance(setting, GridSetting)
        if self._kernel is None:
            assert isinstance(self.form, BodyContactForm)
            self._kernel, self._teller = self.form.compile(self.comm), self.form.teller(self.comm)
        if np.array_equal(self.u, self._u_at):
            # gradients of functions continued beyond the body would grow reset by reset
            self.F = self._F_at = setting.deformations(self.parents)
        if self._current and not self._checked:  # normals were given of the body as it is now
            before = np.einsum("nji,nj->ni", self.F, self.surface.normal)
            before /= np.linalg.norm(before, axis=1, keepdims=True)
            self.surface = Surface(self.surface.x, self.surface.area, before)
        # functions of cells that the body hardly enters would let a pressure turn its surface; where the body
        # was when increments began to count, which a restarted run knows, too
        behind = self.surface.x + self._u_at - _BEHIND * self._size * self.normals(self._F_at)
        self._cells, self._behind = setting.cells_behind(self.name, self.parents, self.body, behind)
        self._look()
        if not self._checked:
            self._check_start()
        self._grouped, self.regroup = self._cells_faced(), False
        self._functions, self._within = setting.at, setting.within
        carried = setting.beside(self.name, self.parents, self.surface.x + self._u_at)
        faces = self.partner[carried.rows] >= 0
        boxes = setting.boxes(self._grouped[carried.rows[faces]], more=1)
        # the last one to be told of a converged step tells its contact
        return [FacingPiece(self, carried, faces, boxes), MovedPiece(self, carried)]

    def _check_start(self) -> None:
        """Raise InputError where the bodies begin inside of each other."""
        self._checked = True
        deepest = int(np.argmin(self.gap))
        if self.gap[deepest] < -0.5 * self._size:
            place = tuple(float(round(c, 9)) for c in self.x[deepest])
            one, other = self.body[deepest], self.body[self.partner[deepest]]
            raise InputError(
                f"{self.name}: bodies begin inside of each other: a site of body {one} at {place} lies "
                f"{-self.gap[deepest]:.4g} m deep in body {other}, more than half a cell ({self._size:.4g} m)"
            )

    def table(self, rows: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of sites `rows`, at increments x (m, n, d) of the nodes of what they face: where the places that
        they face were when increments began to count (m, d), and values of the nodes' functions there, with
        gradients (1/m) of those that tell how the surface turns, (m, 1 + d, n)."""
        place, d, faced = self.facing[rows], self.layout.dim, self.partner[rows]
        lowest = self._grouped[rows]

        def table_of(cells: np.ndarray) -> np.ndarray:
            table: np.ndarray = self._within(self._functions(place, cells[faced]), cells[faced], lowest)
            return table

        for _ in range(_CORRECTIONS):
            table = table_of(self._cells)
            now = place + np.einsum("mn,mnj->mj", table[:, 0], x)
            moved = np.eye(d) + np.einsum("min,mnj->mji", table[:, 1:], x)
            place = place + np.linalg.solve(moved, (self.target[rows] - now)[:, :, None])[:, :, 0]
        return place, np.concatenate([table_of(self._cells)[:, :1], table_of(self._behind)[:, 1:]], axis=1)

    def values(self, factor: float) -> list[np.ndarray]:
        return []

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        self._trial = self.multiplier

    def columns(
        self, rows: np.ndarray, start: np.ndarray, y: np.ndarray, before: np.ndarray
    ) -> list[np.ndarray]:
        """Inputs of the kernels for sites `rows` at y (m, size).

        Args:
            start: by how much the sites are away from the places that they face at y = 0 (m, d).
            before: y at the beginning of the step (m, size).
        """
        d = self.layout.dim
        turned = np.linalg.inv(np.eye(d) + before[:, d:].reshape(-1, d, d))
        history = np.hstack([self._trial[rows, None], self.slip[rows], start + before[:, :d]])
        constants = np.tile(self._constants, (len(rows), 1))
        directions = self.against[rows]
        if d == 3:
            directions = np.hstack([directions, _beside(directions)])
        return [y, start, turned.reshape(-1, d * d), directions, constants, history]

    def evaluated(self, columns: list[np.ndarray]) -> np.ndarray:
        """Residual and tangent (m, size + size^2) per area."""
        assert self._kernel is not None
        return self._kernel(*columns) if len(columns[0]) else np.zeros((0, self._outputs))

    def tell(self, columns: list[np.ndarray]) -> np.ndarray:
        """What the form tells of sites, (m, size)."""
        assert self._teller is not None
        return self._teller(*columns) if len(columns[0]) else self._nothing_told()[:0]

    # a step -------------------------------------------------------------------------------------------
    def improve(self, told: np.ndarray, rows: np.ndarray) -> bool:
        """After iterations have converged: improve the multipliers; whether they have changed."""
        return self._improved(told[:, 0], told[:, 1], rows)

    def check_way(self, moved: np.ndarray, rows: np.ndarray) -> None:
        """Raise LocalFailure where a site that faced nothing has gone through a surface, with displacements
        and their gradients (m, d + d^2) of sites `rows` since increments count. Collective."""
        every = self._every(moved, rows)
        u, F = self._carried(every)
        found = self._found(self.surface.x + u, F)
        deep = np.where(self.partner < 0, -found.gap, -np.inf)
        at = int(np.argmax(deep))
        if deep[at] > _DEEP * self._size:
            raise LocalFailure(
                f"{self.name}: a place of body {self.body[at]} that was farther than {_REACH:g} cells from "
                f"body {self.body[found.site[at]]} is now {deep[at]:.3g} m inside; smaller steps are needed"
            )
        u = u - self.u
        means = np.stack([u[self.sides != side].mean(axis=0) for side in range(self.sides.max() + 1)])
        way = np.linalg.norm(u - means[self.sides], axis=1)
        bad = (self._nearest < 0) & (way > _PART * self._free)
        if np.any(bad):
            raise LocalFailure(
                f"{self.name}: a place of a body that was {self._free[bad].min():.3g} m from another one has "
                f"moved by {way[bad].max():.3g} m relative to it; smaller steps are needed"
            )

    def _every(self, moved: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """What ranks know of their sites `rows`, of all sites. Collective."""
        every = self._nothing()
        every[rows] = moved
        self.comm.Allreduce(MPI.IN_PLACE, every)
        return every

    def _carried(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacements (n, d) and deformation gradients of all sites, of `moved` (n, d + d^2) since
        increments count."""
        d = self.layout.dim
        gradient = moved[:, d:].reshape(-1, d, d)
        return self._u_at + moved[:, :d], (np.eye(d) + gradient) @ self._F_at

    def commit_told(self, told: np.ndarray, rows: np.ndarray) -> None:
        """Take note of what has been told of sites `rows` at the end of a step."""
        self._told = self._nothing_told()
        self._told[rows] = told

    def balance(self, told: np.ndarray, rows: np.ndarray) -> None:
        """In dynamics: the same where forces are in balance."""
        self._balanced = self._nothing_told()
        self._balanced[rows] = told

    def finish(self, moved: np.ndarray, rows: np.ndarray) -> None:
        """The step has converged, with displacements and their gradients (m, d + d^2) of sites `rows` since
        increments count. Collective."""
        self.u, self.F = self._carried(self._every(moved, rows))
        told = np.hstack([self._told, self._told if self._balanced is None else self._balanced])
        self.comm.Allreduce(MPI.IN_PLACE, told)
        trial: np.ndarray = np.where(self._trial != self.multiplier, self._trial, -np.inf)
        self.comm.Allreduce(MPI.IN_PLACE, trial, op=MPI.MAX)
        d, (end, balanced) = self.layout.dim, np.hsplit(told, 2)
        touching = end[:, 1:2] > 0.0
        multiplier = np.where(np.isfinite(trial), trial, self.multiplier)
        self.multiplier = self._trial = np.where(touching[:, 0], multiplier, 0.0)
        self.slip = np.where(touching, end[:, 2 + d :], 0.0)
        self.pressure, self.traction = balanced[:, 1], balanced[:, 2 : 2 + d]
        self._sum()
        self._told, self._balanced = self._nothing_told(), None
        self._look()
        self.regroup = not np.array_equal(self._grouped, self._cells_faced())

    def _sum(self) -> None:
        """Forces and moments on the bodies. What a site does to the other body has its own line of action, as
        gap and slip don't change when both turn as one."""
        force, at = self.area[:, None] * self.traction, np.flatnonzero(self.partner >= 0)
        of_site = np.hstack([force, moments(self.x, force, np.zeros((len(force), 0)))])
        self.sums = np.zeros_like(self.sums)
        np.add.at(self.sums, self.body, of_site)
        np.subtract.at(self.sums, self.body[self.partner[at]], of_site[at])


def _beside(normal: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) at right angles to others."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    across = np.cross(normal, axis)
    unit: np.ndarray = across / np.linalg.norm(across, axis=1, keepdims=True)
    return unit
