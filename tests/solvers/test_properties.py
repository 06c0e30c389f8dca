"""Whatever solvers and terms are made of: an error of the package, or what was asked for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import ufl
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from polarmpm.solvers.arclength import ArcSchedule
from polarmpm.solvers.choice import SOLVERS
from polarmpm.solvers.resetting import make_policy
from polarmpm.solvers.stepping import Schedule
from tests.conftest import COMM, MICROPOLAR
from tests.helpers.weird import anything, attempt, flags, numbers, thorough

pytestmark = pytest.mark.filterwarnings("ignore")
LINE = pm.Surface.line((0.0, 1.0), (2.0, 1.0), 3)


@thorough(100)
@given(anything, anything, flags, anything, anything, anything, flags)
def test_schedules(steps, to, adaptive, smallest, largest, easy, progress):
    made = attempt(Schedule, steps, to, adaptive, smallest, largest, easy, progress)
    if made is not None:
        assert made.number >= 1
        assert math.isfinite(made.to)
        assert 0 < made.smallest <= 1
        assert made.largest is None or 0 < made.largest < math.inf
        assert {type(made.adaptive), type(made.easy), type(made.to)} == {bool, int, float}


@thorough(100)
@given(numbers, anything, anything, numbers, anything, anything)
def test_paths(first, until, largest, smallest, to, steps):
    made = attempt(ArcSchedule, first, until, largest, smallest, to, steps)
    if made is not None:
        assert 0 < made.first <= (made.largest or made.first) < math.inf
        assert 0 < made.smallest <= 1
        assert made.to is None or math.isfinite(made.to)
        assert not (made.to is None and made.steps is None and made.until is None)


class Policy:
    def __init__(self, due: Any):
        self.due = due


@thorough(100)
@given(st.one_of(anything, anything.map(Policy), st.builds(Policy, st.just(lambda a, b, c: True))))
def test_resets(reset):
    policy = attempt(make_policy, reset)
    if policy is not None and not isinstance(reset, Policy):
        assert isinstance(policy, pm.Never if reset is None else pm.EverySteps)
        assert policy.due(1, np.zeros((3, 2, 2)), COMM) in (True, False)


@thorough(100)
@given(anything)
def test_limits(value):
    made = attempt(pm.WhenDistorted, value)
    assert made is None or 0 < made.limit < math.inf
    every = attempt(pm.EverySteps, value)
    assert every is None or every.n >= 1


@thorough(60)
@given(anything, anything, flags)
def test_solvers(name, make, whole_rows):
    before = dict(SOLVERS)
    try:
        attempt(pm.register_solver, name, make, whole_rows=whole_rows)
        for known in SOLVERS.keys() - before.keys():
            assert isinstance(known, str)
            assert callable(SOLVERS[known].make)
    finally:
        for known in SOLVERS.keys() - before.keys():
            del SOLVERS[known]
    assert before == SOLVERS


@thorough(100)
@given(numbers, anything, anything)
def test_ghost_penalties(displacement, rotation, power):
    made = attempt(pm.GhostPenalty, displacement, rotation, power)
    if made is not None:
        assert 0 <= made.displacement < math.inf
        assert 0 <= made.rotation < math.inf
        assert made.power in (1, 3)


@thorough(100)
@given(anything, anything)
def test_boxes(count, lowest):
    made = attempt(pm.Boxes, count, lowest)
    if made is not None:
        grid = pm.Grid.box((0.0,) * len(made.count), (2.0,) * len(made.count), 1.0)
        assert made.numbers(grid).shape == (len(made.lowest), math.prod(made.count))


class Springs(pm.SurfaceTerm):
    def energy(self, at: Any, p: Any) -> Any:
        return p.k / 2 * ufl.dot(at.u, at.u)


def held() -> Any:
    grid = pm.Grid.box((-1.0, -1.0), (4.0, 3.0), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0.0, 0.0), (2.0, 1.0)))
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return problem


@thorough(40)
@given(anything, st.one_of(st.just(LINE), anything), st.one_of(anything, anything.map(lambda v: {"k": v})))
def test_numbers_of_terms(name, surface, values):
    problem = held()
    term = attempt(Springs, name, surface, values)
    if term is not None and attempt(problem.add, term) is not None:
        attempt(lambda: list(problem.march(1, progress=False)))


class Answer(pm.Piece):
    """A piece that says what it is told to."""

    name = "mine"

    def __init__(self, forces: Any, matrices: Any):
        self._forces, self._matrices = forces, matrices

    def forces(self, x: np.ndarray) -> Any:
        return np.zeros_like(x) if self._forces is None else self._forces

    def matrices(self, x: np.ndarray) -> Any:
        return np.zeros((1, *x.shape[1:2] * 2, 1)) if self._matrices is None else self._matrices


class Mine(pm.Term):
    name = "mine"

    def __init__(self, answers: dict[str, Any]):
        self.answers = answers

    def pieces(self, setting: Any) -> Any:
        if "pieces" in self.answers:
            return self.answers["pieces"]
        piece = Answer(self.answers.get("forces"), self.answers.get("matrices"))
        piece.boxes = self.answers.get("boxes", pm.Boxes((2, 2), setting.reached[:1]))
        piece.pairs = self.answers.get("pairs", np.zeros((1, 2), dtype=int))
        return [piece]


@thorough(40)
@given(st.sampled_from(["pieces", "forces", "matrices", "boxes", "pairs"]), anything)
def test_pieces_of_terms(what, value):
    """Something that isn't a piece is refused, and nothing of the body has changed then."""
    problem = held()
    problem.add(Mine({what: value}))
    x = problem.points.x
    if attempt(lambda: list(problem.march(1, progress=False))) is None:
        np.testing.assert_array_equal(problem.points.x, x)
        assert problem.progress.step == 0
