"""Stages of building: points that are taken out of a body during a run, and points that join it."""

from __future__ import annotations

import copy
from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..bodies.misfit import warn_of_misfit
from ..bodies.points import Points
from ..bodies.reference import Reference
from ..bodies.seeding import check_inside
from ..bodies.selection import Selection, check_selection
from ..conditions.amplitudes import Fade
from ..conditions.loads import HandedOver
from ..errors import InputError
from ..materials.base import Material
from ..terms.base import Term
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, values_by_number
from . import initial
from .conservation import Conservation
from .given import Given
from .initial import Stress, stresses_of
from .ongrid import OnGrid
from .release import fading, handed_forces


@dataclass(eq=False)
class Stage:
    """What was taken out of a body, or has joined it.

    Attributes:
        points: of this stage, as a selection.
    """

    name: str
    points: Selection
    parts = ()  # it is no load


class Staged(OnGrid):
    """Excavation and fill. All methods are collective."""

    _refused: InputError | None = None  # why an initial stress isn't one, once points have been removed

    @abstractmethod
    def increments(self) -> tuple[Reference, np.ndarray, np.ndarray] | None:
        """Reference, lattice nodes, and their increments and carried forces [x, carried], between resets."""

    def _prepare(self) -> Any:
        if self._refused is not None:
            raise self._refused
        return super()._prepare()

    def _can_go(self, condition: Any) -> bool:
        return super()._can_go(condition) and not isinstance(condition, Stage)

    # taken out ------------------------------------------------------------------------------------
    @collective("remove", compare=True)
    def remove(self, selection: Selection, *, over: float | None = None, until: float | None = None) -> Stage:
        """Take points out of the body, as an excavation does.

        What they did to the others, their stresses and the loads on them, is gone in the next step; or it
        becomes dead forces (and couples) on the others, which fade evenly over load factors, so that nothing
        jumps. Loads that selections shared keep the shares of those that are left; selections with points
        that are gone can't be loaded anew.

        Before the first load step what is taken out of a body with an initial stress fades likewise.

        Args:
            selection: the points.
            over: load factors over which their forces fade.
            until: load factor at which these have faded, instead of `over`.

        Raises:
            InputError: not a selection of these points, an empty one, or all of them; both `over` and
                `until`; supports that hold nothing any more.
        """
        self._check_outside("remove")
        self.check_open()
        self._check_left()
        fade = fading(self.progress.factor, over, until, "remove")
        self.points.check(check_selection(selection))
        if not len(selection):
            raise InputError("remove: the selection contains no point")
        if self.comm.allreduce(len(self.points.rows(selection))) == self.points.total:
            raise InputError("remove: these are all points; nothing would be left of the body")
        warn_of_misfit(self.points, selection)
        name = f"removal {self.given.next('removal')}"
        stage = Stage(name, selection)

        def take_out() -> None:
            self._take_out(name, selection, fade)
            self.given.add(Given(name, stage, self.progress.factor), "removal")

        self.whole(take_out)
        return stage

    def _take_out(self, name: str, selection: Selection, fade: Fade | None) -> None:
        loaded = self.progress.step > 0 or self.at_rest
        before = self.energies()["residue"] if loaded else 0.0
        between = self._between() if loaded else None
        left = np.ones(len(self.points), dtype=bool)
        left[self.points.rows(selection)] = False
        kept = {rows: a[left] for rows, a in self.kept().items()}
        self.points.remember_ids()
        self.points.replace({field: a[left] for field, a in self.points.arrays().items()}, same=True)
        self.keep(kept)
        self._note_stage()
        old = self._system
        if between is None:
            self._system, self.progress.reset_due = None, True
        else:
            reference, lattice, values = between
            part = Reference(**{f.name: getattr(reference, f.name)[left] for f in fields(Reference)})
            self._go_on_without(name, part, lattice, values, fade)
            self.progress.carried_work += before - self.energies()["residue"]
        if old is not None:
            old.destroy()

    def _between(self) -> tuple[Reference, np.ndarray, np.ndarray]:
        """Reference and increments in the last converged state; reset before if that is due."""
        try:
            self._use_materials(self._settled)
            self._prepare()
        except InputError as e:
            if self.progress.step or not str(e).startswith("initial_stress"):
                raise
            # it may be that the state is read from a restart file next
            self.balanced_at_rest, self._refused = False, None
            try:
                super()._prepare()
            finally:
                self.balanced_at_rest = True
            self._refused = e
        between = self.increments()
        assert between is not None
        return between

    def _go_on_without(
        self, name: str, reference: Reference, lattice: np.ndarray, values: np.ndarray, fade: Fade | None
    ) -> None:
        """The system of the points that are left, with increments and carried forces [x, carried, ...] of
        lattice nodes; what is out of balance without the others fades."""
        self._compile()
        interpolation = self._interpolate(reference)
        if not self.progress.step:
            initial.act_from_the_beginning(interpolation.pieces)
        here = values_by_number(self.comm, lattice, values, interpolation.nodes.lattice)
        x, carried = np.hsplit(here, here.shape[1] // self.layout.block)[:2]  # boxes are summed anew
        held = self._held_before() if self.progress.step else None
        if fade is not None:
            system = self._build(interpolation, x, supports=held)
            self._put_balance(system)
            missing = system.imbalance() - system.on_free(carried)
            handed = handed_forces(name, system, missing, system.x, fade)
            self._loads += handed
            self._note_handed(handed, fade.begin)
            system.destroy()
            self._compile()  # couples in space have a kernel of their own
            system = self._build(interpolation, x, supports=held)
            self._put_balance(system)
            carried = carried + system.imbalance() - system.on_free(carried)  # what rounding leaves
            system.destroy()
        self._drop_pieces(interpolation)
        self._system, self._stale = self._build(interpolation, x), False
        self._system.carried[:] = carried

    def _note_stage(self) -> None:
        """The body isn't what it was, and it is this problem that has changed it."""
        self._leave(changed=True)
        self._seal, self._attempted = None, None
        self._conservation = Conservation(self.comm)
        self._arrangement = self.points.arrangements
        if self._equilibrium is not None:
            self._equilibrium.points_moved = True

    # joined ---------------------------------------------------------------------------------------
    @collective("add", compare=True)
    def add(
        self,
        term: Term | Points,
        *,
        counts: str | None = None,
        over: float | None = None,
        until: float | None = None,
        stress: Stress | None = None,
        overconsolidation: float | None = None,
    ) -> Any:
        """Add a term: a contribution to the nodal system, such as a `SurfaceTerm` of one's own. Or points, as
        a fill does.

        A term acts in mid-run from the next step on, which begins with a reset of the grid. `counts` as of
        `load`.

        Points join the body where they are, undeformed there and without stress, from the next step on. They
        have ids of their own, after all that there have been. Loads on all points (`body_load`) act on them,
        too: at once, or growing evenly over load factors to what they are now. Arrays in `problem.rows` have
        zeros for them.

        Args:
            term: or points, that `seed` has made on this grid and no problem has been made of. A material
                that the body has already is the same, with its present numbers.
            over, until: load factors over which, or until which, the present loads on the points grow.
            stress, overconsolidation: an initial stress of the points, as of `initial_stress`.

        Returns:
            The stage, of points; its `points` are their selection in the body.

        Raises:
            InputError: neither term nor points; a term that is in a problem already, or doesn't fit; points
                that are deformed, or that don't go together with the body; options of the other kind.
        """
        given = {"over": over, "until": until, "stress": stress, "overconsolidation": overconsolidation}
        if not isinstance(term, Points):
            wrong = [name for name, value in given.items() if value is not None]
            if wrong:
                raise InputError(f"add: {wrong[0]} belongs to points, not to {checks.shown(term)}")
            return super().add(term, counts=counts)
        if counts is not None:
            raise InputError("add: counts belongs to terms; points have over and until")
        return self._fill(term, over, until, stress, overconsolidation)

    def _fill(
        self,
        points: Points,
        over: float | None,
        until: float | None,
        stress: Stress | None,
        overconsolidation: float | None,
    ) -> Stage:
        self._check_outside("add")
        self.check_open()
        self._check_left()
        fade, joining = fading(self.progress.factor, over, until, "add"), copy.copy(points)
        self._check_joining(joining)
        name = f"fill {self.given.next('fill')}"

        if stress is not None:
            with errors_on_all_ranks(self.comm):
                stresses = stresses_of(joining, stress)

        def join() -> Stage:
            before = self.energies()["residue"] if stress is not None else 0.0
            if stress is not None:
                self._stress_points(joining, stresses, overconsolidation)
            stage = self._join(name, joining, fade)
            if stress is not None:  # what they have stored was done before
                self.progress.external_work += before - self.energies()["residue"]
            self.given.add(Given(name, stage, self.progress.factor), "fill")
            return stage

        return self.whole(join)

    def _check_joining(self, points: Points) -> None:
        body = self.points
        if points.comm != self.comm:
            raise InputError("add: the points live on another communicator")
        if points.dim != body.dim:
            raise InputError(f"add: points of {points.dim} dimensions; the body has {body.dim}")
        for kind in ("micropolar", "second_gradient"):
            theirs, mine = (any(getattr(m, kind) for m in p.materials) for p in (points, body))
            if theirs != mine:
                raise InputError(f"add: {kind} = {theirs} of the points' materials, {mine} of the body's")
        check_inside(self.grid, points)
        with errors_on_all_ranks(self.comm):
            if not np.array_equal(points.F, np.broadcast_to(np.eye(3), points.F.shape)):
                raise InputError("add: the points are deformed; a fill is undeformed where it is placed")

    def _join(self, name: str, joining: Points, fade: Fade | None) -> Stage:
        points, kept = self.points, self.kept()
        before, known = len(points), len(points.materials)
        points.join(joining)
        self._merge_materials(known, joining)
        new = points.id[before:].copy()
        count = len(points) - before

        def longer(rows_name: str, rows: np.ndarray) -> np.ndarray:
            more = points.x[before:] if rows_name == "last_x" else np.zeros((count, *rows.shape[1:]))
            return np.concatenate([rows, more.astype(rows.dtype)])

        self.keep({rows_name: longer(rows_name, rows) for rows_name, rows in kept.items()})
        self._note_stage()
        self.progress.reset_due = True
        if fade is not None:
            acting = self._loads_at(self.progress.factor)
            for couple, values in enumerate(acting):
                values[:before] = 0.0
                if self.comm.allreduce(float(np.abs(values).max(initial=0.0))) > 0.0:
                    self._loads.append(HandedOver(f"{name}, not yet there", bool(couple), fade, -values))
        ids = np.sort(np.concatenate(self.comm.allgather(new)))
        return Stage(name, Selection(ids, points.fingerprints()[0]))

    def _merge_materials(self, known: int, joining: Points) -> None:
        """Let points of a material that the body has already have its row; rows from `known` on are new."""
        points = self.points
        rows, materials = points.material.copy(), list(points.materials[:known])
        first = list(self.first_materials)
        for k, material in enumerate(points.materials[known:], known):
            at = _row(material, first)
            if at is None:
                at = len(materials)
                materials.append(material)
                first.append(material)
            rows[points.material == k] = at
        points.put_materials(tuple(materials), rows)
        self.first_materials, self._settled = tuple(first), points.materials
        if len(materials) > known:
            self._more_forms()

    @abstractmethod
    def _more_forms(self) -> None:
        """Make the forms of materials that have joined. Collective."""


def _row(material: Material, materials: list[Material]) -> int | None:
    for k, one in enumerate(materials):
        elastic = one.elastic_part if one.never_yields else one
        if material is one or material is elastic or (type(material) is type(one) and material == one):
            return k
        if type(material) is type(elastic) and material == elastic:
            return k  # a point that has no stress at rest
    return None
