"""Second-gradient elasticity: the mean of a classical energy over a micro-space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import sqrt
from typing import Any, ClassVar

import ufl

from ..errors import InputError
from ..tools import checks
from .base import Material, check_material, numbers
from .classical import SaintVenantKirchhoff
from .microspace import MicroSpace


@dataclass(frozen=True, repr=False)
class GradientElastic(Material):
    """The mean of a classical energy psi over a micro-space around each point: W(F, H).

    A micro-space has an extent l_a along each director d_a of the undeformed body. At its place
    (z_1, ..), |z_a| <= l_a / 2, the strain is that of the first order in z,

        C(z) = F^T F + sum_a z_a K_a,   K_a = F^T F,a + F,a^T F = d_a . grad(F^T F),

    and W is the mean of psi(C(z)) by Gauss' rule of two places a director, z_a = +- l_a / sqrt(12). Of
    `SaintVenantKirchhoff` it is exact: W = psi(E) + sum_a l_a^2/12 psi(E,a), with E,a = K_a / 2.

    Equal lengths along all directions of the problem, at right angles, make `SaintVenantKirchhoff` isotropic:
    it doesn't matter how the directors lie. Of other energies that holds to the second order in l.

    Args:
        elastic: a classical material, which doesn't yield.
        lengths: extents of the micro-space (m), not negative: one for each director, or one number for all.
        directors: 1 to 3 unit vectors, one a row, at any angle; the first coordinate axes by default, as many
            as there are lengths, all three for one number. In plane problems they lie in the plane; one along
            the third axis adds nothing there.
        full: C(z) = F(z)^T F(z) with F(z) = F + sum_a z_a F,a, which is positive definite however large l F,a
            is. By default where the energy is known as a function of F only (`UserEnergy`, own classes
            without `measures_of`), which is the only way there.
        normals: a director stays normal to the plane that it was normal to, n_a = cof(F) d_a / |cof(F) d_a|,
            instead of being a fibre, F d_a: n_a,J takes the place of F,a. For thin bodies.

    Raises:
        InputError: not an elastic classical material, lengths or directors that are none, or `full=False` of
            an energy that is known as a function of F only.

    Example:
        >>> rock = SaintVenantKirchhoff.from_engineering(E=20e9, nu=0.2)
        >>> GradientElastic(rock, 0.05)  # the same in all directions
        >>> GradientElastic(rock, 0.05, directors=[[0.8, 0.6]])  # fibres in one direction of a plane
    """

    elastic: Material
    lengths: float | Sequence[float]
    directors: Any = None
    full: bool | None = None
    normals: bool = False

    micropolar = False
    second_gradient = True
    stress_prediction = False  # it would double the code
    units: ClassVar[Mapping[str, str]] = {"l_1": "m", "l_2": "m", "l_3": "m"}

    def __post_init__(self) -> None:
        _check_elastic(self.elastic)
        space = MicroSpace.of(self.lengths, self.directors)
        object.__setattr__(self, "lengths", space.lengths)
        object.__setattr__(self, "directors", space.directors)
        object.__setattr__(self, "normals", checks.flag("normals", self.normals))
        known = self.elastic.measures_of(ufl.Identity(3)) is not None
        full = not known if self.full is None else checks.flag("full", self.full, or_none=True)
        if not full and not known:
            kind = type(self.elastic).__name__
            raise InputError(
                f"full = False: the energy of {kind} is known as a function of F only, not of C; leave full "
                "out, or define measures_of(C)"
            )
        object.__setattr__(self, "full", full)
        taken = sorted(set(self.elastic.parameters()) & set(self.units))
        if taken:
            raise InputError(f"elastic: it has a number called {taken[0]}, as the micro-space has")

    def __repr__(self) -> str:
        along = ", ".join(f"({', '.join(f'{c:.6g}' for c in d)})" for d in self.directors)
        kind = (", full" if self.full else "") + (", normals" if self.normals else "")
        lengths = numbers(self._named_lengths, self.units)
        return f"GradientElastic({self.elastic!r}, {lengths}, along {along}{kind})"

    # numbers --------------------------------------------------------------------------------------
    @property
    def isotropic(self) -> bool:
        return False

    @property
    def _named_lengths(self) -> dict[str, float]:
        return {f"l_{a}": length for a, length in enumerate(self._space.lengths, 1)}

    def parameters(self) -> dict[str, float]:
        """Those of the elastic material, and the lengths l_1, ... of the directors."""
        return {**self.elastic.parameters(), **self._named_lengths}

    def choices(self) -> dict[str, str | bool]:
        own: dict[str, str | bool] = {"full": bool(self.full), "normals": self.normals}
        kind = {"mean of": type(self.elastic).__qualname__, **self.elastic.choices()}
        return {**kind, **own, **self._space.described()}

    def moduli(self, *names: str) -> dict[str, float]:
        return self.elastic.moduli(*names)

    def check_dimension(self, dim: int) -> None:
        self._space.check_dimension(dim)

    # energy ---------------------------------------------------------------------------------------
    @property
    def _space(self) -> MicroSpace:
        return MicroSpace(self.lengths, self.directors)  # type: ignore[arg-type]

    @cached_property
    def _extended(self) -> list[int]:
        """Directors along which the micro-space has an extent."""
        return [a for a, length in enumerate(self._space.lengths) if length > 0]

    @property
    def _closed(self) -> bool:
        """Whether the mean is known in closed form, and lengths are inputs of the compiled code."""
        return type(self.elastic) is SaintVenantKirchhoff and not self.full

    @property
    def _places(self) -> list[tuple[float, ...]]:
        """Coordinates z of the places, along the directors that count."""
        reach = [self._space.lengths[a] / sqrt(12) for a in self._extended]
        return list(product(*((z, -z) for z in reach)))

    def measures(self, F: Any, H: Any) -> tuple[Any, ...]:
        """Strain measures of the elastic material at all places one after the other; of Saint
        Venant-Kirchhoff's E and E,a."""
        space = self._space
        fibres = space.normals(F, H) if self.normals else space.along(H)
        changes = [fibres[a] for a in self._extended]
        if not changes:
            return self.elastic.measures(F)
        if self.full:
            places = [F + _combined(z, changes) for z in self._places]
            return tuple(m for f in places for m in self.elastic.measures(f))
        C, k = ufl.dot(ufl.transpose(F), F), [2 * ufl.sym(ufl.dot(ufl.transpose(F), g)) for g in changes]
        if self._closed:
            return (*self._measures_of(C), *(c / 2 for c in k))
        # each place's strain is a measure of its own: derived by C and all K_a at once the code explodes
        return tuple(m for z in self._places for m in self._measures_of(C + _combined(z, k)))

    def _measures_of(self, C: Any) -> tuple[Any, ...]:
        found = self.elastic.measures_of(C)
        assert found is not None  # __post_init__ has asked
        return found

    def energy(self, *measures_and_parameters: Any) -> Any:
        *measures, p = measures_and_parameters
        if self._closed:
            total = self.elastic.energy(measures[0], p)
            for a, change in zip(self._extended, measures[1:], strict=True):
                total += getattr(p, f"l_{a + 1}") ** 2 / 12 * self.elastic.energy(change, p)
            return total
        places = len(self._places)
        each = len(measures) // places
        parts = [self.elastic.energy(*measures[k : k + each], p) for k in range(0, len(measures), each)]
        return sum(parts[1:], parts[0]) / places


def _combined(weights: Sequence[float], tensors: Sequence[Any]) -> Any:
    parts = [w * t for w, t in zip(weights, tensors, strict=True)]
    return sum(parts[1:], parts[0])


def _check_elastic(elastic: Any) -> None:
    """Raise InputError unless it is a classical material that neither yields nor has gradients already."""
    check_material(elastic)
    kind = type(elastic).__name__
    for wrong, what in (
        (elastic.plastic, "yields"),
        (elastic.micropolar, "is micropolar"),
        (elastic.second_gradient, "has second gradients already"),
    ):
        if wrong:
            raise InputError(
                f"elastic: {kind} {what}; a classical elastic material is needed, such as "
                "SaintVenantKirchhoff or NeoHookean"
            )
