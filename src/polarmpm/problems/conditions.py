"""What acts on a body: supports, loads and terms, in the words of a script."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points, Selection
from ..conditions.amplitudes import Amplitude
from ..conditions.loads import Load, make_loads
from ..conditions.supports import Support, make_support
from ..errors import InputError
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout
from ..terms.base import Term
from ..terms.surfaces import SurfaceSupport
from ..terms.surfaceterms import SurfaceCondition
from ..tools.parallel import errors_on_all_ranks
from . import surfaces
from .state import Progress


class Conditions(ABC):
    """Supports, loads and terms of a problem. All methods are collective.

    Attributes:
        points: where the body's state lives: material points, or the elements' quadrature points.
        layout: unknowns of a node.
        supports, loads: prescribed nodes, and dead loads on points.
        terms: what acts on the body besides its stresses, supports and dead loads; see `add`.
        progress: load factor and number of steps of the last converged state.
    """

    def __init__(self, comm: MPI.Comm, points: Points, dim: int):
        self.comm, self.points, self.progress = comm, points, Progress()
        layouts = {Layout.of(m, dim) for m in points.materials}
        if len(layouts) > 1:
            raise InputError("points: micropolar and classical materials can't be mixed in one body")
        self.layout = layouts.pop()
        self.supports: list[Support] = []
        self.loads: list[Load] = []
        self.terms: list[Term] = []
        self._stale = False  # conditions have changed since the system was built

    @abstractmethod
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        """Predicate of node positions, and its name, of what the user gives to `fix`."""

    @property
    @abstractmethod
    def cell_size(self) -> float:
        """Size of a cell or an element (m), the smallest one. Collective."""

    def fix(
        self,
        where: Any,
        *,
        stiffness: float | None = None,
        rotation_stiffness: float | None = None,
        augment: bool = False,
        normal: Any = None,
        **components: Any,
    ) -> Support | SurfaceSupport:
        """Prescribe displacements and rotations, of nodes or by springs on a surface.

        Args:
            where: `plane(x=0.0)` or a predicate of node positions (n, d) -> (n,) bool; for finite elements
                also facets, or the name of a physical group. Or a `Surface` (also one that doesn't follow the
                grid; `elements.surface(...)`), which the body carries: springs hold it.
            **components: u, theta (all components), or ux, uy, uz, theta_x, theta_y, theta_z (theta in
                plane strain), in m and rad. A number is ramped with the load factor; a function of the
                factor, or of (factor, positions), gives the total displacement or rotation; positions are
                those of the nodes at the last reset, of a surface the undeformed ones. In one step a rotation
                in space may change by less than pi.
            stiffness: of a surface's springs (Pa/m): the virtual work per undeformed area is
                stiffness (u - prescribed u) . du, and the same for rotations. Default: 1000 times the
                stiffest material's lam + 2 mu over the size of a cell: they give way like a layer of a
                thousandth of a cell.
            rotation_stiffness: (N/m); default: 1000 times gamma over the size of a cell, plus mu times it.
            augment: keep the springs' forces after each converged step and let the springs start anew, so
                that what they give way under a load that stays vanishes over steps (augmented Lagrange
                method).
            normal: displacement along a surface's undeformed normals (m): rollers. Not together with other
                displacements.

        Returns:
            The support, for `reaction`. Of a surface, `support.gap` (n,) tells by how much (m) the prescribed
            displacements were missed in the last step.

        Raises:
            InputError: unknown component or none, plane without nodes, value that isn't finite; of a surface,
                a stiffness that isn't positive, materials that don't name their moduli; springs elsewhere.
        """
        springs = {"stiffness": stiffness, "rotation_stiffness": rotation_stiffness, "normal": normal}
        if isinstance(where, Surface):
            return surfaces.add_support(self, where, components, augment=augment, **springs)
        given = [name for name, value in springs.items() if value is not None] + ["augment"] * bool(augment)
        if given:
            raise InputError(f"fix: {given[0]} belongs to springs on a Surface; where = {where!r}")
        predicate, label = self._place(where)
        support = make_support(predicate, label, components, self.layout, len(self.supports) + 1)
        self._admit(where, support)
        self.supports.append(support)
        self._stale = True
        return support

    def _admit(self, where: Any, support: Support) -> None:  # noqa: B027
        """Take note of a support that the user has put on `where`, or refuse it."""

    def add(self, term: Term) -> None:
        """Add a term: a contribution to the nodal system, such as a `SurfaceTerm` of one's own. In mid-run it
        acts from the next step on, which begins with a reset of the grid.

        Raises:
            InputError: not a term, one that is in a problem already, or one that doesn't fit this problem.
        """
        if not isinstance(term, Term):
            raise InputError(
                f"term = {term!r} is not a Term; derive from polarmpm.Term or polarmpm.SurfaceTerm"
            )
        if term.taken:
            raise InputError(f"term = {term.name!r} has been added to a problem already; make another one")
        term.attach(self.layout, self.comm)
        term.taken = True
        self.terms.append(term)
        self._stale = self.progress.reset_due = True

    @property
    def surfaces(self) -> list[SurfaceCondition]:
        """Tractions, pressures, supports and terms of one's own on surfaces."""
        return [term for term in self.terms if isinstance(term, SurfaceCondition)]

    def traction(
        self, where: Surface, *, force: Any = None, couple: Any = None, follows: bool = False
    ) -> None:
        """A traction (N/m^2) and couple traction (N/m; one number in plane strain) on a surface that the body
        carries. Values as in `fix`.

        Dead: per undeformed area, fixed in space. `follows=True`: per current area; the part along the
        undeformed normal follows the current normal, the part in the surface is convected with it and keeps
        its size.

        Raises:
            InputError: neither is given, values of the wrong size, a surface of another dimension; when the
                next step begins, also points of the surface outside of the body.
        """
        surfaces.add_traction(self, where, force, couple, follows=follows)

    def pressure(self, where: Surface, p: Any) -> None:
        """A pressure (Pa) against the current normal of a surface that the body carries, -p cof(F) N dA.

        Raises:
            InputError: as `traction`.
        """
        surfaces.add_pressure(self, where, p)

    def body_load(self, *, force: Any = None, couple: Any = None, on: Selection | None = None) -> None:
        """A dead force (N/m^3) and couple (N/m^2) per reference volume, on all points or a selection.

        Values as in `fix`; functions of two arguments get (factor, initial positions of the points (n, d)).
        """
        self._add_loads(f"body load {len(self.loads) + 1}", on, force, couple, True, 1.0)

    def _add_loads(
        self, name: str, selection: Selection | None, force: Any, couple: Any, density: bool, share: float
    ) -> None:
        self.loads += make_loads(name, selection, force, couple, self.layout, density, share)
        self._stale = True

    def _set_terms(self, factor: float, carrying: bool = False) -> None:
        with errors_on_all_ranks(self.comm):
            for term in self.terms:
                term.set_factor(factor, carrying)

    def term_state(self) -> dict[str, np.ndarray]:
        """What a restart needs of the terms, the same on every rank, by names such as "0/u"."""
        return {f"{k}/{name}": a for k, term in enumerate(self.terms) for name, a in term.state().items()}

    def term_rows(self) -> dict[str, np.ndarray]:
        """The terms' rows of the local points, by names such as "term 0.mass"."""
        return {f"term {k}.{name}": a for k, term in enumerate(self.terms) for name, a in term.rows.items()}

    def restore_term_rows(self, rows: dict[str, np.ndarray]) -> None:
        """Put in rows such as those of `term_rows`, of which there may be others."""
        for k, term in enumerate(self.terms):
            start = f"term {k}."
            term.rows = {name[len(start) :]: a for name, a in rows.items() if name.startswith(start)}

    def restore_terms(self, arrays: dict[str, np.ndarray]) -> None:
        """Put in what `term_state` gave, before `restore`; the problem has the same terms.

        Raises:
            InputError: other terms.
        """
        with_state = [k for k, term in enumerate(self.terms) if term.state()]
        saved = {int(key.split("/")[0]) for key in arrays}
        if saved != set(with_state):
            raise InputError(
                f"the saved state has {len(saved)} term(s) with a state of their own, the problem has "
                f"{len(with_state)}"
            )
        for term in self.terms:
            term.committed = True
        for k in with_state:
            start = f"{k}/"
            of_this = {key[len(start) :]: a for key, a in arrays.items() if key.startswith(start)}
            self.terms[k].restore(of_this)

    def _load_places(self) -> list[tuple[Amplitude, np.ndarray]]:
        """All loads, and the positions (n, d) of this rank where they act.

        Raises:
            InputError: the arc-length method can't take a load; the message names it.
        """
        spatial = [load.name for load in self.loads if load.couple and self.layout.rotations == 3]
        if spatial:
            raise InputError(
                f"{spatial[0]}: couples in space turn with the spin; the arc-length method takes forces only"
            )
        return [(load.amplitude, self.points.X[self.points.rows(load.selection)]) for load in self.loads]
