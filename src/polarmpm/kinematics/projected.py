"""Stiff scalars of a deformation, and deformations in which they are replaced, in UFL (docs/theory.md).

A deformation takes on other values of its volume, its spherical part or its relative rotation while all else
of it stays. The scalars are those that lock: their averages over patches of points stand for them.
"""

from __future__ import annotations

from typing import Any

import ufl

from .tensors import hat


def _block(dim: int) -> Any:
    """Identity on the first `dim` axes."""
    return ufl.as_tensor([[1.0 if i == j < dim else 0.0 for j in range(3)] for i in range(3)])


def with_log_volume(F: Any, gain: Any, dim: int) -> Any:
    """F with a ln det F that is larger by `gain`; in the plane by the block in the plane alone."""
    factor = ufl.exp(gain / dim)
    rows = [[F[i, j] * factor if i < dim and j < dim else F[i, j] for j in range(3)] for i in range(3)]
    return ufl.as_tensor(rows)


def relative_rotation(U: Any) -> Any:
    """Tangent of the angle in the plane by which Q^T F turns."""
    return (U[1, 0] - U[0, 1]) / (U[0, 0] + U[1, 1])


def with_relative_rotation(U: Any, gain: Any) -> Any:
    """U turned in the plane so that its `relative_rotation` is larger by `gain`; U^T U stays."""
    even, odd = U[0, 0] + U[1, 1], U[1, 0] - U[0, 1]
    tangent = odd / even + gain
    length = ufl.sqrt((1 + tangent * tangent) * (even * even + odd * odd))
    cos, sin = (even + tangent * odd) / length, (tangent * even - odd) / length
    return ufl.dot(ufl.as_tensor(((cos, -sin, 0), (sin, cos, 0), (0, 0, 1))), U)


def with_volume_and_skew(U: Any, logarithm: Any, turn: Any) -> Any:
    """U with another skew part, that of the axial vector `turn`, and then a ln det that is `logarithm` by a
    factor to all of it."""
    changed = ufl.sym(U) + hat(turn)
    return changed * ufl.exp((logarithm - ufl.ln(ufl.det(changed))) / 3)


def axial(E: Any) -> Any:
    """Vector of the skew part of a tensor, skw E = hat(axial(E))."""
    return ufl.as_vector([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2


def with_spherical_and_skew(E: Any, gain: Any, turn: Any, dim: int) -> Any:
    """E with a trace that is larger by `gain` on its first `dim` axes, and an axial vector larger by `turn`
    (three components; None: as it is)."""
    changed = E + gain / dim * _block(dim)
    return changed if turn is None else changed + hat(turn)
