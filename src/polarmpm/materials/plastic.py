"""Elastoplastic solids: an elastic material with a yield function and a plastic potential (T 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property, reduce
from itertools import combinations
from typing import Any, ClassVar

import ufl

from ..errors import InputError
from ..tools import checks
from .base import Material, check_material, numbers
from .regions import Edge, Region, SmoothPart, YieldSurface
from .stiffness import stiffness_at_rest


@dataclass(frozen=True)
class Continuation:
    """A number of the material through which a return is approached where Newton's method finds none.

    Attributes:
        parameter: its name.
        values: the softer ones, one after the other; the material's own comes last by itself.
    """

    parameter: str
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        checks.text("parameter", self.parameter, "the name of one of the material's numbers")
        values = checks.array("values", self.values, (None,), "values of the parameter")
        object.__setattr__(self, "values", tuple(values.tolist()))


class Plastic(Material):
    """An elastic material that yields: f(tau, nu, chi) <= 0 with flow along the derivatives of g.

    Derive from it, or hand both functions to `UserPlasticity`. F = Fe Fp, Gamma = Ge + Gp (T 4.1); the
    elastic law holds for Fe and Ge. Tension is positive. What it takes to return a stress to the yield
    surface, and the consistent tangent, is derived by UFL (`forms.plastic`).

    A material of one smooth yield surface defines `yield_function` and, if its flow isn't associated,
    `potential`. One of several surfaces, with edges or with an apex defines `regions` instead:

        @property
        def regions(self):
            cone = YieldSurface("cone", self.cone, self.cone_potential)
            cut = YieldSurface("cut-off", self.cut_off)
            return SmoothPart(cone), SmoothPart(cut), Edge(cone, cut)

    Attributes:
        elastic: the elastic part. A classical one has no couple stress: nu is zero.
        length: a length (m) that makes wryness a strain, for measures of the local iteration.
        regions: of the yield surface, in the order in which a return is attempted; see `first_region`.
        farthest: yield function over elastic modulus beyond which no return is attempted: only iterates that
            diverge have larger ones.
        continuation: how a start is found where no attempt succeeds, on the first of the regions.
    """

    elastic: Material
    plastic = True
    yields = True
    units: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("c", "k", "H", "tip"), "Pa"),
        **dict.fromkeys(("phi", "psi"), "rad"),
        **dict.fromkeys(("l_p", "length"), "m"),
    }

    @property
    def micropolar(self) -> bool:
        return self.elastic.micropolar

    @property
    def isotropic(self) -> bool:
        return self.elastic.isotropic

    @property
    def elastic_part(self) -> Material:
        return self.elastic

    @property
    def length(self) -> float:
        return 1.0

    @property
    def farthest(self) -> float:
        return 10.0

    def __repr__(self) -> str:
        given: dict[str, Any] = {}
        if is_dataclass(self):
            given = {f.name: getattr(self, f.name) for f in fields(self)}
        own = {k: v for k, v in given.items() if isinstance(v, float) and v} or self.plastic_parameters()
        return f"{type(self).__name__}({numbers(own, self.units)}; {self.elastic!r})"

    # numbers --------------------------------------------------------------------------------------
    def parameters(self) -> dict[str, float]:
        """The elastic part's numbers and the plastic ones."""
        return {**self.elastic.parameters(), **self.plastic_parameters()}

    def plastic_parameters(self) -> dict[str, float]:
        """Numbers of yield function and potential by name."""
        return {}

    @cached_property
    def modulus(self) -> float:
        """An elastic stiffness (Pa), which makes stresses strains in measures of the local iteration."""
        return abs(self.moduli("mu").get("mu", 0.0)) or self._at_rest[0] or 1.0

    @cached_property
    def couple_modulus(self) -> float:
        """The largest stiffness of couple stress (N), for the same."""
        named = [abs(value) for value in self.moduli("alpha", "beta", "gamma").values()]
        return (max(named) if named else self._at_rest[1]) or 1.0

    @cached_property
    def _at_rest(self) -> tuple[float, float]:
        """Stiffnesses (Pa, N) of an elastic part whose moduli have names of their own."""
        return stiffness_at_rest(self.elastic)

    # elastic part ---------------------------------------------------------------------------------
    def energy(self, *strains_and_parameters: Any) -> Any:
        return self.elastic.energy(*strains_and_parameters)

    def measures(self, F: Any) -> tuple[Any, ...]:
        return self.elastic.measures(F)

    # yield surface --------------------------------------------------------------------------------
    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """f (Pa) of Kirchhoff stress tau (Pa), couple stress nu (N/m) and hardening variable chi, in UFL."""
        raise NotImplementedError(f"{type(self).__name__} has no yield function")

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """g (Pa), whose derivatives by tau and nu are the directions of flow; default: associated flow."""
        return self.yield_function(tau, nu, chi, p)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        """Energy (Pa) stored by hardening, of which Lambda is the derivative by chi, T (4.17)."""
        return ufl.as_ufl(0.0)

    @property
    def regions(self) -> tuple[Region, ...]:
        return (SmoothPart(self.surface),)

    @property
    def surface(self) -> YieldSurface:
        """The surface of `yield_function` and `potential`."""
        return YieldSurface("surface", self.yield_function, self.potential)

    def first_region(self, tau: Any, nu: Any, chi: Any, p: Any) -> Mapping[str, Any]:
        """Where a trial state is likely to return to: UFL scalars by the regions' names. The region whose
        scalar is the largest is attempted first if it is positive, else the first one of `regions`, which
        has no scalar. The others follow in their order."""
        return {}

    @property
    def continuation(self) -> Continuation | None:
        return None


def check_regions(material: Plastic) -> tuple[tuple[Region, ...], tuple[YieldSurface, ...]]:
    """A material's regions, and the yield surfaces of all of them.

    Raises:
        InputError: there are none, what is named isn't a region, or a name is there twice.
    """
    kind = type(material).__name__
    try:
        regions = tuple(material.regions)
    except TypeError as e:
        raise InputError(f"material: {kind}.regions: a sequence of regions is needed: {e}") from e
    surfaces: dict[str, YieldSurface] = {}
    for region in regions:
        if not isinstance(region, Region):
            raise InputError(
                f"material: {kind} has {checks.shown(region)} among its regions; a Region is needed"
            )
        checks.text(f"material: {kind}: name of {type(region).__name__}", getattr(region, "name", None))
        for surface in region.surfaces:
            if surfaces.setdefault(surface.name, surface) != surface:
                raise InputError(f"material: {kind} has two yield surfaces named {surface.name!r}")
    names = [region.name for region in regions]
    if len(set(names)) < len(names):
        raise InputError(f"material: {kind} has the regions {', '.join(names)}; their names must differ")
    if not surfaces:
        raise InputError(f"material: {kind} has no yield surface; its regions need one at least")
    return regions, tuple(surfaces.values())


def check_elastic(elastic: Any) -> None:
    check_material(elastic)
    if isinstance(elastic, Plastic):
        raise checks.refuse("elastic", elastic, "an elastic material is needed")


def check_names(material: Plastic) -> None:
    """Elastic and plastic numbers share one name space."""
    taken = sorted(set(material.elastic.parameters()) & set(material.plastic_parameters()))
    if taken:
        raise InputError(
            f"elastic: its parameter {taken[0]!r} has the name of a plastic one of "
            f"{type(material).__name__}; rename it"
        )


Function = Callable[..., Any]


@dataclass(frozen=True, repr=False)
class UserPlasticity(Plastic):
    """A user's yield function and potential in UFL, or several of them.

    Args:
        elastic: the elastic part.
        function: f(tau, nu, chi, p) in Pa, smooth where it is zero; nu is None for a classical material. Or
            several functions by the names of their surfaces, which bound the elastic range together: stresses
            return to their smooth parts and to the edges where two or three of them meet.
        flow: potential g(tau, nu, chi, p), or those by name that aren't associated; default: associated flow.
        values: the numbers p.name, so that changing them compiles nothing; the elastic part's are there too.
        hardening: energy (Pa) stored by hardening as a function of (chi, p); default: none.
        length: a length (m) of the microstructure.
        continuation: a number that makes the surface smoother, and values of it through which a return is
            approached where Newton's method finds none, such as the radius of a rounded tip.

    Example:
        >>> UserPlasticity(elastic, lambda tau, nu, chi, p: ufl.sqrt(ufl.inner(tau, tau)) - p.y, {"y": 1e6})
    """

    elastic: Material
    function: Function | Mapping[str, Function]
    values: Mapping[str, float] = field(default_factory=dict)
    flow: Function | Mapping[str, Function] | None = None
    hardening: Function | None = None
    length: float = 1.0
    continuation: Continuation | None = None

    def __post_init__(self) -> None:
        check_elastic(self.elastic)
        object.__setattr__(self, "values", checks.numbers_by_name("values", self.values))
        self._check_functions()
        taken = sorted(set(self.elastic.parameters()) & set(self.values))
        if taken:
            raise InputError(f"values: {taken[0]!r} is a parameter of the elastic material")
        checks.put_numbers(self, "length")
        checks.require(self.length > 0, "length", self.length, "length > 0")
        if self.continuation is not None:
            checks.instance("continuation", self.continuation, Continuation, "a Continuation is")
            if self.continuation.parameter not in self.values:
                raise InputError(f"continuation: {self.continuation.parameter!r} is none of the values")

    def __repr__(self) -> str:
        names = self.function if isinstance(self.function, Mapping) else ("f",)
        return f"UserPlasticity({', '.join(names)}; {numbers(self.values, {})}; {self.elastic!r})"

    def _check_functions(self) -> None:
        given = {"hardening": self.hardening} if self.hardening is not None else {}
        given |= _by_name("function", self.function)
        given |= {} if self.flow is None else _by_name("flow", self.flow)
        for name, value in given.items():
            takes = ("chi", "p") if name == "hardening" else ("tau", "nu", "chi", "p")
            checks.function(name, value, "a function in UFL is", takes=takes)
        if isinstance(self.function, Mapping):
            if not self.function:
                raise InputError("function: no function is given; one at least is needed")
            if self.flow is not None and not isinstance(self.flow, Mapping):
                raise checks.refuse("flow", self.flow, "several functions need flow by the surfaces' names")
        known = self.function if isinstance(self.function, Mapping) else ()
        for name in self.flow if isinstance(self.flow, Mapping) else ():
            if name not in known:
                raise InputError(f"flow: {name!r} is none of the surfaces {', '.join(known) or 'by name'}")

    def plastic_parameters(self) -> dict[str, float]:
        return dict(self.values)

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """f; of several functions the largest."""
        if not isinstance(self.function, Mapping):
            return self.function(tau, nu, chi, p)
        first, *others = (f(tau, nu, chi, p) for f in self.function.values())
        return reduce(ufl.max_value, others, first)

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        flow = self.flow or self.function
        if isinstance(flow, Mapping):
            raise NotImplementedError("several yield functions have a potential each, see `regions`")
        return flow(tau, nu, chi, p)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return ufl.as_ufl(self.hardening(chi, p)) if self.hardening else ufl.as_ufl(0.0)

    @property
    def regions(self) -> tuple[Region, ...]:
        if not isinstance(self.function, Mapping):
            return super().regions
        flow = self.flow if isinstance(self.flow, Mapping) else {}
        surfaces = [YieldSurface(name, f, flow.get(name)) for name, f in self.function.items()]
        edges = [Edge(*meet) for n in (2, 3) for meet in combinations(surfaces, n)]
        return (*map(SmoothPart, surfaces), *edges)


def _by_name(argument: str, given: Any) -> dict[str, Any]:
    """Functions under the names that messages have for them."""
    if isinstance(given, Mapping):
        return {f"{argument}[{name!r}]": value for name, value in given.items()}
    return {argument: given}
