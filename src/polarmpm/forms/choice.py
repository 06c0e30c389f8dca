"""The form of a material: which of the elastic and the plastic one it needs."""

from __future__ import annotations

from ..materials.base import Material
from .points import PointForm
from .projected import ProjectedForm


def make_form(material: Material, dim: int, axial: bool = False) -> PointForm:
    """The form of an elastic or a plastic material at points in `dim` dimensions; `axial`: of a body of
    revolution."""
    if not material.plastic:
        return PointForm(material, dim, axial)
    from .plastic import PlasticForm  # lazy import: elastic scenes need no plasticity

    return PlasticForm(material, dim, axial)


def make_projected(
    material: Material,
    dim: int,
    axial: bool = False,
    *,
    rotation: bool = False,
    stabilisation: float = 0.0,
) -> ProjectedForm:
    """The same with projected scalars, see `ProjectedForm`."""
    if not material.plastic:
        return ProjectedForm(material, dim, axial, rotation=rotation, stabilisation=stabilisation)
    from .projectedplastic import ProjectedPlasticForm  # lazy import: elastic scenes need no plasticity

    return ProjectedPlasticForm(material, dim, axial, rotation=rotation, stabilisation=stabilisation)
