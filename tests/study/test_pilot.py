"""Lines from a pilot run."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.geometry.axes import steepest
from polarmpm.study.pilot import indicator
from tests.conftest import NEO_HOOKEAN


def pressed(grid: pm.Grid) -> pm.QuasiStatic:
    """A block that is pressed down near its corner."""
    points = pm.seed(grid, material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, reset=None)
    for x in (0.0, 4.0):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 4 - 1e-6), ux=0, uy=-0.02)
    return problem


def force(problem: pm.QuasiStatic) -> float:
    list(problem.march(1, progress=False))
    return float(problem.reaction(problem.supports[-1]).force[1])


def test_a_pilot_finds_where_it_matters():
    pilot = pressed(pm.Grid.box((0, 0), (4, 4), 0.5))
    with pytest.raises(pm.InputError, match="has made no step"):
        pm.lines_from(pilot, cells=20, fine=0.05)
    force(pilot)
    found = indicator(pilot)
    for name, near, far in (("x", 1.0, 3.0), ("y", 3.5, 1.0)):
        assert np.interp(near, *found[name]) > 3 * np.interp(far, *found[name])
    lines = pm.lines_from(pilot, cells=(20, 18), fine=0.05, keep={"x": [1.0]})
    for name, cells in (("x", 20), ("y", 18)):
        a = lines[name]
        assert abs(len(a) - 1 - cells) <= 3
        assert steepest(a)[0] <= 1.15 * (1 + 1e-6)
        assert np.diff(a).min() >= 0.045
    assert np.abs(lines["x"] - 1).min() < 1e-12
    near = np.diff(lines["x"])[np.searchsorted(lines["x"], 1.0) - 1]
    assert near < 0.6 * np.diff(lines["x"]).max()
    uniform = pressed(pm.Grid.box((0, 0), (4, 4), 0.125))
    graded = pressed(pm.Grid.graded(**lines))
    assert force(graded) == pytest.approx(force(uniform), rel=0.02)
    assert graded.system.nodes.total < 0.45 * uniform.system.nodes.total


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cells": 0}, "cells = 0"),
        ({"fine": -1.0}, "fine = -1"),
        ({"cells": (3, 4, 5)}, "cells = "),
        ({"keep": {"z": [1]}}, "keep = "),
        ({"keep": {"x": [9.0]}}, "keep x = "),
        ({"growth": 0.9}, "growth = 0.9"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    pilot = pressed(pm.Grid.box((0, 0), (4, 4), 1.0))
    force(pilot)
    with pytest.raises(pm.InputError, match=message):
        pm.lines_from(pilot, **{"cells": 10, "fine": 0.1, **options})


def test_elements_are_no_pilot():
    with pytest.raises(pm.InputError, match="pilot = "):
        pm.lines_from("run", cells=3, fine=0.1)
