"""Whatever a study is made of: an error of the package, or what was asked for."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polarmpm import study
from tests.helpers.weird import anything, attempt, flags, numbers, thorough

pytestmark = pytest.mark.filterwarnings("ignore")
ROW = study.Row("a", "b", 1.0, result=(1.0, 2.0), errors={"exact": 0.1}, cpu_s=1.0, phases={"solve": 1.0})


def build(**arguments: Any) -> Any:
    raise AssertionError("isn't called")


@thorough(100)
@given(
    st.one_of(st.just("GIMPM"), anything),
    numbers,
    st.one_of(st.just(build), anything),
    st.one_of(st.just({"cell": 1.0}), anything),
    st.one_of(st.integers(1, 9), anything),
    flags,
)
def test_discretisations(method, h, function, arguments, steps, adaptive):
    made = attempt(study.Discretisation, method, "label", h, function, arguments, steps, adaptive)
    if made is not None:
        assert 0 < made.h < math.inf
        assert made.steps >= 1


@thorough(60)
@given(
    st.one_of(anything, anything.map(lambda v: {"exact": v}), anything.map(lambda v: {"exact": lambda r: v}))
)
def test_references(references):
    row = attempt(study.compare, ROW, references)
    if row is not None:
        assert all(math.isfinite(error) and error >= 0 for error in row.errors.values())


@thorough(60)
@given(st.one_of(anything, st.lists(st.one_of(st.just(ROW), anything), max_size=2)), anything, numbers)
def test_tables(rows, name, level):
    for table in (study.markdown, study.markdown_phases, study.markdown_orders):
        text = attempt(table, rows)
        assert text is None or text.startswith("|")
    attempt(study.orders, rows, name)
    attempt(study.time_for_error, [ROW], "exact", level)
    attempt(study.markdown_times, rows, name, [level])


@thorough(30)
@given(anything, anything)
def test_runs(discretisations, path):
    assert attempt(study.run, discretisations, {}) is None
    assert attempt(study.read_csv, path) is None
