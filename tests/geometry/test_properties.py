"""Whatever is given to grids, planes and surfaces, there is an error of the package or what was asked for."""

from __future__ import annotations

import copy
import pickle

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from tests.conftest import COMM
from tests.helpers.weird import anything, arrays, attempt, flags, numbers, thorough, vectors

OPTIONS = thorough(60)


@OPTIONS
@given(vectors(2) | vectors(3), vectors(2) | vectors(3), anything)
def test_boxes(lower, upper, cell):
    grid = attempt(pm.Grid.box, lower, upper, cell)
    if grid is not None:
        assert np.allclose(grid.lower, np.asarray(lower, float), rtol=1e-6, atol=1e-300)
        assert np.allclose(grid.upper, np.asarray(upper, float), rtol=1e-6, atol=1e-6 * max(grid.cell))
        assert np.all(np.array(grid.cell) > 0)
        assert np.prod(np.array(grid.shape, dtype=float)) >= 1
        assert pickle.loads(pickle.dumps(grid)) == grid == copy.deepcopy(grid)
        assert repr(grid).count("\n") == 0


@OPTIONS
@given(vectors(2), vectors(2), vectors(2), st.sampled_from([COMM, COMM, COMM, None, "world"]))
def test_grids(origin, cell, shape, comm):
    grid = attempt(pm.Grid, origin, cell, shape, comm)
    if grid is not None:
        index = np.zeros((1, 2), dtype=np.int64)
        assert np.array_equal(grid.node_index(grid.node_number(index)), index)
        assert grid.comm == COMM


@OPTIONS
@given(
    st.sampled_from(["x", "y", "z", "w"]), numbers | anything, flags, anything | st.sampled_from(["below"])
)
def test_planes(axis, value, moving, beyond):
    plane = attempt(pm.plane, **{axis: value}, moving=moving, beyond=beyond)
    if plane is not None:
        assert np.isfinite(plane.value)
        grid = pm.Grid.box((0, 0), (2, 2), 0.5, COMM)
        points = pm.seed(grid, material=pm.NeoHookean(lam=1.0, mu=1.0), points_per_cell=1)
        found = attempt(plane.resolve, grid, points)
        assert found is None or abs(plane.value - grid.plane(plane.axis, found.index)) < 1e-5


@OPTIONS
@given(arrays(3, 2) | arrays(2, 3), arrays(3), st.just([[0, 1.0]] * 3) | arrays(3, 2))
def test_surfaces(x, area, normal):
    surface = attempt(pm.Surface, x, area, normal)
    if surface is not None:
        assert surface.x.shape == surface.normal.shape == (len(surface), surface.dim)
        assert np.all(surface.area > 0)
        assert np.allclose(np.linalg.norm(surface.normal, axis=1), 1)
        assert np.array_equal(copy.deepcopy(surface).x, surface.x)


@OPTIONS
@given(vectors(2), vectors(2), numbers | anything)
def test_lines(a, b, points):
    line = attempt(pm.Surface.line, a, b, points)
    if line is not None:
        assert len(line) == points
        assert np.isclose(line.area.sum(), np.linalg.norm(np.subtract(b, a, dtype=float)))


@OPTIONS
@given(vectors(3), vectors(3), vectors(3), numbers | anything)
def test_rectangles(corner, edge1, edge2, points):
    sheet = attempt(pm.Surface.rectangle, corner, edge1, edge2, points)
    if sheet is not None:
        assert len(sheet) == np.prod(np.broadcast_to(points, 2))
        across = np.cross(np.asarray(edge1, float), np.asarray(edge2, float))
        assert np.isclose(sheet.area.sum(), np.linalg.norm(across))
