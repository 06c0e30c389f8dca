"""Whatever a figure is made of: an error of the package, or a figure."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import polarmpm as pm
from polarmpm import plot
from tests.conftest import COMM, MICROPOLAR
from tests.helpers.bodies import box
from tests.helpers.weird import anything, attempt, flags, thorough, vectors

pytestmark = pytest.mark.filterwarnings("ignore")
LOOKS = st.fixed_dictionaries(
    {},
    optional={
        "label": st.one_of(st.just("u (m)"), anything),
        "limits": vectors(2),
        "cmap": st.one_of(st.sampled_from(["viridis", "coolwarm", "nothing"]), anything),
        "undeformed": flags,
        "length": st.one_of(st.just((1e3, "mm")), anything),
        "view": vectors(2),
        "ax": anything,
    },
)


@cache
def points() -> pm.Points:
    grid = pm.Grid.box((0.0, 0.0), (2.0, 2.0), 1.0)
    return pm.seed(grid, material=MICROPOLAR, points_per_cell=1)


@cache
def elements() -> pm.Elements:
    return pm.Elements(box("quadrilateral", (2, 2), (2.0, 2.0)), material=MICROPOLAR)


@thorough(30)
@given(st.one_of(st.none(), st.just("ramp"), anything), LOOKS, flags)
def test_points(values, look, domains):
    p = points()
    values = np.arange(len(p)) if isinstance(values, str) and values == "ramp" else values
    ax = attempt(plot.plot_points, p, values, **look, domains=domains)
    assert ax is None or COMM.rank == 0
    if ax is not None and look.get("limits") is not None and values is not None:
        assert look["limits"][0] <= look["limits"][1]


@thorough(30)
@given(st.one_of(st.none(), st.just("ramp"), anything), LOOKS, st.one_of(st.just("cells"), anything), flags)
def test_meshes(values, look, at, edges):
    e = elements()
    values = np.arange(len(e.body.owned_cells)) if isinstance(values, str) and values == "ramp" else values
    attempt(plot.plot_mesh, e, values, **look, at=at, edges=edges)


@thorough(30)
@given(anything, anything)
def test_bodies(points, elements):
    assert attempt(plot.plot_points, points) is None
    assert attempt(plot.plot_mesh, elements) is None


@thorough(60)
@given(anything, anything, vectors(2), anything)
def test_panels(rows, columns, figsize, solid):
    if all(not isinstance(n, int) or n < 10 for n in (rows, columns)):
        found = attempt(plot.subplots, rows, columns, figsize=figsize, solid=solid)
        assert found is None or np.size(found[1]) == int(rows) * int(columns)


def _can_be_key(value: Any) -> bool:
    try:
        return {value: 1}[value] == 1
    except Exception:
        return False


KEYS = st.one_of(st.just("a"), anything.filter(_can_be_key))
CURVES = st.one_of(
    anything,
    st.dictionaries(KEYS, anything, max_size=2),
    st.tuples(vectors(2), vectors(2)).map(lambda pair: {"a": pair}),
)


@thorough(40)
@given(CURVES, CURVES, anything)
def test_curves(curves, reference, label):
    attempt(plot.load_displacement, curves, reference=reference)
    attempt(plot.load_displacement, {"a": ([0.0, 1.0], [0, 1])}, xlabel=label)


@thorough(20)
@given(anything, anything)
def test_files(figure, dpi):
    assert attempt(plot.save, figure, "figure.png") is None
    assert attempt(plot.save, None, "figure.png", dpi=dpi) is None
