"""What a material's kernels are made of, besides the layout: its functions, evaluated at stand-ins.

A material's functions may be a script's own code. Whether those of two materials are the same is seen from
what they return: they are evaluated with coefficients in the places of strains, stresses and numbers, and the
signature of that, which is short, tells what the signature of the whole weak form would. Numbers are inputs
of the kernels; a function that branches on one, or has it in its UFL, has another signature.
"""

from __future__ import annotations

from collections.abc import Hashable
from functools import cache
from typing import Any

import ufl

from ..kernels.kernel import PointSpace, matrix, third
from ..materials.base import Material, evaluate_energy, evaluate_measures, named_parameters
from ..tools import compat
from .strains import predicts


class StandIns:
    """Coefficients in the places of what a material's functions take, made when they are asked for."""

    def __init__(self) -> None:
        self.space = PointSpace(compat.point_domain())
        self._made: dict[tuple[str, int], Any] = {}
        self._tensors: dict[str, Any] = {}

    def coefficient(self, name: str, size: int) -> Any:
        key = name, size
        if key not in self._made:
            self._made[key] = self.space.coefficient(size)
        return self._made[key]

    def tensor(self, name: str) -> Any:
        if name not in self._tensors:
            self._tensors[name] = matrix(self.coefficient(name, 9), 3, 3)
        return self._tensors[name]

    def scalar(self, name: str) -> Any:
        return self.coefficient(name, 1)[0]

    def numbers(self, material: Material) -> Any:
        return named_parameters(material, self.coefficient("p", max(len(material.parameters()), 1)))

    def signature(self, expression: Any) -> str:
        """Of UFL of the stand-ins; names tell them apart, not the order in which they were made."""
        order: dict[Any, Any] = {c: f"{name} {size}" for (name, size), c in self._made.items()}
        return compat.expression_signature(expression, {**order, self.space.domain: 0})


@cache
def stand_ins() -> StandIns:
    return StandIns()


def of_material(material: Material) -> Hashable:
    """What a material's energy is, and in which way the weak form takes it.

    Raises:
        InputError: the energy or the measures have a mistake.
    """
    at = stand_ins()
    if material.micropolar:
        strains: tuple[Any, ...] = at.tensor("E"), at.tensor("Gamma")
    else:
        second = third(at.coefficient("H", 27)) if material.second_gradient else None
        measures = evaluate_measures(material, at.tensor("F"), second)
        strains = tuple(map(ufl.variable, measures))  # the weak form derives by them first
    energy = evaluate_energy(material, strains, at.numbers(material))
    return (
        *(material.micropolar, material.isotropic, material.second_gradient, material.plastic),
        *(predicts(material), material.measure, tuple(material.parameters())),
        at.signature(energy),
    )
