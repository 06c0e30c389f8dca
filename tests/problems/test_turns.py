"""One body is worked on by one problem at a time, one load step after the other."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import MICROPOLAR, beam
from tests.helpers.bodies import box

ANOTHER = "another problem has taken them on"


def held(points: pm.Points) -> Any:
    grid = pm.Grid.box((-1.0, -1.0), (4.0, 3.0), 1.0)
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=lambda t: (0.0, 3.0 * t))
    return problem


def seeded() -> pm.Points:
    grid = pm.Grid.box((-1.0, -1.0), (4.0, 3.0), 1.0)
    return pm.seed(grid, material=MICROPOLAR, bounds=((0.0, 0.0), (2.0, 1.0)))


def meshed() -> tuple[pm.Elements, Any, Any]:
    """Elements, and two problems of them."""
    elements = pm.Elements(box("quadrilateral", (2, 1), (2.0, 1.0)), material=MICROPOLAR)
    problems = pm.QuasiStaticFEM(elements), pm.QuasiStaticFEM(elements)
    for problem in problems:
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.body_load(force=lambda t: (0.0, 3.0 * t))
    return elements, *problems


def test_points_of_two_problems(tmp_path: Path):
    points = seeded()
    first, second = held(points), held(points)
    list(first.march(2, to=0.5, progress=False))
    x = points.x.copy()
    for call in (
        lambda: list(second.march(1, progress=False)),
        lambda: second.attempt(1.0),
        lambda: second.system_at(1.0),
        lambda: second.march_arc_length(0.1, steps=1),
        lambda: pm.save_restart(second, tmp_path / "second.h5"),
    ):
        with pytest.raises(pm.InputError, match=f"points: {ANOTHER}"):
            call()
    np.testing.assert_array_equal(points.x, x)
    list(first.march(1, progress=False))
    assert first.progress.step == 3


def test_a_second_phase():
    """A problem that is made of a body later takes it on from where it is, and the first one ends there."""
    points = seeded()
    first = held(points)
    list(first.march(1, progress=False))
    moved = points.mean_displacement()
    later = held(points)
    list(later.march(1, progress=False))  # the same load: it stays where it is
    np.testing.assert_allclose(points.mean_displacement(), moved, atol=1e-3 * np.abs(moved).max())
    with pytest.raises(pm.InputError, match=ANOTHER):
        first.attempt(2.0)
    assert np.all(np.isfinite(first.balance().force))  # of its last step


def test_elements_of_two_problems():
    elements, first, second = meshed()
    list(first.march(1, progress=False))
    with pytest.raises(pm.InputError, match=f"elements: {ANOTHER}"):
        second.attempt(1.0)
    later = pm.QuasiStaticFEM(elements)
    later.fix(pm.plane(x=0.0), u=0, theta=0)
    list(later.march(1, progress=False))
    np.testing.assert_allclose(elements.displacement, 0.0, atol=1e-12)
    with pytest.raises(pm.InputError, match=f"elements: {ANOTHER}"):
        first.attempt(2.0)


def test_a_restored_problem_has_its_body(tmp_path: Path):
    """Reading a file is a change, too: of the problem that reads it."""
    from mpi4py import MPI

    path = Path(MPI.COMM_WORLD.bcast(str(tmp_path))) / "run.h5"
    points = seeded()
    first, second = held(points), held(points)
    list(first.march(1, to=0.5, progress=False))
    pm.save_restart(first, path)
    pm.load_restart(second, path)
    list(second.march(1, progress=False))
    assert second.progress.step == 2
    with pytest.raises(pm.InputError, match=ANOTHER):
        first.attempt(1.0)


@pytest.mark.parametrize("adaptive", [False, True])
def test_two_marches_at_once(adaptive):
    problem = held(seeded())
    marches = [problem.march(4, adaptive=adaptive, progress=False) for _ in range(2)]
    assert next(marches[0]).factor == 0.25
    assert next(marches[1]).number == 2
    with pytest.raises(pm.InputError, match=r"march: since its step 1 .* taken on to step 2"):
        next(marches[0])
    list(marches[1])
    assert problem.progress.factor == 1.0


def test_a_path_beside_a_march():
    problem = beam(2, basis="mpm")
    problem.load(problem.points.farthest((1.0, 0.0)), force=(0.0, -10.0))
    path = problem.march_arc_length(1e-3, steps=3, progress=False)
    next(path)
    problem.attempt(problem.progress.factor + 0.1)
    with pytest.raises(pm.InputError, match="march: since its step 1"):
        next(path)


def test_no_step_within_a_step():
    problem = held(seeded())
    calls: list[Any] = [
        lambda: problem.attempt(1.0),
        lambda: problem.fix(pm.plane(y=0.0), uy=0),
        lambda: problem.body_load(force=(0.0, 1.0)),
        lambda: problem.add(pm.SurfaceTerm("spring", pm.Surface.line((0.0, 0.0), (1.0, 0.0), 2))),
        lambda: problem.release(problem.supports[0]),
    ]
    heard = []

    class Meddling(pm.Observer):
        def after_convergence(self, problem: Any, factor: float) -> None:
            for call in calls:
                with pytest.raises(pm.InputError, match="a load step of this problem is being solved"):
                    call()
                heard.append(factor)

    problem.observers.append(Meddling())
    list(problem.march(1, progress=False))
    assert heard == [1.0] * len(calls)
    assert (len(problem.supports), len(problem.loads)) == (1, 1)


@pytest.mark.parametrize("values", [{"factor": 0.5}, {"factor": float("nan")}, {"step": 0}, {"factor": None}])
def test_progress_is_no_input(values):
    problem = held(seeded())
    list(problem.march(1, progress=False))
    for name, value in values.items():
        setattr(problem.progress, name, value)
    with pytest.raises(pm.InputError, match=r"progress: .* put in by hand"):
        list(problem.march(1, to=2.0, progress=False))


def test_what_a_script_has_put_in():
    problem = held(seeded())
    problem.rows["mine"] = np.zeros(len(problem.points) + 1)
    with pytest.raises(pm.InputError, match=r"rows\['mine'\]"):
        problem.attempt(1.0)
    problem.rows["mine"] = np.zeros((len(problem.points), 2))
    problem.observers.append(pm.Observer)
    with pytest.raises(pm.InputError, match="observers"):
        problem.attempt(1.0)
    problem.observers.clear()
    with pytest.raises(pm.InputError, match="rotation_limit = 0"):
        problem.rotation_limit = 0
    problem.controls = "fast"
    with pytest.raises(pm.InputError, match="controls = 'fast'"):
        problem.attempt(1.0)
    problem.controls = pm.Controls()
    assert problem.attempt(1.0).converged


def test_problems_are_no_values():
    problem = held(seeded())
    for call in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(pm.InputError, match="no copy or pickle of a problem"):
            call(problem)


def test_points_of_elements_that_are_gone():
    """They keep the communicator alive that belongs to the mesh."""
    points = meshed()[0].points
    assert points.nearest((0.0, 0.0)).ids.shape == (1,)
    assert points.total == len(points) or points.comm.size > 1
