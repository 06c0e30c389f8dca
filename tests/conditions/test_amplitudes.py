"""What functions of the load factor may give."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.conditions.amplitudes import Amplitude

X = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda t: (t, 2), [[1, 2]] * 3),
        (lambda t: np.array([1, 2], dtype=np.int8), [[1, 2]] * 3),
        (lambda t: [np.float32(1), np.int64(2)], [[1, 2]] * 3),
        (lambda t: 0, [[0, 0]] * 3),
        (lambda t, X: X, X),
        (lambda t, X: (1, 2), [[1, 2]] * 3),
        (lambda t, X: X[:1], X[:1].repeat(3, axis=0)),
        (lambda t, X=None: (1, 2), [[1, 2]] * 3),
        (lambda *t: (1, 2), [[1, 2]] * 3),
    ],
)
def test_values(function: Any, expected: Any):
    np.testing.assert_array_equal(Amplitude("force", function, 2).at(1.0, X), np.array(expected, dtype=float))


@pytest.mark.parametrize(
    "function",
    [
        lambda: (0.0, 0.0),
        lambda t, X, Y: (0.0, 0.0),
        lambda *, t: (0.0, 0.0),
        lambda t: None,
        lambda t: "12",
        lambda t: ("1", "2"),
        lambda t: (1j, 0),
        lambda t: np.zeros(2, dtype=complex),
        lambda t: (True, False),
        lambda t: (1.0, np.nan),
        lambda t: (1.0, np.inf),
        lambda t: (1.0, 2.0, 3.0),
        lambda t: [1.0],
        lambda t: [[1.0], [2.0, 3.0]],
        lambda t: 5.0,
        lambda t, X: X[:, :1],
        lambda t, X: X[:, 0],
        lambda t, X: X[:-1],
        lambda t, X: X[None].repeat(2, axis=0),
        lambda t, X: X * 1j,
        lambda t, X: X > 0,
    ],
)
def test_what_is_no_value(function: Any):
    with pytest.raises(pm.InputError, match="load 1, force"):
        Amplitude("load 1, force", function, 2).at(1.0, X)


@pytest.mark.parametrize(
    "value",
    [None, "1", True, 1j, (1, 2, 3), [[1, 2]], [1, None], {}, np.nan, (0, np.inf), 1.0, np.array(["a", "b"])],
)
def test_what_is_no_constant(value: Any):
    with pytest.raises(pm.InputError, match="load 1, force"):
        Amplitude("load 1, force", value, 2)


def test_positions_are_a_copy():
    """A function may do with them what it likes."""

    def spoils(t: float, x: np.ndarray) -> np.ndarray:
        x[:] = np.nan
        return np.zeros(2)

    before = X.copy()
    Amplitude("force", spoils, 2).at(1.0, X)
    np.testing.assert_array_equal(X, before)
