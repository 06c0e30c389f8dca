"""Maps in UFL against NumPy: exponential and tangent maps, and the wryness they update."""

from __future__ import annotations

import numpy as np
import pytest
import ufl

from polarmpm.kernels.kernel import PointSpace, compile_expressions
from polarmpm.kinematics import rotations
from polarmpm.kinematics import tensors as kinematics
from polarmpm.kinematics.layout import Layout
from polarmpm.kinematics.motion import Motion
from polarmpm.tools import compat
from tests.conftest import COMM, rotation


def evaluate(expression, *values: np.ndarray) -> np.ndarray:
    """A function of UFL vectors, compiled like any kernel, at rows of values."""
    space = PointSpace(compat.point_domain())
    sizes = [v.shape[1] for v in values]
    coefficients = [space.coefficient(n) for n in sizes]
    slots = dict(zip(coefficients, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
    arguments = [ufl.as_vector([c[i] for i in range(n)]) for c, n in zip(coefficients, sizes, strict=True)]
    e = expression(*arguments)
    kernel = compile_expressions([e], slots, sum(sizes), space.domain, COMM)
    return kernel(*values).reshape(-1, *e.ufl_shape)


def vectors(angle: float, n: int = 12) -> np.ndarray:
    w = np.random.default_rng(1).standard_normal((n, 3))
    return angle * w / np.linalg.norm(w, axis=1, keepdims=True)


# the series' accuracy: rounding up to pi, 1e-7 at 2 pi
ACCURACY = [
    (0.0, 1e-15),
    (1e-12, 1e-15),
    (1e-5, 1e-15),
    (0.3, 1e-15),
    (1.0, 1e-14),
    (3.14, 1e-13),
    (6.28, 1e-7),
]


@pytest.mark.parametrize(("angle", "accuracy"), ACCURACY)
def test_exponential_map(angle, accuracy):
    """exp(hat(w)) is Rodrigues' tensor, from no rotation to large ones."""
    w = vectors(angle)
    found = evaluate(kinematics.exp_map, w)
    np.testing.assert_allclose(found, [rotation(v) for v in w], rtol=0, atol=accuracy)
    np.testing.assert_allclose(
        found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (len(w), 1, 1)), atol=4 * accuracy
    )


@pytest.mark.parametrize(("angle", "accuracy"), ACCURACY)
def test_tangent_maps(angle, accuracy):
    """J_r as in NumPy, where it is checked against differences; J_l(w) = J_r(-w) = exp(hat(w)) J_r(w)."""
    w = vectors(angle)
    right = evaluate(kinematics.right_tangent, w)
    np.testing.assert_allclose(right, rotations.right_tangent(w), rtol=0, atol=accuracy + 1e-14)
    left = evaluate(kinematics.left_tangent, w)
    np.testing.assert_allclose(
        left, np.array([rotation(v) for v in w]) @ right, rtol=0, atol=4 * accuracy + 1e-14
    )


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.7, 3.0])
def test_derivative_of_the_exponential_map(angle):
    """UFL's derivative of exp(hat(w)) is exp(hat(w)) hat(J_r(w) dw), also where the angle is zero."""
    w, dw = vectors(angle), vectors(1.0)[::-1].copy()

    def derivative(a, b):
        v = ufl.variable(a)
        d = ufl.diff(kinematics.exp_map(v), v)
        i, j, k = ufl.indices(3)
        return ufl.as_tensor(d[i, j, k] * b[k], (i, j))

    def product(a, b):
        return ufl.dot(kinematics.exp_map(a), kinematics.hat(ufl.dot(kinematics.right_tangent(a), b)))

    np.testing.assert_allclose(evaluate(derivative, w, dw), evaluate(product, w, dw), atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-9, -0.4, 3.1, -3.1])
def test_plane_exponential_map(angle):
    """The in-plane map is the spatial one about the third axis."""
    found = evaluate(lambda a: kinematics.plane_exp_map(a[0]), np.array([[angle]]))
    np.testing.assert_allclose(found[0], rotation([0, 0, angle]), atol=1e-13)


def test_quaternion_tensor():
    """T (3.168), as in NumPy."""
    q = rotations.from_vector(vectors(2.5))
    np.testing.assert_allclose(evaluate(kinematics.quaternion_tensor, q), rotations.to_tensor(q), atol=1e-15)


def test_plane_tensors():
    """Plane strain: unit stretch out of plane, gradients without it, the wryness in the third row."""
    a = np.arange(1.0, 5.0)[None]

    def square(v):
        return ((v[0], v[1]), (v[2], v[3]))

    stretch = evaluate(lambda v: kinematics.plane_tensor(ufl.as_tensor(square(v))), a)[0]
    np.testing.assert_array_equal(stretch, [[1, 2, 0], [3, 4, 0], [0, 0, 1]])
    gradient = evaluate(lambda v: kinematics.plane_gradient(ufl.as_tensor(square(v))), a)[0]
    np.testing.assert_array_equal(gradient, [[1, 2, 0], [3, 4, 0], [0, 0, 0]])
    wryness = evaluate(lambda v: kinematics.plane_wryness(v), a[:, :2])[0]
    np.testing.assert_array_equal(wryness, [[0, 0, 0], [0, 0, 0], [1, 2, 0]])


def test_wryness_of_a_field_of_rotations():
    """Gamma = axial(Q^T dQ/dX) of Q(X) = exp(hat(w(X))) Q~(X) is Gamma~ + Q~^T J_r(w) dw/dx~ F~.

    The right-hand side is how points are updated; the left-hand side is taken with differences in X.
    """
    rng = np.random.default_rng(2)
    A, B = rng.uniform(-0.5, 0.5, (2, 3, 3))  # gradients of the old rotation vector in X, of w in x~
    F = np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
    old, new = np.array([0.4, -0.8, 0.3]), np.array([-0.5, 0.2, 0.9])

    def Q_old(X):
        return rotation(old + A @ X)

    def Q(X):
        return rotation(new + B @ F @ X) @ Q_old(X)

    def wryness(field, h=1e-6):
        columns = []
        for j in range(3):
            e = h * np.eye(3)[j]
            spin = field(np.zeros(3)).T @ (field(e) - field(-e)) / (2 * h)
            columns.append([spin[2, 1], spin[0, 2], spin[1, 0]])
        return np.array(columns).T

    J = evaluate(kinematics.right_tangent, new[None])[0]
    updated = wryness(Q_old) + rotation(old).T @ J @ B @ F
    np.testing.assert_allclose(wryness(Q), updated, atol=1e-9)


@pytest.mark.parametrize("layout", [Layout(2, 0), Layout(3, 0), Layout(2, 1), Layout(3, 3)])
def test_motion_against_numpy(layout):
    """Update of F, Q and Gamma by increments against quaternions and tangent maps in NumPy."""
    rng, n, d, r = np.random.default_rng(4), 11, layout.dim, layout.rotations
    F = np.tile(np.eye(3), (n, 1, 1))
    F[:, :d, :d] += 0.2 * rng.standard_normal((n, d, d))
    h, w, k = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3))
    h[:, :d, :d] = rng.standard_normal((n, d, d))
    w[:, 3 - r :] = rng.standard_normal((n, r))
    k[:, 3 - r :, :d] = rng.standard_normal((n, r, d))
    turn = np.zeros((n, 3))
    turn[:, 3 - r :] = 2.0 * rng.standard_normal((n, r))
    q, gamma = rotations.from_vector(turn), np.zeros((n, 3, 3))
    gamma[:, 3 - r :, :d] = rng.standard_normal((n, r, d))
    z = np.hstack([h[:, :d, :d].reshape(n, -1), w[:, 3 - r :], k[:, 3 - r :, :d].reshape(n, -1)])
    state = (F, q, gamma) if r else (F,)
    found = Motion(layout, COMM)(state, z)
    back = np.swapaxes(rotations.to_tensor(q), 1, 2)
    expected = [
        (np.eye(3) + h) @ F,
        rotations.multiply(rotations.from_vector(w), q),
        gamma + back @ rotations.right_tangent(w) @ k @ F,
    ]
    for a, b in zip(found, expected, strict=False):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * abs(b).max())
    if r:
        np.testing.assert_allclose(np.linalg.norm(found[1], axis=1), 1.0, rtol=0, atol=4e-16)
    gradients = np.concatenate([(h @ F)[:, :d, :d], (k @ F)[:, 3 - r :, :d]], axis=1)
    by_reference = layout.pack(np.hstack([np.zeros((n, d)), w[:, 3 - r :]]), gradients)
    for a, b in zip(Motion(layout, COMM, by_reference=True)(state, by_reference), found, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14 * abs(b).max())


@pytest.mark.parametrize("d", [2, 3])
def test_cofactor(d):
    """det F F^-T, and without a division also where F is singular."""
    rng = np.random.default_rng(5)
    F = np.eye(d) + rng.uniform(-0.4, 0.4, (9, d, d))

    def cofactor(f):
        return kinematics.cofactor(ufl.as_tensor([[f[d * i + j] for j in range(d)] for i in range(d)]))

    expected = np.linalg.det(F)[:, None, None] * np.swapaxes(np.linalg.inv(F), 1, 2)
    np.testing.assert_allclose(evaluate(cofactor, F.reshape(9, -1)), expected, rtol=0, atol=1e-14)
    flat = np.diag([2.0, 3.0, 0.0][3 - d :])
    np.testing.assert_array_equal(evaluate(cofactor, flat.reshape(1, -1))[0].trace(), [3.0, 6.0][d - 2])


def test_work_of_a_couple():
    """m . J_l(w) dw; in a plane the rotation increment is the spin."""
    m, w, dw = vectors(1.5), vectors(0.8)[::-1].copy(), vectors(1.0)[:, ::-1].copy()
    found = evaluate(lambda *a: ufl.as_vector([kinematics.couple_work(*a)]), m, w, dw)[:, 0]
    spin = np.einsum("nij,nj->ni", rotations.right_tangent(-w), dw)
    np.testing.assert_allclose(found, np.sum(m * spin, axis=1), rtol=0, atol=1e-14)
    plane = evaluate(lambda *a: ufl.as_vector([kinematics.couple_work(*a)]), m[:, :1], w[:, :1], dw[:, :1])
    np.testing.assert_array_equal(plane, m[:, :1] * dw[:, :1])


def test_turned_quaternions():
    """In space, in the plane, and where nothing turns."""
    w, q = vectors(0.7), rotations.from_vector(vectors(2.0)[::-1])
    expected = rotations.multiply(rotations.from_vector(w), q)
    np.testing.assert_allclose(rotations.turned(q, w), expected, rtol=0, atol=1e-15)
    plane = rotations.from_vector(np.pad(w[:, :1], ((0, 0), (2, 0))))
    found = rotations.turned(rotations.identity(len(w)), w[:, :1])
    np.testing.assert_allclose(found, plane, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(rotations.turned(q, w[:, :0]), q)
