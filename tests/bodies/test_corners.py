"""Corners of the domains of material points, on the outside of the body."""

import numpy as np

import polarmpm as pm
from polarmpm.bodies.corners import outer_corners
from tests.conftest import COMM, NEO_HOOKEAN


def test_areas_of_the_corners_close_the_outline():
    """Of a body cut out of its cells with a staircase for an outline: the area that faces a direction is the
    body's width, on both sides, and the whole vector vanishes."""
    grid = pm.Grid((0.03, -0.02), (0.1, 0.07), (20, 20), COMM)
    points = pm.seed(
        grid, lambda x: np.hypot(x[:, 0] - 0.9, x[:, 1] - 0.7) < 0.5, material=NEO_HOOKEAN, cut=False
    )
    x, area, normal, parents = outer_corners(points)
    vector = area[:, None] * normal
    assert np.abs(vector.sum(axis=0)).max() < 1e-12
    low, high = (
        COMM.allreduce(points.x.min(axis=0), op=np_min),
        COMM.allreduce(points.x.max(axis=0), op=np_max),
    )
    width = high - low + 2 * points.half_length0[0] if len(points) else high - low
    upward = vector[vector[:, 1] > 0, 1].sum()
    assert abs(upward - COMM.bcast(width)[0]) < 1e-12
    assert set(parents) <= set(np.concatenate(COMM.allgather(points.id)).tolist())
    assert len(x) == len(area)


def np_min(a, b):
    return np.minimum(a, b)


def np_max(a, b):
    return np.maximum(a, b)


def test_corners_of_a_block():
    """Each side of a block of 4 x 2 points has its length; a corner of the block is there once."""
    grid = pm.Grid((0.0, 0.0), (0.5, 0.5), (4, 4), COMM)
    points = pm.seed(grid, bounds=((0.5, 0.5), (1.5, 1.0)), material=NEO_HOOKEAN)
    x, area, normal, _ = outer_corners(points)
    floor = np.abs(x[:, 1] - 0.5) < 1e-12
    assert np.isclose(np.sum(-area * normal[:, 1] * floor), 1.0)
    ends = floor & (np.abs(np.abs(x[:, 0] - 1.0) - 0.5) < 1e-12)
    assert np.sum(ends) == 2
    assert np.allclose(np.abs(normal[ends]), np.sqrt(0.5))


def test_points_without_domains_stand_for_themselves():
    x = np.array([[0.1, 0.2], [0.3, 0.2]]) if COMM.rank == 0 else np.zeros((0, 2))
    n = len(x)
    points = pm.Points(x, np.full(n, 0.04), np.zeros((n, 2)), NEO_HOOKEAN, COMM)
    found, area, _, _ = outer_corners(points)
    assert np.allclose(found, [[0.1, 0.2], [0.3, 0.2]])
    assert np.allclose(area, 0.2)
