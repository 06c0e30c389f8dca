"""Estimates of errors that the points' boxes don't know."""

from __future__ import annotations

from contextlib import nullcontext

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.problems import doubts
from polarmpm.tools.parallel import sums_by_number
from tests.conftest import COMM, NEO_HOOKEAN


def bent(comm: MPI.Comm, **options) -> pm.QuasiStatic:
    """A cantilever of one and a half cells under its weight, askew to the grid."""
    grid = pm.Grid.box((0, -3), (8, 4), 1.0, comm)
    points = pm.seed(grid, lambda x: np.abs(x[:, 1] - 0.3 * x[:, 0]) <= 0.75, material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, -1e-3))
    for _ in problem.march(1, progress=False):
        pass
    return problem


def test_sums_over_the_ranks():
    """Each rank has all numbers up to its own."""
    numbers = np.arange(COMM.rank + 2)
    found = sums_by_number(COMM, numbers, np.stack([numbers + 1.0, np.ones(len(numbers))], axis=1))
    ranks = np.minimum(COMM.size, COMM.size + 1 - numbers)
    np.testing.assert_array_equal(found, np.stack([(numbers + 1.0) * ranks, ranks], axis=1))


@pytest.mark.filterwarnings("ignore::polarmpm.TrustWarning")
def test_estimates_are_the_same_on_any_ranks():
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        system = bent(comm, boxes=False).system
        found.append([doubts.missed(system), *doubts.roughness(system, np.zeros_like(system.x))])
    np.testing.assert_allclose(*found, rtol=1e-6)
    assert 0.01 < found[0][0] < 0.3


def test_a_run_without_boxes_is_in_doubt_once_and_stays_so():
    with pytest.warns(pm.TrustWarning, match="misses about") if COMM.rank == 0 else nullcontext():
        problem = bent(COMM, boxes=False)
    record = problem.box_record
    assert "in doubt" in problem.trust()
    before = record.state()
    record.restore(before)
    assert record.state() == before
    assert "resolved" in bent(COMM).trust()


@pytest.mark.parametrize("basis", ["mpm", "gimpm"])
def test_tents_are_as_much_too_stiff_as_their_strains_are_rough(basis):
    """And it's told, once, where that is more than a tenth."""

    def beam(cell: float, **options) -> tuple[float, pm.QuasiStatic]:
        grid = pm.Grid.box((0, -1), (7, 2), cell)
        points = pm.seed(grid, bounds=((0, 0), (6, 1)), material=NEO_HOOKEAN)
        problem = pm.QuasiStatic(grid, points, **options)
        problem.fix(pm.plane(x=0.0), u=0)
        problem.body_load(force=(0, -1e-3))
        list(problem.march(2, progress=False))
        return COMM.allreduce(float(np.abs(points.displacement).max(initial=0.0)), op=MPI.MAX), problem

    exact = beam(0.25)[0]
    with pytest.warns(pm.TrustWarning, match="too stiff") if COMM.rank == 0 else nullcontext() as told:
        coarse, problem = beam(1.0, basis=basis)
    assert COMM.rank or sum(w.category is pm.TrustWarning for w in told) == 1
    assert problem.box_record.rough == pytest.approx(1.0 - coarse / exact, rel=0.2)
    assert "in doubt" in problem.trust()
    fine, problem = beam(0.25, basis=basis)
    assert problem.box_record.rough == pytest.approx(1.0 - fine / exact, abs=0.02)
    assert not problem.box_record.in_doubt
