"""Bodies of revolution: x is the radius, y runs along the axis, and all sums are over a whole turn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..materials.base import Material

_ROUNDING = 1e-9  # of the size of a mesh


def check_axisymmetric(x: np.ndarray, material: Material) -> None:
    """Raise InputError for points (n, d) or a material that a body of revolution can't have."""
    if x.shape[1] != 2:
        raise InputError(
            f"axisymmetric = True: the body has {x.shape[1]} dimensions; one of revolution is given by its "
            "section in the plane, x the radius and y along the axis"
        )
    if len(x) and not x[:, 0].min() > 0.0:
        raise InputError(
            f"axisymmetric = True: a point at the radius x = {x[:, 0].min():g}; the axis is x = 0, and all "
            "points are at x > 0"
        )
    if material.second_gradient:
        raise InputError(
            f"axisymmetric = True: {type(material).__name__} has second gradients; bodies of revolution are "
            "of classical or micropolar materials"
        )


def check_section(x: np.ndarray, materials: Sequence[Material]) -> None:
    """The same for a mesh's nodes (n, d), which may lie on the axis."""
    size = float(np.abs(x).max(initial=0.0))
    beyond = x[:, 0] < -_ROUNDING * size
    if np.any(beyond) and x.shape[1] == 2:
        raise InputError(
            f"axisymmetric = True: the mesh has a node at x = {x[:, 0].min():g}; the axis is x = 0, "
            "and the mesh is at x >= 0"
        )
    for material in materials:
        check_axisymmetric(np.maximum(x, _ROUNDING * size) if x.shape[1] == 2 else x, material)


def turned(volume: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Volumes (n,) (m^3) of rings with areas (m^2) whose centroids are at x (n, 2): Pappus."""
    volumes: np.ndarray = 2.0 * np.pi * volume * x[:, 0]
    return volumes
