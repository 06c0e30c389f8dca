"""A few of the stress tests of `benchmarks/stress.py`, and the faults that they have found."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

import polarmpm as pm

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def stress():
    """The modules of the stress tests by name; every rank runs all by itself."""
    sys.path.insert(0, str(BENCHMARKS))
    names = ("cases", "cuts", "steps", "extremes", "locking")
    try:
        yield {name: importlib.import_module(f"stress_{name}") for name in names}
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture
def bodies(stress):
    return {"micropolar": stress["cases"].MICROPOLAR, "classical": stress["cases"].NEO_HOOKEAN}


# where the grid cuts the body ---------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "basis", "ghost"),
    [
        ("micropolar", "mpm", None),
        ("micropolar", "gimpm", None),
        ("micropolar", "bspline", None),
        ("classical", "mpm", "light"),
        ("classical", "gimpm", "light"),
    ],
)
def test_blocks_anywhere(stress, bodies, kind, basis, ghost):
    """Slivers, points on faces and corners, 2 to 6 points a cell: no step is cut."""
    found = stress["cuts"].run(range(10), 2, basis, bodies[kind], ghost=ghost)
    assert found.passed, found
    assert found.cuts == 0
    assert found.iterations <= 12
    assert found.scaled < 1e9


@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline"])
def test_blocks_anywhere_in_space(stress, bodies, basis):
    found = stress["cuts"].run(range(3), 3, basis, bodies["micropolar"])
    assert found.passed, found
    assert found.cuts == 0


def test_one_point_in_a_cell_needs_the_ghost_penalty(stress, bodies):
    """Without it there are modes of no stiffness that body forces do work on."""
    found = stress["cuts"].run(range(10), 2, "gimpm", bodies["micropolar"], single=True, ghost="thesis")
    assert found.passed, found
    assert found.singular == 0


@pytest.mark.parametrize("assembly", ["direct", "projection"])
@pytest.mark.parametrize("kind", ["micropolar", "classical"])
def test_nodes_without_stiffness(stress, bodies, kind, assembly):
    """Points on corners give three of their cell's four nodes a stiffness; the fourth may have none."""
    c = stress["cases"]
    grid = pm.Grid.box((0, 0), (6, 6), 1.0, c.COMM)
    points = c.block_points((0.875, 0.875), (3.25, 1.25), (4, 4), bodies[kind])
    problem = pm.QuasiStatic(grid, points, basis="mpm", assembly=assembly, reset=1, balanced_reset=False)
    c.clamp(problem, 1.0)
    problem.body_load(force=(100.0, -10.0))
    steps = list(problem.march(2, progress=False))
    assert max(s.iterations for s in steps) <= 5
    fresh = pm.QuasiStatic(
        grid,
        c.block_points((0.875, 0.875), (3.25, 1.25), (4, 4), bodies[kind]),
        basis="mpm",
        reset=1,
        balanced_reset=False,
    )
    c.clamp(fresh, 1.0)
    fresh.attempt(0.0)
    assert np.any(np.diag(c.free_tangent(fresh)) == 0.0)


# load steps ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("basis", "resets"),
    [
        ("gimpm", "no resets"),
        ("gimpm", "let go, one half way"),
        ("bspline", "let go, one half way"),
        ("bspline", "balanced, when distorted"),
    ],
)
def test_load_steps_too_large_and_too_small(stress, basis, resets):
    """Cut and recovered, or twenty times as many: with the same resets the answer is the same to 1e-8."""
    for found in (
        stress["steps"].too_large(basis, resets),
        stress["steps"].too_small(basis, resets, factor=20),
    ):
        assert found.passed, found


# ends of the ranges -------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["mpm", "bspline"])
@pytest.mark.parametrize(("coupling", "length"), [(0.35, 1e4), (1e6, 1e4), (1e6, 1e-4), (1e-6, 1e-4)])
def test_moduli(stress, basis, coupling, length):
    """Loads of a billionth of the stiffness are felt as they should, however large kappa and gamma are."""
    found = stress["extremes"].moduli(basis, coupling, length)
    assert found.passed, found
    assert found.cuts == 0


@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline"])
def test_compression_to_a_tenth(stress, bodies, basis):
    for found in (
        stress["extremes"].compression(basis, bodies["micropolar"], reset=None),
        stress["extremes"].compression(basis, bodies["classical"]),
        stress["extremes"].compression(basis, stress["extremes"].HENCKY),
    ):
        assert found.passed, found


@pytest.mark.parametrize("reset", [1, None])
@pytest.mark.parametrize(("dim", "basis", "turns"), [(2, "gimpm", 5), (2, "bspline", 5), (3, "mpm", 1)])
def test_turns(stress, bodies, dim, basis, turns, reset):
    found = stress["extremes"].turning(basis, bodies["micropolar"], dim, turns, reset=reset)
    assert found.passed, found
    assert found.error < 1e-12


def test_large_prescribed_rotations_of_a_classical_body(stress, bodies):
    """36 degrees a step: stresses predicted along the prescribed motion would lead astray."""
    found = stress["extremes"].turning("mpm", bodies["classical"], 2, 1, reset=1)
    assert found.passed, found
    assert found.iterations <= 6


@pytest.mark.slow
@pytest.mark.parametrize(("basis", "reset"), [("mpm", 1), ("bspline", None)])
def test_a_hundred_turns(stress, bodies, basis, reset):
    found = stress["extremes"].turning(basis, bodies["micropolar"], 2, 100, reset=reset)
    assert found.passed, found


@pytest.mark.parametrize("kind", ["micropolar", "classical"])
@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline"])
def test_units(stress, bodies, basis, kind):
    """Nanometres to kilometres, terapascals to picopascals, at the usual tolerances: the same digits."""
    found = stress["extremes"].units(2, basis, bodies[kind])
    assert found.passed, found
    assert found.error < 1e-12


# locking ------------------------------------------------------------------------------------------
@pytest.mark.filterwarnings("ignore:.*lock:UserWarning")
@pytest.mark.parametrize(
    ("method", "nu", "low", "high"),
    [
        ("mpm", 0.0, 0.97, 0.99),
        ("mpm", 0.4999, 0.05, 0.06),
        ("bspline", 0.4999, 0.86, 0.89),
        ("FEM 1", 0.4999, 0.05, 0.06),
        ("FEM 2", 0.4999, 0.97, 0.99),
    ],
)
def test_locking_is_as_documented(stress, method, nu, low, high):
    """Share of the reference's work in the layer under a footing."""
    found = stress["locking"].locking("footing", method, nu, False, tangents=False)
    assert found.passed
    assert low < 1 - found.error < high
