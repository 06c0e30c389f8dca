"""Slots of a point's unknowns and state: today's order by hand, and packing there and back."""

from __future__ import annotations

import numpy as np
import pytest
import ufl

from polarmpm.kernels.kernel import PointSpace, compile_expressions
from polarmpm.kinematics import rotations
from polarmpm.kinematics.layout import SURFACE, Layout, Part, Slot
from polarmpm.tools import compat
from tests.conftest import COMM

LAYOUTS = [Layout(2, 0), Layout(3, 0), Layout(2, 1), Layout(3, 3)]


def numbers(expressions, coefficient, values):
    """UFL expressions of one coefficient at rows of values."""
    domain = coefficient.ufl_domain()
    return compile_expressions(expressions, {coefficient: 0}, values.shape[1], domain, COMM)(values)


def test_order_of_z():
    """(du/dx, w, dw/dx), row by row."""
    found = Layout(2, 1).slots
    assert found == (
        *(Slot("displacement", i, (j,)) for i in range(2) for j in range(2)),
        Slot("rotation", 0, ()),
        *(Slot("rotation", 0, (j,)) for j in range(2)),
    )
    assert [layout.unknowns for layout in LAYOUTS] == [4, 9, 7, 21]
    space = Layout(3, 3)
    assert space.where("rotation") == slice(9, 12)
    assert space.where("rotation", 1) == slice(12, 21)
    assert space.where("displacement") == slice(0, 0)
    assert space.gradients == [slice(k, k + 3) for k in (0, 3, 6, 12, 15, 18)]
    assert Layout(3, 3, SURFACE).where("displacement", 1) == slice(6, 15)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_packing_there_and_back(layout):
    rng, n, d, r, b = np.random.default_rng(0), 5, layout.dim, layout.rotations, layout.block
    value, gradient = rng.random((n, b)), rng.random((n, b, d))
    z = layout.pack(value, gradient)
    by_hand = [gradient[:, :d].reshape(n, -1), value[:, d:], gradient[:, d:].reshape(n, r * d)]
    np.testing.assert_array_equal(z, np.concatenate(by_hand, axis=1))
    np.testing.assert_array_equal(layout.part(z, "displacement", 1), gradient[:, :d])
    np.testing.assert_array_equal(layout.part(z, "rotation"), value[:, d:])
    np.testing.assert_array_equal(layout.part(z, "rotation", 1), gradient[:, d:])
    assert layout.pack(value[:0], gradient[:0]).shape == (0, layout.unknowns)


def test_a_second_derivative_is_another_part():
    """What a second-gradient material adds: each pair of axes once."""
    parts = (Part("displacement", 1), Part("displacement", 2))
    layout = Layout(2, 0, parts)
    assert layout.slots[4:] == tuple(
        Slot("displacement", i, axes) for i in range(2) for axes in ((0, 0), (0, 1), (1, 1))
    )
    assert Layout(3, 0, parts).unknowns == 27
    rng = np.random.default_rng(1)
    value, gradient, second = (rng.random((3, 2, *[2] * k)) for k in range(3))
    z = layout.pack(value, gradient, second)
    np.testing.assert_array_equal(layout.part(z, "displacement", 1), gradient)
    expected = second[:, :, [0, 0, 1], [0, 1, 1]]
    np.testing.assert_array_equal(layout.part(z, "displacement", 2), expected)


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_tensors_in_space(layout):
    """What UFL reads from z is three-dimensional, in plane strain too."""
    rng, n, d, r, b = np.random.default_rng(2), 3, layout.dim, layout.rotations, layout.block
    value, gradient = rng.random((n, b)), rng.random((n, b, d))
    z = PointSpace(compat.point_domain()).coefficient(layout.unknowns)
    expressions, expected = [layout.gradient(z, "displacement")], [np.zeros((n, 3, 3))]
    expected[0][:, :d, :d] = gradient[:, :d]
    if r:
        expressions += [layout.value(z, "rotation"), layout.gradient(z, "rotation")]
        expected += [np.zeros((n, 3)), np.zeros((n, 3, 3))]
        expected[1][:, 3 - r :] = value[:, d:]
        expected[2][:, 3 - r :, :d] = gradient[:, d:]
    assert all(len(e.ufl_shape) == a.ndim - 1 for e, a in zip(expressions, expected, strict=True))
    found = numbers(expressions, z, layout.pack(value, gradient))
    surface = Layout(d, r, SURFACE)
    y = PointSpace(compat.point_domain()).coefficient(surface.unknowns)
    displacement = numbers([surface.value(y, "displacement")], y, surface.pack(value, gradient))
    np.testing.assert_array_equal(displacement[:, :d], value[:, :d])
    assert not displacement[:, d:].any()
    np.testing.assert_array_equal(found, np.hstack([a.reshape(n, -1) for a in expected]))


@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_states(layout, rotated):
    """Packed by NumPy, read by UFL."""
    rng, n, d, r = np.random.default_rng(3), 4, layout.dim, layout.rotations
    frame, wryness, w = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    frame[:, :d, :d] += rng.random((n, d, d))
    wryness[:, 3 - r :, :d], w[:, 3 - r :] = rng.random((n, r, d)), rng.random((n, r))
    q, state = rotations.from_vector(w), layout.state(rotated=rotated)
    packed = state.pack(frame, wryness, q)
    sizes = {(2, 0): (4, 4), (3, 0): (9, 9), (2, 1): (8, 6), (3, 3): (22, 18)}
    assert packed.shape == (n, state.size) == (n, sizes[d, r][rotated])
    s = PointSpace(compat.point_domain()).coefficient(state.size)
    expressions, expected = [state.frame(s)], [frame]
    if r:
        expressions.append(state.wryness(s))
        expected.append(wryness)
        if not rotated:
            expressions.append(ufl.as_vector(state.quaternion(s)))
            expected.append(q)
    found = numbers(expressions, s, packed)
    np.testing.assert_array_equal(found, np.hstack([a.reshape(n, -1) for a in expected]))
    if d == 3 and not rotated:
        parts = (frame, q, wryness) if r else (frame,)
        for a, b in zip(state.unpack(packed), parts, strict=True):
            np.testing.assert_array_equal(a, b)
