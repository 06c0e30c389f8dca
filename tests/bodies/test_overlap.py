"""Points that are put where others are."""

import copy
import re
import warnings

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, NEO_HOOKEAN

GRID = pm.Grid.box((0.0, 0.0), (3.0, 3.0), 0.25, COMM)


TWICE = "points that join lie where points are already, such as at .*: the body is there twice"


def told(join):
    """Whether rank 0, which speaks for all, has warned. Collective."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        join()
    found = any(re.match(TWICE, str(one.message)) for one in caught if one.category is pm.TrustWarning)
    return COMM.bcast(found)


def square(low, high, per_cell=2):
    return pm.seed(GRID, bounds=(low, high), material=NEO_HOOKEAN, points_per_cell=per_cell)


@pytest.mark.parametrize("shift", [0.0, 0.125, 0.31, 0.8])
@pytest.mark.parametrize("per_cell", [1, 2, 3])
def test_a_body_that_is_there_twice(shift, per_cell):
    points = square((0.0, 0.0), (1.0, 1.0), per_cell)
    assert told(lambda: points.join(square((shift, shift / 2), (1.0 + shift, 1.0))))


def test_bodies_that_touch():
    """By their faces, aslant or round ones too, however points are cut there."""
    points = square((0.0, 0.0), (1.0, 1.0), 3)
    assert not told(lambda: points.join(square((1.0, 0.2), (2.0, 1.1))))
    for angle in (0.2, 0.7, 1.1):

        def inside(x, angle=angle):
            disc = np.linalg.norm(x - 1.4, axis=1) < 0.6 + angle / 5
            return disc & ((x - 1.5) @ (np.cos(angle), np.sin(angle)) < 0.4)

        core = pm.seed(GRID, inside, material=NEO_HOOKEAN)
        rest = pm.seed(GRID, lambda x, inside=inside: ~inside(x), material=NEO_HOOKEAN, points_per_cell=3)
        assert not told(lambda core=core, rest=rest: core.join(rest))
    # contact tells of bodies of their own
    assert not told(lambda: points.join(square((0.5, 0.5), (1.5, 1.5)), apart=True))


def test_a_small_part_of_many_points_that_is_there_twice():
    """One cell of 30 000 points, wherever it is among them."""
    grid = pm.Grid.box((0.0, 0.0), (3.0, 3.0), 0.05, COMM)

    def around(x):
        return np.any(np.abs(x - 1.5) > 0.725, axis=1)

    points = pm.seed(grid, around, material=NEO_HOOKEAN, points_per_cell=4)
    hole = ((0.775, 0.775), (2.225, 2.225))
    assert not told(lambda: copy.copy(points).join(pm.seed(grid, bounds=hole, material=NEO_HOOKEAN)))
    more = pm.seed(
        grid,
        lambda x: ~around(x) | np.all(x > (2.0, 2.25), axis=1) & (x[:, 0] < 2.1),
        material=NEO_HOOKEAN,
        points_per_cell=6,
    )
    assert more.total > 25_000
    assert told(lambda: points.join(more))


def test_a_fill_where_the_body_is():
    points = square((0.0, 0.0), (1.0, 1.0))
    problem = pm.QuasiStatic(GRID, points)
    problem.fix(pm.plane(y=0.0), u=0)
    list(problem.march(1, progress=False))
    assert not told(lambda: problem.add(square((0.0, 1.0), (1.0, 1.5))))
    assert told(lambda: problem.add(square((0.5, 0.5), (1.0, 1.5))))
