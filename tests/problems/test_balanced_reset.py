"""Resets that keep the body in equilibrium."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, assert_repeated, by_id


def cantilever(
    *, balanced: bool, basis: str = "mpm", reset: int = 1, dim: int = 2, assembly: str = "direct"
) -> pm.QuasiStatic:
    """A strip of one cell's thickness, cut by the grid, that bends under an end force."""
    upper = (6.0, 5.0, 1.0)[:dim]
    grid = pm.Grid.box((0.0, -2.0, 0.0)[:dim], upper, 0.5, COMM)
    bounds = ((0.0, -0.2, 0.0)[:dim], (5.0, 0.3, 0.5)[:dim])
    points = pm.seed(grid, bounds=bounds, material=MICROPOLAR, points_per_cell=4)
    problem = pm.QuasiStatic(
        grid, points, basis=basis, reset=reset, balanced_reset=balanced, assembly=assembly
    )
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1.0, 0.0, 0.0)[:dim]), force=(0.0, 4.0, 0.0)[:dim])
    return problem


def run(problem: pm.QuasiStatic, steps: int, **options) -> np.ndarray:
    tip = problem.loads[0].selection
    for _ in problem.march(steps, progress=False, **options):
        pass
    return problem.points.mean_displacement(tip)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline", "bspline3"])
def test_a_reset_alone_moves_nothing(basis, dim):
    """At the same load the body stays where it is; the papers' reset lets it sag."""
    moved = {}
    for balanced in (True, False):
        problem = cantilever(balanced=balanced, basis=basis, dim=dim)
        run(problem, 3)
        before = by_id(problem.points, problem.points.displacement)
        assert problem.attempt(1.0).converged  # the same load factor on a fresh grid
        moved[balanced] = abs(by_id(problem.points, problem.points.displacement) - before).max()
    assert moved[True] < 1e-12 < 1e-4 < moved[False]


def test_both_assemblies_carry_the_same():
    found = [run(cantilever(balanced=True, assembly=a), 4) for a in ("direct", "projection")]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-8)


@pytest.mark.parametrize("basis", ["mpm", "gimpm"])
def test_the_answer_depends_little_on_the_number_of_resets(basis):
    never = run(cantilever(balanced=False, basis=basis, reset=None), 4)
    change = {}
    for balanced in (True, False):
        few, many = (run(cantilever(balanced=balanced, basis=basis), steps) for steps in (4, 16))
        change[balanced] = np.linalg.norm(many - few) / np.linalg.norm(never)
    assert change[True] < 0.3 * change[False]


def test_unloading_leads_back_to_the_start():
    lasting = {}
    for balanced in (True, False):
        problem = cantilever(balanced=balanced, basis="bspline")
        run(problem, 4)
        lasting[balanced] = np.linalg.norm(run(problem, 4, to=0.0))
    assert lasting[True] < 0.2 * lasting[False]


def test_a_load_added_later_is_felt():
    problem = cantilever(balanced=True)
    tip = problem.loads[0].selection
    run(problem, 2)
    before = problem.points.mean_displacement(tip)
    problem.load(tip, force=lambda factor: (0.0, 1.0))
    assert problem.attempt(1.0).converged
    moved = problem.points.mean_displacement(tip) - before
    assert moved[1] > 0.1 * before[1]


@pytest.mark.parametrize("stop", [2, 3])
def test_restart_goes_on_to_the_same_digits(folder: Path, stop):
    """Between two resets the carried forces are in the file; at one they follow from the state."""
    straight = cantilever(balanced=True, reset=2)
    run(straight, 5)
    first = cantilever(balanced=True, reset=2)
    for step in first.march(5, progress=False):
        if step.number == stop:
            break
    pm.save_restart(first, folder / "state.h5")
    second = cantilever(balanced=True, reset=2)
    pm.load_restart(second, folder / "state.h5")
    run(second, 5 - stop)
    for name, values in second.points.arrays().items():
        expected = by_id(straight.points, getattr(straight.points, name))
        assert_repeated(by_id(second.points, values), expected, name)


def test_failed_step_leaves_everything():
    """But for the ranks on which points are: the step began with a reset, which may distribute them anew."""
    problem = cantilever(balanced=True)
    run(problem, 2)
    before = {name: by_id(problem.points, a) for name, a in problem.points.arrays().items()}
    assert not problem.attempt(1e6).converged
    for name, values in before.items():
        np.testing.assert_array_equal(by_id(problem.points, getattr(problem.points, name)), values, name)


def test_rounding_does_not_choose_the_stresses_that_are_carried():
    """Where the eighth reset finds this beam, there are motions that its points don't feel, and the moduli's
    matrix is singular: answers of loads that are nearly the same would be a millimetre apart."""
    ends = []
    for force in (100e3, 100e3 * (1.0 + 1e-9)):
        grid = pm.Grid.box((0.0, -4.0), (12.0, 2.0), 0.5, COMM)
        material = pm.Hencky.from_engineering(E=12e6, nu=0.2)
        points = pm.seed(grid, bounds=((0.0, 0.0), (10.0, 1.0)), material=material, points_per_cell=2)
        problem = pm.QuasiStatic(grid, points, reset=1)
        problem.fix(pm.plane(x=0.0), u=0)
        problem.traction(pm.Surface.line((10.0, 0.0), (10.0, 1.0), 8), force=(0.0, -force))
        for _ in problem.march(9, to=0.18, progress=False):
            pass
        ends.append(problem.points.mean_displacement(points.farthest((1.0, 0.0))))
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-7)
