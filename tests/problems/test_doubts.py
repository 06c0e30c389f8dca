"""Estimates of errors that the points' boxes don't know."""

from __future__ import annotations

import warnings
from contextlib import nullcontext

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.problems import doubts
from polarmpm.problems.nearlimit import NearLimit
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

    exact = beam(0.125)[0]
    with pytest.warns(pm.TrustWarning, match="too stiff") if COMM.rank == 0 else nullcontext() as told:
        coarse, problem = beam(1.0, basis=basis)
    assert COMM.rank or sum(w.category is pm.TrustWarning for w in told) == 1
    assert problem.box_record.grid.rough == pytest.approx(1.0 - coarse / exact, rel=0.2)
    assert "in doubt" in problem.trust()
    fine, problem = beam(0.125, basis=basis)
    assert problem.box_record.grid.rough == pytest.approx(1.0 - fine / exact, abs=0.01)
    assert not problem.box_record.in_doubt


@pytest.mark.filterwarnings("ignore::polarmpm.TrustWarning")
def test_estimates_of_flow_and_of_equilibrium_are_the_same_on_any_ranks():
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        problem = bent(comm, basis="mpm")
        stress = problem.fields("stress").stress
        start = np.zeros_like(problem.system.x)
        found.append([*doubts.excess(problem.system, start), doubts.imbalance(problem.system, stress)])
        found[-1].append(doubts.missed(problem.system))
    np.testing.assert_allclose(*found, rtol=1e-6)


def column(cells: int, **options) -> pm.QuasiStatic:
    """Soil under its own weight, held on its sides."""
    h = 4.0 / cells
    grid = pm.Grid.box((0, 0), (h, 4), h, COMM)
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=NEO_HOOKEAN), **options)
    for x in (0.0, h):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.body_load(force=(0, -1e-4))
    list(problem.march(1, progress=False))
    return problem


@pytest.mark.filterwarnings("ignore::polarmpm.TrustWarning")
def test_stresses_in_equilibrium_with_the_weight_leave_no_forces():
    """The imbalance falls with the cells."""
    found = [column(cells, basis="mpm").box_record.grid.imbalance for cells in (4, 8, 16)]
    assert found[1] < found[0] / 3
    assert found[2] < min(found[1] / 3, 0.01)


def test_a_layer_between_platens_that_one_cell_can_not_show():
    """Nothing is rough, but a layer of one cell of tents is far too strong, and it's told."""

    def layer(cells: int) -> pm.QuasiStatic:
        h = 0.5 / cells
        grid = pm.Grid.box((0, 0), (2 + 2 * h, 0.5), h, COMM)
        points = pm.seed(
            grid, bounds=((0, 0), (2, 0.5)), material=pm.NeoHookean.from_engineering(E=1.0, nu=0.45)
        )
        problem = pm.QuasiStatic(grid, points, basis="mpm")
        problem.fix(pm.plane(x=0.0), ux=0)
        problem.fix(pm.plane(y=0.0), uy=0)
        problem.fix(pm.plane(y=0.5), ux=0, uy=-0.01)
        list(problem.march(4, progress=False, adaptive=True))
        return problem

    with pytest.warns(pm.TrustWarning, match="equilibrium") if COMM.rank == 0 else nullcontext():
        coarse = layer(1)
    assert coarse.box_record.grid.rough < 0.01
    assert "out of balance" in coarse.trust()
    with warnings.catch_warnings():
        warnings.simplefilter("error", pm.TrustWarning)
        layer(4)


def hinge(comm: MPI.Comm, cell: float, load: float) -> pm.QuasiStatic:
    """A plastic cantilever that its weight bends nearly till it fails."""
    grid = pm.Grid.box((0, -1.2), (4, 2), cell, comm)
    elastic = pm.Hencky.from_engineering(E=1e6, nu=0.3)
    points = pm.seed(
        grid, bounds=((0, 0.11), (3, 0.91)), material=pm.VonMises(elastic, k=4e3, H=2e4), points_per_cell=2
    )
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, -load))
    list(problem.march(6, progress=False, adaptive=True))
    return problem


def test_near_a_limit_load_a_little_strength_is_much_displacement_and_it_is_told():
    with pytest.warns(pm.TrustWarning, match="limit load") if COMM.rank == 0 else nullcontext():
        coarse = hinge(COMM, 0.4, 290.0)
    assert coarse.box_record.limit.sensitivity > 3.0
    with warnings.catch_warnings():
        warnings.simplefilter("error", pm.TrustWarning)
        elastic = hinge(COMM, 0.4, 90.0)
    np.testing.assert_allclose(elastic.box_record.limit.sensitivity, 1.0, atol=0.01)
    record = coarse.box_record
    before = record.state()
    record.restore(before)
    assert record.state() == before


def test_the_sensitivity_is_that_of_the_displacement_along_the_loads():
    """u grows with the cube of the loads; what loads do at the beginning and end of a step tells it."""
    limit, last = NearLimit(), 0.0
    for scale in np.linspace(0.1, 1.0, 40):
        moved = scale**3 - last**3
        limit.take(7.0 * last * moved, 7.0 * scale * moved, 0.0)
        last = scale
    assert limit.sensitivity == pytest.approx(3.0, rel=1e-6)
    limit.take(-1.0, 1.0, 0.0)  # the load has turned round
    assert limit.sensitivity == 0.0
    limit.take(1.0, 2.0, 0.0)  # nobody knows how far the body has moved under these loads
    assert limit.sensitivity == 0.0


def test_what_supports_move_is_nearer_to_no_limit():
    limit = NearLimit()
    limit.take(0.0, 1.0, 0.0)
    limit.take(1.0, 1.1, 5.0)
    assert limit.sensitivity == 0.0


@pytest.mark.parametrize("number", [2, 3])
def test_near_a_limit_load_with_any_number_of_points(number):
    """A cantilever of four cells across that moves 24 and 15 % too far. With more points less of the work is
    inside their boxes, but the grid's error stays."""
    solid = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.3, l_b=0.1, l_t=0.1, psi=1.0)
    grid = pm.Grid.box((0, -1.2), (4, 2), 0.2, COMM)
    metal = pm.VonMises(solid, k=4e3, H=2e4, l_p=0.1)
    points = pm.seed(grid, bounds=((0, 0.11), (3, 0.91)), material=metal, points_per_cell=number)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0, -260.0))
    with pytest.warns(pm.TrustWarning, match="near its limit load") if COMM.rank == 0 else nullcontext():
        for _ in problem.march(6, adaptive=True, progress=False):
            pass
