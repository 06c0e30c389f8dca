"""Elastoplastic solids: an elastic material with a yield function and a plastic potential (T 4.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import ufl

from ..errors import InputError
from ..tools.checks import require, require_finite
from .base import Material, check_material
from .stiffness import stiffness_at_rest

SPRING = 1e-9  # of the couple-stress moduli, for the return to the apex (`plasticforms`)


class Plastic(Material):
    """An elastic material that yields: f(tau, nu, chi) <= 0 with flow along the derivatives of g.

    Derive from it, or hand both functions to `UserPlasticity`. F = Fe Fp, Gamma = Ge + Gp (T 4.1); the
    elastic law holds for Fe and Ge. Tension is positive. What it takes to return a stress to the yield
    surface, and the consistent tangent, is derived by UFL (`plasticforms`).

    Attributes:
        elastic: the elastic part. A classical one has no couple stress: nu is zero.
        length: a length (m) that makes wryness a strain, for measures of the local iteration.
    """

    elastic: Material
    length: float = 1.0
    plastic = True
    has_apex: bool = False

    @property
    def micropolar(self) -> bool:  # type: ignore[override]
        return self.elastic.micropolar

    @property
    def isotropic(self) -> bool:  # type: ignore[override]
        return self.elastic.isotropic

    def parameters(self) -> dict[str, float]:
        """The elastic part's numbers and the plastic ones."""
        return {**self.elastic.parameters(), **self.plastic_parameters()}

    def plastic_parameters(self) -> dict[str, float]:
        """Numbers of yield function and potential by name."""
        return {}

    @cached_property
    def modulus(self) -> float:
        """An elastic stiffness (Pa), which makes stresses strains in measures of the local iteration."""
        return abs(self.elastic.parameters().get("mu", 0.0)) or self._at_rest[0] or 1.0

    @cached_property
    def _at_rest(self) -> tuple[float, float]:
        """Stiffnesses (Pa, N) of an elastic part whose moduli have names of their own."""
        return stiffness_at_rest(self.elastic)

    def energy(self, *strains_and_parameters: Any) -> Any:
        return self.elastic.energy(*strains_and_parameters)

    def measures(self, F: Any) -> tuple[Any, ...]:
        return self.elastic.measures(F)

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """f (Pa) of Kirchhoff stress tau (Pa), couple stress nu (N/m) and hardening variable chi, in UFL."""
        raise NotImplementedError(f"{type(self).__name__} has no yield function")

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """g (Pa), whose derivatives by tau and nu are the directions of flow; default: associated flow."""
        return self.yield_function(tau, nu, chi, p)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        """Energy (Pa) stored by hardening, of which Lambda is the derivative by chi, T (4.17)."""
        return ufl.as_ufl(0.0)

    def beyond_apex(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """Positive where a trial state is likely to return to the apex."""
        return ufl.as_ufl(-1.0)


def check_elastic(elastic: Any) -> None:
    check_material(elastic)
    if isinstance(elastic, Plastic):
        raise InputError(f"elastic = {elastic!r}: an elastic material is needed")


def check_names(material: Plastic) -> None:
    """Elastic and plastic numbers share one name space."""
    taken = sorted(set(material.elastic.parameters()) & set(material.plastic_parameters()))
    if taken:
        raise InputError(
            f"elastic: its parameter {taken[0]!r} has the name of a plastic one of "
            f"{type(material).__name__}; rename it"
        )


@dataclass(frozen=True)
class UserPlasticity(Plastic):
    """A user's yield function and potential in UFL.

    Args:
        elastic: the elastic part.
        function: f(tau, nu, chi, p) in Pa, smooth where it is zero; nu is None for a classical material.
        flow: potential g(tau, nu, chi, p); default: associated flow.
        values: the numbers p.name, so that changing them compiles nothing; the elastic part's are there too.
        hardening: energy (Pa) stored by hardening as a function of (chi, p); default: none.
        length: a length (m) of the microstructure.

    Example:
        >>> UserPlasticity(elastic, lambda tau, nu, chi, p: ufl.sqrt(ufl.inner(tau, tau)) - p.y, {"y": 1e6})
    """

    elastic: Material
    function: Callable[..., Any]
    values: Mapping[str, float] = field(default_factory=dict)
    flow: Callable[..., Any] | None = None
    hardening: Callable[..., Any] | None = None
    length: float = 1.0

    def __post_init__(self) -> None:
        check_elastic(self.elastic)
        for name in ("function", "flow", "hardening"):
            value = getattr(self, name)
            if not callable(value) and not (value is None and name != "function"):
                raise InputError(f"{name}: {value!r} is not callable")
        taken = sorted(set(self.elastic.parameters()) & set(self.values))
        if taken:
            raise InputError(f"values: {taken[0]!r} is a parameter of the elastic material")
        for name, value in self.values.items():
            require_finite(name, value)
        require_finite("length", self.length)
        require(self.length > 0, "length", self.length, "length > 0")

    def plastic_parameters(self) -> dict[str, float]:
        return dict(self.values)

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return self.function(tau, nu, chi, p)

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return (self.flow or self.function)(tau, nu, chi, p)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return ufl.as_ufl(self.hardening(chi, p)) if self.hardening else ufl.as_ufl(0.0)
