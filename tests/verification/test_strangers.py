"""The scenes of `benchmarks/strangers.py` and `benchmarks/nothing_worse.py` run, and read what they say."""

from __future__ import annotations

import importlib
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from polarmpm.problems import doubts
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


@pytest.mark.parametrize(
    ("number", "options", "missed"),
    [
        (2, {"boxes": False}, 0.25),
        (6, {"boxes": False}, 0.028),
        (2, {"layout": "gauss"}, 0.0),
    ],
)
def test_what_a_sum_over_points_misses(benchmarks, number, options, missed):
    """A strip one cell thick, along the grid: s / (1 - s) is its error. Gauss' points miss nothing there."""
    scenes, records = benchmarks["scenes"], benchmarks["records"]
    made = records.run(lambda: scenes.strip(1.0, 0.0, number, **options), 1, keep=True, adaptive=False)
    assert made.problem.box_record.largest[0] == pytest.approx(missed, abs=0.002)
    assert made.value == pytest.approx(1.0 / (1.0 - missed), rel=5e-3)
    assert len(made.warned) == int(missed > 0.08)
    assert "misses about" in made.problem.trust()


@pytest.mark.parametrize(("cells", "settlement"), [(2, 0.02), (4, 0.01)])
def test_excess_of_strains_tells_a_coarse_footing(benchmarks, cells, settlement):
    """An eighth off with two cells, 4 % with four: the boxes see neither."""
    scenes, records = benchmarks["scenes"], benchmarks["records"]
    made = records.run(lambda: scenes.footing(cells, 2, settlement=settlement), keep=True)
    assert len(made.warned) == int(cells == 2)
    assert (made.problem.box_record.grid.excess > 0.15) == (cells == 2)
    assert made.unresolved < 0.2
    assert "flowing body" in made.problem.trust()


@pytest.mark.parametrize(("cell", "wrong"), [(0.25, True), (0.125, False)])
def test_stresses_tell_how_tents_fail_in_a_flowing_cylinder(benchmarks, cell, wrong):
    """A fifth off with cells of a quarter of the inner radius, 4 % with an eighth; strains are smooth."""
    scenes, records = benchmarks["scenes"], benchmarks["records"]
    made = records.run(partial(by_tents, benchmarks, partial(scenes.hill, cell, 2)), keep=True)
    assert (abs(made.value - 1.0) > 0.1) == wrong
    assert bool(made.warned) == wrong
    assert made.problem.box_record.grid.excess < 0.05


@pytest.mark.parametrize(("cell", "wrong"), [(4.0, True), (1.0, False)])
def test_rough_strains_tell_a_beam_of_a_few_cells(benchmarks, cell, wrong):
    """An eighth off with 2 1/2 cells along a beam that bends far, .4 % with ten; boxes see neither."""
    scenes, records = benchmarks["scenes"], benchmarks["records"]
    made = records.run(lambda: scenes.beam(cell, 3), 20, keep=True)
    assert bool(made.warned) == wrong
    assert made.unresolved < 0.4
    assert (made.problem.box_record.grid.rough > 0.15) == wrong


def by_tents(benchmarks, build):
    problem, read = benchmarks["strangers"].by_tents(build, "mpm")
    return problem, lambda: read()[0]


def test_bending_is_not_rough(benchmarks):
    """Nor is a turned one, of one cell's thickness."""
    scenes, records = benchmarks["scenes"], benchmarks["records"]
    made = records.run(lambda: scenes.strip(1.0, 0.5, 2), 1, keep=True, adaptive=False)
    rough, size = doubts.roughness(made.problem.system, np.zeros_like(made.problem.system.x))
    assert rough < 0.02
    assert 1e-9 < size < 1e-3
