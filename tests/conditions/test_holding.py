"""Supports whose region the body moves into."""

from __future__ import annotations

import warnings

import pytest

import polarmpm as pm
from tests.conftest import NEO_HOOKEAN


def sliding(way: float, **options: object) -> pm.QuasiStatic:
    """A block drawn to the left by its right face, and held across where x < 0.8: there is a third of it."""
    grid = pm.Grid.box((-1, -1), (3, 2), 0.25)
    points = pm.seed(grid, bounds=((0.5, 0), (1.5, 1)), material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    problem.fix(lambda x: x[:, 0] < 0.8, uy=0)
    problem.fix(pm.Surface.line((1.5, 0), (1.5, 1), 8), ux=-way, uy=0)
    return problem


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_what_moves_into_a_predicate_is_told_once(basis):
    problem = sliding(0.6, basis=basis)
    with pytest.warns() if problem.comm.rank == 0 else warnings.catch_warnings() as found:
        list(problem.march(6, progress=False))
    if problem.comm.rank == 0:
        texts = [str(w.message) for w in found if issubclass(w.category, pm.TrustWarning)]
        assert len(texts) == 1
        assert "support 1" in texts[0]
        assert "wherever its predicate is true" in texts[0]
        assert found[0].filename == __file__


def test_small_motions_are_nobodys_business():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(sliding(0.1, basis="mpm").march(4, progress=False))


def thrown(way: float, problem: type, **options: object) -> pm.QuasiStatic:
    """A block on a column of nodes that it leaves."""
    grid = pm.Grid.box((-1, -1), (4, 2), 0.25)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN)
    made = problem(grid, points, reset=1, basis="mpm", **options)
    made.fix(lambda x: x[:, 0] < 0.1, uy=0)
    made.fix(pm.Surface.line((1, 0), (1, 1), 8), ux=lambda t: way * t, uy=0)
    return made


def test_a_body_in_motion_may_leave_its_supports():
    """A warning, once; without inertia it's an error."""
    problem = thrown(0.2, pm.Dynamic, density=1.0)
    with pytest.warns() if problem.comm.rank == 0 else warnings.catch_warnings() as found:
        list(problem.march(duration=8.0, dt=1.0, progress=False))
    if problem.comm.rank == 0:
        texts = [str(w.message) for w in found if "the body has left" in str(w.message)]
        assert len(texts) == 1
        assert "support 1" in texts[0]
    with pytest.raises(pm.SupportLost, match="support 1"):
        list(thrown(1.6, pm.QuasiStatic).march(8, progress=False))
