"""What a rigid rotation on top of a deformation does to the wryness, in space: nothing from a base on; before
it what interpolated rotation vectors do, of the order of the cells."""

from __future__ import annotations

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.kinematics import rotations
from tests.conftest import COMM

TURN = np.array([0.9, -0.7, 2.0])
WRYNESS = np.array([[0.05, 0.15, -0.1], [0.1, -0.05, 0.05], [-0.15, 0.05, 0.1]])
STRETCH = np.eye(3) + np.array([[0.03, 0.08, 0.02], [-0.01, -0.02, 0.03], [0.0, 0.04, -0.01]])
MATERIAL = pm.UserEnergy(
    lambda E, G, p: p.a * ufl.inner(E, E) + p.b * ufl.inner(G, G) + p.c * ufl.inner(G, G) ** 2,
    {"a": 1.0, "b": 0.3, "c": 2.0},
)


def theta(t: float, x: np.ndarray) -> np.ndarray:
    """Bent and twisted until the load factor is 1, then turned."""
    bent = rotations.from_vector(min(t, 1.0) * (x @ WRYNESS.T))
    turn = rotations.from_vector(np.tile(max(t - 1.0, 0.0) * TURN, (len(x), 1)))
    q = rotations.multiply(turn, bent)
    return rotations.to_vector(np.where(q[:, :1] < 0, -q, q))


def u(t: float, x: np.ndarray) -> np.ndarray:
    turn = rotations.to_tensor(rotations.from_vector(max(t - 1.0, 0.0) * TURN[None]))[0]
    return x @ (turn @ (np.eye(3) + min(t, 1.0) * (STRETCH - np.eye(3)))).T - x


@cache
def errors(cell: float, limit: float, *, basis: str = "bspline", boxes: bool = False) -> tuple[float, float]:
    """Relative change of the energy, and of the wryness, by a rotation of 2.3 rad in 8 steps."""
    grid = pm.Grid.box((-4, -4, -4), (4, 4, 4), cell)
    points = pm.seed(grid, bounds=((0, 0, 0), (2, 1, 1)), points_per_cell=2, material=MATERIAL)
    problem = pm.QuasiStatic(grid, points, reset=None, basis=basis, boxes=boxes)
    problem.rotation_limit = limit
    problem.fix(lambda x: x[:, 0] > -99, u=u, theta=theta)
    for _ in problem.march(2):
        pass
    before, wryness = problem.energies()["stored"], points.wryness.copy()
    for _ in problem.march(8, to=2.0):
        pass
    change = COMM.allreduce(abs(points.wryness - wryness).max(initial=0.0), MPI.MAX)
    size = COMM.allreduce(abs(wryness).max(initial=0.0), MPI.MAX)
    return abs(problem.energies()["stored"] / before - 1), change / size


@pytest.mark.parametrize("basis", ["bspline", "mpm"])
def test_a_rotation_from_a_base_on_is_exact(basis):
    """Increments are the same vector everywhere, so that interpolation does nothing to them."""
    assert max(errors(1.0, 1e-9, basis=basis)) < 1e-13


@pytest.mark.parametrize("limit", [1.0, 50.0])
def test_before_a_base_it_is_of_the_order_of_the_cells(limit):
    """Splines: 4.1e-4 and 1.35e-4 with the default, 1.3e-3 and 3.2e-4 without a base at all."""
    coarse, fine = errors(1.0, limit), errors(0.5, limit)
    assert coarse[1] < 1.5e-3
    assert coarse[1] / fine[1] > 2.8
    assert coarse[0] / fine[0] > 2.8


def test_boxes_at_a_new_base_are_of_second_order():
    """What a base itself does to the energy of boxes: 1.0e-4 and 2.5e-5."""
    coarse, fine = (errors(cell, 1e-9, boxes=True)[0] for cell in (1.0, 0.5))
    assert coarse < 1.2e-4
    assert coarse / fine > 3.5
