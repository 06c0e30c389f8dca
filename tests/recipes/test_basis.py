"""The basis of the recipe: unity, linear completeness, gradients, and the answer of the same functions in the
package. Cubic splines (`basis/bspline3.py`) have `tests/basis/test_bspline3.py`."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import BASES
from tests.conftest import MICROPOLAR, by_id
from tests.recipes.basis import Hats


@pytest.mark.parametrize("dim", [2, 3])
def test_unity_and_linear_completeness(dim):
    grid = pm.Grid.box((0.0,) * dim, (2.0, 3.0, 1.5)[:dim], (0.5, 1.0, 0.75)[:dim])
    x = np.random.default_rng(1).uniform(grid.lower, grid.upper, (200, dim))
    table = Hats().at(grid, x, grid.cells_of(x))
    nodes, value = Hats().weights(grid, x).products(grid)
    position = Hats().positions(grid, nodes.ravel()).reshape(*nodes.shape, dim)
    np.testing.assert_allclose(value, table[:, 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(table[:, 0].sum(axis=1), 1.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(table[:, 1:].sum(axis=2), 0.0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.einsum("nk,nkd->nd", value, position), x, rtol=0, atol=1e-14)
    slope = np.einsum("nik,nkd->nid", table[:, 1:], position)
    np.testing.assert_allclose(slope, np.tile(np.eye(dim), (200, 1, 1)), rtol=0, atol=1e-13)


def test_a_run_with_it(monkeypatch):
    monkeypatch.setitem(BASES, "hats", Hats())
    found = []
    for basis in ("mpm", "hats"):
        grid = pm.Grid.box((0, -1), (4, 2), 0.5)
        points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3, 1)), points_per_cell=3)
        problem = pm.QuasiStatic(grid, points, basis=basis)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.load(points.farthest((1, 0)), force=(30.0, -20.0), couple=3.0)
        list(problem.march(2, progress=False))
        found.append(by_id(points, points.x))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-12)
