"""Memory: dropped problems keep nothing, a closed one what its results need.

`benchmarks/operation_memory.py` counts kB of many more problems.
"""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly.system import NodalSystem
from polarmpm.solvers.choice import SOLVERS
from polarmpm.tools import disposal
from tests.conftest import COMM, MICROPOLAR, beam
from tests.helpers.bodies import cantilever

YIELDING = pm.VonMises(MICROPOLAR, k=1.0, H=200.0, l_p=0.4)

KINDS = ("splines", "no resets", "plastic", "projection", "multigrid", "elements", "plastic elements")


def made(kind: str) -> Any:
    """A problem whose resets have been several when it has marched."""
    if "elements" in kind:
        elements = cantilever(material=YIELDING if "plastic" in kind else MICROPOLAR)
        elements.load(pm.plane(x=4.0), force=(0.0, -1.0))
        return elements
    options: dict[str, Any] = {"basis": "mpm", "reset": None if kind == "no resets" else 1}
    if kind == "projection":
        options["assembly"] = "projection"
    if kind == "multigrid":
        options["solver"] = "multigrid"
    dim = 3 if kind == "multigrid" else 2
    problem = beam(dim, YIELDING if kind == "plastic" else MICROPOLAR, **options)
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), force=(0.0, -1.0, 0.0)[:dim])
    return problem


def march(problem: Any, steps: int = 2) -> None:
    for _ in problem.march(steps, progress=False):
        problem.fields()
    problem.energies()
    problem.balance()


@pytest.fixture
def systems(monkeypatch):
    """Systems that are alive."""
    alive: weakref.WeakSet[NodalSystem] = weakref.WeakSet()
    make = NodalSystem.__init__

    def remember(self: NodalSystem, *arguments: Any, **options: Any) -> None:
        make(self, *arguments, **options)
        alive.add(self)

    monkeypatch.setattr(NodalSystem, "__init__", remember)
    return alive


@pytest.fixture
def destroyed(monkeypatch):
    """How many disposals have been made, and called."""
    gc.collect()  # what failed tests have left
    disposal.dispose_of_dropped(COMM)
    count, known = {"made": 0, "called": 0}, set()
    make, call = disposal.Disposal.__init__, disposal.Disposal.__call__

    def counted_make(self: Any, destroy: Any) -> None:
        count["made"] += 1
        known.add(id(self))  # none of an earlier test
        make(self, destroy)

    def counted_call(self: Any) -> None:
        count["called"] += id(self) in known and self._destroy is not None
        call(self)

    monkeypatch.setattr(disposal.Disposal, "__init__", counted_make)
    monkeypatch.setattr(disposal.Disposal, "__call__", counted_call)
    return count


@pytest.mark.parametrize("kind", KINDS)
def test_dropped_problems_go_at_once(kind, systems, destroyed):
    """Without the garbage collector: there is no circle of references; and PETSc's objects go with them, on
    several ranks at the next collective call."""
    march(made(kind))  # compiled by now
    gc.collect()
    gc.disable()
    try:
        problem = made(kind)
        march(problem)
        known = weakref.ref(problem)
        assert len(systems) == 1
        del problem
        assert known() is None
        assert not systems
    finally:
        gc.enable()
    disposal.dispose_of_dropped(COMM)
    assert destroyed["called"] == destroyed["made"] > 0


@pytest.mark.skipif(COMM.size > 1, reason="ranks share a machine's memory")
@pytest.mark.parametrize("kind", KINDS)
def test_memory_of_many_problems(kind):
    """Less than 40 kB for each of twenty; 100 to 400 kB were kept."""

    def resident() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4.096

    begin = 0.0
    for k in range(25):
        begin = resident() if k == 5 else begin
        march(made(kind))
    gc.collect()
    assert (resident() - begin) / 20 < 40.0


def test_runs_that_fail_keep_nothing(systems):
    """Not their systems, once the error is dropped."""
    for _ in range(3):
        problem = beam(2, basis="mpm", reset=1)
        problem.load(problem.points.farthest((1.0, 0.0)), force=(0.0, -1e9))
        with pytest.raises(pm.NotConverged):
            march(problem)
        assert problem.system is None
        del problem
    gc.collect()  # pytest keeps what was raised in a circle
    assert not systems


@pytest.mark.parametrize("kind", ["splines", "elements"])
def test_closed_problems_tell_results_and_take_no_steps(kind, folder, systems):
    with made(kind) as problem:
        march(problem)
        support = problem.supports[0]
        expected = problem.energies(), problem.reaction(support).force, problem.fields().stress
    assert problem.closed
    assert not systems
    assert problem.energies() == expected[0]
    np.testing.assert_array_equal(problem.reaction(support).force, expected[1])
    np.testing.assert_array_equal(problem.fields().stress, expected[2])
    assert len(problem.steps) == 2
    assert problem.system is None
    refused = (
        lambda: list(problem.march(1, progress=False)),
        lambda: problem.attempt(1.0),
        lambda: problem.march_arc_length(0.1, steps=1),
        lambda: problem.system_at(1.0),
        lambda: problem.fix(pm.plane(x=0.0), u=0),
        lambda: problem.body_load(force=(0.0, 1.0)),
        lambda: problem.release(support),
        lambda: pm.save_restart(problem, folder / "closed.h5"),
    )
    for call in refused:
        with pytest.raises(pm.InputError, match="the problem has been closed"):
            call()
    problem.close()


def test_boxes_energy_of_a_closed_problem():
    """It is in the system's increments, which are gone."""
    grid = pm.Grid.box((0.0, -1.0), (4.0, 2.0), 0.5, COMM)
    points = pm.seed(grid, material=MICROPOLAR, points_per_cell=2, bounds=((0.0, 0.0), (3.0, 1.0)))
    problem = pm.QuasiStatic(grid, points, reset=None)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1.0, 0.0)), force=(0.0, -10.0))
    march(problem)
    alone = COMM.allreduce(float(problem.box_record.energies(problem.system).sum()))
    expected = problem.energies()
    assert alone > 0.0
    problem.close()
    assert problem.energies() == expected


def test_a_problem_is_closed_when_its_block_fails():
    """On one rank; on several an error may be one rank's alone."""
    problem = made("splines")

    def fail() -> None:
        with problem:
            march(problem)
            raise ValueError("the script's own")

    with pytest.raises(ValueError, match="the script's own"):
        fail()
    assert problem.closed == (COMM.size == 1)


def test_solvers_of_ones_own_are_destroyed_once(monkeypatch):
    """Whether they can be destroyed twice or not."""
    ended: list[Any] = []
    make = SOLVERS["direct"].make

    class Solver:
        def __init__(self, tangent: Any):
            self.inner = make(tangent)
            self.matrix = self.inner.matrix
            self.factor, self.solve = self.inner.factor, self.inner.solve

        def destroy(self) -> None:
            assert self.inner not in ended
            ended.append(self.inner)
            self.inner.destroy()

    pm.register_solver("once", Solver)
    monkeypatch.setitem(SOLVERS, "once", SOLVERS["once"])  # forgotten after the test
    problem = beam(2, basis="mpm", reset=1, solver="once")
    problem.load(problem.points.farthest((1.0, 0.0)), force=(0.0, -1.0))
    march(problem, 3)
    problem.close()
    del problem
    disposal.dispose_of_dropped(COMM)
    assert len(ended) == 3


def test_disposal_waits_for_all_ranks():
    """What one rank still holds is destroyed on none."""

    class Owner:
        pass

    gone: list[int] = []
    owners = [Owner(), Owner()]
    for number, owner in enumerate(owners):
        disposal.dispose_with(owner, COMM, lambda number=number: gone.append(number))
    if COMM.rank == 0:
        del owner
        owners.pop()
    disposal.dispose_of_dropped(COMM)
    assert gone == ([1] if COMM.size == 1 else [])
    owner = None
    owners.clear()
    disposal.dispose_of_dropped(COMM)
    assert gone == ([1, 0] if COMM.size == 1 else [0, 1])
    assert MPI.COMM_WORLD.size >= COMM.size
