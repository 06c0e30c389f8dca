"""Yield surfaces of the invariants p and q: Drucker-Prager's cone and von Mises' cylinder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import ufl

from ..errors import InputError
from ..tools.caller import warn
from ..tools.checks import choice, put_numbers, refuse, require, shown
from .base import Material
from .plastic import Continuation, Plastic, check_elastic, check_names
from .regions import SPRING, ConeApex, Region, SmoothPart

CONES = ("compression", "extension", "plane strain", "inscribed")
TIPS = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)  # rounded tips over k, see `continuation`


def check_flow(material: Any, name: str) -> None:
    """Checks of what the cone and the cylinder share; `name` is the argument that gives the strength."""
    elastic = material.elastic
    check_elastic(elastic)
    put_numbers(material, "H", name)
    strength = getattr(material, name)
    hint = ", for sand without any a thousandth of its stresses" if strength == 0 else ""
    require(strength > 0, name, strength, f"{name} > 0{hint}")
    check_plastic_length(material)
    if material.H < 0 and not elastic.micropolar:
        warn(
            f"H = {material.H:g}: softening without a length scale; the width of a shear band is that of the "
            "cells"
        )


def check_plastic_length(material: Any) -> None:
    """Raise InputError unless l_p is there, and positive, where the material is micropolar."""
    if material.elastic.micropolar:
        if material.l_p is None:
            raise InputError("l_p = None: a micropolar material needs the plastic length, l_p > 0")
        put_numbers(material, "l_p")
        require(material.l_p > 0, "l_p", material.l_p, "l_p > 0")
    elif material.l_p is not None:
        raise refuse("l_p", material.l_p, "a classical material has no plastic length")


def generalised_square(tau: Any, nu: Any, length: Any) -> Any:
    """q^2 = 3/2 (s : s + nu : nu / l_p^2) with the deviator s of sym tau, T (4.37)-(4.38)."""
    s = ufl.dev(ufl.sym(tau))
    square = ufl.inner(s, s)
    if nu is not None:
        square += ufl.inner(nu, nu) / length**2
    return 1.5 * square


def generalised_stress(tau: Any, nu: Any, length: Any, tip: Any = None) -> Any:
    """q, with a rounded tip, see `generalised_square`."""
    square = generalised_square(tau, nu, length)
    return ufl.sqrt(square if tip is None else square + tip**2)


def cone_slopes(cone: str, phi: float, psi: float) -> tuple[float, float, float]:
    """a, b and k/c of the cone q + a p = k that stands for Mohr-Coulomb's pyramid, see `DruckerPrager`."""
    friction, dilatancy = math.sin(phi), math.sin(psi)
    if cone in ("compression", "extension"):
        sign = -1.0 if cone == "compression" else 1.0
        a, b = (6 * s / (3 + sign * s) for s in (friction, dilatancy))
        return a, b, 6 * math.cos(phi) / (3 + sign * friction)
    b = 3 * dilatancy / math.sqrt(3 + dilatancy**2)  # dilates by sin(psi) in plane flow
    along = b if cone == "plane strain" else 3 * friction / math.sqrt(3 + friction**2)
    root = math.sqrt(1 - along**2 / 9)
    a = math.sqrt(3) * friction / (root + math.sqrt(3) * friction * along / 9)
    return a, b, math.sqrt(3) * math.cos(phi) * (1 - a * along / 9) / root


def plane_friction(cone: str, phi: float, psi: float) -> float:
    """Sine of the angle of friction that a cone shows in plane plastic flow; 1 where there is no limit."""
    a, b, _ = cone_slopes(cone, phi, psi)
    root = math.sqrt(1 - b * b / 9)
    return min(1.0, a * root / (math.sqrt(3) * (1 - a * b / 9)))


@dataclass(frozen=True, repr=False)
class DruckerPrager(Plastic):
    """Drucker-Prager plasticity with linear hardening, T (4.34)-(4.40); classical or micropolar.

    f = q + a p - (k + H chi), g = q + b p with p = tr(tau)/3 and the generalised q with couple stress. States
    beyond the apex of the cone return to it. Angles of friction and cohesions are those of
    Mohr-Coulomb's pyramid (`MohrCoulomb`), whose strength depends on the intermediate stress, while the
    cone's doesn't. `cone` says where both agree:

    - "compression": in triaxial compression, T (4.34)-(4.36), a = 6 sin(phi)/(3 - sin(phi)): the outer cone.
      Elsewhere it is too strong: 30 degrees act as 44 in plane strain;
    - "extension": in triaxial extension, a = 6 sin(phi)/(3 + sin(phi));
    - "plane strain": in plane plastic flow, with the angle of dilatancy that there is; in plane strain its
      limit loads are the pyramid's;
    - "inscribed": touches the pyramid from inside, a = 3 sin(phi)/sqrt(3 + sin(phi)^2); never too strong, and
      "plane strain" where psi = phi.

    Args:
        elastic: e.g. `MicropolarElastic` or `Hencky`.
        phi, psi: angles of friction and dilatancy (rad), 0 <= psi <= phi < pi/2.
        c: cohesion (Pa), which makes k = 6 c cos(phi)/(3 - sin(phi)) of "compression", and so on; or
        k: yield strength (Pa) at p = 0. Exactly one of both.
        H: hardening modulus (Pa), negative for softening.
        l_p: plastic length (m); needed by micropolar materials.
        tip: rounds the apex off: q becomes sqrt(q^2 + tip^2) (Pa). With 0 the apex is sharp.
        cone: of those above. Where none is named and phi > 0, "compression" is taken, as T does, with a
            warning.

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
    cone: str | None = None

    def __post_init__(self) -> None:
        put_numbers(self, "phi", "psi", "tip")
        require(self.tip >= 0, "tip", self.tip, "tip >= 0")
        allowed = "0 <= phi < pi/2, in radians (math.radians converts degrees)"
        require(0 <= self.phi < math.pi / 2, "phi", self.phi, allowed)
        require(0 <= self.psi <= self.phi, "psi", self.psi, f"0 <= psi <= phi = {self.phi:g} rad")
        if (self.c is None) == (self.k is None):
            raise InputError(f"c = {shown(self.c)}, k = {shown(self.k)}: exactly one of both is needed")
        check_flow(self, "c" if self.k is None else "k")
        check_names(self)
        self._check_cone()

    def _check_cone(self) -> None:
        if self.cone is not None:
            choice("cone", self.cone, CONES)
        elif self.phi > 0:
            acts = math.degrees(math.asin(plane_friction(CONES[0], self.phi, self.psi)))
            warn(
                f'cone = None: "compression", the outer cone, is taken. In plane strain its phi = '
                f"{math.degrees(self.phi):.3g} degrees act as {acts:.3g} degrees; name a cone: "
                + ", ".join(f'"{cone}"' for cone in CONES)
            )

    @property
    def _numbers(self) -> tuple[float, float, float]:
        return cone_slopes(self.cone or CONES[0], self.phi, self.psi)

    @property
    def length(self) -> float:
        return self.l_p or 1.0

    @property
    def has_apex(self) -> bool:
        return self.phi > 0 and self.tip == 0

    @property
    def strength(self) -> float:
        """k (Pa), for "compression" T (4.36)."""
        if self.k is not None:
            return self.k
        assert self.c is not None
        return self._numbers[2] * self.c

    def plastic_parameters(self) -> dict[str, float]:
        a, b, _ = self._numbers
        numbers = {"friction": a, "dilatancy": b, "k": self.strength, "H": self.H, "tip": self.tip}
        if self.micropolar:
            numbers |= {"l_p": self.length, "spring": SPRING * self.couple_modulus}
        return numbers

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return self._q(tau, nu, p) + p.friction * ufl.tr(tau) / 3 - (p.k + p.H * chi)

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return self._q(tau, nu, p) + p.dilatancy * ufl.tr(tau) / 3

    def _q(self, tau: Any, nu: Any, p: Any) -> Any:
        return generalised_stress(tau, nu, p.l_p if self.micropolar else 1.0, p.tip)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return p.H * chi**2 / 2

    # the apex -------------------------------------------------------------------------------------
    @property
    def regions(self) -> tuple[Region, ...]:
        cone = self.surface
        return (SmoothPart(cone), ConeApex(self, cone)) if self.has_apex else (SmoothPart(cone),)

    def slopes(self, p: Any) -> tuple[Any, Any]:
        return p.friction, p.dilatancy

    def strength_at(self, chi: Any, p: Any) -> Any:
        return p.k + p.H * chi

    def plastic_length(self, p: Any) -> Any:
        return p.l_p

    def apex_spring(self, p: Any) -> Any:
        return p.spring

    def first_region(self, tau: Any, nu: Any, chi: Any, p: Any) -> dict[str, Any]:
        """The apex by 3 mu Dgamma - q with the multiplier of the small-strain cone."""
        if not self.has_apex or len(self.moduli("lam", "mu")) < 2:
            return {}
        bulk = p.lam + 2 * p.mu / 3
        f = self.yield_function(tau, nu, chi, p)
        multiplier = f / (3 * p.mu + bulk * p.friction * p.dilatancy + p.H)
        return {"apex": 3 * p.mu * multiplier - self._q(tau, nu, p)}

    @property
    def continuation(self) -> Continuation:
        """Cones with rounded tips. Close to the apex the direction of flow on the sharp cone turns with the
        smallest change of stress, and Newton's method finds no solution from the trial state."""
        tips = (share * self.strength for share in TIPS)
        return Continuation("tip", tuple(tip for tip in tips if tip > self.tip))


@dataclass(frozen=True, repr=False)
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
        check_flow(self, "k")
        check_names(self)

    @property
    def length(self) -> float:
        return self.l_p or 1.0

    def plastic_parameters(self) -> dict[str, float]:
        return {"k": self.k, "H": self.H, **({"l_p": self.length} if self.micropolar else {})}

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return generalised_stress(tau, nu, p.l_p if self.micropolar else 1.0) - (p.k + p.H * chi)

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return p.H * chi**2 / 2
