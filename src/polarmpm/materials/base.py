"""What the solver asks of a material."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import ufl
from ufl.corealg.traversal import unique_pre_traversal

from ..errors import InputError, TrustWarning
from ..tools import checks, quiet
from ..tools.caller import warn

_LOCKING = 0.49  # Poisson's ratio, see docs/stability.md


class Material:
    """A hyperelastic material: its energy per reference volume, written once in UFL.

    Derive from it, or hand the energy to `UserEnergy`. Stresses and tangents come from UFL.

    Attributes:
        micropolar: whether points carry a microrotation; without it the scene has no rotation unknowns.
        isotropic: W(R E R^T, R Gamma R^T) = W(E, Gamma) for every rotation R. Allows a cheaper frame.
        plastic: the energy is that of the elastic part, and there is a yield function; see `plastic.Plastic`.
        yields: it is plastic, and can flow; a plastic one may not, see `prestressed.Prestressed`.
        second_gradient: the energy depends on the second gradient of the motion, too: W(F, H) with
            H_iJK = d^2 x_i / dX_J dX_K. Such a material is classical.
        stress_prediction: iterations predict the stress of the tangent's geometric part linearly, see
            `PointForm.iteration_tangent`. It takes fewer of them where strain measures turn with the body; a
            classical material of energy W(F) is left as it is.
    """

    plastic: ClassVar[bool] = False
    yields: ClassVar[bool] = False
    second_gradient: bool = False
    stress_prediction: ClassVar[bool] = True
    units: ClassVar[Mapping[str, str]] = {}  # of parameters, for repr

    @property
    def micropolar(self) -> bool:
        """A material that always is, or never, says `micropolar = True` in its class."""
        return True

    @property
    def isotropic(self) -> bool:
        return False

    @property
    def measure(self) -> str:
        """Of what the energy grows fast where volume is hardly changed: "log", of ln det F, or "trace", of
        tr E. Elastic micropolar energies W(E, Gamma) are taken for the latter; say so if one isn't."""
        return "trace" if self.micropolar and not self.plastic else "log"

    @property
    def never_yields(self) -> bool:
        """It has a plastic state, for the stress that it bears at rest, but can't flow."""
        return self.plastic and not self.yields

    @property
    def elastic_part(self) -> Material:
        """The material itself; of a plastic one that which is elastic in it."""
        return self

    def moduli(self, *names: str) -> dict[str, float]:
        """Moduli of the elastic part (Pa; couple-stress moduli N) that have these names, in this order. A
        user's energy has them if its numbers are called so."""
        known = self.elastic_part.parameters()
        return {name: float(known[name]) for name in names if name in known}

    def parameters(self) -> dict[str, float]:
        """Numbers of the energy by name. They enter the compiled code as inputs."""
        return {}

    def choices(self) -> dict[str, str | bool]:
        """What else makes the energy, besides class and numbers, by name; restart files compare it."""
        return {}

    def energy(self, *strains_and_parameters: Any) -> Any:
        """W(E, Gamma, p) of a micropolar material, W(F, p) of a classical one, W(F, H, p) of one with second
        gradients (W(*measures(...), p) if it has measures of its own); p.name is a parameter.

        E = Q^T F - I and Gamma are 3 x 3 UFL tensors, H is a 3 x 3 x 3 one, also in plane strain; W in Pa
        (J/m^3).
        """
        raise NotImplementedError(f"{type(self).__name__} has no energy")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({numbers(self.parameters(), self.units)})"

    def check_dimension(self, dim: int) -> None:
        """Raise InputError where the material makes no sense in so many dimensions."""

    def measures(self, *deformation: Any) -> tuple[Any, ...]:
        """Strain measures of a classical material, the arguments of its energy, as functions of F (of F and H
        with second gradients); these themselves by default.

        Few scalars (invariants, say) make short code: UFL derives the energy by them first.
        """
        return deformation

    def measures_of(self, C: Any) -> tuple[Any, ...] | None:
        """`measures` of a classical material as functions of C = F^T F, for what has a C but no F, such as
        the places in a micro-space; None of an energy that isn't written so."""
        return None


def numbers(named: Mapping[str, float], units: Mapping[str, str]) -> str:
    """Numbers by name with their units, for repr."""
    return ", ".join(f"{name} = {value:.6g} {units.get(name, '')}".rstrip() for name, value in named.items())


def check_material(material: Any, dim: int | None = None) -> Material:
    """Raise InputError unless `material` has an energy, and, where `dim` is known, one in its dimensions."""
    if not isinstance(material, Material):
        made = isinstance(material, type) and issubclass(material, Material)
        raise InputError(
            f"material: {checks.shown(material)} is not a material; "
            + (
                "it is a kind of them, to be called with its numbers"
                if made
                else "use one of polarmpm's or derive from polarmpm.Material"
            )
        )
    if type(material).energy is Material.energy:
        raise InputError(
            f"material: {type(material).__name__} has no energy; "
            "define energy(E, Gamma, p), or energy(F, p) when it is classical"
        )
    kind = type(material).__name__
    checks.flag(f"material: {kind}.micropolar", material.micropolar)
    checks.flag(f"material: {kind}.isotropic", material.isotropic)
    if checks.flag(f"material: {kind}.second_gradient", material.second_gradient) and material.micropolar:
        raise InputError(f"material: {kind} is micropolar and has second gradients; write micropolar = False")
    if material.plastic and (material.second_gradient or material.elastic_part.second_gradient):
        raise InputError(
            f"material: {kind} is plastic, and its elastic part has second gradients; none yields yet"
        )
    checks.numbers_by_name(f"material: {kind}.parameters()", material.parameters())
    if dim is not None:
        material.check_dimension(dim)
    return material


def parameter_values(material: Material) -> np.ndarray:
    """A material's numbers as the kernels' input; never empty, as an input of no length isn't allowed."""
    return np.array(list(material.parameters().values()) or [0.0], dtype=float)


def named_parameters(material: Material, coefficient: Any) -> SimpleNamespace:
    """The components of a UFL coefficient under the names of the material's parameters."""
    return SimpleNamespace(**{name: coefficient[i] for i, name in enumerate(material.parameters())})


def evaluate_scalar(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """A material's function as a UFL scalar; `what` names it in messages.

    Raises:
        InputError: it raises an error itself, or is not a scalar.
    """
    with checks.evaluating(f"material: {what}", _hint), quiet.ufl():
        value = ufl.as_ufl(function(*arguments))
    if value.ufl_shape or value.ufl_free_indices:
        raise InputError(f"material: {what} has the shape {value.ufl_shape}; a scalar is needed")
    if any(isinstance(node, ufl.classes.ComplexValue) for node in unique_pre_traversal(value)):
        raise InputError(f"material: {what} has complex numbers in it; real ones are needed")
    return value


def _hint(error: Exception) -> str:
    """What is likely wrong where a function for numbers is called with UFL."""
    foreign = "ufl" in str(error).lower() and ("loop of ufunc" in str(error) or "must be real" in str(error))
    return "; write it in UFL, such as ufl.exp for np.exp" if foreign or "ufunc" in str(error) else ""


def evaluate_measures(material: Material, F: Any, H: Any = None) -> tuple[Any, ...]:
    """Strain measures of a classical material at F, and at the second gradient H where it takes one.

    Raises:
        InputError: they raise an error, or aren't UFL expressions in a tuple.
    """
    what = f"material: the measures of {type(material).__name__}"
    with checks.evaluating(what, _hint):
        found = material.measures(F, H) if material.second_gradient else material.measures(F)
    if not isinstance(found, tuple | list) or not all(isinstance(m, ufl.classes.Expr) for m in found):
        raise InputError(f"{what} are {checks.shown(found)}; a tuple of UFL expressions is needed")
    return tuple(found)


def evaluate_energy(material: Material, strains: Sequence[Any], parameters: Any) -> Any:
    """The energy as a UFL scalar, see `evaluate_scalar`."""
    what = f"the energy of {type(material).__name__}"
    return evaluate_scalar(what, material.energy, *strains, parameters)


@dataclass(frozen=True)
class UserEnergy(Material):
    """A user's energy as a function in UFL.

    Args:
        function: W(E, Gamma, p) or, for `micropolar=False`, W(F, p), or, with `second_gradient`, W(F, H, p).
        values: the numbers p.name, so that changing them compiles nothing.

    Raises:
        InputError: not a function of these arguments, or values that aren't finite numbers by name.

    Example:
        >>> UserEnergy(lambda E, G, p: p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G), {"a": 1e6, "b": 10.0})
    """

    function: Callable[..., Any]
    values: Mapping[str, float] = field(default_factory=dict)
    micropolar: bool = True
    isotropic: bool = False
    second_gradient: bool = False

    def __post_init__(self) -> None:
        for name in ("micropolar", "isotropic", "second_gradient"):
            object.__setattr__(self, name, checks.flag(name, getattr(self, name)))
        if self.second_gradient and self.micropolar:
            raise InputError(
                "micropolar = True: an energy of second gradients W(F, H, p) is classical; "
                "write micropolar=False"
            )
        takes: tuple[str, ...] = ("E", "Gamma", "p") if self.micropolar else ("F", "p")
        if self.second_gradient:
            takes = ("F", "H", "p")
        checks.function("function", self.function, "an energy in UFL is", takes=takes)
        object.__setattr__(self, "values", checks.numbers_by_name("values", self.values))

    def __repr__(self) -> str:
        kind = ("micropolar" if self.micropolar else "classical") + (", isotropic" if self.isotropic else "")
        kind += ", second gradients" if self.second_gradient else ""
        name = getattr(self.function, "__name__", type(self.function).__name__)
        return f"UserEnergy({', '.join(filter(None, (name, numbers(self.values, {}), kind)))})"

    def parameters(self) -> dict[str, float]:
        return dict(self.values)

    def energy(self, *args: Any) -> Any:
        return self.function(*args)


def warn_of_locking(
    materials: Sequence[Material],
    functions: str,
    remedy: str,
    *,
    beyond: float = _LOCKING,
    how: str = "displacements are far too small",
) -> None:
    """Warn whoever makes a problem of a nearly incompressible material and functions that don't suit it.

    Args:
        beyond: Poisson's ratio above which they lock.
        how: what that means.
    """
    for material in materials:
        known = material.moduli("lam", "mu")
        if len(known) < 2 or known["lam"] <= 0:
            continue
        nu = known["lam"] / (2 * (known["lam"] + known["mu"]))
        if nu > beyond:
            warn(
                f"{type(material.elastic_part).__name__}: at Poisson's ratio {nu:.6g} {functions} lock, as "
                f"they do beyond {beyond}: {how}; take {remedy}",
                TrustWarning,
            )
