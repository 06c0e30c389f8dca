"""Lines for graded grids: sizes, growth, places that are kept."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.geometry.axes import steepest


@pytest.mark.parametrize(
    ("options", "most"),
    [
        ({"start": 0, "stop": 5, "fine": 1 / 16, "where": (0, 1.25), "keep": [1.0]}, 40),
        ({"start": 0, "stop": 5, "fine": 1 / 16, "where": (0, 1.25), "growth": 1.3}, 33),
        (
            {
                "start": -3,
                "stop": 5,
                "fine": 0.1,
                "where": [(0, 1), (3, 3.4)],
                "keep": [0.5, 2.2],
                "coarse": 0.5,
            },
            60,
        ),
        ({"start": 0, "stop": 5, "fine": 0.1, "where": 2.0}, 26),
        ({"start": 0, "stop": 5, "fine": 0.1, "where": (1, 2), "keep": [2.03, 3]}, 80),
        ({"start": 0, "stop": 1e6, "fine": 1.0, "where": 0}, 100),
        ({"start": -1e-3, "stop": 2e-3, "fine": 7e-5, "where": [(0, 1e-4), 1e-3], "keep": [0.3e-3]}, 60),
    ],
)
def test_lines(options, most):
    a = pm.lines(**options)
    size = np.diff(a)
    assert (a[0], a[-1]) == (options["start"], options["stop"])
    assert len(size) <= most
    assert steepest(a)[0] <= options.get("growth", 1.15) * (1 + 1e-6)
    assert size.max() <= options.get("coarse", np.inf) * (1 + 1e-9)
    where = options["where"]
    for zone in where if isinstance(where, list) else [where]:
        low, high = zone if isinstance(zone, tuple) else (zone, zone)
        inside = (a[:-1] < high + 1e-9 * high) & (a[1:] > low) & (a[:-1] >= low - 1e-9 * abs(low))
        inside &= a[1:] <= high * (1 + 1e-9) if high > low else True
        assert size[inside].max(initial=0.0) <= options["fine"] * (1 + 1e-9) if high > low else True
        assert min(np.abs(a - low).min(), np.abs(a - high).min()) < 1e-12 * (1 + a[-1])
    for place in options.get("keep", []):
        assert np.abs(a - place).min() <= 1e-12 * a[-1]


def test_lines_all_fine_are_equal():
    np.testing.assert_allclose(pm.lines(0, 1, fine=0.11), np.linspace(0, 1, 11), atol=1e-15)
    assert type(pm.Grid.graded(x=pm.lines(0, 1, fine=0.1), y=pm.lines(0, 2, fine=0.2))) is pm.Grid


def test_random_lines():
    rng = np.random.default_rng(4)
    for _ in range(10):
        stop, growth = rng.uniform(0.5, 10), rng.uniform(1.1, 1.5)
        low, high = np.sort(rng.uniform(0, stop, 2))
        keep, fine = rng.uniform(0, stop, rng.integers(0, 3)), stop * 10 ** rng.uniform(-2.5, -0.5)
        a = pm.lines(0, stop, fine=fine, where=(low, high), keep=keep, growth=growth)
        size = np.diff(a)
        inside = (a[:-1] >= low - 1e-9) & (a[1:] <= high + 1e-9)
        assert size.min() > 0
        assert size[inside].max() <= fine * (1 + 1e-9)
        assert steepest(a)[0] <= growth * (1 + 1e-6)
        assert all(np.abs(a - place).min() < 1e-8 * stop for place in (*keep, low, high))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stop": 0.0}, "stop = 0"),
        ({"fine": 0.0}, "fine = 0"),
        ({"growth": 1.0}, "growth = 1"),
        ({"keep": [6.0]}, "keep = "),
        ({"keep": "x"}, "keep = "),
        ({"where": (3, 1)}, r"where = \(3, 1\)"),
        ({"where": (3, 9)}, r"where = \(3, 9\)"),
        ({"where": []}, "where = "),
        ({"coarse": 0.01}, "coarse = 0.01"),
        ({"fine": 1e-7}, "cells along an axis"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    with pytest.raises(pm.InputError, match=message):
        pm.lines(**{"start": 0.0, "stop": 5.0, "fine": 0.1, **change})
