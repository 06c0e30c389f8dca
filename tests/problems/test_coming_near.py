"""Resets of bodies in motion that come to supports, or to pieces of themselves."""

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.problems.comingnear import pieces_meet
from tests.conftest import COMM

MATERIAL = pm.NeoHookean.from_engineering(E=1e4, nu=0.3)


def test_a_block_that_falls_is_stopped_by_nodes():
    """Which it doesn't know of when it begins to fall; without resets it falls through."""
    speeds, lowest = [], []
    for reset in ("in motion", pm.WhenDistorted()):
        grid = pm.Grid.box((0.0, 0.0), (2.0, 1.5), 0.125, comm=COMM)
        points = pm.seed(grid, material=MATERIAL, bounds=((0.25, 0.6), (0.75, 1.1)))
        points.join(pm.seed(grid, material=MATERIAL, bounds=((1.5, 0.25), (1.75, 0.5))))
        options = {} if isinstance(reset, str) else {"reset": reset}
        problem = pm.Dynamic(
            grid, points, density=1000.0, basis="mpm", ghost=pm.GhostPenalty(100.0), **options
        )
        problem.fix(lambda x: x[:, 1] < 0.3, u=0)
        problem.velocity(points.where(lambda x: x[:, 0] < 1.0), v=(0.0, -1.0))
        for _ in problem.march(0.5, dt=0.0125, progress=False):
            pass
        speeds.append(problem.momentum()[1])
        lowest.append(COMM.allreduce(points.x[:, 1].min(initial=np.inf), op=MPI.MIN))
        if isinstance(reset, str):
            assert problem.progress.since_reset < 40
    assert speeds[0] > -100.0  # stopped, or thrown back
    assert lowest[0] > 0.25
    assert speeds[1] == pytest.approx(-250.0, rel=1e-9)


def test_pieces_meet_where_they_may_share_nodes():
    grid = pm.Grid.box((0.0, 0.0), (20.0, 20.0), 1.0, comm=COMM)
    x = np.array([[1.5, 1.5], [4.5, 1.5]])
    piece, body = np.array([0, 1]), np.zeros(2, dtype=int)
    rows = slice(0, 2 if COMM.rank == 0 else 0)
    one = (piece[rows], body[rows])
    assert pieces_meet(grid, COMM, x[rows], *one)
    assert not pieces_meet(grid, COMM, 4.0 * x[rows], *one)
    assert not pieces_meet(grid, COMM, x[rows], piece[rows], piece[rows])


def test_pieces_of_one_body_meet_and_part():
    """Two squares of one body: the grid is reset at each step when they are near, and they rebound."""
    grid = pm.Grid.box((0.0, 0.0), (3.0, 1.0), 0.125, comm=COMM)
    points = pm.seed(grid, material=MATERIAL, bounds=((0.5, 0.25), (1.0, 0.75)))
    points.join(pm.seed(grid, material=MATERIAL, bounds=((1.75, 0.25), (2.25, 0.75))))
    problem = pm.Dynamic(grid, points, density=1000.0, rho_inf=1.0)
    left = points.where(lambda x: x[:, 0] < 1.5)
    problem.velocity(v=(-0.5, 0.0))
    problem.velocity(left, v=(0.5, 0.0))
    resets = []
    for _ in problem.march(1.6, dt=0.02, progress=False):
        resets.append(problem.progress.reset_due)
    assert not any(resets[:10])
    assert all(resets[40:50])
    speed = points.mean(points.velocity, left)[0]
    assert speed < -0.3
    assert np.abs(problem.momentum()).max() < 1e-9


@pytest.mark.parametrize("reset", ["in motion", 100, None])
def test_a_body_that_flies_out_of_the_grid_is_stopped(reset):
    """A rigid motion may never ask for a reset; without resets the body is in its own cells."""
    grid = pm.Grid.box((0.0, 0.0), (2.0, 1.0), 0.25, comm=COMM)
    points = pm.seed(grid, material=MATERIAL, bounds=((0.5, 0.25), (1.0, 0.75)))
    options = {} if reset == "in motion" else {"reset": reset}
    problem = pm.Dynamic(grid, points, density=1000.0, **options)
    problem.velocity(v=(1.0, 0.0))
    if reset is None:
        assert [step.number for step in problem.march(2.0, dt=0.1, progress=False)][-1] == 20
        return
    with pytest.raises(pm.PointsOutsideGrid, match=r"from \(0.0, 0.0\) to \(2.0, 1.0\) m"):
        for _ in problem.march(2.0, dt=0.1, progress=False):
            pass
    end = COMM.allreduce(points.x[:, 0].max(initial=0.0), op=MPI.MAX)
    assert 2.0 < end < 2.1 + 1e-9  # within a step


def test_a_body_that_leaves_the_grid_is_met_by_one_that_follows():
    grid = pm.Grid.box((0.0, 0.0), (2.0, 1.0), 0.25, comm=COMM)
    points = pm.seed(grid, material=MATERIAL, bounds=((0.5, 0.25), (1.0, 0.75)))
    problem = pm.Dynamic(grid, points, density=1000.0, regrid=pm.FollowBody(margin=2))
    problem.velocity(v=(1.0, 0.0))
    for _ in problem.march(2.0, dt=0.1, progress=False):
        pass
    assert len(problem.regrids) > 0
    assert problem.momentum()[0] == pytest.approx(250.0, rel=1e-9)


def test_a_body_at_rest_that_is_turned_out_of_the_grid_is_stopped():
    """In statics, too: the far end leaves the grid while no cell is distorted."""
    grid = pm.Grid.box((0.0, 0.0), (1.5, 1.5), 0.25, comm=COMM)
    points = pm.seed(grid, material=MATERIAL, bounds=((0.0, 1.0), (1.0, 1.5)))
    problem = pm.QuasiStatic(grid, points)
    problem.fix(lambda x: x[:, 0] < 10.0, ux=0.0, uy=0.3)
    with pytest.raises(pm.PointsOutsideGrid):
        for _ in problem.march(10, progress=False):
            pass
