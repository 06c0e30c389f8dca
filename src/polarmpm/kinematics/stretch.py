"""Stretch tensors of deformation gradients, and the domains that they stretch."""

from __future__ import annotations

import numpy as np


def right_stretch(F: np.ndarray) -> np.ndarray:
    """U = sqrt(F^T F) of deformation gradients (n, 3, 3)."""
    value, vector = np.linalg.eigh(np.swapaxes(F, 1, 2) @ F)
    root: np.ndarray = (vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]) @ np.swapaxes(vector, 1, 2)
    return root


def domain_half_length(F: np.ndarray, half_length0: np.ndarray) -> np.ndarray:
    """Half-lengths l_i = U_ii l_i0 (m) of domains, (n, d), T (2.56)-(2.58).

    By the theorem of Cayley and Hamilton U (i1 i2 - i3) = i1 i3 I + (i1^2 - i2) C - C^2 with C = F^T F and
    U's invariants: an eigenvector is never needed.
    """
    C = np.swapaxes(F, 1, 2) @ F
    stretch = np.sqrt(_eigenvalues(C))
    i1 = stretch.sum(axis=0)
    i2 = stretch[0] * stretch[1] + stretch[1] * stretch[2] + stretch[2] * stretch[0]
    i3 = stretch[0] * stretch[1] * stretch[2]
    axes = np.arange(half_length0.shape[1])
    square = np.einsum("nij,nij->ni", C[:, axes], C[:, axes])
    u = (i1 * i3)[:, None] + (i1**2 - i2)[:, None] * C[:, axes, axes] - square
    half_length: np.ndarray = u / (i1 * i2 - i3)[:, None] * half_length0
    return half_length


def _eigenvalues(C: np.ndarray) -> np.ndarray:
    """Eigenvalues (3, n) of positive semidefinite tensors (n, 3, 3), by the cosine of a third of an angle."""
    mean = np.trace(C, axis1=1, axis2=2) / 3
    B = C - mean[:, None, None] * np.eye(3)
    size = np.sqrt(np.einsum("nij,nij->n", B, B) / 6)
    B /= np.where(size > 0, size, 1.0)[:, None, None]
    determinant = (
        B[:, 0, 0] * (B[:, 1, 1] * B[:, 2, 2] - B[:, 1, 2] ** 2)
        - B[:, 0, 1] * (B[:, 0, 1] * B[:, 2, 2] - B[:, 1, 2] * B[:, 0, 2])
        + B[:, 0, 2] * (B[:, 0, 1] * B[:, 1, 2] - B[:, 1, 1] * B[:, 0, 2])
    )
    angle = np.arccos(np.clip(determinant / 2, -1.0, 1.0)) / 3
    third = 2 * np.pi / 3
    roots: np.ndarray = np.maximum(mean + 2 * size * np.cos([angle, angle + third, angle - third]), 0.0)
    return roots
