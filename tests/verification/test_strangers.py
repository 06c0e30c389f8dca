"""The scenes of `benchmarks/strangers.py` and `benchmarks/nothing_worse.py` run, and read what they say."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from tests.conftest import COMM

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
pytestmark = pytest.mark.skipif(COMM.size > 1, reason="each rank would do the same")


@pytest.fixture(scope="module")
def benchmarks():
    """The benchmarks' modules by name."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        names = ("records", "scenes", "strangers", "nothing_worse")
        yield {name: importlib.import_module(name) for name in names}
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.mark.parametrize("micropolar", [False, True])
def test_strip_reads_the_stiffness_of_a_beam(benchmarks, micropolar):
    """Many points, two cells across: what is left is below 1/12^2 of the section's moment of inertia."""
    scenes = benchmarks["scenes"]
    stuff = scenes.micropolar() if micropolar else scenes.classical()
    found = benchmarks["records"].run(lambda: scenes.strip(2.0, 0.0, 6, material=stuff), 1)
    assert found.value == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("group", ["strips", "column"])
def test_groups_run_and_compare(benchmarks, group, tmp_path, capsys):
    strangers, file = benchmarks["strangers"], tmp_path / "found.json"
    strangers.main([group, "--quick", "--json", str(file)])
    strangers.main(["compare", str(file), str(file)])
    assert "0 entries are worse" in capsys.readouterr().out


def test_a_failure_is_told_and_is_worse(benchmarks):
    records, scenes = benchmarks["records"], benchmarks["scenes"]
    good = records.record("a", records.run(lambda: scenes.column(8, 2)), error=0.01)
    bad = records.record("a", records.run(lambda: scenes.column(8, 0)), error=0.01)
    assert bad["failure"].startswith("points_per_cell")
    assert records.is_worse(good, bad)
    assert not records.is_worse(bad, good)
    assert records.is_worse(good, good | {"error": -0.012})
