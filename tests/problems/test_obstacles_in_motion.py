"""Contact with rigid obstacles in dynamic problems."""

import math
import re
from contextlib import nullcontext

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM

CELL, YOUNG, DENSITY, GRAVITY = 0.25, 1e6, 1000.0, 9.81


def at_rest(angle, friction):
    """A block on an incline, in equilibrium."""
    grid = pm.Grid((-0.5, -0.5), (CELL, CELL), (12, 8), COMM)
    material = pm.NeoHookean.from_engineering(E=YOUNG, nu=0.3)
    points = pm.seed(grid, material=material, bounds=((0.1, 0.0), (1.1, 0.5)))
    problem = pm.QuasiStatic(grid, points)
    problem.obstacle(pm.HalfSpace((0, 0), (0, 1)), friction=friction, name="incline")
    problem.body_load(force=DENSITY * GRAVITY * np.array([math.sin(angle), -math.cos(angle)]))
    return problem


def named(problem, name):
    return next(term for term in problem.terms if term.name == name)


def test_a_block_goes_on_resting_on_an_incline():
    """From a quasi-static start: it stays, and friction bears what gravity has along the incline."""
    angle = math.radians(20)
    start = at_rest(angle, 0.5)
    for _ in start.march(3, progress=False):
        pass
    problem = pm.Dynamic.of(start, density=DENSITY, rho_inf=0.5)
    incline, X = named(problem, "incline"), problem.points.x.copy()
    for step in problem.march(0.2, dt=0.01, progress=False):
        assert step.iterations <= 4
    moved = np.abs(problem.points.x - X).max(initial=0.0)
    assert COMM.allreduce(float(moved)) < 1e-4
    assert -incline.force[0] / incline.force[1] == pytest.approx(math.tan(angle), rel=1e-3)


def test_a_released_block_slides(folder):
    """Its momentum is what gravity and the incline have given it; a restart goes on to the same digits."""
    angle, friction = math.radians(30), 0.3

    def make():
        start = at_rest(angle, friction)
        stop = start.obstacle(pm.HalfSpace((1.1, 0), (-1, 0)), name="stop")
        for _ in start.march(3, progress=False):
            pass
        assert stop.force[0] < 0.0
        problem = pm.Dynamic.of(start, density=DENSITY, rho_inf=0.5)
        problem.release(named(problem, "stop"))
        return problem, named(problem, "incline")

    problem, incline = make()
    given = np.zeros(2)
    for step in problem.march(0.4, dt=0.01, progress=False):
        given += 0.01 * incline.force
        if step.number - 3 == 20:
            pm.save_restart(problem, folder / "a.h5")
    mass = problem.inertia()["mass"]
    given += 0.4 * mass * GRAVITY * np.array([math.sin(angle), -math.cos(angle)])
    assert np.allclose(problem.momentum(), given, atol=2e-2 * given[0])
    expected = mass * GRAVITY * (math.sin(angle) - friction * math.cos(angle)) * 0.4
    assert problem.momentum()[0] == pytest.approx(expected, rel=0.03)
    again, same = make()
    pm.load_restart(again, folder / "a.h5")
    for _ in again.march(0.4, steps=20, progress=False):
        pass
    assert np.allclose(same.force, incline.force, rtol=1e-7)
    assert np.allclose(again.momentum(), problem.momentum(), rtol=1e-9, atol=1e-9 * expected)


def test_a_level_set_of_the_load_factor_is_not_taken_over():
    start = at_rest(0.3, 0.5)
    start.obstacle(lambda x, t: 3.0 - t - x[0], name="plate")
    for _ in start.march(1, progress=False):
        pass
    with pytest.raises(pm.InputError, match=re.escape("plate: a level set of the load factor")):
        pm.Dynamic.of(start, density=DENSITY)


def thrown_disc(nu=0.3, **options):
    """A disc against an oblique wall with friction, at a fifth of its waves' speed."""
    grid = pm.Grid.box((0, 0), (1.2, 1.2), 0.05, COMM)
    material = pm.NeoHookean.from_engineering(E=1e5, nu=nu)
    points = pm.seed(grid, lambda x: np.hypot(x[:, 0] - 0.6, x[:, 1] - 0.8) < 0.15, material=material)
    problem = pm.Dynamic(grid, points, density=1e3, **options)
    problem.obstacle(pm.HalfSpace((0.2, 0.8), (np.cos(0.3), np.sin(0.3))), friction=0.4)
    problem.velocity(v=(-2.0, -0.7))
    return problem


def test_resets_keep_what_varies_within_boxes():
    """The energy within the points' boxes, a tenth of the whole of this disc, goes through its resets."""
    problem = thrown_disc()
    whole = problem.energies()["external"]
    for _ in problem.march(0.24, dt=4e-3, progress=False):
        pass
    found = problem.energies()
    assert abs(found["reset"]) < 1e-10 * whole
    assert found["kinetic"] + found["stored"] > 0.97 * whole
    assert abs(found["residue"]) < 0.03 * whole


def test_what_resets_let_go_is_told():
    """Nearly incompressible bodies forget at a reset how strains vary within the points' boxes; energies say
    how much that is."""
    problem = thrown_disc(nu=0.49)
    whole = problem.energies()["external"]
    told = pytest.warns(pm.TrustWarning, match=r"resets have let go \d+% of the body's energy")
    with told if COMM.rank == 0 else nullcontext():
        for _ in problem.march(0.24, dt=4e-3, progress=False):
            pass
    found = problem.energies()
    assert found["reset"] > 0.03 * whole
    assert abs(found["residue"]) < 0.25 * found["reset"]
    assert "in doubt" in problem.trust()
