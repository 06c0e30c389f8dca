"""Dynamic problems that go on: from quasi-static ones, from restart files, and to equilibrium."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import MICROPOLAR, NEO_HOOKEAN, assert_repeated

COMM = MPI.COMM_WORLD
WEIGHT = (0.0, -3.0)


def cantilever(kind: type = pm.QuasiStatic, *, micropolar: bool = False, **options: Any) -> Any:
    """A block on cells, clamped at x = 0, without its loads."""
    material = MICROPOLAR if micropolar else NEO_HOOKEAN
    if kind in (pm.QuasiStatic, pm.Dynamic):
        grid = pm.Grid.box((0.0, -2.0), (6.0, 2.0), 0.5)
        points = pm.seed(grid, bounds=((0.0, -0.4), (2.9, 0.5)), material=material)
        problem = kind(grid, points, **options)
    else:
        from dolfinx import mesh

        corners = [np.array([0.0, -0.4]), np.array([2.9, 0.5])]
        body = mesh.create_rectangle(COMM, corners, [6, 2], mesh.CellType.quadrilateral)
        problem = kind(pm.Elements(body, material=material, degree=2), **options)
    problem.fix(pm.plane(x=0.0), u=0.0)
    return problem


def inertia(micropolar: bool) -> dict[str, Any]:
    return {"density": 0.1, **({"microinertia": 0.02} if micropolar else {})}


def tip(problem: Any) -> float:
    p = problem.points
    sums = [p.volume0 @ p.displacement[:, 1], p.volume0.sum()]
    sums = COMM.allreduce(np.array(sums))
    return float(sums[0] / sums[1])


@pytest.mark.parametrize("micropolar", [False, True])
@pytest.mark.parametrize(
    ("static", "dynamic"), [(pm.QuasiStatic, pm.Dynamic), (pm.QuasiStaticFEM, pm.DynamicFEM)]
)
def test_an_equilibrium_stays(static: Any, dynamic: Any, micropolar: bool):
    options = {"reset": 2} if static is pm.QuasiStatic else {}
    problem = cantilever(static, micropolar=micropolar, **options)
    load = problem.body_load(force=WEIGHT)
    for _ in problem.march(5):
        pass
    before, down = problem.energies(), tip(problem)
    going = dynamic.of(problem, **inertia(micropolar))
    assert going.time == 0.0
    for _ in going.march(duration=1.0, steps=4):
        pass
    after = going.energies()
    assert tip(going) == pytest.approx(down, rel=1e-7)
    assert after["kinetic"] < 1e-12 * before["stored"]
    assert after["stored"] == pytest.approx(before["stored"], rel=1e-6)
    assert after["residue"] == pytest.approx(before["residue"], abs=1e-6 * before["stored"])
    with pytest.raises(pm.InputError, match="taken"):
        problem.attempt(1.1)
    for one in going.loads if static is pm.QuasiStatic else ():
        assert one is not load
    going.release(next(given.condition for given in going.given if given.name.startswith("body load")))
    for _ in going.march(duration=0.2, steps=4):
        pass
    assert going.energies()["kinetic"] > 1e-3 * before["stored"]
    assert tip(going) > down


def test_of_what_is_no_static_problem():
    problem = cantilever()
    with pytest.raises(pm.InputError, match="no load step"):
        pm.Dynamic.of(problem, density=1.0)
    for wrong in (None, cantilever(pm.Dynamic, density=1.0), cantilever(pm.QuasiStaticFEM)):
        with pytest.raises(pm.InputError, match="QuasiStatic is needed"):
            pm.Dynamic.of(wrong, density=1.0)


@pytest.mark.parametrize("kind", [pm.Dynamic, pm.DynamicFEM])
def test_slow_motion_ends_at_the_static_answer(kind: Any):
    static = cantilever(pm.QuasiStatic if kind is pm.Dynamic else pm.QuasiStaticFEM)
    static.body_load(force=(0.0, -1.0))
    for _ in static.march(2):
        pass
    problem = cantilever(kind, density=0.1, drag=10.0)
    problem.body_load(force=lambda t: (0.0, -min(t, 1.0)))
    for _ in problem.march(12.0, dt=0.3):
        pass
    assert tip(problem) == pytest.approx(tip(static), rel=1e-4)
    e = problem.energies()
    assert e["kinetic"] < 1e-4 * e["external"]
    assert abs(e["residue"]) < 2e-2 * e["external"]


@pytest.mark.parametrize("kind", [pm.Dynamic, pm.DynamicFEM])
@pytest.mark.parametrize("saved", [3, 4])
def test_a_restart_goes_on_to_the_same_digits(kind: Any, saved: int, folder: Path):
    def make(**options: Any) -> Any:
        more = {"reset": 4} if kind is pm.Dynamic else {}
        problem = cantilever(kind, micropolar=True, **(inertia(True) | more | options))
        problem.body_load(force=lambda t: (0.0, -np.sin(3.0 * t)))
        problem.velocity(v=(0.0, 0.3), spin=0.1)
        return problem

    whole, first, file = make(), make(), folder / "run.h5"
    for step in whole.march(0.7, steps=7):
        if step.number == saved:
            pm.save_restart(whole, file)
    COMM.barrier()
    with pytest.raises(pm.InputError, match="mass"):
        pm.load_restart(make(density=0.2), file)
    pm.load_restart(first, file)
    assert first.time == pytest.approx(0.1 * saved)
    for _ in first.march(0.7, steps=7 - saved):
        pass
    for name in ("x", "F", "q", "velocity", "acceleration", "spin", "spin_rate"):
        assert_repeated(getattr(first.points, name), getattr(whole.points, name))
    assert_repeated(np.array([*first.energies().values()]), np.array([*whole.energies().values()]))
