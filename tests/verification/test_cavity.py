"""A long hole in clay is widened by a third, as by a pressuremeter: the pressure has a closed form."""

from __future__ import annotations

import math

import pytest

import polarmpm as pm

INNER, OUTER, CELL, WIDENED = 1.0, 20.0, 0.25, 0.3  # m
YOUNG, POISSON, COHESION = 6e6, 0.49, 20e3  # Pa, -, Pa


def pressure(radius: float) -> float:
    """Against the wall of the hole at its present radius: all of the clay keeps its volume, and within
    r_p^2 = G/c (a^2 - a_0^2) it flows."""
    shear = YOUNG / 2 / (1 + POISSON)
    grown = radius**2 - INNER**2
    return COHESION * (
        1.0 - grown * shear / COHESION / (OUTER**2 + grown) + math.log(grown * shear / COHESION / radius**2)
    )


@pytest.mark.parametrize("basis", ["bspline", "gimpm"])
def test_pressure_of_a_cavity_that_is_widened(basis):
    clay = pm.Tresca(pm.Hencky.from_engineering(E=YOUNG, nu=POISSON), c=COHESION)
    grid = pm.Grid.box((INNER, 0), (OUTER + 1, CELL), cell=CELL)
    points = pm.seed(grid, bounds=((INNER, 0), (OUTER, CELL)), material=clay, axisymmetric=True)
    problem = pm.QuasiStatic(grid, points, basis=basis)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(y=CELL), uy=0)
    wall = problem.fix(pm.plane(x=INNER), ux=WIDENED)
    for step in problem.march(20, progress=False):
        radius = INNER + WIDENED * step.factor
        found = problem.reaction(wall).force[0] / (2 * math.pi * radius * CELL)
        if step.factor > 0.2:
            assert found == pytest.approx(pressure(radius), rel=5e-3)
