"""A smooth wall in sand at rest gives way, or is pushed into it: Rankine's active and passive pressures."""

from __future__ import annotations

import math

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM

HEIGHT, WIDTH, WEIGHT, FRICTION, COHESION = 3.0, 9.0, 18e3, math.radians(30.0), 500.0  # m, m, N/m^3, -, Pa
ACTIVE, PASSIVE = -6e-3, 0.06  # the wall's motion (m)


def sand() -> pm.MohrCoulomb:
    return pm.MohrCoulomb(pm.Hencky.from_engineering(E=3e7, nu=0.3), phi=FRICTION, psi=0.0, c=COHESION)


def on_points(basis: str) -> pm.QuasiStatic:
    grid = pm.Grid.box((0, 0), (WIDTH, HEIGHT + 1), cell=0.5)
    points = pm.seed(grid, bounds=((0, 0), (WIDTH, HEIGHT)), material=sand())
    return pm.QuasiStatic(grid, points, basis=basis)


def on_elements() -> pm.QuasiStaticFEM:
    from dolfinx import mesh

    cells = mesh.create_rectangle(COMM, [(0, 0), (WIDTH, HEIGHT)], [18, 6], mesh.CellType.quadrilateral)
    return pm.QuasiStaticFEM(pm.Elements(cells, material=sand(), degree=2))


def pressure(problem: pm.QuasiStatic | pm.QuasiStaticFEM, motion: float) -> float:
    """What the wall bears after its motion, over that of a fluid as heavy as the sand."""
    ground = pm.K0(weight=WEIGHT, K0=0.5, surface=HEIGHT)
    problem.initial_stress(ground)
    problem.body_load(force=ground.force)
    wall = problem.fix(pm.plane(x=0.0), ux=lambda f: motion * f)
    problem.fix(pm.plane(x=WIDTH), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    for _ in problem.march(6, adaptive=True, progress=False):
        pass
    return float(problem.reaction(wall).force[0]) / (0.5 * WEIGHT * HEIGHT**2)


def rankine(motion: float) -> float:
    """The pressure of sand that flows without a change of volume, so that it is as much higher as it is
    shorter."""
    K = math.tan(math.pi / 4 + np.sign(motion) * FRICTION / 2) ** 2
    times = WIDTH / (WIDTH - motion)
    return times**2 * K + np.sign(motion) * times * 4 * COHESION * math.sqrt(K) / (WEIGHT * HEIGHT)


@pytest.mark.parametrize("make", [lambda: on_points("bspline"), lambda: on_points("gimpm"), on_elements])
@pytest.mark.parametrize("motion", [ACTIVE, PASSIVE])
def test_pressures_of_rankine(make, motion):
    """The sand flows all through; what it was at rest is forgotten."""
    assert pressure(make(), motion) == pytest.approx(rankine(motion), rel=2e-3)
