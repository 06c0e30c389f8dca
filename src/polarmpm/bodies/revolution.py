"""Bodies of revolution: x is the radius, y runs along the axis, and all sums are over a whole turn."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..materials.base import Material


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


def turned(volume: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Volumes (n,) (m^3) of rings with areas (m^2) whose centroids are at x (n, 2): Pappus."""
    volumes: np.ndarray = 2.0 * np.pi * volume * x[:, 0]
    return volumes


def rings(x: np.ndarray, area: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids (n, 2), volumes (n,) and half axes (n, 2, 2) of what boxes become by a turn.

    A box has more of its volume outside: its centroid moves outward, and its second moment about that is
    less.

    Args:
        x, area, axes: centroids, areas and half axes of the boxes in the plane, see `Points.half_axes0`.
    """
    # (1 - s p p^T) a has the squares a^T a - 3 m m^T: those about the centroid, which moves by m
    p = axes[:, :, 0] / (np.sqrt(3.0) * x[:, :1])
    square = np.minimum(np.sum(p**2, axis=1), 1.0)
    s = (1.0 - np.sqrt(1.0 - square)) / np.where(square > 0.0, square, 1.0)
    moved = np.einsum("nk,nki->ni", p, axes)
    less = np.einsum("n,nk,ni->nki", s, p, moved)
    return x + moved / np.sqrt(3.0), turned(area, x), axes - less
