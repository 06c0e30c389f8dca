"""Moments of inertia of microrotations that aren't alike in all directions, as a user gives them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..bodies.points import Points
from ..tools import checks

_ROUND = 1e-9  # of a tensor's largest component: how symmetric it has to be


def is_tensor(given: Any) -> bool:
    """Whether `microinertia` is given as tensors: (3, 3), one a material, or a function that gives them."""
    if callable(given):
        with checks.evaluating("microinertia"):
            return np.ndim(given(np.zeros((2, 3)))) == 3
    if isinstance(given, Mapping):
        return any(np.ndim(value) == 2 for value in given.values())
    if checks.several(given):
        return any(np.ndim(value) for value in given)
    return False


def of_points(name: str, given: Any, points: Points) -> np.ndarray:
    """Tensors (np, 3, 3) of the local points, symmetric and positive.

    Raises:
        InputError: values of other shapes, or no moments of inertia.
    """
    materials, n = points.materials, len(points)
    if callable(given):
        values = checks.numeric(name, checks.function(name, given, takes=("positions",))(points.X.copy()))
        if values.shape != (n, 3, 3):
            raise checks.refuse(name, values, f"tensors ({n}, 3, 3) are needed")
        return _checked(name, values)
    if isinstance(given, Mapping):
        if set(given) != set(materials):
            raise checks.refuse(name, given, "one value for each of the body's materials")
        of_material = [given[m] for m in materials]
    elif np.shape(given) == (3, 3):
        of_material = [given] * len(materials)
    else:
        of_material = list(checks.sequence(name, given, len(materials), "tensors (3, 3), one a material,"))
    tensors = np.stack([_tensor(name, one) for one in of_material])
    found: np.ndarray = _checked(name, tensors)[points.material]
    return found


def _tensor(name: str, value: Any) -> np.ndarray:
    found = checks.numeric(name, value)
    if found.shape not in ((), (3, 3)):
        raise checks.refuse(name, value, "a number or a tensor (3, 3) is needed")
    tensor: np.ndarray = found if found.ndim else found * np.eye(3)
    return tensor


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    size = np.abs(values).max(axis=(1, 2), initial=0.0)
    uneven = np.abs(values - np.swapaxes(values, 1, 2)).max(axis=(1, 2), initial=0.0)
    bad = ~np.isfinite(values).all(axis=(1, 2)) | ~(uneven <= _ROUND * size)
    if not bad.any() and len(values):
        principal = np.linalg.eigvalsh(values)
        bad = ~(principal[:, 0] > 0.0) | (principal[:, 2] > (principal[:, :2].sum(axis=1)) * (1.0 + _ROUND))
    if bad.any():
        allowed = "symmetric, positive, and no principal moment more than the sum of the others, is needed"
        raise checks.refuse(name, values[np.argmax(bad)].tolist(), allowed)
    return values
