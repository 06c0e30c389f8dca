"""Corrections that lead too far are shortened: a scalar equation, and bodies that flow in one large step."""

from __future__ import annotations

import math

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import LocalFailure
from polarmpm.solvers import newton
from tests.helpers.bodies import box

SOIL = pm.VonMises(pm.Hencky.from_engineering(E=1e4, nu=0.3), k=math.sqrt(3.0))


class Flat:
    """arctan(x) = 0, for which Newton's method runs away from beyond 1.4.

    Args:
        x: where it begins.
        edge: from there on there is no residual.
    """

    def __init__(self, x: float, edge: float = 1e100, searched: bool = True):
        self.x, self.edge, self.searched, self.tangents = x, edge, searched, 0
        self.origin = self.direction = self.taken = 0.0

    def evaluate(self, tangent: bool) -> None:
        if abs(self.x) > self.edge:
            raise LocalFailure("no residual there")
        self.r, self.tangents = math.atan(self.x), self.tangents + tangent
        if tangent:
            self.k = 1 / (1 + self.x**2)

    def convergence_measures(self) -> tuple[float, float]:
        return abs(self.r), abs(self.r * self.direction)

    def pending(self) -> bool:
        return False

    def update(self, fresh: bool, accuracy: float) -> None:
        self.origin, self.start = self.x, self.r
        self.direction = -self.r / self.k
        self.x += self.direction

    def waits(self) -> bool:
        return False

    def backtrack(self) -> bool:
        self.direction /= 2
        self.x -= self.direction
        return True

    def slope(self, start: bool = False) -> float | None:
        return (self.start if start else self.r) * self.direction if self.searched else None

    def take(self, share: float) -> None:
        self.x = self.origin + share * self.direction


@pytest.mark.parametrize("start", [1.5, -3.0, 20.0])
@pytest.mark.parametrize("edge", [1e100, 400.0])
def test_a_search_finds_what_newton_alone_loses(start, edge):
    controls = pm.Controls(divergence=1e300)
    found = Flat(start, edge)
    assert newton.solve(found, controls).converged
    assert abs(found.x) < 1e-8
    assert not newton.solve(Flat(start, edge, searched=False), controls).converged


def test_corrections_that_go_well_are_not_touched():
    one, other = Flat(0.9), Flat(0.9, searched=False)
    assert newton.solve(one, pm.Controls()).history == newton.solve(other, pm.Controls()).history


def pressed_layer(problem, depth, right=3.0, top=1.5):
    for x in (0.0, right):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    return problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > top - 1e-6), ux=0, uy=-depth)


@pytest.mark.parametrize("locking", [None, "auto"])
@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_a_footing_flows_in_one_step(basis, locking):
    """Its limit load, as in many steps; the elastic load would be 3.5 times as large. No step is cut."""
    loads = []
    for steps in (1, 8):
        grid = pm.Grid.box((0, 0), (3, 1.5), 0.25)
        points = pm.seed(grid, material=SOIL, points_per_cell=2)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, locking=locking)
        held = pressed_layer(problem, 0.005)
        taken = list(problem.march(steps, progress=False))
        assert all(step.cuts == 0 and step.iterations <= 30 for step in taken)
        loads.append(-problem.reaction(held).force[1])
    assert loads[0] == pytest.approx(loads[1], rel=0.02)


@pytest.mark.parametrize("locking", [None, "always"])
def test_elements_flow_in_one_step(locking):
    body = pm.Elements(box("quadrilateral", (12, 6), (3.0, 1.5)), material=SOIL, degree=1)
    problem = pm.QuasiStaticFEM(body, locking=locking)
    pressed_layer(problem, 0.005)
    (step,) = problem.march(1, progress=False)
    assert step.iterations <= 16


def test_a_share_of_a_correction():
    """The slope is the out-of-balance forces' work; prescribed values aren't shortened."""
    grid = pm.Grid.box((0, 0), (3, 1.5), 0.25)
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=SOIL, points_per_cell=2), reset=None)
    pressed_layer(problem, 0.005)
    system = problem.system_at(1.0)
    system.set_prescribed(system.prescribed.increments(1.0))
    system.evaluate(True)
    system.update(True)
    system.evaluate(True)
    assert system.slope() is None  # prescribed values have been put in
    before, r = system.x.copy(), system.on_free(system.residual)[: system.nodes.owned]
    system.update(True)
    whole = system.x - before
    expected = system.comm.allreduce(float(np.sum(r * whole[: system.nodes.owned])))
    assert system.slope(start=True) == pytest.approx(expected, rel=1e-13)
    system.take(0.25)
    np.testing.assert_allclose(system.x - before, 0.25 * whole, rtol=0, atol=1e-18)
    np.testing.assert_array_equal(system.before, before)
    assert system.slope(start=True) == pytest.approx(expected, rel=1e-13)
