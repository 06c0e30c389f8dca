"""Derivatives by twins: against differences of whole runs, which are too slow and too rough for use."""

from __future__ import annotations

import gc
import weakref
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM
from tests.sensitivity import scenes
from tests.sensitivity.scenes import BEAM, SOIL, differences, digits, rates


def marches(steps: int) -> Any:
    return lambda run: run.march(steps=steps)


@pytest.mark.parametrize(
    ("options", "least"),
    [
        ({"basis": "bspline"}, 6),
        ({"basis": "bspline", "balanced_reset": False}, 6),
        ({"basis": "mpm"}, 6),
        ({"basis": "mpm", "balanced_reset": False}, 6),
        ({"basis": "bspline3"}, 6),
        ({"basis": "bspline-averaged"}, 6),
        ({"basis": "gimpm", "ghost": "light"}, 6),
        ({"basis": "gimpm", "balanced_reset": False}, 5),
        ({"locking": "always"}, 6),
    ],
)
@pytest.mark.filterwarnings("ignore:balanced_reset")
def test_cantilever(options, least):
    scene = partial(scenes.cantilever, **options)
    found = rates(scene, BEAM, ["E", "l"], marches(3))
    exact = differences(scene, BEAM, ["E", "l"], marches(3), 1e-6)
    assert digits(found, exact) >= least


def test_flow_under_a_platen():
    found = rates(scenes.column, SOIL, ["c", "kappa"], marches(3))
    assert digits(found, differences(scenes.column, SOIL, ["c", "kappa"], marches(3), 1e-5)) >= 5.5


def test_elements():
    found = rates(scenes.elements, SOIL, ["c"], marches(3))
    assert digits(found, differences(scenes.elements, SOIL, ["c"], marches(3), 1e-5)) >= 6


def test_surfaces():
    found = rates(scenes.held_on_surfaces, BEAM, ["l"], marches(3))
    assert digits(found, differences(scenes.held_on_surfaces, BEAM, ["l"], marches(3), 1e-5)) >= 6


ARCH = {**BEAM, "l": 0.1}


@pytest.mark.parametrize("options", [{}, {"balanced_reset": False, "basis": "mpm"}])
@pytest.mark.filterwarnings("ignore:balanced_reset")
def test_along_the_path(options):
    """Through the limit point, where there is no derivative at a given load."""

    def march(run: Any) -> Any:
        return run.march_arc_length(0.2, steps=4)

    scene = partial(scenes.arch, **options)
    found = rates(scene, ARCH, ["E", "l"], march)
    exact = differences(scene, ARCH, ["E", "l"], march, 1e-6)
    assert digits(found, exact) >= 6
    problem, _ = scene(ARCH)
    factors = [step.factor for step in march(problem)]
    assert max(factors) > factors[-1]


def test_the_last_step_along_the_path_ends_at_a_load():
    def march(run: Any) -> Any:
        return run.march_arc_length(0.05, to=0.1)

    found = rates(scenes.arch, ARCH, ["l"], march)
    assert found["factor"]["l"][-1] == 0.0
    exact = differences(scenes.arch, ARCH, ["l"], march, 1e-6)
    assert digits({"root": found["root"]}, {"root": exact["root"]}) >= 6


@pytest.mark.slow
def test_couples_in_space():
    found = rates(scenes.shaft, BEAM, ["E", "l"], marches(2))
    assert digits(found, differences(scenes.shaft, BEAM, ["E", "l"], marches(2), 1e-5)) >= 6


def test_steps_that_adapt():
    """The twins take over the run's cuts."""
    few = pm.Controls(max_iterations=5)
    with pm.Sensitivity(scenes.column, SOIL, ["c"], controls=few) as run:
        steps = [(step.factor, step.cuts, run.rates) for step in run.march(1, adaptive=True)]
    assert sum(cuts for _, cuts, _ in steps) > 0

    def march(problem: Any) -> Any:
        return (problem.attempt(factor) for factor, _, _ in steps)

    found = {o: {"c": np.array([rates[o]["c"] for _, _, rates in steps])} for o in ("force", "side")}
    assert digits(found, differences(scenes.column, SOIL, ["c"], march, 1e-6)) >= 5.5


def test_the_remainder_is_of_second_order():
    """Mid-run, of a number that has to do with turns only."""
    scene, march = scenes.column, marches(2)
    slope = rates(scene, SOIL, ["kappa"], march)["side"]["kappa"][-1]

    def side(change: float) -> Any:
        problem, observables = scene({**SOIL, "kappa": SOIL["kappa"] * (1 + change)}, controls=scenes.TIGHT)
        return [observables["side"]() for _ in march(problem)][-1]

    off = [np.abs(side(h) - side(0) - h * SOIL["kappa"] * slope).max() for h in (0.02, 0.01)]
    assert 1.9 < np.log2(off[0] / off[1]) < 2.1


@pytest.mark.parametrize("scene", [scenes.cantilever, scenes.column, scenes.elements])
def test_the_run_is_the_same_to_the_last_bit(scene):
    values = BEAM if scene is scenes.cantilever else SOIL
    alone, observables = scene(values)
    expected = [(step.history, {o: f() for o, f in observables.items()}) for step in alone.march(2)]
    with pm.Sensitivity(scene, values, list(values)[:1]) as run:
        for step, (history, answers) in zip(run.march(2), expected, strict=True):
            if COMM.size == 1:  # else factors aren't the same to the last bit, run by run
                assert step.history == history
                assert all(np.array_equal(run.values[o], value) for o, value in answers.items())
        for name in ("x", "F", "q", "wryness"):
            found, once = getattr(run.problem.points, name), getattr(alone.points, name)
            if COMM.size == 1:
                assert np.array_equal(found, once)
            else:
                np.testing.assert_allclose(found, once, rtol=0, atol=1e-9)


def test_a_run_that_is_dropped_is_gone():
    """Without the garbage collector: there are factors in it."""
    run = pm.Sensitivity(scenes.cantilever, BEAM, ["l"])
    next(run.march(3))
    there = weakref.ref(run.problem)
    gc.disable()
    try:
        del run
        assert there() is None
    finally:
        gc.enable()


def test_local_iterations_begin_from_those_of_the_run(monkeypatch):
    """They are fewer, and closer: kappa, which hardly matters, has a digit more."""
    from polarmpm.assembly import borrowed
    from polarmpm.forms.returnmapping import ReturnMapping

    evaluate = ReturnMapping.evaluate

    def noted(self: Any, *args: Any) -> Any:
        found = evaluate(self, *args)
        if self.near is not None:
            counts.append((int(found.iterations.sum()), len(found.rows)))
        return found

    def run() -> tuple[Any, float]:
        counts.clear()
        found = rates(scenes.column, SOIL, ["c", "kappa"], marches(3))
        iterations, points = COMM.allreduce(np.sum(counts, axis=0, dtype=float))
        return found, iterations / points

    counts: list[tuple[int, int]] = []
    monkeypatch.setattr(ReturnMapping, "evaluate", noted)
    near, few = run()
    monkeypatch.setattr(borrowed, "_yielding_near", lambda *args: None)
    far, many = run()
    exact = rates(scenes.column, SOIL, ["c", "kappa"], marches(3), method="exact")
    assert digits(near, exact) >= 6.5
    assert digits(far, exact) >= 5.5
    assert few < 0.7 * many


def test_one_side_costs_half():
    with pm.Sensitivity(scenes.cantilever, BEAM, ["l"], sides=1) as run:
        found = [run.rates["root"]["l"] for _ in run.march(2)]
    exact = differences(scenes.cantilever, BEAM, ["l"], marches(2), 1e-6)["root"]["l"]
    assert np.abs(np.array(found) - exact).max() < 1e-4 * np.abs(exact).max()


def test_a_twin_that_goes_astray_is_replaced(monkeypatch):
    """By one of a smaller step, which has gone all the way."""
    from polarmpm.sensitivity import runs

    take = runs._take

    def troubled(pair: Any, step: Any) -> str:
        return take(pair, step) or ("astray" if pair.step > 5e-6 and step.number == 2 else "")

    with pm.Sensitivity(scenes.cantilever, BEAM, ["l"], step=3e-6) as run:
        expected = [run.rates["root"]["l"] for _ in run.march(3)]
    monkeypatch.setattr(runs, "_take", troubled)
    with pm.Sensitivity(scenes.cantilever, BEAM, ["E", "l"]) as run:
        found = [run.rates["root"]["l"] for _ in run.march(3)]
        assert run.steps["l"] == pytest.approx(3e-6)
    assert found[1:] == pytest.approx(expected[1:], rel=1e-9)
    assert found[0] == pytest.approx(expected[0], rel=1e-5)


def test_no_number_is_given_where_there_is_none(monkeypatch):
    from polarmpm.sensitivity import runs

    monkeypatch.setattr(runs, "_take", lambda pair, step: "its chord steps leave 0.5 of the imbalance")
    with pm.Sensitivity(scenes.cantilever, BEAM, ["l"], sides=1) as run:
        with pytest.raises(pm.NotDifferentiable, match=r"l: step 1 .* leave 0.5") as caught:
            next(run.march(3))
        assert (caught.value.parameter, caught.value.step) == ("l", 1)
        with pytest.raises(pm.InputError, match="ended early"):
            run.march(3)


def test_resets_that_lose_stresses_are_told_of():
    with (
        pytest.warns(pm.TrustWarning, match="sawtooth") if COMM.rank == 0 else nullcontext(),
        pm.Sensitivity(partial(scenes.cantilever, balanced_reset=False), BEAM, ["E"], sides=1),
    ):
        pass


@pytest.mark.mpi
@pytest.mark.timeout(300)
def test_two_ranks_whose_points_move():
    """To other ranks at resets; the same derivatives as on one."""
    scenes.assert_two_ranks_agree("twins", 1e-7)


def test_numbers_that_dont_matter():
    """Their derivatives are zero but for rounding, and no twin goes astray."""
    found = rates(scenes.cantilever, {**BEAM, "unused": 3.0}, ["E", "unused"], marches(2))
    assert np.all(found["tip"]["unused"] == 0.0)


# what is refused --------------------------------------------------------------------------------
def longer(p: dict[str, float], **options: Any) -> Any:
    grid = pm.Grid.box((0, 0), (6, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0.0), (p["length"], 1.0)), material=scenes.elastic(BEAM))
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return problem, {"x": lambda: points.mean(points.x)}


def at_random(p: dict[str, float]) -> Any:
    problem, observables = scenes.cantilever({**BEAM, "E": 1e6 * (1 + next(_NOISE))})
    return problem, observables


_NOISE = iter(np.linspace(0, 1, 100))


def touching(p: dict[str, float]) -> Any:
    problem, observables = scenes.cantilever(p)
    problem.obstacle(pm.HalfSpace((0, -1.0), (0, 1)))
    return problem, observables


def in_motion(p: dict[str, float]) -> Any:
    grid = pm.Grid.box((0, 0), (6, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=scenes.elastic(p))
    return pm.Dynamic(grid, points, density=1e3, microinertia=1.0), {"x": lambda: points.mean(points.x)}


def at_an_edge(p: dict[str, float]) -> Any:
    pm.MicropolarElastic.from_engineering(E=1e6, nu=0.25, n=0.5, l_b=0.1, l_t=0.1, psi=p["psi"])
    return scenes.cantilever(BEAM)


def under_way(p: dict[str, float]) -> Any:
    problem, observables = scenes.cantilever(p)
    next(problem.march(10))
    return problem, observables


@pytest.mark.parametrize(
    ("build", "values", "options", "message"),
    [
        (scenes.cantilever, {**BEAM, "extra": 0.0}, {}, "extra = 0: steps are shares"),
        (scenes.cantilever, BEAM, {"parameters": ["e"]}, "parameters = 'e'"),
        (scenes.cantilever, BEAM, {"parameters": "E"}, "parameters = 'E'"),
        (scenes.cantilever, BEAM, {"parameters": []}, r"parameters = \[\]"),
        (scenes.cantilever, {}, {}, "values"),
        (scenes.cantilever, {"E": "stiff"}, {}, "E = 'stiff'"),
        (scenes.cantilever, BEAM, {"method": "adjoint"}, "method = 'adjoint'"),
        (scenes.cantilever, BEAM, {"sides": 3}, "sides = 3"),
        (scenes.cantilever, BEAM, {"step": 0.5}, "step = 0.5"),
        (lambda p: None, BEAM, {}, "build returned None"),
        (lambda p: (1, {"x": float}), BEAM, {}, "build: problem = 1"),
        (lambda p: (scenes.cantilever(p)[0], {}), BEAM, {}, "observables"),
        (lambda p: (scenes.cantilever(p)[0], {"x": 1}), BEAM, {}, "observables: x = 1"),
        (longer, {"length": 4.5}, {}, "length: .* change with it.*not a geometry"),
        (at_random, {"E": 1.0}, {}, "has to be deterministic"),
        (touching, BEAM, {}, "contact"),
        (at_an_edge, {"psi": 1.5}, {}, r"psi: twins have 1\.500045 beside 1\.5, and build fails"),
        (in_motion, BEAM, {}, "Dynamic can't be differentiated"),
        (under_way, BEAM, {}, "has taken 1 step"),
        (partial(scenes.cantilever, basis="mpm", assembly="projection"), BEAM, {}, "assembly = 'projection'"),
        (partial(scenes.elements, assembly="dolfinx"), SOIL, {}, "assembly = 'native'"),
        (
            partial(scenes.cantilever, regrid=lambda problem, trial: None),
            BEAM,
            {},
            "regrid: runs whose steps",
        ),
    ],
)
def test_what_is_refused(build, values, options, message):
    with pytest.raises(pm.InputError, match=message):
        pm.Sensitivity(build, values, **{"parameters": None, **options})


def test_conditions_that_come_later():
    with pm.Sensitivity(scenes.cantilever, BEAM, ["E"]) as run:
        march = run.march(3)
        next(march)
        run.problem.fix(pm.plane(y=-3.0), uy=0)
        with pytest.raises(pm.InputError, match="give all of them in build"):
            next(march)


def test_observables_are_numbers():
    def build(p: dict[str, float]) -> Any:
        return scenes.cantilever(p)[0], {"name": lambda: "tip"}

    with pm.Sensitivity(build, BEAM, ["E"]) as run, pytest.raises(pm.InputError, match="observables: name"):
        next(run.march(3))
