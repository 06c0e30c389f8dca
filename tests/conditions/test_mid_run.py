"""Conditions that are added in mid-run: what they hold and load is the same for points, with and without
resets in between, and for elements; and a restart knows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated, by_id
from tests.helpers.bodies import box

STRICT = pm.Controls(force_tolerance=1e-11, energy_tolerance=1e-24)
KINDS = [
    pytest.param({"reset": None}, id="bspline, no reset"),
    pytest.param({"reset": 1}, id="bspline, reset"),
    pytest.param({"reset": None, "basis": "mpm"}, id="mpm, no reset"),
    pytest.param({"reset": 1, "basis": "gimpm"}, id="gimpm, reset"),
    pytest.param(None, id="elements"),
]
LENGTH, HEIGHT = 4.0, 1.0


def bar(
    options: dict[str, Any] | None, material: pm.Material = NEO_HOOKEAN, dim: int = 2, below: float = -3.0
) -> Any:
    """A bar of 4 x 1 (x 1) m as points (options of the problem) or elements (None)."""
    size = (LENGTH, HEIGHT, HEIGHT)[:dim]
    if options is None:
        cell = "quadrilateral" if dim == 2 else "hexahedron"
        cells = (8, 2) if dim == 2 else (4, 1, 1)
        body = pm.Elements(box(cell, cells, size), material=material, degree=2)
        return pm.QuasiStaticFEM(body, controls=STRICT)
    grid = pm.Grid.box((0.0, below, -1.0)[:dim], (8.0, 3.0, 2.0)[:dim], 0.5)
    points = pm.seed(grid, material=material, bounds=((0.0,) * dim, size))
    return pm.QuasiStatic(grid, points, controls=STRICT, **options)


def end_of(problem: Any) -> Any:
    body = getattr(problem, "elements", problem.points)
    return body.farthest((1.0, 0.0, 0.0)[: problem.layout.dim])


def end_moved(problem: Any, end: Any) -> np.ndarray:
    return getattr(problem, "elements", problem.points).mean_displacement(end)


def pulled(options: dict[str, Any] | None, force: Any = lambda t: (2000.0 * min(t, 1.0), 0.0)) -> Any:
    """A bar on rollers, pulled along x: uniaxial, so that stretches are even."""
    problem = bar(options, below=0.0)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.load(end_of(problem), force=force)
    return problem


@pytest.mark.parametrize("options", KINDS)
def test_a_support_holds_the_body_where_it_is(options):
    """A cantilever that is bent by a load; its end is held then, and stays though the load goes on."""
    problem = bar(options, MICROPOLAR)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = end_of(problem)
    problem.load(end, force=lambda t: (0.0, -30.0 * t))
    list(problem.march(3, progress=False))
    before = end_moved(problem, end)
    assert before[1] < -0.2
    turned = by_id(problem.points, problem.points.rotation_vector)[-1]
    held = problem.fix(lambda x: x[:, 0] > 3.2, u=0, theta=0)
    list(problem.march(2, to=2.0, progress=False))
    np.testing.assert_allclose(end_moved(problem, end), before, atol=2e-3 * abs(before[1]))
    np.testing.assert_allclose(by_id(problem.points, problem.points.rotation_vector)[-1], turned, atol=2e-3)
    assert problem.reaction(held).force[1] > 20.0


@pytest.mark.parametrize("options", KINDS)
@pytest.mark.parametrize("value", [0.2, lambda t: 0.2 * t, lambda t, x: 0.2 * t + 0.0 * x[:, 0]])
def test_a_support_moves_the_body_from_there(options, value):
    """By what its value gains; the wall is the place where all bodies have nodes."""
    problem = pulled(options)
    end = end_of(problem)
    list(problem.march(2, progress=False))
    before = end_moved(problem, end)
    problem.release(problem.supports[0])
    problem.fix(pm.plane(x=0.0), ux=value)
    list(problem.march(2, to=1.5, progress=False))
    np.testing.assert_allclose(end_moved(problem, end) - before, (0.1, 0.0), atol=5e-3)


@pytest.mark.parametrize("options", KINDS)
def test_a_support_in_total_brings_the_body_back(options):
    """In one step to where it prescribes: the even stretch 1 + u / L, whatever the state was before."""
    problem = pulled(options)
    list(problem.march(3, progress=False))
    load, end = problem.given.entries[2].condition, end_of(problem)
    before = end_moved(problem, end)[0]
    assert before > 0.6
    problem.release(load)

    def everywhere(x: np.ndarray) -> np.ndarray:
        return np.full(len(x), True)

    # x at the nodes are those of the last reset: u as a function of it has to be constant
    problem.fix(everywhere, ux=lambda t: 0.1, counts="total")
    problem.release(problem.supports[0])
    list(problem.march(1, to=1.1, progress=False))
    u = problem.points.displacement[:, 0]
    np.testing.assert_allclose(u, 0.1, atol=2e-3 * before)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("options", [{"reset": None}, {"reset": 1, "basis": "mpm"}, None])
def test_rotations_in_total(options, dim):
    """A body whose points have been turned is turned to another angle, not by it."""
    problem = bar(options, MICROPOLAR, dim)

    def everywhere(x: np.ndarray) -> np.ndarray:
        return np.full(len(x), True)

    first, second = np.array([0.2, -0.3, 0.5]), np.array([-0.1, 0.2, 0.3])
    if dim == 2:
        first, second = first[2], second[2]
    support = problem.fix(everywhere, u=0, theta=first)
    list(problem.march(2, progress=False))
    problem.release(support)
    problem.fix(everywhere, u=0, theta=lambda t: second, counts="total")
    list(problem.march(2, to=1.5, progress=False))
    found = problem.points.rotation_vector
    expected = np.array([0.0, 0.0, second]) if dim == 2 else second
    np.testing.assert_allclose(found, np.tile(expected, (len(found), 1)), atol=1e-6)


def test_a_function_is_a_total_from_the_start():
    """A constant displacement is reached in the first step; counts="from now" holds the body instead."""
    for counts, expected in ((None, 0.1), ("total", 0.1), ("from now", 0.0)):
        for options in ({"reset": 1}, None):
            problem = bar(options, below=0.0)
            problem.fix(pm.plane(x=0.0), ux=0)
            problem.fix(pm.plane(y=0.0), uy=0)
            problem.fix(
                pm.plane(x=4.0) if options is None else lambda x: x[:, 0] > 3.6,
                ux=lambda t: 0.1,
                counts=counts,
            )
            list(problem.march(2, progress=False))
            assert end_moved(problem, end_of(problem))[0] == pytest.approx(expected, abs=5e-3)


# loads ----------------------------------------------------------------------------------------------------
def surface_of(problem: Any) -> Any:
    if isinstance(problem, pm.QuasiStaticFEM):
        return problem.elements.surface(pm.plane(y=HEIGHT))
    return pm.Surface.line((LENGTH, HEIGHT), (0.0, HEIGHT), 16)


LATE = {
    "load": lambda p, v, **o: p.load(end_of(p), force=(0.0, v), **o),
    "body load": lambda p, v, **o: p.body_load(force=(0.0, v / 4.0), **o),
    "traction": lambda p, v, **o: p.traction(surface_of(p), force=(0.0, v / 4.0), **o),
    "load on a surface": lambda p, v, **o: p.load(surface_of(p), force=(0.0, v), **o),
}
FUNCTION = {"load": lambda p, v, **o: p.load(end_of(p), force=lambda t: (0.0, v * t), **o)}


@pytest.mark.parametrize("options", [KINDS[0], KINDS[2], KINDS[4]])
@pytest.mark.parametrize(
    ("add", "counts", "expected"),
    [(add, None, 8.0 * 0.25) for add in LATE.values()]
    + [(add, "total", 8.0 * 0.75) for add in LATE.values()]
    + [(FUNCTION["load"], None, 8.0 * 0.75), (FUNCTION["load"], "from now", 8.0 * 0.25)],
)
def test_a_load_that_comes_late(options, add, counts, expected):
    """Numbers grow from where they are added; functions are totals; or as `counts` says."""
    problem = bar(options)
    wall = problem.fix(pm.plane(x=0.0), u=0)
    problem.load(end_of(problem), force=lambda t: (5.0, 0.0))
    list(problem.march(1, to=0.5, progress=False))
    add(problem, -8.0, counts=counts)
    list(problem.march(1, to=0.75, progress=False))
    # a new surface comes with a reset, whose carried forces take a little of the old load's reaction
    np.testing.assert_allclose(problem.reaction(wall).force, (-5.0, expected), rtol=1e-3)


@pytest.mark.parametrize("options", [KINDS[0], KINDS[4]])
def test_facets_and_pressures_that_come_late(options):
    problem = bar(options)
    problem.fix(pm.plane(x=0.0), u=0)
    list(problem.march(1, to=0.5, progress=False))
    if options is None:
        problem.traction(pm.plane(y=HEIGHT), force=(0.0, -1.0))
        problem.pressure(pm.plane(y=0.0), 1.0)
    else:
        problem.traction(surface_of(problem), force=(0.0, -1.0))
        problem.pressure(pm.Surface.line((0.0, 0.0), (LENGTH, 0.0), 16), 1.0)
    list(problem.march(1, to=0.75, progress=False))
    # -p n = +p y at the bottom: both cancel, to the turn of the surface
    assert abs(problem.reaction(problem.supports[0]).force[1]) < 0.01
    assert problem.balance().residue[0] < 1e-6


def test_springs_that_come_late():
    """Springs on a surface hold it where it is."""
    for options in ({"reset": None}, {"reset": 1}, None):
        problem = bar(options)
        problem.fix(pm.plane(x=0.0), u=0)
        end = end_of(problem)
        problem.load(end, force=lambda t: (0.0, -20.0 * t))
        list(problem.march(2, progress=False))
        before = end_moved(problem, end)
        if options is None:
            surface = problem.elements.surface(end)
        else:
            x = problem.points.mean(problem.points.x, end)
            surface = pm.Surface.line((x[0], x[1] - 0.4), (x[0], x[1] + 0.4), 4)
        springs = problem.fix(surface, u=0)
        list(problem.march(1, to=1.5, progress=False))
        np.testing.assert_allclose(end_moved(problem, end), before, atol=0.02 * abs(before[1]))
        assert problem.reaction(springs).force[1] > 5.0
        if options is not None:
            with pytest.raises(pm.InputError, match="where it was in the undeformed body isn't known"):
                problem.fix(surface, u=0, counts="total")


def test_bad_counts():
    problem = bar({"reset": 1}, MICROPOLAR, 3)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    for act in (
        lambda: problem.fix(pm.plane(x=0.0), u=0, counts="later"),
        lambda: problem.load(end_of(problem), force=(1.0, 0.0, 0.0), counts=True),
        lambda: problem.body_load(force=(1.0, 0.0, 0.0), counts="now"),
    ):
        with pytest.raises(pm.InputError, match=r"counts = .*'from now' and 'total'"):
            act()
    assert (len(problem.supports), len(problem.loads)) == (1, 0)
    problem.load(end_of(problem), force=(1.0, 0.0, 0.0))
    list(problem.march(1))
    with pytest.raises(pm.InputError, match="single components of a rotation have no total"):
        problem.fix(pm.plane(x=0.0), theta_x=0, counts="total")


# restart --------------------------------------------------------------------------------------------------
def late_conditions(problem: Any, end: Any) -> None:
    """What a run has got since the load factor 0.5, in order."""
    problem.load(end, force=(0.0, -10.0))
    problem.fix(lambda x: abs(x[:, 0] - LENGTH) < 0.3, ux=0.02)
    problem.body_load(force=lambda t: (1.0 * t, 0.0))


@pytest.mark.parametrize("saved_at", [0.75, 1.0])
@pytest.mark.parametrize("options", [{"reset": 2, "basis": "mpm"}, {"reset": None}, {"reset": 1}, None])
def test_restart_knows_since_when(options, saved_at, folder):
    """The script gives all conditions before it reads the file, those of mid-run and released ones too."""

    def started(late: bool) -> tuple[Any, Any]:
        problem = bar(options, MICROPOLAR)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        end = end_of(problem)
        problem.load(end, force=lambda t: (0.0, -20.0 * min(t, 0.5)))
        if late:
            late_conditions(problem, end)
        return problem, end

    whole, end = started(late=False)
    list(whole.march(2, to=0.5, progress=False))
    late_conditions(whole, end)
    list(whole.march(1, to=0.75, progress=False))
    if saved_at == 1.0:
        whole.release(whole.supports[1], until=2.0)
        list(whole.march(1, to=1.0, progress=False))
    pm.save_restart(whole, folder / "run.h5")
    again, _ = started(late=True)
    pm.load_restart(again, folder / "run.h5")
    assert len(again.supports) == len(whole.supports)
    assert [load.name for load in again.loads] == [load.name for load in whole.loads]
    for problem in (whole, again):
        list(problem.march(2, to=1.5, progress=False))
    tolerance = 1e-9 if COMM.size == 1 else 1e-7
    for name in ("x", "F", "q"):
        expected = by_id(whole.points, getattr(whole.points, name))
        np.testing.assert_allclose(
            by_id(again.points, getattr(again.points, name)), expected, atol=tolerance, err_msg=name
        )
    forgetful, _ = started(late=False)
    with pytest.raises(pm.InputError, match=r"the saved state has .*load 2.*hasn't given"):
        pm.load_restart(forgetful, folder / "run.h5")


def test_what_is_new_at_a_restart_counts_from_there(folder):
    problem = pulled({"reset": None}, force=lambda t: (500.0, 0.0))
    list(problem.march(1, to=0.5, progress=False))
    pm.save_restart(problem, folder / "run.h5")
    again = pulled({"reset": None}, force=lambda t: (500.0, 0.0))
    again.load(end_of(again), force=(100.0, 0.0))
    again.fix(lambda x: x[:, 0] > 3.2, uy=0)
    pm.load_restart(again, folder / "run.h5")
    list(again.march(1, to=0.75, progress=False))
    assert again.reaction(again.supports[0]).force[0] == pytest.approx(-525.0, rel=1e-6)
    held = by_id(again.points, again.points.x)
    moved = held - by_id(problem.points, problem.points.x)
    assert np.abs(moved[by_id(again.points, again.points.X)[:, 0] > 3.8, 1]).max() < 1e-9


def test_restart_of_another_body_is_refused(folder):
    """A selection that was made before the file's points were put in may be of other points."""
    problem = bar({"reset": 1})
    problem.fix(pm.plane(x=0.0), u=0)
    problem.load(end_of(problem), force=(1.0, 0.0))
    list(problem.march(1, progress=False))
    pm.save_restart(problem, folder / "run.h5")
    grid = pm.Grid.box((0.0, -3.0), (8.0, 3.0), 0.5)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, 0.0), (LENGTH, HEIGHT)), points_per_cell=3)
    other = pm.QuasiStatic(grid, points)
    other.fix(pm.plane(x=0.0), u=0)
    other.load(points.farthest((1, 0)), force=(1.0, 0.0))
    with pytest.raises(pm.InputError, match="of another body"):
        pm.load_restart(other, folder / "run.h5")
    assert_repeated(by_id(problem.points, problem.points.id), np.arange(problem.points.total))
