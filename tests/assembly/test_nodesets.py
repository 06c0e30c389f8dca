"""Groups of points that share a set of nodes, and which of them are merged."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly import nodesets
from polarmpm.assembly.nodesets import group_points
from polarmpm.basis.base import Weights
from tests.assembly.test_system import random_increment, tangent_at
from tests.conftest import MICROPOLAR


def groups(lowest, count, material=None):
    lowest, count = np.array(lowest), np.array(count)
    w = Weights(lowest, count, np.zeros((len(lowest), lowest.shape[1], 2, int(count.max()))))
    return group_points(np.zeros(len(lowest), dtype=int) if material is None else np.array(material), w)


def test_few_points_are_merged_into_the_largest_group():
    """Of one lowest node and material; the points' order goes with their groups."""
    lowest = [[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 0]]
    count = [[4, 4], [3, 4], [3, 3], [3, 3], [4, 3], [4, 4]]
    order, made = groups(lowest, count, [0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(made.node, [[0, 0], [1, 0], [0, 0]])
    np.testing.assert_array_equal(made.count, [[4, 4], [3, 3], [4, 4]])
    np.testing.assert_array_equal(made.material, [0, 0, 1])
    np.testing.assert_array_equal(made.offsets, [0, 4, 5, 6])
    assert set(order[:4]) == {0, 1, 2, 4}
    assert order[4:].tolist() == [3, 5]


def test_what_is_not_merged():
    """A box that no group has, which would make nodes that no point reaches; many points on few nodes."""
    _, made = groups([[0, 0]] * 2, [[3, 4], [4, 3]])
    np.testing.assert_array_equal(np.sort(made.count, axis=0), [[3, 3], [4, 4]])
    order, made = groups([[0, 0]] * 60, [[3, 3]] * 59 + [[4, 4]])
    np.testing.assert_array_equal(made.count, [[3, 3], [4, 4]])
    np.testing.assert_array_equal(made.offsets, [0, 59, 60])
    assert order[59] == 59


@pytest.mark.parametrize("basis", ["gimpm", "bspline-averaged"])
@pytest.mark.parametrize("dim", [2, 3])
def test_merging_changes_no_sum(dim, basis, monkeypatch):
    """Forces and tangent of a body off the planes, with merged groups and with none; the same nodes."""
    found = []
    for flush in (100.0, 0.0):
        monkeypatch.setattr(nodesets, "_FLUSH", flush)
        grid = pm.Grid.box((0,) * dim, (4,) * dim, 1.0)
        points = pm.seed(
            grid, lambda x: (x[:, 0] < 2) | (x[:, 1] < 2), material=MICROPOLAR, points_per_cell=2
        )
        points.x = points.X = 0.3 + 0.8 * points.x
        problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": basis})
        problem.system_at(0.0)
        system = problem.system
        x = random_increment(system, 0.02)
        tangent = tangent_at(system, x)
        number = sum(b.batch.ngroups for b in system.interpolation.batches)
        found.append((number, system.nodes.number, system.interpolation.spread(points.x), tangent))
    assert found[0][0] < found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])
    for merged, apart in zip(found[0][2:], found[1][2:], strict=True):
        np.testing.assert_allclose(merged, apart, rtol=0, atol=1e-12 * np.abs(apart).max())
