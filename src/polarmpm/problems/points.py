"""Quasi-static problems of material points on a grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..basis.base import Basis
from ..basis.registry import basis_of
from ..bodies.partition import LoadShares
from ..bodies.points import Points
from ..bodies.reference import Increments, Reference
from ..bodies.selection import Selection
from ..bodies.validity import Seal
from ..conditions.loads import Applied, HandedOver, Load
from ..conditions.movinggrid import MovingGrid
from ..forms.points import PointForm
from ..forms.stresses import MaterialField
from ..forms.trial import try_energy
from ..geometry.grid import Grid
from ..geometry.planes import PlaneSpec
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..materials.base import Material
from ..solvers.choice import check_solver
from ..solvers.newton import Controls, Outcome
from ..solvers.resetting import ResetPolicy, WhenDistorted, make_policy
from ..terms.base import Term
from ..terms.ghost import Ghost, GhostPenalty, make_penalty
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, reduced
from .balancing import BalancedResets
from .boxes import BoxRecord
from .conservation import Conservation
from .described import described, of_rank
from .fitting import (
    check_assembly,
    check_bodies,
    check_body,
    check_boxes,
    check_revolution,
    check_second_gradients,
    touches_axis,
)
from .gridpolicies import RegridPolicy
from .locking import check_locking, choose_form, warn_of_dilatancy, warn_of_functions
from .ongrid import Compiled
from .regridding import Regridded, Regridding
from .state import Fields, Progress, choose_fields
from .surfaces import add_load
from .telling import note_settings
from .whole import Changing
from .work import StepStart

_DISTORTED = WhenDistorted()
# The papers' method, for what they publish: `QuasiStatic(grid, points, **PUBLISHED)`.
PUBLISHED: dict[str, Any] = {"basis": "gimpm", "reset": 1, "balanced_reset": False, "locking": None}


class QuasiStatic(Regridded):
    """Equilibrium of material points on a grid under slowly changing loads. All methods are collective.

    Attributes:
        grid: the background grid as of the last reset.
        initial_grid: the grid that was given; moving planes (see `plane`) stretch it, `regrid` changes it.
        rotation_limit: rotation increments that are larger than this (rad) somewhere get a new base after a
            step.
        rows: arrays (np, ...) of the script's own by name, one row a local point. They follow the points when
            these move to other ranks at a reset, and into restart files.

    Args:
        grid: background grid.
        points: the body.
        basis: weighting functions: "bspline" (quadratic), "bspline-averaged" (over the points' boxes),
            "bspline3" (cubic), "gimpm" or "mpm" (T 2.3.2), or a `Basis`. The defaults of this and of the
            resets are the settings with the least error for their time (docs/accuracy.md); those of the
            papers are `pm.PUBLISHED`.
        assembly: how residual and tangent are summed over the points: "direct", or (with basis="mpm") as a
            "projection" on a quadrature space, assembled by dolfinx, to the same result.
        reset: when the grid is reset: a policy such as `WhenDistorted(0.2)`, every n steps (1: the papers'
            method), or None for never. By policies it is also when points have left the grid, in which case
            the next step raises PointsOutsideGrid unless planes have moved, or `regrid` gives another grid;
            without resets the grid is that of the undeformed body, which may leave it.
        balanced_reset: a reset keeps the body in equilibrium. The new basis can't balance all of the points'
            stresses; the papers let the rest relax, which softens the body reset by reset. Here it is carried
            along as an initial stress of the points until the next reset (docs/theory.md).
        ghost: stabilises cells that the body cuts slightly (T 2.3.4): None, "thesis" (a hundredth of lambda
            and of gamma, T 4.4), "light" (against the thinnest cuts only) or a `GhostPenalty`. With basis
            "gimpm" or "mpm" and assembly "direct".
        rebalance: on several ranks, when points move to other ranks at a reset: when the most work of a rank,
            over the mean, or the share of nodes at the borders between ranks has grown by this factor since
            they were distributed last; None for never. Where `locking` is cured, they are at every reset, as
            the points of a patch have to be on one rank.
        controls: tolerances of Newton's method.
        solver: of linear systems: "direct" (MUMPS), "multigrid" (a Krylov method with algebraic multigrid:
            less time and memory in large problems in space), or "auto", which chooses by the number of
            unknowns.
        boxes: points integrate the strain energy over their own boxes (docs/theory.md), so that few of them
            see that a thin body bends; by default with all bases that have second derivatives, the splines.
            Points whose boxes are as large as a cell are split at the first balanced reset (docs/theory.md).
        locking: "auto": materials that lock on coarse cells (docs/stability.md) see the mean volume, and
            relative rotation, of a patch of cells instead of their points' own; "always": all do; None: none.
        regrid: a policy of other grids in the course of the run, such as `AlongBands` or `FollowBody`; or a
            function that returns a grid, or None: of the problem at each reset, or of the problem and a
            `Trial` after each step, which is then taken again. Points are split where cells become finer
            (docs/grids.md). `regrids` tells of each change.

    Raises:
        InputError: an argument is out of range; materials that don't go together.
        PointsOutsideGrid: points lie outside the grid; the message names them.
    """

    @collective("QuasiStatic", comm=lambda self, grid, *args, **options: grid.comm, compare=True)
    def __init__(
        self,
        grid: Grid,
        points: Points,
        *,
        basis: str | Basis = "bspline",
        assembly: str = "direct",
        reset: int | ResetPolicy | None = _DISTORTED,
        balanced_reset: bool = True,
        ghost: str | GhostPenalty | None = None,
        rebalance: float | None = 1.1,
        controls: Controls | None = None,
        solver: str = "auto",
        boxes: bool | None = None,
        locking: str | None = "auto",
        regrid: RegridPolicy | Callable[[Any], Grid | None] | None = None,
    ):
        check_body(grid, points)
        self.balanced_reset = checks.flag("balanced_reset", balanced_reset)
        self.grid = self.initial_grid = grid
        self._moving, self.regridding = MovingGrid(grid), Regridding(regrid)
        self.basis, self.policy = basis_of(basis), make_policy(reset)
        self.assembly, self.solver = check_assembly(assembly, self.basis), check_solver(solver)
        check_bodies(points, self.assembly)
        check_second_gradients(points, self.basis)
        check_revolution(grid, points, assembly)
        super().__init__(grid.comm, points, grid.dim, controls)
        self.locking = check_locking(locking)
        self.forms = self._forms_of(self.points.materials)
        with errors_on_all_ranks(grid.comm):
            self._warn_of_locking()
        self.rotation_limit = 1.0
        self.boxes = check_boxes(boxes, self.basis)
        self.box_record = BoxRecord(points, self.forms, grid.comm)
        self._size = 0.0  # largest gradient of the last step's increments on this rank
        self.load_shares = LoadShares(grid.comm, rebalance)
        self._conservation = Conservation(grid.comm)
        self.regridding.begin(self)
        self.ghost = make_penalty(ghost, points.materials, self.layout, self.basis, assembly)
        if self.ghost:
            self.add(Ghost(self.ghost, self.layout, self._ghost_beyond))
        self._compiled = Compiled()
        self._resets = BalancedResets((f.layout for f in self.forms), self.comm, self.timer)
        self._system: LoadedPoints | None = None
        self._seal: Seal | None = None
        self._arrangement = points.arrangements
        # forces and couples at the points of the last attempt and of the last converged step
        self._attempted: tuple[np.ndarray, np.ndarray] | None = None
        self._converged_loads: tuple[np.ndarray, np.ndarray] | None = None
        if self.load_shares.due() or self._in_patches:
            self._migrate()
        self._hold_axis()
        note_settings(self)

    def _touches_axis(self) -> bool:
        return self.initial_grid.lower[0] == 0.0 and touches_axis(self.points)

    def _warn_of_locking(self) -> None:
        """On one rank; an error where the script makes errors of warnings."""
        if self.comm.rank == 0:
            left = [form.material for form in self.forms if not form.scalars]
            warn_of_functions(self.locking, left, self.basis)
            if not self.basis.patch_linear:
                warn_of_dilatancy(self.forms, "basis='bspline'")

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        for thing in (
            *(self.policy, self.box_record, self.box_record.grid, self.box_record.limit),
            *(self.load_shares, self.load_shares.shares),
            *(self._conservation, self._moving, self._compiled, self._resets),
        ):
            yield thing, None

    def _forms_of(self, materials: Sequence[Material]) -> list[PointForm]:
        locking = None if self.assembly == "projection" else self.locking
        axial, dim = self.points.axisymmetric, self.initial_grid.dim
        forms = [choose_form(locking, m, dim, self.basis, axial) for m in materials]
        for form in forms:
            form.check()
            try_energy(form.material, self.comm)
        return forms

    def _renew_forms(self) -> None:
        self.points.arrangements += 1
        self._arrangement = self.points.arrangements
        self.forms = self._forms_of(self.points.materials)
        self.box_record = BoxRecord(self.points, self.forms, self.comm)
        self._compiled = Compiled()
        self._resets = BalancedResets((f.layout for f in self.forms), self.comm, self.timer)
        if self._system is not None:
            self._system.destroy()
            self._system = None
        self.progress.reset_due = True

    def _more_forms(self) -> None:
        more = self._forms_of(self.points.materials[len(self.forms) :])
        self.forms = [*self.forms, *more]
        if self._compiled.kernels:
            self._compiled.kernels = [*self._compiled.kernels, *(form.compile(self.comm) for form in more)]
        self.box_record.renew(self.forms)
        self._resets.layouts = tuple(dict.fromkeys(form.layout for form in self.forms))

    def _put_into_forms(self) -> None:
        for form, material in zip(self.forms, self.points.materials, strict=True):
            form.take(material)
        if self._system is not None:
            self._system.interpolation.pack()

    def _free(self) -> None:
        self.box_record.kept = self.box_record.energies(self._system)
        if self._system is not None:
            self._system.destroy()
            self._system = None

    # conditions -----------------------------------------------------------------------------------
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        if isinstance(where, PlaneSpec):
            self.basis.check_plane(where := self._here(where), self._moving.initial)
            return where.resolve(self._moving.initial, self.points, now=self.grid), where.name
        what = "a plane, a Surface or a predicate of node positions (n, d) is"
        return checks.function("fix: where", where, what, takes=("positions",)), getattr(
            where, "__name__", "predicate"
        )

    def _named(self, where: Any) -> Any:
        named = isinstance(where, str | int | np.integer) and not isinstance(where, bool)
        return self.points.surface(where) if named and self.points.surfaces else where

    def _note_handed(self, handed: list[HandedOver], factor: float) -> None:
        if self._converged_loads is not None:
            for load in handed:
                load.add_to(self._converged_loads[load.couple], self.points, factor)

    @collective("load", compare=True)
    def load(
        self,
        where: Selection | Surface | str | int,
        *,
        force: Any = None,
        couple: Any = None,
        counts: str | None = None,
    ) -> Term | Applied:
        """A dead force (N) and couple (N m) in total, shared by selected points in proportion to their
        reference volumes, so that it acts in the middle of these, or spread evenly over a surface, also one
        by the name of a group of facets of the mesh that the points come from.

        Numbers are ramped, functions of the load factor give the value. In plane strain they count per unit
        thickness, and the couple is one number.

        Args:
            counts: of a load that is added in mid-run: "from now": what the values gain from the present load
                factor on, so that nothing jumps; or "total": the values at the load factor. Default: numbers
                grow from now, functions give the total.

        Returns:
            The load, for `release`.
        """
        where = self._named(where)
        if isinstance(where, Surface):
            return add_load(self, where, force, couple, counts)
        if not isinstance(where, Selection):
            allowed = "use points.where, points.farthest, points.nearest, or a Surface"
            raise checks.refuse("selection", where, allowed)
        name = f"load {self.given.next('load')}"
        self.points.check(where)
        share = 1.0 / self.points.volume_of(where) if len(where) else 1.0
        return self._add_loads(name, where, (force, couple), counts, share=share)

    def _put_loads(self, system: LoadedPoints, factor: float | None) -> None:
        last = self.progress.factor
        if factor is None:
            system.set_loads(*(self._converged_loads or self._loads_at(last)))
        else:
            self._attempted = self._loads_at(factor)
            system.set_loads(*self._attempted)
        self._set_terms(last if factor is None else factor)

    # solving --------------------------------------------------------------------------------------
    def _increments(self, system: LoadedPoints) -> Increments:
        return system.gathered()

    def volume_ratios(self, increments: Increments) -> np.ndarray:
        change = np.eye(self.grid.dim) + increments.gradient
        ratios: np.ndarray = rotations.determinant(change)
        if self.layout.axial:  # a ring doesn't pass through the axis
            assert self._system is not None
            before = self._system.interpolation.reference.x[:, 0]
            ratios = np.minimum(ratios, 1.0 + increments.value[:, 0] / before)
        return ratios

    def _check(self, increments: Increments) -> str:
        inverted = reduced(self.comm, int(np.count_nonzero(self.volume_ratios(increments) <= 0)))
        return f"{inverted} material point(s) turned inside out" if inverted else ""

    def _trust(self, system: LoadedPoints, start: StepStart, at_points: Increments, outcome: Outcome) -> None:
        outcome.unresolved = self.box_record.unresolved(system, start.x, at_points.gradient)
        outcome.reason = self.box_record.refusal(outcome.unresolved)
        outcome.converged = not outcome.reason
        if outcome.converged:
            self.box_record.note_loads(system, start, self.terms)
            self._indicate(system, outcome)

    def _note(self, outcome: Outcome) -> None:
        assert self._system is not None
        self.box_record.grid.look_at_stresses(self._system, self._stresses)
        self.box_record.note(outcome.unresolved, self.progress.step, self._size)

    def _stresses(self) -> np.ndarray:
        return self._fields.evaluate(self.points, choose_fields(("stress",), self.points)).stress

    def trust(self) -> str:
        """In a line: the largest share of a step's work inside the points' boxes (docs/accuracy.md)."""
        return self.box_record.summary()

    def _commit(self, system: LoadedPoints, increments: Increments, factor: float) -> None:
        assert self._compiled.motion is not None
        self._size = float(np.abs(increments.gradient).max(initial=0.0))
        system.interpolation.update_points(increments, self._compiled.motion)
        self.points.forget_sides()
        system.put_projected()
        system.keep_boxes(first=self.progress.since_reset == 0)
        self._conservation.check(system.interpolation, system.x)
        if self.points.plastic:
            self._with_boxes(lambda: self._flow(system))
        self._converged_loads = self._attempted
        p, kept = self.progress, system.box_tangent
        p.box_solutions = 0 if kept is None else kept.solutions
        p.factor, p.step, p.since_reset = factor, p.step + 1, p.since_reset + 1
        with errors_on_all_ranks(self.comm, "the reset policy") as answer:
            due = answer.alike = bool(self.policy.due(p.since_reset, increments.gradient, self.comm))
        due = due or self._comes_near(system, increments)
        p.reset_due = due or any(term.renew for term in self.terms) or self._has_left()
        if not p.reset_due and self.layout.rotations:
            largest = float(np.abs(system.x[:, self.layout.dim :]).max(initial=0.0))
            if reduced(self.comm, largest, MPI.MAX) > self.rotation_limit:
                self._with_boxes(system.rebase_rotations)
                for term in self.terms:
                    term.rebase_rotations()
                p.rotation_factor = factor
        self._seal = Seal(self.points)

    def _comes_near(self, system: LoadedPoints, increments: Increments) -> bool:
        """Whether the body comes to what the grid's nodes don't know of. Collective."""
        return False

    # restart --------------------------------------------------------------------------------------
    def increments(self) -> tuple[Reference, np.ndarray, np.ndarray] | None:
        """What a restart needs between two resets: reference state, lattice numbers of the owned nodes, and
        their increments and carried forces (n, 2 block), then those of `BoxTangent` where one is kept
        (n, 4 block); None when the grid is to be reset before the next step."""
        s = self._system
        if s is None or self.progress.reset_due:
            self._put_sides()
            return None
        values, boxes = [s.x, s.carried], s.box_tangent
        if boxes is not None:
            values += [boxes.x, boxes.before]
        rows = np.hstack([v[: s.nodes.owned] for v in values])
        return s.interpolation.reference, s.nodes.lattice[: s.nodes.owned], rows

    def kept(self) -> dict[str, np.ndarray]:
        out = super().kept()
        if self._converged_loads is not None:
            out |= {"forces": self._converged_loads[0], "couples": self._converged_loads[1]}
        return out | {"box_energy": self.box_record.energies(self._system)}

    def keep(self, rows: dict[str, np.ndarray]) -> None:
        super().keep(rows)
        self.box_record.kept = rows.get("box_energy")
        self._converged_loads = (rows["forces"], rows["couples"]) if "forces" in rows else None

    def restore(
        self,
        progress: Progress,
        increments: tuple[Reference, np.ndarray, np.ndarray] | None,
        kept: dict[str, np.ndarray],
        shares: np.ndarray | None,
    ) -> None:
        """Continue from a state whose points have been put in already; see `io.restart`.

        Args:
            increments: as from `increments`.
            kept: as from `kept`.
            shares: how well the points are distributed, from `LoadShares.state`; None: they are distributed
                now.
        """
        self.check_open()
        self.progress, self._equilibrium, self._conservation = progress, None, Conservation(self.comm)
        self._leave(changed=True)
        self.keep(kept)
        self._seal, self._arrangement = None, self.points.arrangements
        if self._system is not None:
            self._system.destroy()
            self._system = None
        factor = progress.factor if increments is None else progress.reset_factor
        for load in self._loads:
            if isinstance(load, Load) and load.selection is not None:
                self.points.check(load.selection)  # the saved points may be others
        self._put_grid(self._moving.at(factor if progress.step else None, self.supports))
        reference, lattice, values = increments or (None, None, None)
        if shares is None:
            reference = self._migrate(reference)
        else:
            self.load_shares.restore(shares)
        if reference is None or lattice is None or values is None:
            progress.reset_due = True
            return
        self._compile()
        self._system, self._stale = self._continued(reference, lattice, values), False

    # results --------------------------------------------------------------------------------------
    @collective("fields")
    def fields(self, *names: str | MaterialField) -> Fields:
        found = super().fields(*names)
        if "energy" in found:
            found.energy[:] += self.box_record.energies(self._system) / self.points.volume0
        return found

    @property
    def system(self) -> LoadedPoints | None:
        """Active nodes, their increments and residual as of the last step; None before the first one."""
        return self._system

    def __repr__(self) -> str:
        return described(self, f"{len(self.points)} points{of_rank(self.comm)}, basis {self.basis.name!r}")
