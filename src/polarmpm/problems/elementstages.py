"""Stages of building with finite elements: some are taken out of the body during a run, and put in again."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from ..assembly.system import NodalSystem
from ..bodies.elements import Elements
from ..bodies.facets import FacetSurface
from ..bodies.points import Points
from ..bodies.reference import Increments
from ..bodies.selection import Selection, check_selection
from ..bodies.stagedmesh import refuse_inverted
from ..conditions.amplitudes import Fade
from ..conditions.loads import HandedOver
from ..conditions.prescribed import Prescribed
from ..errors import InputError
from ..forms.elementkernels import NativeElementForms
from ..solvers.newton import Outcome
from ..terms.base import Term
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .base import Problem
from .elementdoubts import ElementRecord
from .given import Given
from .initial import Stress, stresses_of
from .release import fading, handed_forces
from .stages import Stage
from .whole import Changing
from .work import StepStart


class StagedElements(Problem):
    """Excavation and fill. All methods are collective."""

    elements: Elements
    forms: Any
    carried_at_rest: np.ndarray | None
    _last_loads: np.ndarray | None

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        for thing in (self.element_record, self.element_record.limit):
            yield thing, None

    # trust ----------------------------------------------------------------------------------------
    @cached_property
    def element_record(self) -> ElementRecord:
        """What strains within the elements tell."""
        return ElementRecord(self.elements)

    def _trust(self, system: NodalSystem, start: StepStart, at_points: Increments, outcome: Outcome) -> None:
        self.element_record.look(system, start, at_points, self.terms)

    def _note(self, outcome: Outcome) -> None:
        self.element_record.note(self.progress.step)

    def trust(self) -> str:
        """In a line: how much of a plastic body's strains its elements don't resolve (docs/accuracy.md)."""
        return self.element_record.summary() or super().trust()

    # stages ---------------------------------------------------------------------------------------
    def _can_go(self, condition: Any) -> bool:
        return super()._can_go(condition) and not isinstance(condition, Stage)

    def _check_stages(self, what: str) -> None:
        self._check_outside(what)
        self.check_open()
        self._check_left()
        if self.points.moving:
            raise InputError(f"{what}: elements in motion stay in the body")
        if not isinstance(self.forms, NativeElementForms):
            why = "materials with second gradients" if self.points.second_gradient else "assembly = 'dolfinx'"
            raise InputError(f"{what}: {why}: all elements of the mesh stay in the body")

    def _whole_cells(self, what: str, ids: np.ndarray) -> np.ndarray:
        """This rank's own cells that a selection has. Local.

        Raises:
            InputError: it has some of the quadrature points of a cell only.
        """
        e, count = self.elements, len(self.elements.reference_points)
        numbers, there = np.unique(ids // count, return_counts=True)
        if np.any(there != count):
            cut = int(numbers[np.argmax(there != count)])
            raise InputError(
                f"{what}: of element {cut} the selection has {int(there[there != count][0])} of {count} "
                "quadrature points; elements go, and come, as a whole: select a region of the mesh, "
                "points.region(name), or draw the line along edges"
            )
        return e.cells_of(ids)

    # taken out ------------------------------------------------------------------------------------
    @collective("remove", compare=True)
    def remove(self, selection: Selection, *, over: float | None = None, until: float | None = None) -> Stage:
        """Take elements out of the body, as an excavation does.

        What they did to the others, their stresses and the loads on them and on their facets, is gone in the
        next step; or it becomes dead forces (and couples) on the others, which fade evenly over load factors,
        so that nothing jumps. Nodes that no element touches any more stay where they are. Elements that are
        built later, such as those of a fill, are taken out before the first load step.

        Before the first load step what is taken out of a body with an initial stress fades likewise.

        Args:
            selection: all quadrature points of the elements: `points.region(name)`, `points.where(...)`.
            over: load factors over which their forces fade.
            until: load factor at which these have faded, instead of `over`.

        Returns:
            The stage, which `add` puts in again.

        Raises:
            InputError: not a selection of these points, an empty one, parts of elements, or all of them; both
                `over` and `until`; supports that hold nothing any more; surfaces of these elements that are
                held, loaded or in contact by terms; second gradients, `assembly="dolfinx"`, or motion.
        """
        self._check_stages("remove")
        fade = fading(self.progress.factor, over, until, "remove")
        self.points.check(check_selection(selection))
        if not len(selection):
            raise InputError("remove: the selection contains no point")
        if len(selection) == self.points.total:
            raise InputError("remove: these are all elements; nothing would be left of the body")
        with errors_on_all_ranks(self.comm):
            cells = self._whole_cells("remove", selection.ids)
        self._check_surfaces(cells)
        name = f"removal {self.given.next('removal')}"
        stage = Stage(name, selection)

        def take_out() -> None:
            self._take_out(name, cells, fade)
            self.given.add(Given(name, stage, self.progress.factor), "removal")

        self.whole(take_out)
        return stage

    def _check_surfaces(self, cells: np.ndarray) -> None:
        for term in self.terms:
            surface = getattr(term, "surface", None)
            touched = isinstance(surface, FacetSurface) and bool(np.any(np.isin(surface.cells, cells)))
            if self.comm.allreduce(int(touched)):
                raise InputError(
                    f"remove: {term.name} acts on the surface of some of these elements; release it before"
                )

    def _take_out(self, name: str, cells: np.ndarray, fade: Fade | None) -> None:
        loaded = self.progress.step > 0 or self.at_rest
        before = self.energies()["residue"] if loaded else 0.0
        whole = self._forces_now() if loaded else None
        left = self.elements.take_out(cells)
        self.keep({rows: a[left] for rows, a in self.kept().items()})
        self._note_stage()
        self._check_supports()
        if whole is None:
            return
        self._hold_rest()
        if fade is not None:
            missing = self._missing(whole)
            handed = handed_forces(name, self._prepare(), missing, np.zeros_like(missing), fade)
            self._loads += handed
            self._stale = True
            self._forces_now()
            self._carry(self._missing(whole))  # what rounding leaves
        self.progress.carried_work += before - self.energies()["residue"]

    def _forces_now(self) -> np.ndarray:
        """Internal forces less loads (nodes, block) in the last converged state, complete on owned rows; the
        system is made for the elements that are in the body now. Collective."""
        self._use_materials(self._settled)
        system = self._system_of_state()
        self._put_loads(system, None)
        forces: np.ndarray = system.assemble(False).forces.copy()
        return forces

    def _system_of_state(self) -> NodalSystem:
        self._last_loads = None  # of the body as it was
        try:
            return self._prepare()
        except InputError as e:
            if self.progress.step or not str(e).startswith("initial_stress"):
                raise
        # it may be that the state is read from a restart file next
        self.carried_is_found = True
        system = self._prepare()
        return system

    def _missing(self, whole: np.ndarray) -> np.ndarray:
        """What keeps the body as it is in the place of forces that the whole of it had (nodes, block)."""
        system = self._prepare()
        left: np.ndarray = system.on_free(self._forces_now() - whole)
        return left

    def _carry(self, forces: np.ndarray) -> None:
        """Forces (nodes, block) that are carried along from here on."""
        system = self._prepare()
        carried = np.zeros_like(forces) if self.carried_at_rest is None else self.carried_at_rest
        self.carried_at_rest = np.where(system.prescribed.fixed, carried, carried + forces)
        system.carried[:] = self.carried_at_rest

    def _hold_rest(self) -> None:
        """What an initial stress has found to be carried along stays, at nodes of the body."""
        self.carried_is_found = True
        if self.carried_at_rest is not None:
            here = self.elements.reached()[:, None]
            self.carried_at_rest = np.where(here, self.carried_at_rest, 0.0)
            self._stale = True

    def _check_supports(self) -> None:
        """Raise InputError for supports that hold nothing of the body any more. Collective."""
        made = Prescribed(self.elements.nodes, self.supports, self.layout, self.comm)
        reached = self.elements.reached()
        held = np.array([int(np.any(mask & reached)) for mask in made.masks], dtype=int)
        for support, number in zip(self.supports, np.atleast_1d(self.comm.allreduce(held)), strict=True):
            if not number:
                raise InputError(f"remove: {support.name} would hold nothing of the body any more")

    def _note_stage(self) -> None:
        """The body isn't what it was, and it is this problem that has changed it."""
        self._leave(changed=True)
        self._last_loads = None
        self._renew_forms()
        if self._equilibrium is not None:
            self._equilibrium.points_moved = True

    # put in ---------------------------------------------------------------------------------------
    @collective("add", compare=True)
    def add(
        self,
        term: Term | Stage | Selection,
        *,
        counts: str | None = None,
        over: float | None = None,
        until: float | None = None,
        stress: Stress | None = None,
        overconsolidation: float | None = None,
    ) -> Any:
        """Add a term: a contribution to the nodal system, such as a `SurfaceTerm` of one's own. Or put
        elements into the body that have been taken out, as a fill does.

        A term acts in mid-run from the next step on. `counts` as of `load`.

        Elements are undeformed, and without stress, where their nodes are then: those that they share with
        the body have moved with it, others are where they were when they were left alone. Their reference
        state is that place, and displacements of their points count from there; those of nodes from the mesh.
        Loads on all points (`body_load`), on the elements and on their facets act on them, too: at once, or
        those on points growing evenly over load factors to what they are now. Arrays in `problem.rows` have
        zeros for them.

        Args:
            term: or what `remove` has returned, or a selection of quadrature points of elements that have
                been removed.
            over, until: load factors over which, or until which, the present loads on the points grow.
            stress, overconsolidation: an initial stress of the elements, as of `initial_stress`.

        Returns:
            The stage, of elements.

        Raises:
            InputError: neither term nor elements; a term that doesn't fit; elements that are in the body, are
                turned inside out where they are, or parts of elements; options of the other kind; material
                points; what `remove` refuses.
        """
        given = {"over": over, "until": until, "stress": stress, "overconsolidation": overconsolidation}
        if isinstance(term, Points):
            raise InputError(
                "add: points join bodies of material points; a fill of elements is part of the mesh: remove "
                "it before the first step, and add what remove has returned"
            )
        if not isinstance(term, Stage | Selection):
            wrong = [name for name, value in given.items() if value is not None]
            if wrong:
                raise InputError(f"add: {wrong[0]} belongs to elements, not to {checks.shown(term)}")
            return self._add_term(term, counts)
        if counts is not None:
            raise InputError("add: counts belongs to terms; elements have over and until")
        self._check_stages("add")
        fade = fading(self.progress.factor, over, until, "add")
        return self._fill(term.points if isinstance(term, Stage) else term, fade, stress, overconsolidation)

    def _fill(
        self, selection: Selection, fade: Fade | None, stress: Stress | None, overconsolidation: float | None
    ) -> Stage:
        if selection.body is not None and selection.body not in self.points.fingerprints():
            raise InputError("add: the selection is of another body; it is to be one of these elements")
        with errors_on_all_ranks(self.comm):
            cells = self._cells_outside(selection)
            refuse_inverted(self.elements, cells)
        stage = Stage(f"fill {self.given.next('fill')}", selection)

        def put_in() -> None:
            self._put_in(stage.name, cells, fade, stress, overconsolidation)
            self.given.add(Given(stage.name, stage, self.progress.factor), "fill")

        self.whole(put_in)
        return stage

    def _add_term(self, term: Term, counts: str | None) -> None:
        super().add(term, counts=counts)

    def _cells_outside(self, selection: Selection) -> np.ndarray:
        """Own cells of a selection of elements that aren't in the body. Local."""
        e, ids = self.elements, selection.ids
        total = int(e.mesh.topology.index_map(e.dim).size_global) * len(e.reference_points)
        if not len(ids):
            raise InputError("add: the selection contains no point")
        if ids[-1] >= total:
            raise InputError(f"add: the selection has point {ids[-1]}; the mesh has {total}")
        cells = self._whole_cells("add", ids)
        inside = cells[np.isin(cells, e.live)]
        if len(inside):
            raise InputError(
                f"add: element {e.body.original_cells[inside[0]]} is in the body; elements can be added that "
                "remove has taken out"
            )
        return cells

    def _put_in(
        self,
        name: str,
        cells: np.ndarray,
        fade: Fade | None,
        stress: Stress | None,
        overconsolidation: float | None,
    ) -> None:
        p, kept = self.points, self.kept()
        before = self.energies()["residue"] if stress is not None else 0.0
        old, new = self.elements.put_in(cells)

        def longer(rows_name: str, rows: np.ndarray) -> np.ndarray:
            out = p.x.copy() if rows_name == "last_x" else np.zeros((len(p), *rows.shape[1:]), rows.dtype)
            out[old] = rows
            return out

        self.keep({rows_name: longer(rows_name, rows) for rows_name, rows in kept.items()})
        if stress is not None:
            self._stress_rows(new, stress, overconsolidation)
        self._note_stage()
        if self.progress.step or self.at_rest:
            self._hold_rest()
        if stress is not None:  # what they have stored was done before
            self.progress.external_work += before - self.energies()["residue"]
        if fade is not None:
            for couple, values in enumerate(self._loads_at(self.progress.factor)):
                values[old] = 0.0
                if self.comm.allreduce(float(np.abs(values).max(initial=0.0))) > 0.0:
                    self._loads.append(HandedOver(f"{name}, not yet there", bool(couple), fade, -values))

    def _stress_rows(self, rows: np.ndarray, stress: Stress, overconsolidation: float | None) -> None:
        """Give some undeformed points a stress. Collective."""
        p = self.points
        used = self.comm.allreduce(np.bincount(p.material[rows], minlength=len(p.materials)))
        for material, number in zip(p.materials, used, strict=True):
            if number and not material.plastic:
                raise InputError(
                    f"add: stress: elements of {type(material).__name__} take one in a body with an initial "
                    "stress only; give it one before the first step, which may be zero"
                )
        joining = self._points_alone(rows)
        with errors_on_all_ranks(self.comm):
            stresses = stresses_of(joining, stress)
        self._stress_points(joining, stresses, overconsolidation)
        for field in ("plastic_F", "hardening"):
            values = getattr(p, field).copy()
            values[rows] = getattr(joining, field)
            setattr(p, field, values)

    def _points_alone(self, rows: np.ndarray) -> Points:
        """A body of some of the points. Collective."""
        made = self.points.__copy__()
        made.replace({name: a[rows] for name, a in self.points.arrays().items()}, same=True)
        return made
