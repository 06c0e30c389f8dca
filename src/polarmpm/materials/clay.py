"""Clays: an elastic energy whose stiffness grows with pressure, and the modified Cam-Clay model.

Compressive pressure is p = -tr(tau)/3 > 0 of the Kirchhoff stress, and volume is counted by ln J. In these,
the lines of compression and swelling are straight at any strain: ln J = -compression ln p and -swelling ln p.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import ufl

from ..errors import InputError
from ..kinematics.spectral import squared_log_strain, strain_invariants
from ..tools.checks import number, put_numbers, refuse, require
from .base import Material
from .cones import check_plastic_length, generalised_square
from .plastic import Continuation, Plastic, check_elastic, check_names
from .regions import Region, SmoothPart, YieldSurface


@dataclass(frozen=True, repr=False)
class Houlsby(Material):
    """Hyperelastic soil whose moduli grow with the pressure (Houlsby 1985; Borja, Tamagnini 1998); classical.

    W = p_0 swelling exp(Omega) + (mu + alpha p_0 exp(Omega)) |dev ln V|^2,  Omega = -ln J / swelling, so that
    without shear p = p_0 exp(Omega) and the bulk modulus is p / swelling. The undeformed body has the
    pressure p_0: loads and supports, or neighbours, have to bear it.

    Args:
        p_0: pressure (Pa) of the undeformed body, > 0.
        swelling: index of swelling, the slope of ln J over ln p, > 0.
        mu: part of the shear modulus (Pa) that doesn't depend on the pressure, >= 0.
        alpha: part that does, over the pressure; >= 0. One of both must be positive.

    Raises:
        InputError: an argument is out of range.
    """

    p_0: float
    swelling: float
    mu: float = 0.0
    alpha: float = 0.0

    micropolar = False
    isotropic = True
    stress_prediction = False  # as `Hencky`
    units: ClassVar[Mapping[str, str]] = {"p_0": "Pa", "mu": "Pa"}

    def __post_init__(self) -> None:
        put_numbers(self, "p_0", "swelling", "mu", "alpha")
        for name in ("p_0", "swelling"):
            require(getattr(self, name) > 0, name, getattr(self, name), f"{name} > 0")
        for name in ("mu", "alpha"):
            require(getattr(self, name) >= 0, name, getattr(self, name), f"{name} >= 0")
        if self.mu == self.alpha == 0:
            raise InputError("mu = 0, alpha = 0: without a shear modulus nothing keeps its shape; give one")

    def parameters(self) -> dict[str, float]:
        return {"p_0": self.p_0, "swelling": self.swelling, "mu": self.mu, "alpha": self.alpha}

    def measures(self, F: Any) -> tuple[Any, ...]:
        return (*strain_invariants(F), ufl.det(F))

    def energy(self, first: Any, square: Any, third: Any, J: Any, p: Any) -> Any:
        volume = ufl.ln(J)
        pressure = p.p_0 * ufl.exp(-volume / p.swelling)
        deviator = squared_log_strain(first, square, third) - volume**2 / 3
        return p.swelling * pressure + (p.mu + p.alpha * pressure) * deviator


@dataclass(frozen=True, repr=False)
class CamClay(Plastic):
    """Modified Cam-Clay (Roscoe and Burland 1968) at finite strain; classical or micropolar.

    f = g = 2 sqrt((p - p_c/2)^2 + (q/M)^2) - p_c: an ellipse through p = 0 and p = p_c with its top on the
    line q = M p, with the generalised q of T (4.38). The pressure p_c of consolidation follows the plastic
    change of volume, chi = -ln Jp: p_c = p_c0 exp(chi / (compression - swelling)). With `cohesion` the
    ellipse begins at the tension -cohesion, and p and p_c are counted from there.

    Args:
        elastic: `Houlsby`, or any other elastic material.
        M: slope of the critical state line q = M p, > 0; 6 sin(phi)/(3 - sin(phi)) for triaxial compression.
        compression: index of compression, the slope of ln J over ln p of first loading; > swelling.
        p_c: pressure (Pa) of consolidation of the undeformed body, > 0.
        swelling: index of swelling; default: the elastic part's, where it has one.
        cohesion: tension (Pa) at which the ellipse begins, >= 0. Elastic parts that have no stress at rest
            begin on the yield surface without.
        l_p: plastic length (m); needed by micropolar materials.

    Raises:
        InputError: an argument is out of range, or the undeformed body is beyond the yield surface.
    """

    elastic: Material
    M: float
    compression: float
    p_c: float
    swelling: float | None = None
    cohesion: float = 0.0
    l_p: float | None = None

    def __post_init__(self) -> None:
        check_elastic(self.elastic)
        put_numbers(self, "M", "compression", "p_c", "cohesion")
        own = self.elastic.parameters().get("swelling")
        given = self.swelling if self.swelling is not None else own
        if given is None:
            raise InputError(
                f"swelling = None: {type(self.elastic).__name__} has no index of swelling; it is needed"
            )
        swelling = number("swelling", given, least=0.0)
        if own is not None and swelling != own:
            raise refuse("swelling", swelling, f"the elastic part's is {own:g}; leave it out")
        object.__setattr__(self, "swelling", swelling)
        require(self.M > 0, "M", self.M, "M > 0")
        require(
            self.compression > swelling,
            "compression",
            self.compression,
            f"compression > swelling = {swelling:g}",
        )
        require(self.p_c > 0, "p_c", self.p_c, "p_c > 0")
        require(self.cohesion >= 0, "cohesion", self.cohesion, "cohesion >= 0")
        at_rest = self.elastic.parameters().get("p_0", 0.0)
        require(
            at_rest <= self.p_c,
            "p_c",
            self.p_c,
            f"p_c >= p_0 = {at_rest:g}, the pressure of the undeformed body",
        )
        check_plastic_length(self)
        self._check_shear()
        check_names(self)

    def _check_shear(self) -> None:
        """`Houlsby`'s energy is convex up to |dev ln V|^2 = swelling/alpha, where q/p is largest."""
        if not isinstance(self.elastic, Houlsby) or not self.elastic.alpha:
            return
        alpha, mu = self.elastic.alpha, self.elastic.mu
        most = math.sqrt(1.5 * self.elastic.swelling / alpha) * (alpha + 2 * mu / self.p_c)
        if most <= self.M:
            raise InputError(
                f"elastic: at a pressure of {self.p_c / 2:g} Pa Houlsby bears no q/p beyond {most:.4g}, which"
                f" has to be more than M = {self.M:g}; a larger alpha or mu is needed"
            )

    @property
    def length(self) -> float:
        return self.l_p or 1.0

    @cached_property
    def modulus(self) -> float:
        """The shear modulus (Pa), at the pressure of consolidation."""
        if isinstance(self.elastic, Houlsby):
            return self.elastic.mu + self.elastic.alpha * self.p_c
        return abs(self.moduli("mu").get("mu", 0.0)) or self._at_rest[0] or 1.0

    def plastic_parameters(self) -> dict[str, float]:
        assert self.swelling is not None
        numbers = {
            "M": self.M,
            "hardening": 1.0 / (self.compression - self.swelling),
            "p_c": self.p_c,
            "cohesion": self.cohesion,
        }
        return numbers | ({"l_p": self.length} if self.micropolar else {})

    @property
    def regions(self) -> tuple[Region, ...]:
        """The ellipse; where pressures are exponential once more by their logarithms, which are next to
        linear in the strains: what isn't found from a trial state by one of both is found by the other."""
        ellipse = YieldSurface("ellipse", self.yield_function, hardening=self.compaction)
        if not self._exponential:
            return (SmoothPart(ellipse),)
        logarithms = YieldSurface("logarithms", self.logarithmic, hardening=self.logarithmic_compaction)
        return SmoothPart(ellipse), SmoothPart(logarithms)

    @property
    def _exponential(self) -> bool:
        """Pressures grow exponentially with the strain, and are never negative."""
        return isinstance(self.elastic, Houlsby)

    @property
    def farthest(self) -> float:
        """Pressures of trial states may be any multiple of the solution's."""
        return 1e12 if self._exponential else 10.0

    @property
    def continuation(self) -> Continuation:
        """Elastic parts whose pressures grow less with the strain; of others, less hardening."""
        assert self.swelling is not None
        if self._exponential:
            return Continuation("swelling", tuple(self.swelling * 2.0**k for k in (5, 4, 3, 2, 1)))
        slope = self.plastic_parameters()["hardening"]
        return Continuation("hardening", tuple(slope * share for share in (0.0, 0.1, 0.3, 0.6)))

    def _of_ellipse(self, tau: Any, nu: Any, chi: Any, p: Any) -> tuple[Any, Any, Any]:
        """Pressure, (q/M)^2, and the pressures that the ellipse spans."""
        square = generalised_square(tau, nu, p.l_p if self.micropolar else 1.0) / p.M**2
        return p.cohesion - ufl.tr(tau) / 3, square, p.p_c * ufl.exp(p.hardening * chi) + p.cohesion

    def yield_function(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        pressure, square, width = self._of_ellipse(tau, nu, chi, p)
        return 2 * ufl.sqrt((pressure - width / 2) ** 2 + square) - width

    def logarithmic(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """p_c0 ln((p^2 + (q/M)^2) / (p p_c)): the same surface."""
        pressure, square, width = self._of_ellipse(tau, nu, chi, p)
        return p.p_c * (ufl.ln(pressure**2 + square) - ufl.ln(pressure) - ufl.ln(width))

    def compaction(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        """-tr(dg/dtau): by how much the volume shrinks per multiplier."""
        return _shrinking(self.yield_function, tau, nu, chi, p)

    def logarithmic_compaction(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _shrinking(self.logarithmic, tau, nu, chi, p)

    def consolidated(self, tau: np.ndarray, ratio: float) -> np.ndarray:
        """Hardening variables (n,) at which the pressure of consolidation is a multiple of that of the
        ellipse through stresses (n, 3, 3).

        Raises:
            InputError: there is no such ellipse.
        """
        pressure = self.cohesion - np.trace(tau, axis1=1, axis2=2) / 3
        s = tau + (pressure - self.cohesion)[:, None, None] * np.eye(3)
        square = 1.5 * np.einsum("nij,nij->n", s, s) / self.M**2
        if np.any(pressure <= 0.0):
            raise InputError(f"overconsolidation = {ratio:g}: CamClay has no ellipse through a tension")
        own = ratio * (pressure + square / pressure - self.cohesion)
        if np.any(own <= 0.0):
            raise InputError(
                f"overconsolidation = {ratio:g}: there is a stress without a pressure of consolidation"
            )
        chi: np.ndarray = np.log(own / self.p_c) / self.plastic_parameters()["hardening"]
        return chi

    def consolidation(self, chi: np.ndarray) -> np.ndarray:
        """p_c (Pa) of hardening variables (n,), such as `points.hardening`."""
        return self.p_c * np.exp(np.asarray(chi) * self.plastic_parameters()["hardening"])


def _shrinking(g: Callable[..., Any], tau: Any, *others: Any) -> Any:
    varied = ufl.variable(tau)
    return -ufl.tr(ufl.diff(g(varied, *others), varied))


def critical_slope(phi: float) -> float:
    """M of an angle of friction (rad) in triaxial compression, 6 sin(phi)/(3 - sin(phi))."""
    return 6 * math.sin(phi) / (3 - math.sin(phi))
