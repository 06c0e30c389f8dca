"""Hooks into a run, and decisions that another run replays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import MICROPOLAR, assert_repeated, beam, by_id
from tests.helpers.bodies import box


class Log(pm.Observer):
    """What was heard, with what could be seen then."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, float]] = []

    def after_reset(self, problem: Any) -> None:
        assert np.abs(problem.system.x).max(initial=0.0) == 0.0
        self.heard.append(("reset", problem.progress.factor))

    def after_convergence(self, problem: Any, factor: float) -> None:
        assert problem.progress.factor < factor
        self.heard.append(("convergence", factor))

    def after_commit(self, problem: Any, rebased: bool) -> None:
        self.heard.append(("rebased" if rebased else "commit", problem.progress.factor))


def bent(**options: Any) -> Any:
    problem = beam(2, basis="mpm", **options)
    problem.load(problem.points.farthest((1.0, 0.0)), force=(0.0, -40.0), couple=-30.0)
    return problem


def test_points():
    problem, log = bent(reset=2, balanced_reset=True), Log()
    problem.observers.append(log)
    list(problem.march(3, to=0.75, progress=False))
    assert log.heard == [
        *(("reset", 0.0), ("convergence", 0.25), ("commit", 0.25), ("convergence", 0.5), ("commit", 0.5)),
        *(("reset", 0.5), ("convergence", 0.75), ("commit", 0.75)),
    ]


def test_elements():
    problem = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (3, 2)), material=MICROPOLAR))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.traction(pm.plane(x=1.0), force=(0.0, 30.0))
    log = Log()
    problem.observers.append(log)
    list(problem.march(2, progress=False))
    each = [[("convergence", t), ("reset", t), ("rebased", t)] for t in (0.5, 1.0)]
    assert log.heard == each[0] + each[1]


class Replayed:
    """Resets where another run had them."""

    def __init__(self, steps: set[int], problem: Any):
        self.steps, self.problem = steps, problem

    def due(self, steps: int, gradient: np.ndarray, comm: Any) -> bool:
        return self.problem().progress.step in self.steps


@pytest.mark.parametrize("limit", [0.05, 10.0])
def test_decisions_are_replayed(limit):
    """A run whose resets come from its distortion, and one that has them by number: the same digits."""
    first, log, runs = bent(reset=pm.WhenDistorted(0.05)), Log(), []
    first.rotation_limit = limit
    first.observers.append(log)
    list(first.march(6, progress=False))
    factors = [step.factor for step in first.steps]
    resets = {factors.index(t) + 1 for event, t in log.heard if event == "reset" and t > 0}
    assert resets
    assert any(event == "rebased" for event, _ in log.heard) == (limit < 1.0)
    second = bent(reset=Replayed(resets, lambda: runs[0]))
    runs.append(second)
    second.rotation_limit = limit
    list(second.march(6, progress=False))
    assert_repeated(by_id(second.points, second.points.x), by_id(first.points, first.points.x))
