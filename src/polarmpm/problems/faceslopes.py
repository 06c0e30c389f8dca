"""Finite elements with second gradients: their forms, and slopes that supports hold on facets."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..conditions.supports import Support
from ..errors import InputError
from ..forms.elementkernels import NativeElementForms
from ..forms.elements import ElementForms
from ..geometry.planes import PlaneSpec
from ..tools.checks import shown
from .locking import forms_of_elements


def make_forms(elements: Elements, slope_penalty: float, assembly: str, locking: str | None) -> ElementForms:
    """The forms that the materials of a body need, for one of `elements.ASSEMBLIES`."""
    if any(m.second_gradient for m in elements.points.materials):
        from ..forms.gradientelements import GradientForms  # lazy import: others need none of it

        return GradientForms(elements, slope_penalty)
    if assembly == "native":
        return NativeElementForms(elements, forms_of_elements(locking, elements))
    if not elements.points.plastic:
        return ElementForms(elements)
    from ..forms.plasticelements import PlasticElementForms  # lazy import: elastic scenes need no plasticity

    return PlasticElementForms(elements)


def hold(elements: Elements, forms: ElementForms, where: Any, support: Support, even: dict[int, bool]) -> Any:
    """What holds the slopes of some columns on facets at zero; None where a plane of symmetry says nothing of
    slopes. Collective.

    Args:
        even: as of `Conditions._tie`; columns that are odd are left alone.

    Raises:
        InputError: nothing of the body resists slopes, or has facets there.
    """
    gradient = any(material.second_gradient for material in elements.points.materials)
    if not gradient:
        if all(even.values()):
            raise InputError(
                f"{support.name}: slope = 0: none of the body's materials has second gradients; nothing in "
                "it resists a slope"
            )
        return None
    try:
        facets = elements.facets(where)
        return forms.slopes(facets, [column for column, same in even.items() if same])
    except InputError as e:
        raise InputError(f"{support.name}: slopes are held on facets of the boundary; {e}") from None


def normal_axis(elements: Elements, where: Any) -> int:
    """The axis along which the normals of facets of a plane of symmetry are. Collective.

    Raises:
        InputError: they are along none, or along several.
    """
    if isinstance(where, PlaneSpec):
        return where.axis
    if not isinstance(where, str | int | np.integer | Facets) or isinstance(where, bool):
        raise InputError(
            f"symmetry: where = {shown(where)}: a plane, such as plane(x=0.0), or facets are needed"
        )
    normals = np.abs(elements.surface(where).normal)  # every rank has all of them
    axis = int(np.argmax(normals.sum(axis=0)))
    if np.any(normals[:, axis] < 1 - 1e-9):
        raise InputError(
            f"symmetry: {elements.facets(where).name}: their normals aren't all along one axis; planes of "
            "symmetry are normal to x, y or z"
        )
    return axis
