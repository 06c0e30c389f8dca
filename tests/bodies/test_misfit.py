"""Selections whose limit cuts boxes: what is said of the volume that their points stand for."""

import pickle
import warnings

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, NEO_HOOKEAN

STIFF = pm.NeoHookean(lam=6e3, mu=4e3)


def layer(low=0.061, thickness=0.25, dim=2):
    """A plate of half a metre on cells of a quarter, with points 1/8 m apart, and its upper layer."""
    grid = pm.Grid.box((0.0, -1.0, 0.0)[:dim], (2.0, 1.0, 0.5)[:dim], 0.25, COMM)
    bounds = ((0.0, low, 0.0)[:dim], (2.0, low + 0.5, 0.5)[:dim])
    return grid, bounds, lambda x: x[:, 1] > low + thickness


def seeded(*arguments):
    grid, bounds, upper = layer(*arguments)
    points = pm.seed(grid, bounds=bounds, material=NEO_HOOKEAN)
    return grid, points, points.where(upper)


def said(act):
    """What is warned of, on rank 0."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        act()
    return COMM.bcast("".join(str(w.message) for w in caught if w.category is pm.TrustWarning))


@pytest.mark.parametrize("dim", [2, 3])
def test_limit_amid_boxes(dim):
    """The limit is at .311 m, the lowest boxes of the layer reach from .25 to .375 m."""
    _, points, upper = seeded(0.061, 0.25, dim)
    assert "stand for 25% more volume than the part" in said(lambda: points.assign(upper, STIFF))


def test_less_volume():
    _, points, upper = seeded(0.0, 0.203125)  # three eighths of the lowest boxes are left out
    assert "stand for 16% less volume" in said(lambda: points.assign(upper, STIFF))


@pytest.mark.parametrize(("low", "thickness"), [(0.0, 0.25), (0.061, 0.314), (0.0, 0.251)])
def test_limit_on_faces(low, thickness):
    _, points, upper = seeded(low, thickness)
    assert said(lambda: points.assign(upper, STIFF)) == ""


def test_limit_askew():
    """Boxes on either side of a limit in a quarter of the plate make up for each other."""
    _, points, _ = seeded()
    assert said(lambda: points.assign(points.where(lambda x: x[:, 1] > 0.16 * x[:, 0] + 0.1), STIFF)) == ""


def test_loads_bodies_and_stages():
    """Whatever goes by the volume of a selection."""
    for act in (
        lambda q, s: q.body_load(force=(0.0, -1.0), on=s),
        lambda q, s: q.remove(s),
        lambda q, s: q.points.separate(s),
    ):
        grid, points, upper = seeded()
        problem = pm.QuasiStatic(grid, points)
        assert "25% more volume" in said(lambda act=act, q=problem, s=upper: act(q, s))


def test_joined_parts():
    """What is advised: each part has its volume, and there is nothing to say."""
    grid, (low, high), _ = layer()
    middle = low[1] + 0.25

    def join():
        points = pm.seed(grid, bounds=(low, (high[0], middle)), material=NEO_HOOKEAN)
        points.join(pm.seed(grid, bounds=((low[0], middle), high), material=STIFF))
        volumes = np.bincount(points.material, points.volume0, minlength=2)
        np.testing.assert_allclose(COMM.allreduce(volumes), 0.5, rtol=1e-12)

    assert said(join) == ""


def test_predicates_of_the_points_alone():
    """A mask of the points can't be asked about other places: nothing is said, and nothing raised."""
    _, points, upper = seeded()
    mask = np.isin(points.id, upper.ids)
    assert said(lambda: points.assign(points.where(lambda x: mask), STIFF)) == ""
    by_ids = pm.Selection(upper.ids)
    assert said(lambda: points.assign(by_ids, STIFF)) == ""


def test_pickles_do_without_the_predicate():
    _, _, upper = seeded()
    again = pickle.loads(pickle.dumps(upper))
    assert upper.predicate is not None
    assert again.predicate is None
    np.testing.assert_array_equal(again.ids, upper.ids)
