"""Conditions that are released: at once, or as a load that fades."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.conditions.amplitudes import Fade
from tests.conditions.test_mid_run import HEIGHT, KINDS, LENGTH, bar, end_moved, end_of, surface_of
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id

EXACT = [KINDS[0], KINDS[2], KINDS[4]]  # without resets, whose carried forces take a part of reactions


def propped(options: Any, material: pm.Material = NEO_HOOKEAN, dim: int = 2) -> tuple[Any, Any, Any]:
    """A cantilever of unit weight density 10, propped at its end; the wall and the prop."""
    problem = bar(options, material, dim)
    theta = {"theta": 0} if material.micropolar else {}
    wall = problem.fix(pm.plane(x=0.0), u=0, **theta)
    prop = problem.fix(lambda x: x[:, 0] > 3.7, uy=0)
    problem.body_load(force=lambda t: (0.0, -10.0 * min(t, 1.0), 0.0)[:dim])
    list(problem.march(2, progress=False))
    return problem, wall, prop


def test_the_lists_are_read_only():
    problem, wall, prop = propped({"reset": None})
    assert problem.supports == (wall, prop)
    assert isinstance(problem.loads, tuple)
    assert isinstance(problem.terms, tuple)
    with pytest.raises(AttributeError):
        problem.supports = []
    with pytest.raises(pm.InputError, match=r"remove: .* problem\.release takes one away"):
        problem.supports.remove(prop)


@pytest.mark.parametrize("options", KINDS)
def test_a_support_that_is_gone(options):
    """The body falls as far as one that never had it: nothing of the reaction is left or carried."""
    problem, wall, prop = propped(options)
    problem.release(prop)
    list(problem.march(2, to=2.0, progress=False))
    free = bar(options)
    free.fix(pm.plane(x=0.0), u=0)
    free.body_load(force=lambda t: (0.0, -10.0 * min(t, 1.0)))
    list(free.march(2, progress=False))
    expected = end_moved(free, end_of(free))
    found = by_id(problem.points, problem.points.displacement).min(axis=0)[1]
    lowest = by_id(free.points, free.points.displacement).min(axis=0)[1]
    assert expected[1] < -0.1
    exact = options is None or options["reset"] is None
    # resets on the way move the answer, those of domains more than others
    domains = options is not None and options.get("basis") == "gimpm"
    assert found == pytest.approx(lowest, rel=1e-6 if exact else 0.03 if domains else 3e-3)
    assert problem.reaction(wall).force[1] == pytest.approx(40.0, rel=1e-6)
    with pytest.raises(pm.InputError, match=r"support 2 \(<lambda>\) was released at load factor 1"):
        problem.reaction(prop)


@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize("options", EXACT)
def test_a_reaction_that_fades(options, material):
    """Handed over, it keeps the body where it is; a share of it is what the wall doesn't carry."""
    problem, wall, prop = propped(options, material)
    end = end_of(problem)
    held, before = problem.reaction(prop).force[1], end_moved(problem, end)
    moment = problem.reaction(wall).moment[0]
    problem.release(prop, over=0.5)
    assert problem.attempt(1.0).converged
    np.testing.assert_allclose(end_moved(problem, end), before, atol=1e-9)
    assert problem.reaction(wall).moment[0] == pytest.approx(moment, rel=1e-7)
    list(problem.march(1, to=1.25, progress=False))
    assert problem.reaction(wall).force[1] == pytest.approx(40.0 - 0.5 * held, rel=1e-7)
    assert problem.balance().residue == pytest.approx((0.0, 0.0), abs=1e-8)
    list(problem.march(1, to=1.5, progress=False))
    assert problem.reaction(wall).force[1] == pytest.approx(40.0, rel=1e-7)
    assert abs(problem.energies()["residue"]) < 0.05 * problem.energies()["external"]
    (load,) = problem.loads  # nothing is left of it
    assert load.name.startswith("body load")


@pytest.mark.parametrize("options", [{"reset": 1}, {"reset": 1, "basis": "mpm"}])
def test_a_reaction_that_fades_over_resets(options):
    """Dead forces on the points go with the body; the end is that of a body that was never propped."""
    problem, wall, prop = propped(options)
    problem.release(prop, until=2.0)
    list(problem.march(5, to=2.0, progress=False))
    assert problem.reaction(wall).force[1] == pytest.approx(40.0, rel=0.03)
    assert len(problem.loads) == 1


@pytest.mark.parametrize("options", [{"reset": None}, None])
def test_couples_in_space_that_fade(options):
    """A clamped end that is twisted is let go: equilibrium stays, then the twist goes back to nothing."""
    problem = bar(options, MICROPOLAR, 3)
    wall = problem.fix(pm.plane(x=0.0), u=0, theta=0)
    head = problem.fix(
        pm.plane(x=LENGTH) if options is None else (lambda x: x[:, 0] > 3.7),
        u=lambda t, x: t * 0.2 * np.stack([0 * x[:, 0], 0.5 - x[:, 2], x[:, 1] - 0.5], axis=1),
        theta=(0.2, 0.0, 0.0),
    )
    list(problem.march(1, progress=False))
    axis = np.array([0.0, 0.5, 0.5])
    twist = problem.reaction(wall, axis).moment[0]
    before = problem.points.x.copy()
    problem.release(head, until=2.0)
    assert problem.attempt(1.0).converged
    np.testing.assert_allclose(problem.points.x, before, atol=1e-6)
    list(problem.march(1, to=1.5, progress=False))
    left = 0.0
    for load in problem.loads:
        of_points = load.values if load.couple else np.cross(problem.points.x - axis, load.values)
        left += 0.5 * COMM.allreduce(of_points.sum(axis=0))[0]
    assert 0.5 * abs(twist) < abs(left) < abs(twist)
    assert problem.reaction(wall, axis).moment[0] == pytest.approx(-left, rel=1e-3)
    list(problem.march(1, to=2.0, progress=False))
    np.testing.assert_allclose(problem.points.x, problem.points.X, atol=1e-6)


LOADS = {
    "load": lambda p: p.load(end_of(p), force=(0.0, -8.0)),
    "body load": lambda p: p.body_load(force=(0.0, -2.0)),
    "traction": lambda p: p.traction(surface_of(p), force=(0.0, -2.0)),
    "load on a surface": lambda p: p.load(surface_of(p), force=(0.0, -8.0)),
}


@pytest.mark.parametrize("options", EXACT)
@pytest.mark.parametrize("name", LOADS)
def test_loads_that_go(name, options):
    """At once, and over load factors from the value that they have then."""
    problem = bar(options)
    wall = problem.fix(pm.plane(x=0.0), u=0)
    first, second = (LOADS[name](problem) for _ in range(2))
    list(problem.march(1, to=0.5, progress=False))
    assert problem.reaction(wall).force[1] == pytest.approx(8.0, rel=1e-6)
    problem.release(first)
    problem.release(second, over=0.2)
    for factor, expected in ((0.55, 3.0), (0.6, 2.0), (0.9, 0.0)):
        list(problem.march(1, to=factor, progress=False))
        assert problem.reaction(wall).force[1] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(problem.points.x, problem.points.X, atol=1e-8)


@pytest.mark.parametrize("options", [{"reset": None}, {"reset": 1}, None])
@pytest.mark.parametrize("over", [None, 0.5])
def test_springs_and_pressures_that_go(options, over):
    """The springs' forces fade as a reaction does; a balanced reset doesn't carry on what was released."""
    problem = bar(options)
    wall = problem.fix(pm.plane(x=0.0), u=0)
    if options is None:
        top, below = problem.elements.surface(pm.plane(x=LENGTH)), pm.plane(y=0.0)
    else:
        top = pm.Surface.line((LENGTH, 0.0), (LENGTH, HEIGHT), 4)
        below = pm.Surface.line((0.0, 0.0), (LENGTH, 0.0), 16)
    springs, pressure = problem.fix(top, u=0), problem.pressure(below, 5.0)
    list(problem.march(2, progress=False))
    assert problem.reaction(springs).force[1] < -4.0
    problem.release(springs, over=over)
    problem.release(pressure, over=over)
    if over:
        list(problem.march(1, to=1.25, progress=False))
        fading = sum(part.force[1] for part in problem.balance().parts if part.name != "support 1 (x = 0)")
        assert problem.reaction(wall).force[1] == pytest.approx(-fading, rel=0.03)
    list(problem.march(2, to=2.0, progress=False))
    assert abs(problem.reaction(wall).force[1]) < (1e-6 if not options or not options["reset"] else 0.2)
    largest = 1e-8 if not options or not options["reset"] else 0.02
    np.testing.assert_allclose(problem.points.x, problem.points.X, atol=largest)
    with pytest.raises(pm.InputError, match="was released"):
        problem.reaction(springs)


@pytest.mark.parametrize("options", [{"reset": None}, {"reset": None, "basis": "mpm"}, None])
def test_energy_of_what_is_released_at_once(options):
    """All stored energy is given back to what was released; trapezoids are exact for small motions."""
    problem = bar(options)
    problem.fix(pm.plane(x=0.0), u=0)
    prop = problem.fix(lambda x: x[:, 0] > 3.7, uy=-1e-4)
    load = problem.load(end_of(problem), force=(1e-2, 0.0))
    body = problem.body_load(force=(1e-2, 0.0))
    list(problem.march(1, progress=False))
    stored = problem.energy()
    assert problem.energies()["external"] == pytest.approx(stored, rel=1e-3)
    for one in (prop, load, body):
        problem.release(one)
    list(problem.march(1, to=2.0, progress=False))
    assert problem.energy() < 1e-5 * stored
    assert abs(problem.energies()["external"]) < 1e-3 * stored


def test_a_platen_that_is_taken_away():
    """Its plane stays where it was, so that grid and body fit; the body springs back as far as it can."""
    grid = pm.Grid.box((0, 0), (4, 1), 0.5)
    points = pm.seed(grid, material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, reset=1)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    platen = problem.fix(pm.plane(x=4.0), ux=lambda t: 1.0 * min(t, 1.0))
    list(problem.march(4, progress=False))
    assert problem.grid.upper[0] == pytest.approx(4.75)
    problem.release(platen, over=1.0)
    list(problem.march(4, to=2.0, progress=False))
    assert problem.grid.upper[0] == pytest.approx(5.0)
    assert points.mean_displacement(points.farthest((1, 0)))[0] < 0.05


def test_mistakes():
    problem, _, prop = propped({"reset": None})
    other, foreign, _ = propped({"reset": None})
    fresh = bar({"reset": None})
    first = fresh.fix(pm.plane(x=0.0), u=0)
    for act, message in (
        (lambda: problem.release(foreign), "no condition of this problem"),
        (lambda: problem.release("prop"), "'prop' is no condition"),
        (lambda: problem.reaction(foreign), "isn't a support of this problem"),
        (lambda: problem.release(prop, over=1.0, until=2.0), "one of them"),
        (lambda: problem.release(prop, over=0.0), "nothing can fade between"),
        (lambda: problem.release(prop, over=-0.5), "over = -0.5: finite load factors, not negative"),
        (lambda: problem.release(prop, until=1.0), "nothing can fade between"),
        (lambda: problem.release(prop, over=np.nan), "finite load factor"),
        (lambda: fresh.release(first, over=1.0), "before the first load step"),
    ):
        with pytest.raises(pm.InputError, match=message):
            act()
    late = problem.fix(lambda x: x[:, 0] > 3.7, ux=0)
    with pytest.raises(pm.InputError, match="no load step has been solved yet with support 3"):
        problem.reaction(late)
    with pytest.raises(pm.InputError, match="no load step has been solved yet with support 3"):
        problem.release(late, over=1.0)
    problem.release(prop)
    with pytest.raises(pm.InputError, match=r"was released at load factor 1 already"):
        problem.release(prop)
    fresh.release(first)
    assert fresh.supports == ()
    assert other.supports[0] is foreign


FADING = {
    "dead": lambda p: p.load(end_of(p), force=(0.0, -9.0)),
    "body": lambda p: p.body_load(force=(0.0, -3.0)),
    "traction": lambda p: p.traction(surface_of(p), force=(0.0, -5.0)),
    "pressure": lambda p: p.pressure(surface_of(p), 7.0),
    "support": lambda p: p.fix(lambda x: x[:, 0] > 3.7, uy=0.01),
    "springs": lambda p: p.fix(surface_of(p), uy=0.01),
}


@pytest.mark.parametrize("options", [KINDS[0], KINDS[4]])
@pytest.mark.parametrize("kind", FADING)
def test_a_fade_has_a_direction_and_an_end(kind, options, folder):
    """Away from where it has vanished there is no step; once it has, it doesn't come back, nor after a
    restart."""

    def make() -> tuple[Any, Any]:
        problem = bar(options)
        problem.fix(pm.plane(x=0.0), u=0)
        return problem, FADING[kind](problem)

    problem, condition = make()
    list(problem.march(1, progress=False))
    moved = np.abs(end_moved(problem, end_of(problem))).max()
    problem.release(condition, until=0.5)
    with pytest.raises(
        pm.InputError, match=r"released, fades from load factor 1 to 0\.5: on the way from 1 "
    ):
        list(problem.march(1, to=1.5, progress=False))
    assert problem.progress.factor == 1.0
    list(problem.march(2, to=0.5, progress=False))
    assert np.abs(end_moved(problem, end_of(problem))).max() < 1e-7 * moved
    pm.save_restart(problem, folder / "faded.h5")
    again, _ = make()
    pm.load_restart(again, folder / "faded.h5")
    for one in (problem, again):
        list(one.march(1, to=1.0, progress=False))
        assert np.abs(end_moved(one, end_of(one))).max() < 1e-7 * moved


def test_fades():
    """Both ways along the load factor; back before its beginning nothing grows."""
    assert [Fade(1.0, 2.0).share(t) for t in (0.5, 1.0, 1.25, 2.0, 3.0)] == [1.0, 1.0, 0.75, 0.0, 0.0]
    assert [Fade(1.0, 0.0).share(t) for t in (1.5, 0.75, -1.0)] == [1.0, 0.75, 0.0]
