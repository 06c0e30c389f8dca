"""Yield surfaces that depend on the intermediate stress: Mohr-Coulomb's pyramid and Tresca's prism.

Of the Kirchhoff stress with deviator s, J2 = s : s / 2 and Lode's angle theta,
sin(3 theta) = -sqrt(27)/2 det(s) / J2^1.5, from -30 degrees (triaxial extension) to 30 degrees (triaxial
compression), the pyramid is

    sqrt(J2) K(theta) + p sin(phi) - c cos(phi) = 0,   K = cos(theta) - sin(theta) sin(phi)/sqrt(3).

Its edges are sharp (`materials.edges`), or rounded as by Abbo, Lyamin, Sloan and Hambleton (2011): beyond an
angle `corner`, K is a + b sin(3 theta) + c sin(3 theta)^2, whose value and first two derivatives agree there.
The surface lies inside of the pyramid and is smooth but for its apex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from ..tools.checks import choice, put_numbers, refuse, require
from .base import Material
from .cones import TIPS, check_flow
from .edges import PyramidEdge, PyramidFace, principal_values
from .plastic import Continuation, Plastic, check_names
from .regions import SPRING, ConeApex, Edge, Region, SmoothPart, YieldSurface

EDGES = ("rounded", "sharp")
_SHARPEST = 1 - 1e-13  # sine of three times the angle beyond which flow on a face is that on the edge
_SIGNS = {"extension": -1, "compression": 1}  # the edges, and of Lode's angle there
_NOTHING = 1e-30  # J2 over the square of a modulus; Lode's angle of no deviator is any


def lode_function(theta: float, friction: float) -> float:
    """K of the sharp pyramid at Lode's angle (rad); friction = sin(phi)."""
    return math.cos(theta) - math.sin(theta) * friction / math.sqrt(3)


def edge_numbers(friction: float, corner: float, sign: int) -> tuple[float, float, float]:
    """a, b and c of K on the rounded edge that begins at Lode's angle sign * corner (rad)."""
    t, f = sign * corner, friction / math.sqrt(3)
    x, slope = math.sin(3 * t), 3 * math.cos(3 * t)
    rows = [[1.0, x, x * x], [0.0, slope, 2 * x * slope], [0.0, -9 * x, 2 * (slope * slope - 9 * x * x)]]
    cos, sin = math.cos(t), math.sin(t)
    a, b, c = np.linalg.solve(rows, [cos - sin * f, -sin - cos * f, sin * f - cos])
    return float(a), float(b), float(c)


def _pyramid_numbers(name: str, friction: float, corner: float) -> dict[str, float]:
    """Parameters of a pyramid by the names that `_invariants` has for them."""
    numbers = {f"sin_{name}": friction}
    for edge, sign in _SIGNS.items():
        abc = edge_numbers(friction, corner, sign)
        numbers |= {f"{name}_{edge}_{k}": v for k, v in zip("abc", abc, strict=True)}
    return numbers


def _lode_function(s: Any, second: Any, name: str, p: Any, sharp: bool) -> Any:
    """K of the pyramid, for a deviator and its J2, in UFL."""
    sine = -math.sqrt(27) / 2 * ufl.det(s) / (second * ufl.sqrt(second))
    theta = ufl.asin(ufl.max_value(-p.sin_corner, ufl.min_value(p.sin_corner, sine))) / 3  # of the faces
    face = ufl.cos(theta) - ufl.sin(theta) * getattr(p, f"sin_{name}") / math.sqrt(3)
    if sharp:
        return face
    edges = []
    for edge in _SIGNS:
        a, b, c = (getattr(p, f"{name}_{edge}_{k}") for k in "abc")
        edges.append(a + sine * (b + sine * c))
    rounded = ufl.conditional(ufl.gt(sine, 0.0), edges[1], edges[0])
    return ufl.conditional(ufl.gt(abs(sine), p.sin_corner), rounded, face)


def _invariants(tau: Any, nu: Any, name: str, p: Any, sharp: bool = False) -> Any:
    """sqrt(q^2 + tip^2) + sqrt(3) p sin(angle), q^2 = 3 J2 K^2 + 3/2 nu : nu / l_p^2."""
    s = ufl.dev(ufl.sym(tau))
    second = ufl.inner(s, s) / 2 + p.nothing
    square = 3 * second * _lode_function(s, second, name, p, sharp) ** 2 + p.tip**2
    if nu is not None:
        square += 1.5 * ufl.inner(nu, nu) / p.l_p**2
    return ufl.sqrt(square) + getattr(p, f"sin_{name}") * ufl.tr(tau) / math.sqrt(3)


@dataclass(frozen=True)
class _Tip:
    """The apex of a pyramid, for `ConeApex`: names of the yield surface's and the potential's angle.

    The slope of the potential is that of the largest cone inside of its pyramid: of all its flow that on the
    faces distorts most.
    """

    material: MohrCoulomb
    surface: str
    potential: str

    def slopes(self, p: Any) -> tuple[Any, Any]:
        dilatancy = getattr(p, f"sin_{self.potential}")
        return math.sqrt(3) * getattr(p, f"sin_{self.surface}"), 3 * dilatancy / ufl.sqrt(3 + dilatancy**2)

    def strength_at(self, chi: Any, p: Any) -> Any:
        return (self.material.cohesion(chi, p) if self.surface == "phi" else math.sqrt(3) * p.cut) - p.tip

    def plastic_length(self, p: Any) -> Any:
        return p.l_p

    def apex_spring(self, p: Any) -> Any:
        return p.spring


@dataclass(frozen=True, repr=False)
class MohrCoulomb(Plastic):
    """Mohr-Coulomb plasticity with linear hardening of the cohesion, and a tension cut-off; classical or
    micropolar. See the module.

    In units of q, so that chi is the equivalent plastic strain of plane shear without dilatancy:

        f = sqrt(q^2 + tip^2) + sqrt(3) [p sin(phi) - (c + H chi) cos(phi)]

    with q^2 = 3 J2 K(theta)^2 + 3/2 nu : nu / l_p^2 and p = tr(tau)/3, and the potential g with psi. With
    sharp edges, and within `corner` of plane shear, that is Mohr's and Coulomb's law; at rounded edges the
    strength is less by `edge_deficit`.

    Args:
        elastic: e.g. `Hencky`, or `MicropolarElastic`.
        phi, psi: angles of friction and dilatancy (rad), 0 <= psi <= phi < pi/2.
        c: cohesion (Pa), > 0.
        H: what the cohesion gains per chi (Pa), negative for softening.
        l_p: plastic length (m); needed by micropolar materials.
        cut: largest tension (Pa) that a principal stress may reach, with associated flow; default: what the
            pyramid allows.
        tip: rounds the apex off: q becomes sqrt(q^2 + tip^2) (Pa). With 0 the apex is sharp.
        corner: Lode's angle (rad) beyond which edges are rounded, below pi/6. The closer to it, the sharper,
            and the harder to return to.
        edges: "rounded": smooth, see the module. "sharp": the pyramid itself, whose edges are regions of
            their own, as triaxial strengths ask for; of classical, isotropic materials without `cut` and
            `tip`. Bodies under load find their equilibrium less easily with it.

    Raises:
        InputError: an argument is out of range.
    """

    elastic: Material
    phi: float = 0.0
    psi: float = 0.0
    c: float = math.nan
    H: float = 0.0
    l_p: float | None = None
    cut: float | None = None
    tip: float = 0.0
    corner: float = math.radians(25.0)
    edges: str = "rounded"

    def __post_init__(self) -> None:
        put_numbers(self, "phi", "psi", "tip", "corner")
        allowed = "0 <= phi < pi/2, in radians (math.radians converts degrees)"
        require(0 <= self.phi < math.pi / 2, "phi", self.phi, allowed)
        require(0 <= self.psi <= self.phi, "psi", self.psi, f"0 <= psi <= phi = {self.phi:g} rad")
        require(0 <= self.corner < math.pi / 6, "corner", self.corner, "0 <= corner < pi/6, in radians")
        check_flow(self, "c")
        strength = math.sqrt(3) * self.c * math.cos(self.phi)
        require(0 <= self.tip < strength, "tip", self.tip, f"0 <= tip < sqrt(3) c cos(phi) = {strength:g} Pa")
        if self.cut is not None:
            put_numbers(self, "cut")
            require(self.cut > 0, "cut", self.cut, "cut > 0 (Pa)")
            if self.phi > 0:
                most = self.c / math.tan(self.phi)
                require(
                    self.cut < most, "cut", self.cut, f"cut < c/tan(phi) = {most:g} Pa, the pyramid's tip"
                )
        self._check_edges()
        check_names(self)

    def _check_edges(self) -> None:
        choice("edges", self.edges, EDGES)
        if self.edges == "sharp" and (why := self._rounded_for):
            raise refuse("edges", self.edges, f'"rounded" {why}')

    @property
    def _rounded_for(self) -> str:
        """Why edges can't be sharp."""
        if self.elastic.micropolar or not self.elastic.isotropic:
            return "with micropolar materials, and with those that don't say isotropic=True"
        given = {"cut": self.cut or 0.0, "tip": self.tip}
        return "".join(f"with {name} = {value:g}" for name, value in given.items() if value)

    @property
    def sharp(self) -> bool:
        return self.edges == "sharp"

    @property
    def length(self) -> float:
        return self.l_p or 1.0

    @property
    def edge_deficit(self) -> tuple[float, float]:
        """By which share the strength is less than the sharp pyramid's, in triaxial extension and compression
        at p = 0."""
        if self.sharp:
            return 0.0, 0.0
        found, friction = [], math.sin(self.phi)
        for sign in _SIGNS.values():
            a, b, c = edge_numbers(friction, self.corner, sign)
            found.append(1 - lode_function(sign * math.pi / 6, friction) / (a + sign * b + c))
        return found[0], found[1]

    # numbers and functions ------------------------------------------------------------------------
    def plastic_parameters(self) -> dict[str, float]:
        numbers = {"c": self.c, "H": self.H, "tip": self.tip, "cos_phi": math.sqrt(3) * math.cos(self.phi)}
        corner = _SHARPEST if self.sharp else math.sin(3 * self.corner)
        numbers |= {"sin_corner": corner, "nothing": _NOTHING * self.modulus**2}
        if self.sharp:
            numbers["scale"] = self.modulus
        for name, angle in (("phi", self.phi), ("psi", self.psi)):
            numbers |= _pyramid_numbers(name, math.sin(angle), self.corner)
        if self.cut is not None:
            numbers |= {"cut": self.cut, **_pyramid_numbers("tension", 1.0, self.corner)}
        if self.micropolar:
            numbers |= {"l_p": self.length, "spring": SPRING * self.couple_modulus}
        return numbers

    def cohesion(self, chi: Any, p: Any) -> Any:
        """sqrt(3) (c + H chi) cos(phi) (Pa)."""
        return (p.c + p.H * chi) * p.cos_phi

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _invariants(tau, nu, "phi", p, self.sharp) - self.cohesion(chi, p)

    def potential(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _invariants(tau, nu, "psi", p, self.sharp)

    def tension(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """The cut-off: the largest principal stress is at most `cut`; the pyramid for phi = 90 degrees."""
        return _invariants(tau, nu, "tension", p) - math.sqrt(3) * p.cut

    def hardening_energy(self, chi: Any, p: Any) -> Any:
        return p.cos_phi * p.H * chi**2 / 2

    # regions --------------------------------------------------------------------------------------
    @property
    def regions(self) -> tuple[Region, ...]:
        shear = self.surface
        if self.cut is None:
            tip = (ConeApex(_Tip(self, "phi", "psi"), shear),) if self.phi > 0 and self.tip == 0 else ()
            if not self.sharp:
                return (SmoothPart(shear), *tip)
            return (PyramidFace(self, shear), *(PyramidEdge(self, name, shear) for name in _SIGNS), *tip)
        tension = YieldSurface("tension", self.tension)
        tip = (ConeApex(_Tip(self, "tension", "tension"), tension),) if self.tip == 0 else ()
        return (SmoothPart(shear), SmoothPart(tension), Edge(shear, tension), *tip)

    def first_region(self, tau: Any, nu: Any, chi: Any, p: Any) -> dict[str, Any]:
        """Of sharp edges: where the small-strain return to a face changes the order of principal stresses."""
        if not self.sharp or len(self.moduli("lam", "mu")) < 2:
            return {}
        high, middle, low = principal_values(ufl.sym(tau))
        half = math.sqrt(3) / 2
        rise, fall = half * (1 + p.sin_psi), half * (1 - p.sin_psi)
        volume = p.lam * (rise - fall)
        stiffness = half * (1 + p.sin_phi) * (volume + 2 * p.mu * rise)
        stiffness += half * (1 - p.sin_phi) * (2 * p.mu * fall - volume) + p.cos_phi * p.H
        multiplier = 2 * p.mu * self.yield_function(tau, nu, chi, p) / stiffness
        found = {
            "compression": middle - high + multiplier * rise,
            "extension": low - middle + multiplier * fall,
        }
        return found | ({"apex": found["compression"] + found["extension"]} if self.phi > 0 else {})

    @property
    def continuation(self) -> Continuation:
        """Pyramids with rounded tips, see `DruckerPrager.continuation`."""
        tips = (share * math.sqrt(3) * self.c * math.cos(self.phi) for share in TIPS)
        return Continuation("tip", tuple(tip for tip in tips if tip > self.tip))


def Tresca(elastic: Material, c: float, **options: Any) -> MohrCoulomb:
    """Tresca's prism: the pyramid without friction, c (Pa) the undrained shear strength; options as of
    `MohrCoulomb`."""
    return MohrCoulomb(elastic, c=c, **options)
