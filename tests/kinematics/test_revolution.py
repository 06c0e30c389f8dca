"""Bodies of revolution: deformation gradient and wryness in the plane of the radius and the axis are those of
the body in space."""

from __future__ import annotations

import numpy as np
import pytest

from polarmpm.kinematics import rotations
from polarmpm.kinematics.layout import AXIAL, Layout
from polarmpm.kinematics.motion import Motion
from tests.conftest import COMM, rotation

PLACE, H = np.array([0.7, 0.4]), 1e-5  # radius and height; step of differences
# the axes of the plane and across it, (r, z, -hoop), in space at the angle zero
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T


def displacement(s):
    r, z = s
    return np.array([0.3 * r + 0.1 * r**2 * z, -0.2 * z + 0.15 * r**2])


def angle(s):
    """About the third axis."""
    r, z = s
    return 0.9 * r + 0.3 * r * z


def gradient(f, s):
    return np.stack([(f(s + h) - f(s - h)) / (2 * H) for h in H * np.eye(2)], axis=-1)


def in_space(x):
    """Place and microrotation of the body of revolution at a point of space."""
    r, s = np.hypot(x[0], x[1]), np.array([np.hypot(x[0], x[1]), x[2]])
    radial = np.array([x[0], x[1], 0.0]) / r
    u, hoop = displacement(s), np.array([-radial[1], radial[0], 0.0])
    return x + u[0] * radial + np.array([0.0, 0.0, u[1]]), rotation(-angle(s) * hoop)


def measures_in_space():
    """F, Q and the wryness by differences, in the axes of the plane."""
    x = np.array([PLACE[0], 0.0, PLACE[1]])
    Q, F, wryness = in_space(x)[1], np.empty((3, 3)), np.empty((3, 3))
    for k, h in enumerate(H * np.eye(3)):
        (up, more), (down, less) = in_space(x + h), in_space(x - h)
        F[:, k] = (up - down) / (2 * H)
        spin = Q.T @ (more - less) / (2 * H)
        wryness[:, k] = [spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]
    return tuple(AXES.T @ m @ AXES for m in (F, Q, wryness / 2))


@pytest.mark.parametrize("rotations_there", [0, 1])
def test_two_increments_make_the_state_of_the_body_in_space(rotations_there):
    """By X, and then by x of half of the motion."""
    layout = Layout(2, rotations_there, AXIAL)
    F, q, wryness = np.eye(3)[None], rotations.identity(1), np.zeros((1, 3, 3))
    grad, turn, bend = gradient(displacement, PLACE), angle(PLACE), gradient(angle, PLACE)
    x = PLACE.copy()
    for share, left in ((0.5, 1.0), (0.5, 0.5)):
        by = share * (grad if left == 1.0 else grad @ np.linalg.inv(np.eye(2) + 0.5 * grad))
        bent = share * (bend if left == 1.0 else bend @ np.linalg.inv(np.eye(2) + 0.5 * grad))
        u = 0.5 * displacement(PLACE)
        values = np.array([[*u, 0.5 * turn][: layout.block]])
        z = layout.pack(values, np.array([np.vstack([by, bent])[: layout.block]]))
        state = (F, q, wryness) if rotations_there else (F,)
        moved = Motion(layout, COMM)(state, np.column_stack([z, [1.0 / x[0]]]))
        F, q, wryness = moved if rotations_there else (*moved, q, wryness)
        x = x + u
    expected = measures_in_space()
    np.testing.assert_allclose(F[0], expected[0], atol=1e-8)
    if rotations_there:
        np.testing.assert_allclose(rotations.to_tensor(q)[0], expected[1], atol=1e-12)
        np.testing.assert_allclose(wryness[0], expected[2], atol=1e-8)
