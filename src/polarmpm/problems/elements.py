"""Quasi-static problems of finite elements: the same problem on a conforming mesh (FEM mode)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ..assembly.elements import ElementSystem
from ..assembly.elementsums import SummedElements
from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..bodies.reference import Increments
from ..conditions.amplitudes import Amplitude, check_counts
from ..conditions.holding import check_held
from ..conditions.loads import Applied, no_microrotation
from ..conditions.prescribed import Prescribed
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.elementkernels import NativeElementForms
from ..forms.trial import try_energy
from ..geometry.nodes import Nodes
from ..geometry.planes import PlaneSpec
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.motion import Motion
from ..solvers.choice import check_solver
from ..solvers.newton import Controls
from ..terms.base import Piece, Term, pieces_of
from ..terms.settings import MeshSetting, check_facets
from ..terms.surfaceterms import SurfaceCondition
from ..tools import checks
from ..tools.disposal import dispose_of_dropped
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from . import faceslopes, initial
from .conditions import AXIS
from .described import described, of_rank
from .elementstages import StagedElements
from .facetloads import SurfaceLoad, Varying, carried_so_far, forms_of_loads
from .given import Present
from .locking import check_locking, warn_of_elements
from .state import Progress
from .surfaces import add_load
from .whole import Changing

ASSEMBLIES = ("native", "dolfinx")


class QuasiStaticFEM(StagedElements):
    """Equilibrium of a mesh of finite elements under slowly changing loads. All methods are collective.

    Attributes:
        rows: arrays (np, ...) of the script's own by name, one row a local quadrature point; they go into
            restart files.

    Args:
        elements: the body.
        controls: tolerances of Newton's method.
        solver: as of `QuasiStatic`.
        slope_penalty: of materials with second gradients, eta of the interior penalty: how closely slopes of
            neighbours agree, and held ones are met, multiplied by (degree - 1)^2. Below about 5 the elements
            may become unstable.
        assembly: how residual and tangent are summed over the elements: "native", by the points' own kernels
            in compiled loops, or "dolfinx", by its forms: the same to 1e-12, several times slower.
        locking: as of `QuasiStatic`, with an element for a patch. Simplices of degree 1, second gradients and
            assembly "dolfinx" have no cure; nor have elements of degree 3, which lock much less.
    """

    holds_on_facets = True
    knows_undeformed = True
    body = "elements"
    systems: Callable[..., ElementSystem] | None = None  # what makes them; None: as `assembly` says

    @collective("QuasiStaticFEM", comm=lambda self, elements, *args, **options: elements.comm, compare=True)
    def __init__(
        self,
        elements: Elements,
        *,
        controls: Controls | None = None,
        solver: str = "auto",
        slope_penalty: float = 20.0,
        assembly: str = "native",
        locking: str | None = "auto",
    ):
        checks.instance("elements", elements, Elements, "a meshed body, polarmpm.Elements(...), is")
        self.assembly = checks.choice("assembly", assembly, ASSEMBLIES)
        self.locking = check_locking(locking)
        if self.locking == "always" and assembly == "dolfinx":
            raise InputError("locking = 'always': assembly = 'dolfinx' has no cure; allowed is 'native'")
        self.solver = check_solver(solver)
        super().__init__(elements.comm, elements.points, elements.dim, controls)
        self.elements = elements
        slope_penalty = checks.number("slope_penalty", slope_penalty, above=0.0, allowed="a positive number")
        self._slope_penalty = slope_penalty
        self._renew_forms()
        for material in elements.points.materials:
            try_energy(material, self.comm)
        with errors_on_all_ranks(elements.comm):  # of warnings a script may make errors
            if elements.comm.rank == 0:
                warn_of_elements(self.locking, elements, self.forms)
        self._surface_loads: list[SurfaceLoad] = []
        self.held_slopes: dict[Support, Any] = {}  # slopes that supports hold
        self.progress.reset_due = False
        self._system: ElementSystem | None = None
        self._last_loads: np.ndarray | None = None  # forces of the last converged state's loads
        self.carried_at_rest: np.ndarray | None = None  # forces (nodes, block) that hold an initial stress
        self._body: Any = None  # densities of body loads at the quadrature points
        self._hold_axis()

    def _touches_axis(self) -> bool:
        on_axis = self.elements.on_plane(AXIS)(self.elements.nodes.position)
        return bool(self.comm.allreduce(int(on_axis.sum())))

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        for thing in (self.elements, self.forms, *self.forms.changing()):
            yield thing, None

    def _count_from_here(self) -> None:
        super()._count_from_here()
        self.elements.counted_from = self.elements.moved

    def _check_change(self, name: str) -> None:
        if not self.forms.takes_numbers:
            raise InputError(f"{name}: materials of elements with second gradients can't change during a run")

    def _renew_forms(self) -> None:
        self.forms = faceslopes.make_forms(self.elements, self._slope_penalty, self.assembly, self.locking)
        _ = self.forms.residual_form  # built now, so that a mistake in a user's energy shows here
        self._stale = True

    def _put_into_forms(self) -> None:
        self.forms.put_materials(self.points.materials)

    def _free(self) -> None:
        if self._system is not None:
            self._system.destroy()
            self._system = None

    # conditions -----------------------------------------------------------------------------------
    def _place(self, where: Any) -> tuple[Callable[[np.ndarray], np.ndarray], str]:
        e = self.elements
        if isinstance(where, str | int | np.integer | Facets):
            facets = e.facets(where)
            return lambda position: facets.nodes, facets.name
        if isinstance(where, PlaneSpec):
            on, name = e.on_plane(where), where.name
            count = self.comm.allreduce(int(on(e.nodes.position).sum()))
            if not count:
                raise InputError(f"plane {name}: no node of the mesh lies on it")
            return on, name
        what = "facets, a physical group, a plane or a predicate of positions (n, d) is"
        return checks.function("fix: where", where, what, takes=("positions",)), getattr(
            where, "__name__", "predicate"
        )

    def _normal_axis(self, where: Any) -> int:
        return faceslopes.normal_axis(self.elements, where)

    def _tie(self, where: Any, support: Support, even: dict[int, bool]) -> None:
        held = faceslopes.hold(self.elements, self.forms, where, support, even)
        if held is not None:
            if self.progress.step:
                held.count_from(self.elements.moved)
            self.held_slopes[support], support.on_facets = held, True

    def _surface_of(self, where: Any) -> Any:
        return where if isinstance(where, Surface) else self.elements.surface(where)

    @property
    def surface_loads(self) -> tuple[SurfaceLoad, ...]:
        """Tractions, couple tractions and pressures on facets."""
        return Present(self._surface_loads)

    def _admit(self, where: Any, support: Support) -> None:
        with errors_on_all_ranks(self.comm):
            prescribed = Prescribed(self.elements.nodes, [support], self.layout, self.comm)
        here = self.elements.reached()[: self.elements.nodes.owned]
        check_held(prescribed, here.astype(float), self.progress.step)

    def _prescribed(self, nodes: Nodes, supports: Sequence[Support] | None = None) -> Prescribed:
        made = super()._prescribed(nodes, supports)
        if self.elements.staged:
            made.fixed[~self.elements.reached()] = True
        return made

    def _add_term(self, term: Term, counts: str | None) -> None:
        if isinstance(term, SurfaceCondition):
            check_facets(term, self.elements)
        super()._add_term(term, counts)
        if isinstance(term, SurfaceCondition) and self.progress.step:
            term.start_from(*carried_so_far(self.elements, term))

    def _remove_load(self, load: Any) -> None:
        super()._remove_load(load)
        self._surface_loads = [one for one in self._surface_loads if one is not load]

    @collective("load", compare=True)
    def load(
        self, where: Any, *, force: Any = None, couple: Any = None, counts: str | None = None
    ) -> Term | Applied:
        """A dead force (N) and couple (N m) in total, spread evenly over facets.

        Args:
            where: `elements.facets(...)`, `elements.farthest(...)`, or what `elements.facets` takes; or a
                surface.
            force, couple: numbers are ramped, functions of the load factor give the value. In plane strain
                they count per unit thickness, and the couple is one number.
            counts: of a load that is added in mid-run: "from now": what the values gain from the present load
                factor on, so that nothing jumps; or "total": the values at the load factor. Default: numbers
                grow from now, functions give the total.

        Returns:
            The load, for `release`.
        """
        if isinstance(where, Surface):
            return add_load(self, where, force, couple, counts)
        group, values = self.elements.facets(where), {"force": force, "couple": couple}
        return self._add_surface(group, values, False, 1.0 / group.area, "load", counts)

    @collective("traction", compare=True)
    def traction(
        self,
        where: Any,
        *,
        force: Any = None,
        couple: Any = None,
        follows: bool = False,
        counts: str | None = None,
    ) -> Term | Applied:
        """A traction (N/m^2) and couple traction (N/m) on facets (what `elements.facets` takes), or on a
        surface.

        Dead: per undeformed area, fixed in space. `follows=True`: per current area; the part along the
        undeformed normal follows the current normal, the part in the surface is convected with it and keeps
        its size. Values and `counts` as in `load`; functions of two arguments get (factor, initial positions
        (n, d)).
        """
        if isinstance(where, Surface):
            return super().traction(where, force=force, couple=couple, follows=follows, counts=counts)
        group = self.elements.facets(where)
        return self._add_surface(group, {"force": force, "couple": couple}, follows, 1.0, "traction", counts)

    @collective("pressure", compare=True)
    def pressure(self, where: Any, p: Any, *, counts: str | None = None) -> Term | Applied:
        """A pressure (Pa) against the current normal of the current surface, on facets (what
        `elements.facets` takes) or on a surface. Values and `counts` as in `load`."""
        if isinstance(where, Surface):
            return super().pressure(where, p, counts=counts)
        return self._add_surface(self.elements.facets(where), {"pressure": p}, True, 1.0, "pressure", counts)

    def _add_surface(
        self,
        facets: Facets,
        values: dict[str, Any],
        follows: bool,
        share: float,
        what: str,
        counts: str | None,
    ) -> Applied:
        name = f"{what} {self.given.next('load')} ({facets.name})"
        self._check_outside(name)
        check_counts(name, counts)
        follows = checks.flag(f"{name}: follows", follows)
        if all(v is None for v in values.values()):
            missing = "no pressure" if "pressure" in values else "neither force nor couple"
            raise InputError(f"{name}: {missing} is given")
        if values.get("couple") is not None and not self.layout.rotations:
            raise no_microrotation(name, values["couple"])
        sizes = {"force": self.layout.dim, "couple": self.layout.rotations, "pressure": 1}
        parts = []
        for kind, value in values.items():
            if value is not None:
                amplitude = Amplitude(f"{name}, {kind}", value, sizes[kind])
                parts.append(SurfaceLoad(facets, amplitude, kind, follows, share))
        applied = Applied(name, tuple(parts))
        self._take(applied, [load.amplitude for load in parts], counts)
        self._surface_loads += parts
        return applied

    # solving --------------------------------------------------------------------------------------
    def _prepare(self) -> ElementSystem:
        if self._system is not None and not self._stale:
            return self._system
        prescribed = self._prescribed(self.elements.nodes)
        if prescribed.needs_motion and self.progress.step:
            prescribed.put_motion(self.elements.displacement, self.elements.q)
        with self.timer("compile"):
            dead, varying = self._load_forms()
        dispose_of_dropped(self.comm)
        if self._system is not None:
            self._system.destroy()
        self.forms.held = {s: self.held_slopes[s] for s in self.supports if s in self.held_slopes}
        kind: Callable[..., ElementSystem] = ElementSystem
        if isinstance(self.forms, NativeElementForms):
            kind = self.systems or SummedElements
        self._system = kind(self.forms, dead, varying, prescribed, self.timer, self.solver, self._pieces())
        self._rebase(None)
        self.carried_at_rest = initial.carried(self, self._system, self.carried_at_rest)
        self._stale = self.progress.reset_due = False
        return self._system

    def _pieces(self) -> list[Piece]:
        """The terms' pieces while increments count from the present state."""
        setting = MeshSetting(self.elements)
        for term in self.terms:
            term.begin()
        return [piece for term in self.terms for piece in pieces_of(term, setting)]

    @property
    def _loaded(self) -> bool:
        """Whether there are dead loads at points."""
        return bool(self.loads)

    def _load_forms(self) -> tuple[list[Any], list[Varying]]:
        couples_vary = self.layout.rotations == 3
        block = self.layout.block if self._loaded else 0
        body_varies = couples_vary and self._couples_act
        dead, varying, self._body = forms_of_loads(
            self.elements, self.forms, self.surface_loads, block, body_varies, couples_vary
        )
        return dead, varying

    def _put_loads(self, system: ElementSystem, factor: float | None) -> None:
        last = self.progress.factor
        self._set_terms(last if factor is None else factor)
        if factor is None and self._last_loads is not None:
            return system.put_external(self._last_loads)
        factor = last if factor is None else factor
        of_points = None if self._body is None else self._loads_at(factor)
        with errors_on_all_ranks(self.comm):
            if of_points is not None:
                forces, couples = of_points
                density = np.concatenate([forces, couples], axis=1) / self.elements.mesh_volume[:, None]
                self.forms.put_at_points(self._body, density)
            for load in self.surface_loads:
                values = load.amplitude.at(factor, load.position) * load.share
                load.function.x.array.reshape(-1, load.amplitude.size)[load.rows] = values
        system.set_loads()

    @property
    def cell_size(self) -> float:
        return self.elements.cell_size

    def _load_places(self) -> list[tuple[Amplitude, np.ndarray]]:
        for load in self.surface_loads:
            if load.follows or (load.kind == "couple" and self.layout.rotations == 3):
                raise InputError(
                    f"{load.amplitude.name} turns with the body; the arc-length method takes dead forces only"
                )
        return super()._load_places() + [(load.amplitude, load.position) for load in self.surface_loads]

    def _increments(self, system: ElementSystem) -> Increments:
        system.forms.x.x.array[:] = system.x.ravel()
        d, (value, gradient) = self.layout.dim, self.forms.values_at_points()
        return Increments(value, gradient[:, :d], gradient[:, d:])

    def volume_ratios(self, increments: Increments) -> np.ndarray:
        d = self.layout.dim
        ratios: np.ndarray = rotations.determinant(self.points.F[:, :d, :d] + increments.gradient)
        if self.layout.axial:  # a ring doesn't pass through the axis
            ratios = np.minimum(ratios, 1.0 + increments.value[:, 0] / self.points.x[:, 0])
        return ratios

    def _check(self, increments: Increments) -> str:
        bad = self.volume_ratios(increments) <= 0
        cells = np.unique(self.points.id[bad] // len(self.elements.reference_points))
        inverted = np.unique(np.concatenate(self.comm.allgather(cells)))
        if not len(inverted):
            return ""
        names = ", ".join(map(str, inverted[:10])) + (" ..." if len(inverted) > 10 else "")
        return f"{len(inverted)} element(s) turned inside out: {names}"

    def _commit(self, system: ElementSystem, increments: Increments, factor: float) -> None:
        e, p, d = self.elements, self.points, self.layout.dim
        base, projected = p.q, system.projected_F()
        p.x = p.x + increments.value[:, :d]
        self._motion.move(p, p, increments)
        for rows, F in projected:
            p.F[rows] = F  # a new array, of this step
        e.q = rotations.turned(e.q, system.x[:, d:])
        self.forms.flow(base)
        e.moved = e.moved + system.x[:, :d]
        self._last_loads = None if system.varying else system.loads  # others depend on the increments
        g = self.progress
        g.factor, g.step = factor, g.step + 1
        g.reset_factor = g.rotation_factor = factor
        self._rebase(system)

    @cached_property
    def _motion(self) -> Motion:
        """Update of the points by gradients with respect to X. Collective."""
        return Motion(self.layout, self.comm, by_reference=True)

    def _rebase(self, system: ElementSystem | None) -> None:
        """Count increments from the present state on."""
        e = self.elements
        self.forms.total.x.array.reshape(-1, self.layout.block)[:, : e.dim] = e.moved
        self.forms.pack()
        if self.points.second_gradient:
            self.points.grad_F = self.forms.second_gradient()
        if system is not None:
            system.x = np.zeros_like(system.x)
            if self.terms:
                system.put_pieces(self._pieces())
            self._tell_of_reset()

    def restore(self, progress: Progress) -> None:
        """Continue from a state that has been put into the elements already; see `io.restart`."""
        self.check_open()
        self.progress, self._equilibrium = progress, None
        self._leave(changed=True)
        if self._system is not None:
            self._system.destroy()
            self._system = None
        if self.elements.staged:
            self._renew_forms()  # they know the undeformed places
        self._rebase(None)

    # results --------------------------------------------------------------------------------------
    @property
    def system(self) -> ElementSystem | None:
        """Nodes and residual as of the last step; None before the first one."""
        return self._system

    @collective("energies")
    def energies(self) -> dict[str, float]:
        """As of `QuasiStatic`; of bodies with second gradients also

        - faces: energy of the interior penalty, and of slopes that are held, which isn't in `stored`.
        """
        found = super().energies()
        if self.points.second_gradient:
            faces = self.forms.face_energy()
            found = {**found, "faces": faces, "residue": found["residue"] - faces}
        return found

    def __repr__(self) -> str:
        e = self.elements
        cells = f"{len(e.live)} {e.body.cell}s{of_rank(self.comm)}, degree {e.degree}"
        return described(self, cells)
