"""What a run says by itself."""

from __future__ import annotations

import logging

import pytest

import polarmpm as pm
from polarmpm.tools import saying
from tests.conftest import COMM, MICROPOLAR
from tests.helpers.bodies import box


@pytest.fixture(autouse=True)
def _afresh():
    saying.say_once.cache_clear()
    yield
    saying.say_once.cache_clear()


def pulled(**options):
    grid = pm.Grid.box((0, -1), (5, 2), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3, 1)))
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(20.0, 0.0))
    return problem


def said(capfd) -> list[str]:
    lines = capfd.readouterr().err.splitlines()
    return [line for line in lines if line.startswith("polarmpm: ") and "compiling" not in line]


def test_settings_that_are_not_recommended_are_named_once(capfd):
    for _ in range(2):
        pulled(boxes=False, balanced_reset=False)
    lines = said(capfd)
    if COMM.rank == 0:
        (line,) = lines
        assert "boxes=False, balanced_reset=False: not the recommended settings" in line
    else:
        assert not lines


def test_recommended_settings_need_no_words(capfd):
    pulled()
    assert not said(capfd)


@pytest.mark.parametrize("elements", [False, True])
def test_the_end_says_how_far_to_trust(capfd, elements):
    problem = pulled()
    if elements:
        body = pm.Elements(box("quadrilateral", (4, 2), (3.0, 1.0)), material=MICROPOLAR)
        problem = pm.QuasiStaticFEM(body)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.fix(pm.plane(x=3.0), u=(0.02, 0.0))
    march = problem.march(2)
    for _ in march:
        assert not said(capfd)
    assert list(march) == []  # it's over, and says so once
    lines = said(capfd)
    if COMM.rank == 0:
        (line,) = lines
        assert line.startswith("polarmpm: 2 steps to load factor 1 (")
        assert line.endswith(problem.trust())
    else:
        assert not lines


def test_lines_are_turned_off(capfd, monkeypatch):
    problem = pulled()
    list(problem.march(1, progress=False))
    problem.report = False
    list(problem.march(1, to=1.5))
    problem.report = True
    logger = logging.getLogger("polarmpm")
    monkeypatch.setattr(logger, "level", logger.level)  # put back at the end
    logger.setLevel(logging.WARNING)
    list(problem.march(1, to=2.0))
    assert not said(capfd)
    logger.setLevel(logging.INFO)


def test_a_march_that_ends_early_says_nothing(capfd):
    problem = pulled()
    for _ in problem.march(3):
        break
    assert not said(capfd)
