"""The part of a problem of material points that lives on the grid: resets, and the systems between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly import carrying
from ..assembly.interpolation import Interpolation
from ..assembly.loadedpoints import LoadedPoints
from ..assembly.pointboxes import BoxTangent
from ..assembly.points import PointSystem
from ..assembly.transfer import motion_of
from ..basis.base import Basis
from ..bodies.partition import LoadShares, distribute
from ..bodies.reference import Reference
from ..bodies.seeding import check_inside
from ..bodies.validity import Seal, check_state
from ..conditions.holding import check_held
from ..conditions.movinggrid import MovingGrid
from ..conditions.prescribed import Prescribed
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.couples import CoupleForm
from ..forms.points import PointForm
from ..geometry.grid import Grid
from ..geometry.planes import Plane, PlaneSpec
from ..kernels.kernel import Kernel
from ..kinematics.motion import Motion
from ..solvers.resetting import Never, ResetPolicy
from ..tools import checks
from ..tools.disposal import dispose_of_dropped
from ..tools.parallel import Route, reduced, values_by_number
from . import initial, slopes
from .balancing import BalancedResets
from .base import Problem
from .boxes import BoxRecord
from .conservation import Conservation, Totals
from .locking import warn_of_turning


@dataclass
class Compiled:
    """Kernels of a problem."""

    kernels: list[tuple[Kernel, Kernel]] = field(default_factory=list)
    couple: Kernel | None = None
    motion: Motion | None = None


class OnGrid(Problem):
    """What `QuasiStatic` does on the grid. Its attributes are described there."""

    grid: Grid
    initial_grid: Grid
    basis: Basis
    forms: Sequence[PointForm]
    assembly: str
    solver: str
    boxes: bool
    balanced_reset: bool
    policy: ResetPolicy
    box_record: BoxRecord
    load_shares: LoadShares
    _moving: MovingGrid
    _compiled: Compiled
    _resets: BalancedResets
    _conservation: Conservation
    _system: LoadedPoints | None
    _seal: Seal | None  # on what the last step has put into the points
    _arrangement: int  # of the points, see `Points.arrangements`
    _attempted: tuple[np.ndarray, np.ndarray] | None
    _converged_loads: tuple[np.ndarray, np.ndarray] | None
    _most_growth = np.inf  # of the points' domains
    _carries_sides = False  # resets carry along how the deformation varies within the points' boxes
    _ghost_beyond = False  # whether the ghost penalty acts beyond the walls of the grid
    systems: Callable[..., LoadedPoints] | None = None  # what makes them; None: as `assembly` says
    distribution: Callable[[], Route | None] | None = None  # moves points to ranks; None: by their places

    def _beside(self, where: PlaneSpec) -> PlaneSpec:
        initial, here = self._moving.initial, self._here(where)
        self.basis.check_plane(here, initial)
        slopes.beside(here, initial, self.points, self.grid)
        return replace(where, beyond="auto")

    def _here(self, where: PlaneSpec) -> PlaneSpec:
        """A plane of the given grid in the one that the problem goes on from."""
        return where

    def _tie(self, where: Any, support: Support, even: dict[int, bool]) -> None:
        if all(even.values()):
            slopes.check_slopes(self.basis)
        slopes.tie(support, even, self.basis, self.grid)

    def _admit(self, where: Any, support: Support) -> None:
        self._moving.admit(where, support, self.supports, self.progress.step > 0)
        if self.basis.patch_linear:
            warn_of_turning(self.forms, support, self.layout)

    def _dismiss(self, support: Support) -> None:
        self._moving.dismiss(support, self.progress.factor if self.progress.step else None)

    @property
    def cell_size(self) -> float:
        return min(self.grid.smallest)

    @property
    def rotation_limit(self) -> float:
        return self._rotation_limit

    @rotation_limit.setter
    def rotation_limit(self, limit: float) -> None:
        self._rotation_limit = checks.number("rotation_limit", limit, above=0.0)

    @property
    def _in_patches(self) -> bool:
        """Whether the points of a patch have to be on one rank, at every reset."""
        return self.comm.size > 1 and any(form.scalars for form in self.forms)

    def _prepare(self) -> LoadedPoints:
        """The system of the present grid; reset if that is due, renewed if conditions have changed."""
        p, old, regroup = self.progress, self._system, any(term.regroup for term in self._working_terms)
        if self.points.arrangements != self._arrangement:
            raise InputError(
                "points: others have joined them, or they were given another material after the problem had "
                "been made of them"
            )
        if old is not None and not p.reset_due:
            if self._seal is not None:
                self._seal.check(self.points)
            if not self._stale and not regroup:
                return old
        dispose_of_dropped(self.comm)
        self._compile()
        reset = old is None or p.reset_due
        if old is None or reset:
            self._system = self._reset()
        elif regroup:
            self._system = self._regrouped(old)
        else:
            self._drop_pieces(old.interpolation)
            self._system = self._build(old.interpolation, old.x)
            self._system.carried[:] = old.carried
            if old.box_tangent is not None:
                self._system.box_tangent = replace(old.box_tangent, values=None)
        if old is not None:
            old.destroy()
        self._stale = False
        if reset:
            self._tell_of_reset()
        return self._system

    def _regrouped(self, old: LoadedPoints) -> LoadedPoints:
        """The same system where terms act on other nodes than before; increments go on. Collective."""
        lattice, boxes = old.nodes.lattice[: old.nodes.owned], old.box_tangent
        values = [old.x, old.carried] + ([] if boxes is None else [boxes.x, boxes.before])
        rows = np.hstack([v[: old.nodes.owned] for v in values])
        made = self._continued(old.interpolation.reference, lattice, rows)
        self._drop_pieces(made.interpolation)
        return made

    def _continued(self, reference: Reference, lattice: np.ndarray, rows: np.ndarray) -> LoadedPoints:
        """The system of the last reset's state, whose nodes of lattice numbers (n,) have increments and
        carried forces (n, 2 block), then those of `BoxTangent` where one is kept. Collective."""
        interpolation = self._interpolate(reference)
        here = values_by_number(self.comm, lattice, rows, interpolation.nodes.lattice)
        x, carried, *of_boxes = np.hsplit(here, here.shape[1] // self.layout.block)
        made = self._build(interpolation, x)
        made.carried[:] = carried
        if of_boxes:
            x, before = map(np.ascontiguousarray, of_boxes)
            made.box_tangent = BoxTangent(x, before, self.progress.box_solutions)
        return made

    def _reset(self) -> LoadedPoints:
        """The system of a new grid, from whose nodes increments count."""
        p = self.progress
        in_boxes = self.box_record.energy(self._system) if self.balanced_reset else 0.0
        self._put_sides()
        grid = self._moving.at(p.factor if p.step else None, self.supports)
        check_inside(grid, self.points)
        check_state(self.points, everything=False)
        self._put_grid(grid)
        if self.load_shares.due() or self._in_patches:
            with self.timer("migration"):
                self._migrate()
        with self.timer("reset"):
            interpolation = self._interpolate(None)
        balanced = self.balanced_reset and p.step > 0
        held = self._held_before() if balanced else None
        balanced = balanced or (self.balanced_at_rest and not p.step)
        if held is not None:  # before anything is changed
            self._check_held(interpolation, self._prescribed(interpolation.nodes))
        system = self._build(interpolation, supports=held)
        p.carried_work -= in_boxes
        p.reset_due, p.since_reset = False, 0
        p.reset_factor = p.rotation_factor = p.factor
        if balanced:
            self._put_balance(system)
            if not p.step:
                initial.act_from_the_beginning(interpolation.pieces)
                initial.check_equilibrium(self, system)
            self._resets.carry(system)
            self.box_record.note_carried(system.unresisted)
        if not self._drop_pieces(interpolation) and held is None:
            return system
        made = self._build(interpolation)
        made.carried[:] = system.carried
        system.destroy()
        return made

    def _after_balance(self, system: LoadedPoints) -> np.ndarray | None:
        """A change of the increments (nodes, block) of which a reset carries along only what varies smoothly,
        if there is one."""
        return None

    def _put_sides(self) -> None:
        """Let the points know how their deformation varies within their boxes, for the next grid.
        Collective."""
        s = self._system
        if s is not None and s.interpolation.carries:
            s.interpolation.put_sides(s.x, self._after_balance(s))

    def _has_left(self) -> bool:
        """Whether points have left the grid that a reset would make. Collective."""
        if isinstance(self.policy, Never):  # which is at home in the undeformed body's cells
            return False
        grid, x = self._moving.at(self.progress.factor, self.supports), self.points.x
        ends = np.stack([x.min(axis=0), x.max(axis=0)]) if len(x) else x
        return bool(reduced(self.comm, int(not grid.inside(ends).all()), MPI.MAX))

    def _check_held(self, interpolation: Interpolation, prescribed: Prescribed) -> None:
        volume = interpolation.spread(self.points.volume[:, None])[: interpolation.nodes.owned, 0]
        size = np.prod(self.grid.smallest)
        if not self.grid.equal:
            own = interpolation.nodes.owned
            size = np.prod(self.grid.sizes_around(interpolation.nodes.position[:own]), axis=1)
        check_held(prescribed, volume / size, self.progress.step, leaves=self.points.moving)

    def _held_before(self) -> list[Support] | None:
        """Supports with which the last step has converged: what has come or gone since is to be felt, not
        carried along. None if they are the present ones."""
        left = [s for s in self._leaving if isinstance(s, Support)]
        held = [s for s in self.supports if s.committed] + left
        return held if left or len(held) < len(self.supports) else None

    def _drop_pieces(self, interpolation: Interpolation) -> bool:
        """Take away what terms contribute that have been released; whether there was something."""
        before = len(interpolation.pieces)
        interpolation.pieces = [p for p in interpolation.pieces if p.of in self._terms]
        return len(interpolation.pieces) < before

    def _put_balance(self, system: LoadedPoints) -> None:
        """Put in the loads that a reset has to balance: not the present ones, as what has been added since
        the last step stays out of balance."""
        system.set_loads(*(self._converged_loads or self._loads_at(self.progress.factor)))
        self._set_terms(self.progress.factor, carrying=True)

    def _fall_back(self) -> bool:
        """The first step after a reset may fail with initial stresses: it is tried with forces instead."""
        s = self._system
        if s is None or self.progress.since_reset:
            return False
        return self._resets.fall_back(s, lambda: self._put_balance(s))

    def _close(self, system: LoadedPoints) -> None:
        carrying.close_again(system)

    def _fell_back(self, converged: bool) -> None:
        if not converged and self._system is not None:
            self._resets.return_to_stresses(self._system)

    def _migrate(self, reference: Reference | None = None) -> Reference | None:
        """Distribute the points afresh, with all that is kept for each of them between steps; between resets
        also their reference, which is then returned for the new distribution."""
        before, kept = Totals.numbers(self.points, self.grid), self.kept()
        x = None if reference is None else reference.x
        route = self._distribute(x) if self.distribution is None else self.distribution()
        self.load_shares.distributed()
        if route is None:
            return reference
        self._leave(changed=True)
        self._conservation.moved(before, self.points, self.grid)
        self.keep({name: route.forward(rows) for name, rows in kept.items()})
        self._attempted = None
        if self._seal is not None:  # the sums are over other points now
            self._seal = Seal(self.points)
        if self._equilibrium is not None:
            self._equilibrium.points_moved = True
        return None if reference is None else reference.moved(route)

    def _distribute(self, x: np.ndarray | None) -> Route | None:
        """Move the points to the ranks by where they are, or were, at x (np, d) (m). Collective."""
        cells = None
        if self._in_patches:
            cells = self.basis.patches(self.grid, self.points.x if x is None else x)[0]
        return distribute(self.grid, self.points, x, cells)

    def _put_grid(self, grid: Grid) -> None:
        """Make it the grid; the supports' planes follow."""
        if grid is not self.grid:
            self.grid = grid
            for support in self.supports:
                if isinstance(support.where, Plane):
                    support.where.follow(grid)

    def _interpolate(self, reference: Reference | None) -> Interpolation:
        terms = self._working_terms
        for term in terms if reference is None else []:
            term.begin()
        made = Interpolation(
            self.grid,
            self.points,
            self.basis,
            self.forms,
            reference,
            terms,
            self.boxes,
            self._most_growth,
            self._carries_sides,
        )
        self._conservation.reset(made)
        self.load_shares.built(self.points, made.nodes)
        return made

    def _build(
        self,
        interpolation: Interpolation,
        x: np.ndarray | None = None,
        supports: Sequence[Support] | None = None,
    ) -> LoadedPoints:
        """The system on nodes with increments x (nodes, block) since the reset, with other supports than
        those that act if they are given."""
        prescribed, c = self._prescribed(interpolation.nodes, supports), self._compiled
        if supports is None:
            self._check_held(interpolation, prescribed)
        kind: Callable[..., LoadedPoints] = self.systems or PointSystem
        if self.assembly == "projection":
            # lazy import: direct sums need no assembler of dolfinx
            from ..assembly.projection import ProjectedSystem as kind
        system = kind(interpolation, c.kernels, c.couple, prescribed, self.timer, self.solver)
        if x is not None:
            system.x[:] = x
            system.place()
            prescribed.start_from(self.progress.factor, x)
        if prescribed.needs_motion and self.progress.step:
            prescribed.put_motion(*motion_of(system, self.points))
        return self._resets.equip(system)

    def _compile(self) -> None:
        c = self._compiled
        with self.timer("compile"):
            if not c.kernels:
                c.kernels = [form.compile(self.comm) for form in self.forms]
                second = any(form.layout.second for form in self.forms)
                c.motion = Motion(self.layout.with_second(second), self.comm)
            unsymmetric = self.layout.rotations == 3 and self._couples_act
            if unsymmetric and c.couple is None:
                c.couple = CoupleForm().compile(self.comm)

    def _with_boxes(self, change: Callable[[], None]) -> None:
        """Change what the boxes' energy depends on besides the increments; what it loses counts as
        carried."""
        boxes = self.box_record
        before = boxes.energy(self._system)
        change()
        self.progress.carried_work += boxes.energy(self._system) - before

    def _flow(self, system: LoadedPoints) -> None:
        """Put the plastic flow of a converged step into the points' plastic state."""
        i = system.interpolation
        for batch, mapping in zip(i.batches, system.mappings, strict=True):
            if mapping is not None:
                mapping.update_plastic_state(self.points, batch.rows, i.reference.q[batch.rows])
        i.pack_flow()
        system.place()
