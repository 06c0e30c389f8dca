"""Quaternions and rotation vectors of many points."""

from __future__ import annotations

import numpy as np
import pytest

from polarmpm.kinematics import rotations
from tests.conftest import rotation

ANGLES = [0.0, 1e-14, 1e-9, 1e-4, 0.05, 1.0, 3.0, np.pi - 1e-9, np.pi, np.pi + 1e-3, 5.0, 2 * np.pi - 1e-3]


def vectors(angle: float, n: int = 20) -> np.ndarray:
    w = np.random.default_rng(0).standard_normal((n, 3))
    w[:3] = np.eye(3)
    return angle * w / np.linalg.norm(w, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_vector_quaternion_tensor(angle):
    """T (3.168), (3.170), (3.171): unit quaternions, Rodrigues' tensor, and back to the same vector."""
    w = vectors(angle)
    q = rotations.from_vector(w)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(rotations.to_tensor(q), [rotation(v) for v in w], atol=1e-14)
    np.testing.assert_allclose(rotations.to_vector(q), w, atol=1e-14 + 1e-12 * angle)


def test_composition():
    """A product is first the right rotation, then the left one; the conjugate undoes a rotation."""
    a, b = rotations.from_vector(vectors(1.3)), rotations.from_vector(vectors(2.2)[::-1])
    product = rotations.to_tensor(a) @ rotations.to_tensor(b)
    np.testing.assert_allclose(rotations.to_tensor(rotations.multiply(a, b)), product, atol=1e-14)
    np.testing.assert_allclose(
        rotations.multiply(a, rotations.conjugate(a)), rotations.identity(20), atol=1e-15
    )


def test_a_history_passes_pi_and_stays_a_rotation():
    """A thousand increments past a half turn: the vector is continuous and the quaternion of unit length."""
    axis = np.array([[2.0, -1.0, 2.0]]) / 3
    q, step = rotations.identity(1), rotations.from_vector(axis * 6.0 / 1000)
    for k in range(1, 1001):
        q = rotations.normalise(rotations.multiply(step, q))
        np.testing.assert_allclose(rotations.to_vector(q), axis * 6.0 * k / 1000, atol=1e-11)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)


def test_no_rotation_at_a_full_turn():
    """q = -1 has no axis; the result is finite."""
    w = rotations.to_vector(-rotations.identity(2))
    assert np.all(np.isfinite(w))


@pytest.mark.parametrize("angle", [*ANGLES, 0.0499, 0.0501])
def test_right_tangent(angle):
    """J_r(w) dw is the axial vector of exp(hat(w))^T d exp(hat(w)): the identity that Gamma's update uses."""
    w, h = vectors(angle), 1e-6
    J = rotations.right_tangent(w)
    for p in range(len(w)):
        for j in range(3):
            dw = h * np.eye(3)[j]
            spin = rotation(w[p]).T @ (rotation(w[p] + dw) - rotation(w[p] - dw)) / (2 * h)
            axial = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            np.testing.assert_allclose(J[p, :, j], axial, atol=2e-9)


def test_right_tangent_has_no_step_where_its_series_ends():
    """Both sides of the angle at which the formula is changed agree to rounding."""
    below, above = (rotations.right_tangent(vectors(0.05 + d)) for d in (-1e-13, 1e-13))
    np.testing.assert_allclose(below, above, atol=1e-12)


def test_relative_vector():
    """The shortest rotation from one orientation to another; equal orientations a turn apart give none."""
    a, b = vectors(2.9), vectors(1.7)[::-1]
    w = rotations.relative_vector(a, b)
    assert np.linalg.norm(w, axis=1).max() <= np.pi + 1e-12
    for p in range(len(w)):
        np.testing.assert_allclose(rotation(w[p]) @ rotation(b[p]), rotation(a[p]), atol=1e-13)
    axis = vectors(1.0)
    np.testing.assert_allclose(
        rotations.relative_vector(axis * (2 * np.pi + 0.1), axis * 0.3), -0.2 * axis, atol=1e-13
    )


def test_no_points():
    """A rank without points calls all of them with empty arrays."""
    q, w = rotations.identity(0), np.zeros((0, 3))
    assert rotations.to_tensor(rotations.normalise(q)).shape == (0, 3, 3)
    assert rotations.to_vector(q).shape == rotations.relative_vector(w, w).shape == (0, 3)
    assert rotations.right_tangent(w).shape == (0, 3, 3)


@pytest.mark.parametrize("dim", [2, 3])
def test_determinant(dim):
    a = np.random.default_rng(dim).normal(size=(50, dim, dim))
    a[0, 0] = a[0, 1]  # singular
    np.testing.assert_allclose(rotations.determinant(a), np.linalg.det(a), rtol=1e-12, atol=1e-14)
