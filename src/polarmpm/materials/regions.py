"""Regions of a yield surface: smooth parts, edges where smooth parts meet, the apex of a cone.

A stress that a trial state puts outside of the elastic range returns to one of the regions that its material
names (`Plastic.regions`). A region is local equations r(X) = 0 in UFL for X = (Ue, Ge, chi, multipliers),
T (4.61); derivatives, the consistent tangent and compiled code follow from them (`forms.plastic`,
`forms.returns`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import ufl

from ..errors import InputError
from ..kinematics.spectral import exp_symmetric, squared_log_strain, strain_invariants
from ..tools import checks
from .base import evaluate_scalar

SPRING = 1e-9  # of the couple-stress moduli, for the return to the apex

Entries = Sequence[tuple[int, int]]


# what a region is given -------------------------------------------------------------------------------
@dataclass(frozen=True)
class LocalState:
    """A point at the unknowns X of its return, as UFL expressions in the frame of the kernels.

    Attributes:
        dim: dimensions of the body; tensors are 3 x 3 also in plane strain.
        F, Q: deformation gradient and microrotation. Of a classical material Q and all wrynesses are None.
        Fe_trial, Ge_trial: elastic deformation and wryness if nothing flowed, T (4.42)-(4.44).
        chi_before: hardening variable before the step.
        Ue, Ge, chi, multipliers: X; Ue is Fe itself of a classical material.
        p: the material's numbers, p.name.
        elastic_stress: (Ue, Ge) -> B (Pa) and S (N/m).
        stress_at: (Ue, Ge) -> tau (Pa) and nu (N/m).
        hardening_energy: chi -> energy (Pa) that hardening stores.
        entries: of deformations, and of wrynesses, that X holds.
        owner: the material's name for messages.
    """

    dim: int
    F: Any
    Q: Any
    Fe_trial: Any
    Ge_trial: Any
    chi_before: Any
    Ue: Any
    Ge: Any
    chi: Any
    multipliers: tuple[Any, ...]
    p: Any
    elastic_stress: Callable[[Any, Any], tuple[Any, Any]]
    stress_at: Callable[[Any, Any], tuple[Any, Any]]
    hardening_energy: Callable[[Any], Any]
    entries: tuple[Entries, Entries]
    owner: str

    @property
    def Fe(self) -> Any:
        """Elastic deformation Q Ue."""
        return self.Ue if self.Q is None else ufl.dot(self.Q, self.Ue)

    @property
    def flow(self) -> Any:
        """Fe_trial Fe^-1: what flows in the step, in the current configuration."""
        return ufl.dot(self.Fe_trial, ufl.inv(self.Fe))

    def kirchhoff(self) -> tuple[Any, Any]:
        """tau (Pa) and nu (N/m) at X, the same variables in each call; nu is None of a classical material."""
        return self._kirchhoff

    @cached_property
    def _kirchhoff(self) -> tuple[Any, Any]:
        # UFL sorts operands by walking through them: equal stresses that aren't one object cost it minutes
        tau, nu = self.stress_at(self.Ue, self.Ge)
        return ufl.variable(tau), None if nu is None else ufl.variable(nu)

    def flat(self, tensor: Any) -> list[Any]:
        """A deformation's rows: the entries that X holds."""
        return [tensor[i, j] for i, j in self.entries[0]]

    def flat_wryness(self, tensor: Any) -> list[Any]:
        """The same of a wryness; nothing of a classical material."""
        return [tensor[i, j] for i, j in self.entries[1]]

    def hardening_work(self) -> Any:
        """Lambda Dchi (Pa): what hardening stores of the step's plastic work, T (4.17)."""
        chi = ufl.variable(self.chi)
        return ufl.diff(self.hardening_energy(chi), chi) * (self.chi - self.chi_before)


@dataclass(frozen=True)
class Scales:
    """Sizes that make local residuals strains.

    Attributes:
        dim: dimensions of the body.
        deformation, wryness: numbers of their entries in X.
        modulus, couple_modulus: stiffnesses (Pa, N).
        length: makes wryness a strain (m).
    """

    dim: int
    deformation: int
    wryness: int
    modulus: float
    couple_modulus: float
    length: float


# smooth surfaces and their edges ----------------------------------------------------------------------
@dataclass(frozen=True)
class YieldSurface:
    """A smooth surface f(tau, nu, chi, p) = 0 that bounds the elastic range f <= 0.

    Args:
        name: of the surface and of the region on which it alone is active.
        function: f (Pa) in UFL, smooth where it is zero; nu is None for a classical material.
        potential: g (Pa), whose derivatives are the directions of flow; default: f (associated flow).
        hardening: h(tau, nu, chi, p), by which chi grows per multiplier: dchi = h dgamma, such as
            tr(dg/dtau) where chi is the plastic change of volume; default: 1.

    Raises:
        InputError: no name, or not functions of these arguments.
    """

    name: str
    function: Callable[..., Any]
    potential: Callable[..., Any] | None = None
    hardening: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        checks.text("name", self.name)
        for argument in ("function", "potential", "hardening"):
            given = getattr(self, argument)
            if given is not None or argument == "function":
                checks.function(argument, given, "a function in UFL is", takes=("tau", "nu", "chi", "p"))

    def value(self, owner: str, *arguments: Any) -> Any:
        """f as a UFL scalar; raises InputError with the owner's name."""
        return evaluate_scalar(f"yield_function of {owner} ({self.name!r})", self.function, *arguments)

    def flow_potential(self, owner: str, *arguments: Any) -> Any:
        """g as a UFL scalar; raises InputError with the owner's name."""
        what = f"potential of {owner} ({self.name!r})"
        return evaluate_scalar(what, self.potential or self.function, *arguments)

    def growth(self, s: LocalState, multiplier: Any) -> Any:
        """By how much chi grows at X."""
        if self.hardening is None:
            return multiplier
        tau, nu = s.kirchhoff()
        what = f"hardening of {s.owner} ({self.name!r})"
        return multiplier * evaluate_scalar(what, self.hardening, tau, nu, s.chi, s.p)

    def at(self, s: LocalState) -> Any:
        """f at X."""
        tau, nu = s.kirchhoff()
        return self.value(s.owner, tau, nu, s.chi, s.p)

    def directions(self, s: LocalState) -> tuple[Any, Any]:
        """dg/dtau and dg/dnu at X."""
        tau, nu = s.kirchhoff()
        g = self.flow_potential(s.owner, tau, nu, s.chi, s.p)
        return ufl.diff(g, tau), None if nu is None else ufl.diff(g, nu)


class Region(ABC):
    """A part of the yield surface with local equations of its own.

    A subclass of a user's own needs `residual`, `row_scale` and `flow`. X has as many unknowns as there are
    rows: the entries of Ue and Ge, chi, and the multipliers.

    Attributes:
        name: unique within the material; kernels are compiled by it when the first point returns there.
        surfaces: yield surfaces that are active in it. Of the material's others, f <= 0 is asked of a
            solution besides what `flow` says.
        multipliers: how many of them X has.
    """

    name: str
    surfaces: tuple[YieldSurface, ...] = ()
    multipliers: int = 1

    def __repr__(self) -> str:
        of = ", ".join(surface.name for surface in self.surfaces)
        return f"<{type(self).__name__} {getattr(self, 'name', '')!r}{f' of {of}' if of else ''}>"

    @abstractmethod
    def residual(self, s: LocalState) -> list[Any]:
        """The local equations, UFL scalars."""

    @abstractmethod
    def row_scale(self, scales: Scales) -> np.ndarray:
        """Factors of the equations (rows,) that make them strains."""

    @abstractmethod
    def flow(self, s: LocalState) -> list[Any]:
        """Dissipation per reference volume (Pa) of a solution, and a strain that is negative where the
        solution isn't admissible, such as one whose flow runs backwards."""


class Edge(Region):
    """Where smooth surfaces meet: one multiplier for each of them (Koiter), T (4.57)-(4.60) otherwise.

    All yield functions are zero, flows and the growth of chi add up.

    Raises:
        InputError: no surface, or one that isn't a `YieldSurface`.
    """

    def __init__(self, *surfaces: YieldSurface, name: str = ""):
        if not surfaces:
            raise InputError(f"{type(self).__name__}: no surface is given; one at least is needed")
        for surface in surfaces:
            checks.instance(f"{type(self).__name__}: surface", surface, YieldSurface, "a YieldSurface is")
        if name:
            checks.text("name", name)
        self.surfaces, self.multipliers = surfaces, len(surfaces)
        self.name = name or "+".join(surface.name for surface in surfaces)

    def residual(self, s: LocalState) -> list[Any]:
        flows = [(m, *surface.directions(s)) for m, surface in zip(s.multipliers, self.surfaces, strict=True)]
        back = _sum([-m * flow for m, flow, _ in flows])
        fe = ufl.dot(exp_symmetric(back), s.Fe_trial)
        rows = s.flat(s.Ue - (fe if s.Q is None else ufl.dot(ufl.transpose(s.Q), fe)))
        if s.Ge is not None:
            turn = ufl.transpose(s.Q)
            step = _sum([m * ufl.dot(turn, ufl.dot(wryness, s.F)) for m, _, wryness in flows])
            rows += s.flat_wryness(s.Ge + step - s.Ge_trial)
        chi = s.chi - s.chi_before
        for multiplier, surface in zip(s.multipliers, self.surfaces, strict=True):
            chi = chi - surface.growth(s, multiplier)
        return [*rows, chi, *(surface.at(s) for surface in self.surfaces)]

    def row_scale(self, scales: Scales) -> np.ndarray:
        strains = [1.0] * scales.deformation + [scales.length] * scales.wryness + [1.0]
        return np.array([*strains, *([1.0 / scales.modulus] * self.multipliers)])

    def flow(self, s: LocalState) -> list[Any]:
        """tau : dFp-flow + nu : dGp-flow - Lambda Dchi, T (4.23), and the smallest multiplier."""
        tau, nu = s.kirchhoff()
        work = []
        for multiplier, surface in zip(s.multipliers, self.surfaces, strict=True):
            flow, wryness_flow = surface.directions(s)
            work.append(multiplier * ufl.inner(tau, flow))
            if nu is not None:
                work.append(multiplier * ufl.inner(nu, wryness_flow))
        least = s.multipliers[0]
        for multiplier in s.multipliers[1:]:
            least = ufl.min_value(least, multiplier)
        return [_sum(work) - s.hardening_work(), least]


class SmoothPart(Edge):
    """The smooth part of one surface, T (4.57)-(4.60)."""

    def __init__(self, surface: YieldSurface):
        super().__init__(surface)


def _sum(terms: Sequence[Any]) -> Any:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


# the apex of a cone -----------------------------------------------------------------------------------
class Cone(Protocol):
    """What the apex asks of the material whose cone f = q + a p - strength it is, p = tr(tau)/3."""

    def slopes(self, p: Any) -> tuple[Any, Any]:
        """a and b, of yield function and potential."""

    def strength_at(self, chi: Any, p: Any) -> Any:
        """Yield strength (Pa)."""

    def plastic_length(self, p: Any) -> Any:
        """Length (m) by which wryness counts in the generalised stress q; micropolar materials only."""

    def apex_spring(self, p: Any) -> Any:
        """`SPRING` times a couple-stress modulus (N); micropolar materials only."""


class ConeApex(Region):
    """The tip of a cone, where the stress is an even tension.

    Args:
        cone: the material.
        surface: the cone's smooth part.
    """

    name = "apex"

    def __init__(self, cone: Cone, surface: YieldSurface):
        checks.instance("ConeApex: surface", surface, YieldSurface, "a YieldSurface is")
        for method in ("slopes", "strength_at", "plastic_length", "apex_spring"):
            checks.function(f"ConeApex: cone.{method}", getattr(cone, method, None), "a method is")
        self.cone, self.surfaces = cone, (surface,)

    def residual(self, s: LocalState) -> list[Any]:
        """sym tau = p I on the cone's tip, the flow symmetric, no couple stress.

        The flow of wryness has the direction of a couple stress: on the smooth cone it is a multiple of S C,
        C = F^T F, so that (Ge_trial - Ge) C^-1 has no part of which the couple stress vanishes (as it does
        for skew wryness with bounded stiffness). A spring of a billionth of the moduli sees to that.
        """
        tau, _ = s.kirchhoff()
        deviator, ratio = ufl.dev(ufl.sym(tau)), s.flow
        pairs = _pairs(s.dim)
        friction, dilatancy = self.cone.slopes(s.p)
        rows = [deviator[0, 0], deviator[1, 1], *(deviator[i, j] for i, j in pairs)]
        rows.append(friction * ufl.tr(tau) / 3 - self.cone.strength_at(s.chi, s.p))
        rows += [ratio[i, j] - ratio[j, i] for i, j in pairs]
        if s.Ge is not None:
            couple = s.elastic_stress(s.Ue, s.Ge)[1]
            back = ufl.inv(ufl.dot(ufl.transpose(s.F), s.F))
            spring = self.cone.apex_spring(s.p)
            rows += s.flat_wryness(couple + spring * ufl.dot(s.Ge - s.Ge_trial, back))
        rows.append(s.chi - s.chi_before - s.multipliers[0])
        dilatancy = ufl.conditional(ufl.gt(dilatancy, 0.0), dilatancy, friction)
        rows.append(s.multipliers[0] - ufl.ln(ufl.det(ratio)) / dilatancy)
        return rows

    def row_scale(self, scales: Scales) -> np.ndarray:
        pairs = len(_pairs(scales.dim))
        stress = [1.0 / scales.modulus] * (scales.deformation - pairs)
        spring = [scales.length / scales.couple_modulus] * scales.wryness
        return np.array([*stress, *([1.0] * pairs), *spring, 1.0, 1.0])

    def flow(self, s: LocalState) -> list[Any]:
        """Dissipation as on an edge; admissible is a flow within the cone of normals at the apex (Koiter)."""
        tau, nu = s.kirchhoff()
        ratio = s.flow
        volume = ufl.ln(ufl.det(ratio))
        square = squared_log_strain(*strain_invariants(ratio)) - volume**2 / 3
        work = ufl.tr(tau) / 3 * volume
        if s.Ge is not None:
            wryness = ufl.dot(s.Q, ufl.dot(s.Ge_trial - s.Ge, ufl.inv(s.F)))
            square += self.cone.plastic_length(s.p) ** 2 * ufl.inner(wryness, wryness)
            work += ufl.inner(nu, wryness)
        least = self.cone.slopes(s.p)[1] * ufl.sqrt(ufl.max_value(square, 0.0) / 1.5)
        return [work - s.hardening_work(), volume * (1.0 + 1e-6) - least]


def _pairs(dim: int) -> tuple[tuple[int, int], ...]:
    """Entries above the diagonal that may differ from zero."""
    return ((0, 1), (0, 2), (1, 2)) if dim == 3 else ((0, 1),)
