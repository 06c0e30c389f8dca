"""Elastoplastic solids: an elastic material with a yield function and a plastic potential (T 4.2)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import ufl

from ..errors import InputError
from .base import Material, check_material, require, require_finite
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


def _check_elastic(elastic: Any) -> None:
    check_material(elastic)
    if isinstance(elastic, Plastic):
        raise InputError(f"elastic = {elastic!r}: an elastic material is needed")


def _check_flow(elastic: Any, name: str, strength: Any, H: Any, l_p: Any) -> None:
    """Checks of what the cone and the cylinder share; `name` is the argument that gives the strength."""
    _check_elastic(elastic)
    require_finite("H", H)
    require_finite(name, strength)
    require(strength > 0, name, strength, f"{name} > 0")
    if elastic.micropolar:
        if l_p is None:
            raise InputError("l_p = None: a micropolar material needs the plastic length, l_p > 0")
        require_finite("l_p", l_p)
        require(l_p > 0, "l_p", l_p, "l_p > 0")
    elif l_p is not None:
        raise InputError(f"l_p = {l_p!r}: a classical material has no plastic length")
    if H < 0 and not elastic.micropolar:
        warnings.warn(
            f"H = {H:g}: softening without a length scale; the width of a shear band is that of the cells",
            stacklevel=4,
        )


def _check_names(material: Plastic) -> None:
    """Elastic and plastic numbers share one name space."""
    taken = sorted(set(material.elastic.parameters()) & set(material.plastic_parameters()))
    if taken:
        raise InputError(
            f"elastic: its parameter {taken[0]!r} has the name of a plastic one of "
            f"{type(material).__name__}; rename it"
        )


def _generalised_stress(tau: Any, nu: Any, length: Any, tip: Any = None) -> Any:
    """q = sqrt(3/2 (s : s + nu : nu / l_p^2)), s the deviator of sym tau: T (4.37)-(4.38); with a rounded
    tip."""
    s = ufl.dev(ufl.sym(tau))
    square = ufl.inner(s, s)
    if nu is not None:
        square += ufl.inner(nu, nu) / length**2
    return ufl.sqrt(1.5 * square if tip is None else 1.5 * square + tip**2)


@dataclass(frozen=True)
class DruckerPrager(Plastic):
    """Drucker-Prager plasticity with linear hardening, T (4.34)-(4.40); classical or micropolar.

    f = q + a p - (k + H chi), g = q + b p with a, b = 6 sin(angle)/(3 - sin(angle)) of the angles of
    friction and dilatancy, p = tr(tau)/3 and the generalised q with couple stress. States beyond the apex of
    the cone return to it.

    Args:
        elastic: e.g. `MicropolarElastic` or `Hencky`.
        phi, psi: angles of friction and dilatancy (rad), 0 <= psi <= phi < pi/2.
        c: cohesion (Pa), which makes k = 6 c cos(phi)/(3 - sin(phi)); or
        k: yield strength (Pa) at p = 0. Exactly one of both.
        H: hardening modulus (Pa), negative for softening.
        l_p: plastic length (m); needed by micropolar materials.
        tip: rounds the apex off: q becomes sqrt(q^2 + tip^2) (Pa). With 0 the apex is sharp.

    Raises:
        InputError: an argument is out of range.
    """

    elastic: Material
    phi: float = 0.0
    psi: float = 0.0
    c: float | None = None
    k: float | None = None
    H: float = 0.0
    l_p: float | None = None
    tip: float = 0.0

    def __post_init__(self) -> None:
        for name in ("phi", "psi", "tip"):
            require_finite(name, getattr(self, name))
        require(self.tip >= 0, "tip", self.tip, "tip >= 0")
        allowed = "0 <= phi < pi/2, in radians (math.radians converts degrees)"
        require(0 <= self.phi < math.pi / 2, "phi", self.phi, allowed)
        require(0 <= self.psi <= self.phi, "psi", self.psi, f"0 <= psi <= phi = {self.phi:g} rad")
        if (self.c is None) == (self.k is None):
            raise InputError(f"c = {self.c!r}, k = {self.k!r}: exactly one of both is needed")
        name, strength = ("c", self.c) if self.k is None else ("k", self.k)
        _check_flow(self.elastic, name, strength, self.H, self.l_p)
        _check_names(self)

    @property
    def length(self) -> float:  # type: ignore[override]
        return self.l_p or 1.0

    @property
    def has_apex(self) -> bool:  # type: ignore[override]
        return self.phi > 0 and self.tip == 0

    @property
    def strength(self) -> float:
        """k (Pa), T (4.36)."""
        if self.k is not None:
            return self.k
        assert self.c is not None
        return 6 * self.c * math.cos(self.phi) / (3 - math.sin(self.phi))

    def plastic_parameters(self) -> dict[str, float]:
        a, b = (6 * math.sin(angle) / (3 - math.sin(angle)) for angle in (self.phi, self.psi))
        numbers = {"friction": a, "dilatancy": b, "k": self.strength, "H": self.H, "tip": self.tip}
        if self.micropolar:
            numbers |= {"l_p": self.length, "spring": SPRING * self._couple_modulus()}
        return numbers

    def _couple_modulus(self) -> float:
        numbers = self.elastic.parameters()
        named = [abs(numbers[name]) for name in ("alpha", "beta", "gamma") if name in numbers]
        return (max(named) if named else self._at_rest[1]) or 1.0

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return self._q(tau, nu, p) + p.friction * ufl.tr(tau) / 3 - (p.k + p.H * chi)

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return self._q(tau, nu, p) + p.dilatancy * ufl.tr(tau) / 3

    def _q(self, tau: Any, nu: Any, p: Any) -> Any:
        return _generalised_stress(tau, nu, p.l_p if self.micropolar else 1.0, p.tip)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return p.H * chi**2 / 2

    # the apex -------------------------------------------------------------------------------------
    def beyond_apex(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """3 mu Dgamma - q with the multiplier of the small-strain cone."""
        if not self.has_apex or not {"lam", "mu"} <= set(self.elastic.parameters()):
            return ufl.as_ufl(-1.0)
        bulk = p.lam + 2 * p.mu / 3
        f = self.yield_function(tau, nu, chi, p)
        multiplier = f / (3 * p.mu + bulk * p.friction * p.dilatancy + p.H)
        return 3 * p.mu * multiplier - self._q(tau, nu, p)


@dataclass(frozen=True)
class VonMises(Plastic):
    """Von Mises plasticity with linear hardening, T (4.32) with the generalised q (4.38).

    Args:
        elastic: e.g. `MicropolarElastic` or `Hencky`.
        k: yield strength (Pa), > 0.
        H: hardening modulus (Pa), negative for softening.
        l_p: plastic length (m); needed by micropolar materials.
    """

    elastic: Material
    k: float = math.nan
    H: float = 0.0
    l_p: float | None = None

    def __post_init__(self) -> None:
        _check_flow(self.elastic, "k", self.k, self.H, self.l_p)
        _check_names(self)

    @property
    def length(self) -> float:  # type: ignore[override]
        return self.l_p or 1.0

    def plastic_parameters(self) -> dict[str, float]:
        return {"k": self.k, "H": self.H, **({"l_p": self.length} if self.micropolar else {})}

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _generalised_stress(tau, nu, p.l_p if self.micropolar else 1.0) - (p.k + p.H * chi)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return p.H * chi**2 / 2


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
        _check_elastic(self.elastic)
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
