"""Stiff parts in soft bodies, which smooth functions let reach into what is beside them."""

import re
import warnings

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM

SOFT = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)


def said(problem, force, held=0.6):
    """What is said of stiff parts of a body in its first step, held on the left; rank 0's."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.fix(lambda x: x[:, 0] <= held, u=0)
        problem.body_load(force=force)
        for _ in problem.march(1, progress=False):
            pass
    texts = [str(w.message) for w in caught if w.category is pm.TrustWarning]
    return COMM.bcast("".join(t for t in texts if "times as stiff" in t))


def told(cell, ratio, length=1.0, basis="bspline", low=(0.137, 0.061), apart=False):
    """The same of a bar of 3 x 1 with a stiff block of length x 0.5 in it that is pulled."""
    grid = pm.Grid.box((-1.0, -2.0), (6.0, 3.0), cell, COMM)

    def inside(x):
        y = x - low
        return (np.abs(y[:, 0] - 1.5) < length / 2) & (np.abs(y[:, 1] - 0.5) < 0.25)

    points = pm.seed(grid, bounds=(low, np.add(low, (3.0, 1.0))), material=SOFT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the block's sides cut boxes
        block = points.where(inside)
        points.assign(block, pm.NeoHookean.from_engineering(E=ratio * 1e6, nu=0.3))
        if apart:
            points.separate(block)
    problem = pm.QuasiStatic(grid, points, basis=basis)
    return said(problem, (1e3, 0), 1.6 if apart else 0.6)


@pytest.mark.parametrize("low", [(0.137, 0.061), (0.0, 0.0)])
def test_a_stiff_block_on_few_cells(low):
    """Elements of degree 2 find 21 % (12 % where it lies along the grid) more displacement."""
    found = told(0.25, 1e3, low=low)
    assert re.search("points: 1[5-8] % of the work is done across the sides of parts that", found)


@pytest.mark.parametrize(
    "options",
    [
        {"cell": 0.125, "ratio": 1e3},
        {"cell": 0.25, "ratio": 10.0},
        {"cell": 0.25, "ratio": 1e3, "length": 0.2},
        {"cell": 0.25, "ratio": 1e3, "basis": "mpm"},
        {"cell": 0.25, "ratio": 1e3, "apart": True},
    ],
)
def test_where_little_is_beside(options):
    """Smaller cells, like stiffnesses, a small block, kinks at the cells' faces, bodies that only touch."""
    assert told(**options) == ""


@pytest.mark.parametrize(
    ("along", "force", "doubt"), [(1, (0, -300.0), False), (1, (1e3, 0), False), (0, (1e3, 0), True)]
)
def test_layers_are_told_where_the_soft_one_does_the_work(along, force, doubt):
    """Two joined layers of 4 x 0.25, 30 : 1, bent and pulled along, are within 1 % on these cells; pulled
    across, the soft one alone is stretched, by 6 % too little."""
    grid = pm.Grid.box((0, -2), (6, 2), 0.25, COMM)
    lower, upper = ((0.0, 0.061), (4.0, 0.311)), ((0.0, 0.311), (4.0, 0.561))
    if not along:
        lower, upper = ((0.0, 0.061), (0.8, 0.561)), ((0.8, 0.061), (1.6, 0.561))
    points = pm.seed(grid, bounds=lower, material=SOFT)
    points.join(pm.seed(grid, bounds=upper, material=pm.NeoHookean.from_engineering(E=3e7, nu=0.3)))
    found = said(pm.QuasiStatic(grid, points), force, 0.0)
    assert bool(found) == doubt
