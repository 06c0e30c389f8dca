"""Whatever is given to bodies of points, there is an error of the package or what was asked for."""

from __future__ import annotations

import copy
import pickle

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.weird import (
    NAN,
    Rude,
    anything,
    arrays,
    attempt,
    flags,
    numbers,
    predicates,
    thorough,
    vectors,
)

OPTIONS = thorough(60)
MATERIALS = st.sampled_from([NEO_HOOKEAN] * 6 + [HENCKY, MICROPOLAR, None, pm.NeoHookean, "steel", Rude()])


def grid() -> pm.Grid:
    return pm.Grid.box((-1, -1), (3, 2), 0.5, COMM)


def inside(x: np.ndarray) -> np.ndarray:
    found: np.ndarray = np.all((x >= 0) & (x <= [2.0, 1.0]), axis=1)
    return found


def body() -> pm.Points:
    return pm.seed(grid(), bounds=((0, 0), (2, 1)), material=NEO_HOOKEAN)


BODY, OTHER = body(), pm.seed(grid(), inside, material=MICROPOLAR, points_per_cell=1)
SELECTIONS = st.sampled_from(
    [
        BODY.farthest((1, 0)),
        BODY.where(lambda x: x[:, 0] > 99),
        OTHER.farthest((1, 0)),
        pm.Selection([1, 2, 5]),
        pm.Selection([10**6]),
        None,
        [1, 2],
        "tip",
        Rude(),
    ]
)


@OPTIONS
@given(
    predicates(inside) | st.none(),
    MATERIALS,
    st.fixed_dictionaries(
        {},
        optional={
            "points_per_cell": st.sampled_from([1, 2, 3, (1, 2), [3, 1], np.int8(2), 100000]) | anything,
            "bounds": st.just(((0, 0), (2, 1))) | st.tuples(vectors(2), vectors(2)) | anything,
            "layout": st.sampled_from(["uniform", "gauss"]) | anything,
            "cut": flags,
        },
    ),
)
def test_seeds(predicate, material, options):
    points = attempt(pm.seed, grid(), predicate, material=material, **options)
    if points is not None:
        assert points.total > 0
        volume = COMM.allreduce(float(points.volume0.sum()))
        if points.total > 1 and options.get("cut", True) and options.get("layout", "uniform") == "uniform":
            box = options.get("bounds") or ((-1, -1), (3, 2))
            if callable(predicate):
                box = ((0, 0), (2, 1))
            assert np.isclose(volume, np.prod(np.subtract(box[1], box[0], dtype=float)), rtol=1e-3)
        assert np.all(points.volume0 > 0)
        assert np.all(np.isfinite(points.x))


@OPTIONS
@given(
    arrays(3, 2) | arrays(3, 3),
    arrays(3),
    arrays(3, 2),
    MATERIALS,
    st.just(COMM) | st.none(),
    st.fixed_dictionaries({}, optional={"half_axes": arrays(3, 2, 2), "first_id": numbers | anything}),
)
def test_points(x, volume, half_length, material, comm, options):
    points = attempt(pm.Points, x, volume, half_length, material, comm, **options)
    if points is not None:
        n, d = points.x.shape
        assert (n, d) == (len(points), points.dim)
        assert all(np.all(np.isfinite(a)) for a in points.arrays().values())
        assert points.volume0.min() > 0
        assert len(np.unique(np.concatenate(COMM.allgather(points.id)))) == points.total
        twin = copy.deepcopy(points)
        again = pickle.loads(pickle.dumps(points))
        points.x[:] = NAN
        for other in (twin, again):
            assert np.array_equal(other.x, points.X)
            assert other.comm == COMM


@OPTIONS
@given(anything, st.none() | numbers | anything)
def test_selections(ids, of):
    selection = attempt(pm.Selection, ids, of)
    if selection is not None:
        assert np.array_equal(selection.ids, np.unique(np.asarray(ids, dtype=np.int64)))
        assert np.array_equal(BODY.id[BODY.rows(selection)], np.intersect1d(BODY.id, selection.ids))


@OPTIONS
@given(predicates(inside))
def test_where(predicate):
    before = BODY.x.copy()
    found = attempt(BODY.where, predicate)
    assert np.array_equal(BODY.x, before)
    assert found is None or len(found) in (0, BODY.total)


@OPTIONS
@given(vectors(2), st.none() | numbers | anything)
def test_farthest(direction, tolerance):
    found = attempt(BODY.farthest, direction, tolerance)
    if found is not None:
        assert len(found) > 0
        n = np.asarray(direction, float)
        along = np.concatenate(COMM.allgather(BODY.x @ (n / np.abs(n).max())))
        ids = np.concatenate(COMM.allgather(BODY.id))
        assert ids[np.argmax(along)] in found.ids


@OPTIONS
@given(vectors(2), st.integers(1, 5) | numbers | anything)
def test_nearest(position, count):
    found = attempt(BODY.nearest, position, count)
    if found is not None:
        assert len(found) == min(int(count), BODY.total)


@OPTIONS
@given(st.just(np.ones(len(BODY))) | arrays(len(BODY), 2) | anything, SELECTIONS)
def test_mean(values, selection):
    found = attempt(BODY.mean, values, selection)
    assert found is None or np.shape(found) == np.shape(values)[1:]
    found = attempt(BODY.mean_displacement, selection)
    assert found is None or np.all(found == 0)
    found = attempt(BODY.rows, selection)
    assert found is None or np.all(found < len(BODY))


@thorough(30)
@given(SELECTIONS, MATERIALS)
def test_assign(selection, material):
    points = body()
    attempt(points.assign, selection, material)
    assert points.material.max(initial=0) < len(points.materials)
    assert all(isinstance(m, pm.Material) for m in points.materials)


@thorough(30)
@given(st.builds(body) | st.just(OTHER) | anything)
def test_join(other):
    points = body()
    before = points.total
    attempt(points.join, other)
    theirs = other.total if isinstance(other, pm.Points) else 0
    assert points.total in (before, before + theirs)
    assert attempt(points.join, points) is None
