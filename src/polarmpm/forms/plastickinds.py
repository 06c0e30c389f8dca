"""The same as `kinds` of what a plastic material has besides its energy."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import ufl

from ..materials.base import evaluate_scalar
from ..materials.plastic import Plastic
from ..materials.regions import LocalState, Region, YieldSurface
from .kinds import stand_ins

Entries = tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]


def of_yielding(material: Plastic, surfaces: Sequence[YieldSurface]) -> Hashable:
    """What the yield surfaces, hardening and the choice of a first region are.

    Raises:
        InputError: one of the functions has a mistake.
    """
    at, owner = stand_ins(), type(material).__name__
    wryness = at.tensor("nu") if material.micropolar else None
    chi, p = at.scalar("chi"), at.numbers(material)
    stress = at.tensor("tau"), wryness, chi, p
    found = [hardening_energy(material, chi, p)]
    for surface in surfaces:
        found += [surface.value(owner, *stress), surface.flow_potential(owner, *stress)]
        if surface.hardening is not None:
            found.append(evaluate_scalar(f"hardening of {owner}", surface.hardening, *stress))
    likely = material.first_region(*stress)
    found += [ufl.as_ufl(value) for value in likely.values()]
    names = tuple((surface.name, surface.hardening is None) for surface in surfaces)
    return names, tuple(likely), at.signature(ufl.as_vector(found))


def of_hardening(material: Plastic) -> Hashable:
    """What hardening stores."""
    at = stand_ins()
    return at.signature(hardening_energy(material, at.scalar("chi"), at.numbers(material)))


def hardening_energy(material: Plastic, chi: Any, p: Any) -> Any:
    what = f"hardening_energy of {type(material).__name__}"
    return evaluate_scalar(what, material.hardening_energy, chi, p)


def of_region(material: Plastic, region: Region, dim: int, entries: Entries) -> Hashable:
    """What a region's equations are, of a material of a known kind."""
    at, micropolar = stand_ins(), material.micropolar
    p, owner = at.numbers(material), type(material).__name__
    made = at.coefficient("multipliers", max(region.multipliers, 1))

    def standing(name: str, deformation: Any, wryness: Any) -> tuple[Any, Any]:
        """Other stresses for each place at which they are asked for."""
        stress = at.tensor(f"{name}, stress") + deformation
        if wryness is None:
            return stress, None
        return stress + wryness, at.tensor(f"{name}, couple stress") + 2.0 * wryness - deformation

    state = LocalState(
        dim=dim,
        F=at.tensor("F"),
        Q=at.tensor("Q") if micropolar else None,
        Fe_trial=at.tensor("Fe_trial"),
        Ge_trial=at.tensor("Ge_trial") if micropolar else None,
        chi_before=at.scalar("chi_before"),
        Ue=at.tensor("Ue"),
        Ge=at.tensor("Ge") if micropolar else None,
        chi=at.scalar("chi"),
        multipliers=tuple(made[k] for k in range(region.multipliers)),
        p=p,
        elastic_stress=lambda *measures: standing("elastic", *measures),
        stress_at=lambda *measures: standing("Kirchhoff", *measures),
        hardening_energy=lambda chi: hardening_energy(material, chi, p),
        entries=entries,
        owner=owner,
    )
    rows, flow = region.residual(state), region.flow(state)
    active = tuple(surface.name for surface in region.surfaces)
    signature = at.signature(ufl.as_vector([*rows, *flow]))
    return region.name, region.multipliers, active, dim, entries, len(rows), signature
