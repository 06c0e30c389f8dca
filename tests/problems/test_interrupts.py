"""Whatever ends a load step early leaves the last converged state, from which the run goes on.

The scenes, and how calls inside a step are ended, are those of `benchmarks/operation_interrupts.py`, which
ends steps at many more calls.
"""

from __future__ import annotations

import random
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.problems.whole import Undo
from polarmpm.tools.interrupts import undisturbed
from tests.conftest import COMM, MICROPOLAR, beam
from tests.helpers.bodies import cantilever

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SOME = (
    *("points", "reset", "rotation base", "plastic", "projection", "surfaces", "moving plane"),
    *(
        "fading support",
        "fading symmetry",
        "other support",
        "elements",
        "elements, surfaces",
        "plastic elements",
        "arc length",
    ),
)
alone = pytest.mark.skipif(COMM.size > 1, reason="an interrupt strikes one rank")


@pytest.fixture(scope="module")
def interrupts() -> Any:
    """The benchmark's module."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return import_module("operation_interrupts")
    finally:
        sys.path.remove(str(BENCHMARKS))


@alone
@pytest.mark.parametrize("name", SOME)
def test_an_exception_at_some_calls(interrupts, name, folder):
    """State to the bit; the run that goes on, and one from a restart file, come to the same end."""
    scene = interrupts.SCENES[name]
    before, end = interrupts.right(scene)
    number = interrupts.calls(scene)
    draw = random.Random(name)
    for part in range(3):  # early, in the middle, and late in the step
        at = round(number * (part + draw.random()) / 3)
        file = folder / "now.h5" if part == 2 else None
        problem = scene.begin(scene.ended - 1)
        assert interrupts.ended(scene, problem, max(1, at), before, end, file) == ""


@alone
@pytest.mark.parametrize("name", ["reset", "plastic elements", "surfaces"])
def test_one_run_that_is_ended_again_and_again(interrupts, name):
    """Each time at a later call of the same step."""
    scene = interrupts.SCENES[name]
    before, end = interrupts.right(scene)
    problem, at, stopped = scene.begin(scene.ended - 1), 1, True
    while stopped:
        stopper = interrupts.Stopper(at, interrupts.Timeout)
        march = scene.march(problem, scene.steps - scene.ended + 1)
        stopped = stopper.run(lambda march=march: next(march))
        if stopped:
            assert interrupts.differing(interrupts.state(problem), before) == [], stopper.where
        at += 1 + at // 4
    assert problem.progress.step == len(problem.steps) == scene.ended
    assert interrupts.off(interrupts.state(scene.finish(problem)), end) < 1e-9


class Trouble(pm.Observer):
    """Raises in one of the hooks, at a step, once."""

    def __init__(self, hook: str, step: int, error: type[BaseException]):
        self.hook, self.step, self.error, self.told = hook, step, error, [0]

    def _hear(self, problem: Any, hook: str) -> None:
        self.told.append(problem.progress.step)
        if hook == self.hook and problem.progress.step == self.step:
            self.hook = ""
            raise self.error("of the script's own")

    def after_reset(self, problem: Any) -> None:
        self._hear(problem, "reset")

    def after_convergence(self, problem: Any, factor: float) -> None:
        self._hear(problem, "convergence")

    def after_commit(self, problem: Any, rebased: bool) -> None:
        self._hear(problem, "commit")


def made(kind: str) -> Any:
    if kind == "elements":
        elements = cantilever(material=MICROPOLAR)
        elements.load(pm.plane(x=4.0), force=(0.0, -20.0))
        return elements
    problem = beam(2, basis="gimpm", reset=2, balanced_reset=True)
    problem.load(problem.points.farthest((1.0, 0.0)), force=(0.0, -20.0))
    return problem


def digits(problem: Any) -> dict[str, np.ndarray]:
    energies = {name: np.array(value) for name, value in problem.energies().items()}
    return {**{name: a.copy() for name, a in problem.points.arrays().items()}, **energies}


def bar_of_splines() -> pm.QuasiStatic:
    """A bar that is pulled and pressed down, with all settings left alone: points have boxes."""
    grid = pm.Grid.box((0, -1), (3, 2), cell=0.5, comm=COMM)
    points = pm.seed(grid, bounds=((0, 0), (2, 0.75)), material=pm.NeoHookean(lam=1e6, mu=4e5))
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=lambda t: (0, -2e3 * t if t < 10 else -1e9))
    return problem


@pytest.mark.parametrize("between", ["failed step", "observer"])
def test_steps_after_one_that_fails_are_those_without(between, folder):
    """What boxes have added to the last tangent serves in the next step, also after one that has failed."""

    class Ends(pm.Observer):
        def after_convergence(self, problem: Any, factor: float) -> None:
            raise ValueError

    def positions(problem: pm.QuasiStatic) -> np.ndarray:
        rows = np.concatenate(COMM.allgather(np.column_stack([problem.points.id, problem.points.x])))
        return rows[np.argsort(rows[:, 0])]

    whole, problem = bar_of_splines(), bar_of_splines()
    for one in (whole, problem):
        list(one.march(2, to=0.5, progress=False))
    if between == "observer":
        problem.observers.append(Ends())
    with pytest.raises(ValueError if between == "observer" else pm.NotConverged):
        list(problem.march(1, to=1.0 if between == "observer" else 20.0, progress=False))
    problem.observers.clear()
    again = bar_of_splines()
    pm.save_restart(problem, folder / "failed.h5")
    pm.load_restart(again, folder / "failed.h5")
    for one in (whole, problem, again):
        list(one.march(2, progress=False))
    np.testing.assert_array_equal(positions(problem), positions(whole))
    np.testing.assert_array_equal(positions(again), positions(whole))


@pytest.mark.parametrize("kind", ["points", "elements"])
@pytest.mark.parametrize(("hook", "step"), [("reset", 2), ("convergence", 2), ("commit", 3)])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_errors_of_observers_on_all_ranks(kind, hook, step, error):
    """A step that an observer has ended hasn't been taken; the observers are told of it again."""
    whole, problem = made(kind), made(kind)
    list(whole.march(4, progress=False))
    if (kind, hook) == ("elements", "reset"):
        step = 3  # told of when the step's solution has become the state
    trouble = Trouble(hook, step, error)
    problem.observers.append(trouble)
    march = problem.march(4, progress=False)
    next(march)
    next(march)
    expected, told = digits(problem), list(trouble.told)
    with pytest.raises(error, match="of the script's own"):
        next(march)
    assert problem.progress.step == len(problem.steps) == 2
    for name, found in digits(problem).items():
        np.testing.assert_array_equal(found, expected[name], err_msg=name)
    assert trouble.told == told
    trouble.hook = ""  # what it knew has been put back, too
    list(problem.march(2, progress=False))
    assert [s.number for s in problem.steps] == [1, 2, 3, 4]
    for name, found in digits(whole).items():
        size = COMM.allreduce(np.abs(found).max(initial=0.0), op=max)
        np.testing.assert_allclose(digits(problem)[name], found, rtol=0, atol=1e-9 * size, err_msg=name)


def test_a_load_that_fails_in_an_iteration_of_its_own():
    """A function of the load factor raises; loads, terms and progress are as before."""
    broken = [False]

    def force(factor: float) -> tuple[float, float]:
        if broken[0] and factor > 0.6:
            raise OSError("a table is missing")
        return 0.0, -20.0 * factor

    problem = beam(2, basis="gimpm", reset=1)
    problem.load(problem.points.farthest((1.0, 0.0)), force=force)
    list(problem.march(2, to=0.5, progress=False))
    before, broken[0] = digits(problem), True
    with pytest.raises(OSError, match="a table is missing"):
        list(problem.march(1, progress=False))
    for name, found in digits(problem).items():
        np.testing.assert_array_equal(found, before[name], err_msg=name)
    broken[0] = False
    list(problem.march(2, progress=False))
    assert problem.progress.factor == 1.0


def test_a_run_that_has_failed_has_not_been_reset():
    """What NotConverged leaves is what the last step has left."""
    problem = beam(2, basis="gimpm", reset=1)
    problem.load(problem.points.farthest((1.0, 0.0)), force=lambda t: (0.0, -10.0 if t <= 1 else -1e9))
    list(problem.march(2, progress=False))
    before, x = digits(problem), problem.system.x
    with pytest.raises(pm.NotConverged):
        list(problem.march(1, to=2.0, progress=False))
    assert problem.progress.reset_due
    assert problem.system.x is x
    for name, found in digits(problem).items():
        np.testing.assert_array_equal(found, before[name], err_msg=name)


# parts --------------------------------------------------------------------------------------------------
class Thing:
    """Something with attributes."""

    def __init__(self) -> None:
        self.number, self.listed, self.named = 1, [1, 2], {"a": 1}


def test_undo_puts_back_attributes_and_contents():
    thing = Thing()
    listed, undo = thing.listed, Undo([(thing, None)])
    thing.number, thing.new = 2, 3
    thing.listed.append(3)
    thing.named = {"b": 2}
    undo.put_back()
    assert vars(thing) == {"number": 1, "listed": [1, 2], "named": {"a": 1}}
    assert thing.listed is listed


def test_undo_of_some_attributes_leaves_the_others():
    thing = Thing()
    undo = Undo([(thing, ("number",))])
    thing.number, thing.named, thing.new = 2, {}, 3
    undo.put_back()
    assert (thing.number, thing.named, thing.new) == (1, {}, 3)


@pytest.mark.parametrize("ending", [None, ValueError])
def test_signals_wait(ending):
    """The handler is called at the end, with an error too."""
    caught = []
    before = signal.signal(signal.SIGINT, lambda *_: caught.append(1))
    try:
        try:
            with undisturbed():
                signal.raise_signal(signal.SIGINT)
                assert not caught
                if ending:
                    raise ending
        except ValueError:
            assert ending
        assert caught == [1]
        signal.raise_signal(signal.SIGINT)
        assert caught == [1, 1]
    finally:
        signal.signal(signal.SIGINT, before)
