"""Sums over patches, held against NumPy's; shares of volumes, wherever their iteration begins."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly import elasticvolumes
from polarmpm.errors import LocalFailure
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN
from tests.helpers import plasticity


def patches_of(basis, material):
    grid = pm.Grid.box((0, 0), (4, 3), 1.0)
    points = pm.seed(grid, lambda x: x[:, 0] + x[:, 1] < 5, material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking="always")
    problem.fix(pm.plane(y=0.0), u=0)
    return problem.system_at(1.0).interpolation.patches[0]


@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["one scalar", "two"])
@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_sums_over_patches(basis, material):
    """Of one function or three a patch, in compiled loops of their own, and any number."""
    p, rng = patches_of(basis, material), np.random.default_rng(0)
    n, m, phi = len(p.patch), p.scalars, p.values
    weighted = p.volume[:, None] * phi
    for columns in (1, 2):
        values, moments = rng.random((n, 5))[:, 1 : 1 + columns], rng.random((p.count, phi.shape[1], columns))
        expected = np.zeros((p.count, phi.shape[1], columns))
        np.add.at(expected, p.patch, weighted[:, :, None] * values[:, None])
        np.testing.assert_allclose(p.moments(values), expected, rtol=1e-13, atol=1e-13)
        expected = np.einsum("na,nac->nc", phi, moments[p.patch])
        np.testing.assert_allclose(p.at_points(moments), expected, rtol=1e-13)
    matrices = rng.random((n, m, m))
    expected = np.zeros((p.count, p.modes, p.modes))
    each = np.einsum("na,nb,ncd->nacbd", weighted, phi, matrices)
    np.add.at(expected, p.patch, each.reshape(n, p.modes, p.modes))
    np.testing.assert_allclose(p.products(matrices), expected, rtol=1e-13, atol=1e-13)


def footing(steps):
    soil = plasticity.cone(HENCKY, 20.0, 20.0, k=None, c=HENCKY.mu / 4e3, cone="plane strain")
    grid = pm.Grid.box((0, 0), (4, 2), 0.5)
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=soil, points_per_cell=2), basis="mpm", reset=None)
    problem.fix(pm.plane(y=0.0), u=0)
    for x in (0.0, 4.0):
        problem.fix(pm.plane(x=x), ux=0)
    held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 2 - 1e-6), ux=0, uy=-0.01)
    list(problem.march(steps, adaptive=True, progress=False))
    return problem.reaction(held).force[1]


def test_shares_of_volumes_do_not_depend_on_where_their_iteration_begins(monkeypatch):
    """Near the last tangent's solution it takes fewer returns of stresses; a bad start costs itself alone."""
    loads, counts, again = [], [], elasticvolumes.ElasticVolumes._again

    def counted(*args):
        counts[-1] += 1
        return again(*args)

    def fails(*_):
        raise LocalFailure("too far away")

    monkeypatch.setattr(elasticvolumes.ElasticVolumes, "_again", counted)
    for start in (None, fails):
        if start is not None:
            monkeypatch.setattr(elasticvolumes.ElasticVolumes, "_predicted", start)
        counts.append(0)
        loads.append(footing(4))
    assert loads[0] == pytest.approx(loads[1], rel=1e-8)
    assert COMM.allreduce(counts[0]) < 0.8 * COMM.allreduce(counts[1])
