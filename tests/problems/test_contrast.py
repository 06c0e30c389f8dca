"""Stiff parts in soft bodies, which smooth functions let reach into what is beside them."""

import re
import warnings

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM

SOFT = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)


def told(cell, ratio, length=1.0, basis="bspline", low=(0.137, 0.061), apart=False):
    """What is said of a bar of 3 x 1 with a stiff block of length x 0.5 in it; rank 0's."""
    grid = pm.Grid.box((-1.0, -2.0), (6.0, 3.0), cell, COMM)

    def inside(x):
        y = x - low
        return (np.abs(y[:, 0] - 1.5) < length / 2) & (np.abs(y[:, 1] - 0.5) < 0.25)

    points = pm.seed(grid, bounds=(low, np.add(low, (3.0, 1.0))), material=SOFT)
    block = points.where(inside)
    points.assign(block, pm.NeoHookean.from_engineering(E=ratio * 1e6, nu=0.3))
    if apart:
        points.separate(block)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pm.QuasiStatic(grid, points, basis=basis)
    return COMM.bcast("".join(str(w.message) for w in caught if w.category is pm.TrustWarning))


@pytest.mark.parametrize("low", [(0.137, 0.061), (0.0, 0.0)])
def test_a_stiff_block_on_few_cells(low):
    """Elements of degree 2 find 21 % (12 % where it lies along the grid) more displacement."""
    found = told(0.25, 1e3, low=low)
    assert re.search(
        "points: 1[5-8] % of a material's volume lie within half a cell of one that is 20 ", found
    )


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
