"""What acts on a body: supports, loads and terms, in the words of a script."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.misfit import warn_of_misfit
from ..bodies.points import Points
from ..bodies.selection import Selection
from ..conditions.amplitudes import Amplitude, check_counts
from ..conditions.loads import AnyLoad, Applied, Load, make_loads
from ..conditions.supports import Support, make_support
from ..errors import InputError
from ..geometry.planes import Plane, PlaneSpec, plane
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout
from ..terms.base import Term
from ..terms.surfaces import SurfaceSupport
from ..terms.surfaceterms import SurfaceCondition
from ..tools import checks
from ..tools.checks import shown
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from . import slopes, surfaces
from .given import Given, Present, Register
from .keeping import Keeping
from .state import Progress
from .turns import Turns
from .whole import Changing, Whole

AXIS = plane(x=0.0)


class Conditions(Keeping, Whole, Turns):
    """Supports, loads and terms of a problem. All methods are collective.

    Attributes:
        points: where the body's state lives: material points, or the elements' quadrature points.
        layout: unknowns of a node.
        given: all conditions that a script has given, those that have been released too.
        axis: of a body of revolution that reaches its axis, what holds it there; else None.
        progress: load factor and number of steps of the last converged state.
    """

    holds_on_facets = False  # slopes; else on planes of the grid
    axis: Support | None = None
    forms: Any  # the materials' weak forms, of points or of elements
    knows_undeformed = False  # where a surface that is added in mid-run was in the undeformed body

    def __init__(self, comm: MPI.Comm, points: Points, dim: int):
        self.comm, self.points, self.progress = comm, points, Progress()
        layouts = {Layout.of(m, dim, points.axisymmetric) for m in points.materials}
        if len(layouts) > 1:
            raise InputError("points: micropolar and classical materials can't be mixed in one body")
        self.layout = layouts.pop()
        self._supports: list[Support] = []
        self._loads, self._terms, self._leaving = [], [], []
        self.given = Register()
        self._leave()
        self._stale = False  # conditions have changed since the system was built
        self._unasked: list[Amplitude] = []  # functions that haven't been compared over the ranks yet

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        conditions: list[Any] = [*self._supports, *self._loads, *self._terms, *self._leaving]
        for given in self.given:
            conditions += [given, *getattr(given.condition, "parts", (given.condition,))]
        for thing in (self.progress, self.points, *conditions):
            yield thing, None
        for condition in conditions:
            if isinstance(condition, Support) and isinstance(condition.where, Plane):
                yield condition.where, None
            if hasattr(condition, "amplitude"):
                yield condition.amplitude, None
            for amplitude in condition.amplitudes() if isinstance(condition, SurfaceCondition) else ():
                yield amplitude, None

    @property
    def supports(self) -> tuple[Support, ...]:
        """Prescribed nodes; `fix` adds to them, `release` takes one away."""
        return Present(self._supports)

    @property
    def loads(self) -> tuple[AnyLoad, ...]:
        """Dead loads on points."""
        return Present(self._loads)

    @property
    def terms(self) -> tuple[Term, ...]:
        """What acts on the body besides its stresses, supports and dead loads; see `add`."""
        return Present(self._terms)

    @abstractmethod
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        """Predicate of node positions, and its name, of what the user gives to `fix`."""

    def _named(self, where: Any) -> Any:
        """The surface that the name of a group of boundary facets means, where that's a surface."""
        return where

    def _surface_of(self, where: Any) -> Any:
        """The surface that is meant where a support has a method."""
        return where

    @property
    @abstractmethod
    def cell_size(self) -> float:
        """Size of a cell or an element (m), the smallest one. Collective."""

    @collective("fix", compare=True)
    def fix(
        self,
        where: Any,
        *,
        method: str | None = None,
        stiffness: float | None = None,
        rotation_stiffness: float | None = None,
        augment: bool = False,
        normal: Any = None,
        counts: str | None = None,
        body: int | None = None,
        **components: Any,
    ) -> Support | SurfaceSupport:
        """Prescribe displacements and rotations, of nodes or on a surface.

        Args:
            where: `plane(x=0.0)` or a predicate of node positions (n, d) -> (n,) bool; for finite elements
                also facets, or the name of a physical group. Or a `Surface` (`elements.surface(...)`), which
                the body carries, of points from a mesh also the name of a group of its facets.
            **components: u, theta (all components), or ux, uy, uz, theta_x, theta_y, theta_z (theta in
                plane strain), in m and rad. A number is ramped with the load factor; a function of the
                factor, or of (factor, positions), gives the displacement or rotation; positions are
                those of the nodes at the last reset, of a surface the undeformed ones. In one step a rotation
                in space may change by less than pi. One number for several components is zero. slope=0 (or
                slope_x=0 ...) holds du/dn, not u, on a plane (docs/conventions.md).
            counts: "from now" or "total": whether these values count from the body's present place, so that
                u=0 holds it there and it moves by what the values gain from now on; or from the undeformed
                body, so that u=0 brings it back to it in the next step. Default: before the first load step
                the total, later from now on. (A grid's node has the points' displacement, by a fit.)
            method: how a surface is held (docs/conventions.md): "nitsche" by the material's own tractions,
                and springs for what these miss; "nitsche-unsymmetric" likewise, stable however thinly it cuts
                cells; "penalty" by springs alone. Facets of elements are held so where it is given.
            stiffness: of a surface's springs (Pa/m): the virtual work per undeformed area is
                stiffness (u - prescribed u) . du, and the same for rotations. By default as stiff as a layer
                of 1/20 of a cell or less, with "penalty" of a thousandth.
            rotation_stiffness: the same for rotations (N/m).
            augment: with "penalty": keep the springs' forces after each converged step and let the springs
                start anew, so that what they give way under a load that stays vanishes over steps.
            normal: displacement along a surface's undeformed normals (m): rollers. Not beside displacements.
            body: number of one of several bodies of points (`points.body`), whose nodes alone are held.

        Returns:
            The support, for `reaction` and `release`. Of a surface, `support.gap` (n,) tells by how much (m)
            the prescribed displacements were missed in the last step.

        Raises:
            InputError: unknown component or none, plane without nodes, value that isn't finite; of a surface,
                a stiffness or a method that can't be; springs elsewhere. When the next step begins, a support
                at whose nodes there is nothing of the body.
        """
        self._check_outside("fix")
        check_counts("fix", counts)
        body = self._number_of_body(body, where)
        springs = {"stiffness": stiffness, "rotation_stiffness": rotation_stiffness, "normal": normal}
        where = self._named(where) if method is None else self._surface_of(self._named(where))
        if isinstance(where, Surface):
            options = {**springs, "method": method, "augment": augment, "counts": counts}
            return surfaces.add_support(self, where, components, **options)
        _check_no_springs(where, {"method": method, **springs}, checks.flag("fix: augment", augment))
        return self._fix_nodes(where, components, counts, body=body)

    def _number_of_body(self, body: int | None, where: Any) -> int | None:
        """Of those that there are, what a user gives as `body`."""
        if body is None:
            return None
        if self.holds_on_facets or self.points.bodies == 1:
            raise checks.refuse("fix: body", body, "there is one body only; leave it out")
        if isinstance(where, Surface | str):
            raise checks.refuse("fix: body", body, "a surface is on one body anyway; leave it out")
        most = self.points.bodies - 1
        return checks.whole("fix: body", body, least=0, most=most, allowed=f"0 to {most}")

    @collective("symmetry", compare=True)
    def symmetry(self, where: PlaneSpec) -> Support:
        """Let a plane be one of symmetry, so that the body is the half of a symmetric one.

        On it the displacement along its normal vanishes, and the slope of the others across it; of
        microrotations those about axes in the plane vanish (in plane strain theta), and the slope of the one
        about its normal. Functions and points of the half are then those of the whole body, to rounding. In
        mid-run all of it counts from now on.

        Args:
            where: such as `plane(x=0.0)`; with splines a wall of the grid; of finite elements also facets.

        Returns:
            The support, for `reaction` and `release`.

        Raises:
            InputError: not a plane, not one on which the body's basis can prescribe values, or one with the
                body on both sides.
        """
        self._check_outside("symmetry")
        zero, even = slopes.symmetric(self._normal_axis(where), where, self.layout)
        return self._fix_nodes(where, zero, None, even)

    def _touches_axis(self) -> bool:
        """Whether a body of revolution reaches its axis. Collective."""
        return False

    def _hold_axis(self) -> None:
        """On the axis of a body of revolution nothing moves outward, and nothing turns. Collective."""
        if self.layout.axial and self._touches_axis():
            zero, even = slopes.symmetric(0, AXIS, self.layout)
            self.axis = self._fix_nodes(AXIS, zero, None, even)

    def _fix_nodes(
        self,
        where: Any,
        components: dict[str, Any],
        counts: str | None,
        even: dict[int, bool] | None = None,
        body: int | None = None,
    ) -> Support:
        """`even`: of a plane of symmetry, which columns are even across it."""
        self.check_open()
        if even is None:
            predicate, label = self._place(where)
            even, components = slopes.take_slopes(where, components, self.layout, self.holds_on_facets)
        else:
            predicate, label = self._place(self._beside(where))
            label = f"symmetry, {label}"
        label += "" if body is None else f", body {body}"
        total = not self.progress.step if counts is None else counts == "total"
        number = self.given.next("support")
        support = make_support(predicate, label, components, self.layout, number, total, bool(even))
        turned = [c for c in support.columns if c >= self.layout.dim]
        if total and self.progress.step and 0 < len(turned) < self.layout.rotations:
            raise InputError(
                f"{support.name}: counts = 'total': in space single components of a rotation have no total; "
                "give theta, or counts='from now'"
            )
        support.body = body
        if even and body is not None:
            raise checks.refuse("fix: body", body, "slopes are held of all bodies; leave it out")
        if even:
            if total and self.progress.step:
                raise InputError(f"{support.name}: counts = 'total': a slope has no total in mid-run")
            self._tie(where, support, even)
        self._admit(where, support)
        self._follow([amplitude for amplitude, _ in support.columns.values()])
        self._supports.append(support)
        self.given.add(Given(support.name, support, self.progress.factor, counts), "support")
        self._stale = True
        return support

    def _normal_axis(self, where: Any) -> int:
        """The axis across a plane of symmetry."""
        return slopes.axis_of_plane(where)

    def _beside(self, where: PlaneSpec) -> PlaneSpec:
        """A plane of symmetry, once it is known to be one. Collective."""
        return where

    @abstractmethod
    def _tie(self, where: Any, support: Support, even: dict[int, bool]) -> None:
        """Let a support on a plane hold slopes there, or refuse it.

        Args:
            even: of columns of unknowns: their slope vanishes; False: they are odd across a plane of
                symmetry.
        """

    def _admit(self, where: Any, support: Support) -> None:
        """Take note of a support that the user has put on `where`, or refuse it."""

    def _admit_term(self, term: Term) -> None:
        """Refuse a term that can't be in this problem."""

    @collective("add", compare=True)
    def add(self, term: Term, *, counts: str | None = None) -> None:
        """Add a term: a contribution to the nodal system, such as a `SurfaceTerm` of one's own. In mid-run it
        acts from the next step on, which begins with a reset of the grid. `counts` as of `load`.

        Raises:
            InputError: not a term, one that is in a problem already, or one that doesn't fit this problem.
        """
        self._check_outside("add")
        if not isinstance(term, Term):
            raise InputError(
                f"term = {shown(term)} is not a Term; derive from polarmpm.Term or polarmpm.SurfaceTerm"
            )
        if term.taken:
            raise InputError(f"term = {term.name!r} has been added to a problem already; make another one")
        name = checks.text("term.name", term.name)
        check_counts(name, counts)
        checks.function(f"{name}: pieces", term.pieces, takes=("setting",))
        self.check_open()
        self._admit_term(term)
        term.attach(self.layout, self.comm)
        self._follow(term.amplitudes() if isinstance(term, SurfaceCondition) else [])
        term.taken = True
        term.begin_at(self.progress.factor, counts)
        self._terms.append(term)
        kind = "surface" if isinstance(term, SurfaceCondition) else "term"
        self.given.add(Given(term.name, term, self.progress.factor, counts), kind)
        self._stale = self.progress.reset_due = True

    @property
    def surfaces(self) -> list[SurfaceCondition]:
        """Tractions, pressures, supports and terms of one's own on surfaces."""
        return [term for term in self._terms if isinstance(term, SurfaceCondition)]

    def surface_name(self, kind: str) -> str:
        """Name of the next condition on a surface."""
        return f"{kind} {self.given.next('surface')}"

    @collective("traction", compare=True)
    def traction(
        self,
        where: Surface | str | int,
        *,
        force: Any = None,
        couple: Any = None,
        follows: bool = False,
        counts: str | None = None,
    ) -> Term | Applied:
        """A traction (N/m^2) and couple traction (N/m; one number in plane strain) on a surface that the body
        carries. Values and `counts` as in `load`.

        Dead: per undeformed area, fixed in space. `follows=True`: per current area; the part along the
        undeformed normal follows the current normal, the part in the surface is convected with it and keeps
        its size.

        Returns:
            The traction, for `release`.

        Raises:
            InputError: neither is given, values of the wrong size, a surface of another dimension; when the
                next step begins, also points of the surface outside of the body.
        """
        return surfaces.add_traction(self, self._named(where), force, couple, follows=follows, counts=counts)

    @collective("pressure", compare=True)
    def pressure(self, where: Surface | str | int, p: Any, *, counts: str | None = None) -> Term | Applied:
        """A pressure (Pa) against the current normal of a surface that the body carries, -p cof(F) N dA.

        Returns:
            The pressure, for `release`.

        Raises:
            InputError: as `traction`, and where the surface's normals point into the body.
        """
        return surfaces.add_pressure(self, self._named(where), p, counts=counts)

    @collective("body_load", compare=True)
    def body_load(
        self,
        *,
        force: Any = None,
        couple: Any = None,
        on: Selection | None = None,
        counts: str | None = None,
    ) -> Applied:
        """A dead force (N/m^3) and couple (N/m^2) per reference volume, on all points or a selection.

        Values and `counts` as in `load`; functions of two arguments get (factor, initial positions of the
        points (n, d)).

        Returns:
            The load, for `release`.
        """
        name = f"body load {self.given.next('load')}"
        return self._add_loads(name, on, (force, couple), counts, density=True)

    def _add_loads(
        self,
        name: str,
        selection: Selection | None,
        values: tuple[Any, Any],
        counts: str | None,
        density: bool = False,
        share: float = 1.0,
    ) -> Applied:
        self._check_outside(name)
        check_counts(name, counts)
        if selection is not None:
            self.points.check(selection)
            if density:
                warn_of_misfit(self.points, selection)
        parts = make_loads(name, selection, *values, self.layout, density, share)
        applied = Applied(name, tuple(parts))
        self._take(applied, [load.amplitude for load in parts], counts)
        self._loads += parts
        return applied

    def _take(self, applied: Applied, amplitudes: Sequence[Amplitude], counts: str | None) -> None:
        """Note a load of a script's."""
        self.check_open()
        for amplitude in amplitudes:
            amplitude.begin(self.progress.factor, counts)
        self._follow(amplitudes)
        self.given.add(Given(applied.name, applied, self.progress.factor, counts), "load")
        self._stale = True

    def _follow(self, amplitudes: Sequence[Amplitude]) -> None:
        """Take note of what a script has given to follow the load factor."""
        self._unasked += amplitudes

    def _set_terms(self, factor: float, carrying: bool = False) -> None:
        terms = self._working_terms
        if terms:
            with errors_on_all_ranks(self.comm):
                for term in terms:
                    term.set_factor(factor, carrying)

    def _load_places(self) -> list[tuple[Amplitude, np.ndarray]]:
        """All loads, and the positions (n, d) of this rank where they act.

        Raises:
            InputError: the arc-length method can't take a load; the message names it.
        """
        if not all(isinstance(load, Load) for load in self._loads):
            raise InputError(
                "forces fade over load factors (of a support that is released, of points that are removed or "
                "added); the arc-length method can't do that"
            )
        loads = [load for load in self._loads if isinstance(load, Load)]
        spatial = [load.name for load in loads if load.couple and self.layout.rotations == 3]
        if spatial:
            raise InputError(
                f"{spatial[0]}: couples in space turn with the spin; the arc-length method takes forces only"
            )
        return [(load.amplitude, self.points.X[self.points.rows(load.selection)]) for load in loads]


def _check_no_springs(where: Any, options: dict[str, Any], augment: bool) -> None:
    """Raise InputError if something is given that belongs to springs on a surface."""
    given = [name for name, value in options.items() if value is not None] + ["augment"] * augment
    if given:
        raise InputError(f"fix: {given[0]} belongs to springs on a Surface; where = {shown(where)}")
