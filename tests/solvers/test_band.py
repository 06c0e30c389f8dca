"""Factors of small matrices whose unknowns are coupled to near ones only."""

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.solvers.band import Band
from polarmpm.solvers.direct import DirectSolver
from polarmpm.solvers.linear import Rows


def rows_of(dense, block, symmetric):
    """Compressed rows of a matrix of blocks, of a symmetric one the upper triangle."""
    n = len(dense)
    there = np.kron(
        np.abs(dense).reshape(n // block, block, n // block, block).sum(axis=(1, 3)) > 0,
        np.ones((block, block)),
    )
    there = np.triu(there) if symmetric else there
    row, column = np.nonzero(there)
    indptr = np.searchsorted(row, np.arange(n + 1)).astype(np.int64)
    columns = column.astype(np.int32)
    return Rows(block, indptr, lambda: columns, dense[row, column].copy(), lambda: None)


def strip(block, symmetric, seed, nodes=40):
    """A definite matrix of nodes in a strip, in any order, one of them alone."""
    rng = np.random.default_rng(seed)
    place = rng.permutation(nodes)
    near = np.abs(place[:, None] - place) <= 3
    near[0] = near[:, 0] = False
    near[0, 0] = True
    dense = rng.normal(size=(nodes * block, nodes * block)) * np.kron(near, np.ones((block, block)))
    if symmetric:
        dense = dense + dense.T
    return dense + np.diag(np.abs(dense).sum(axis=1) + 1.0)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize(("block", "nodes"), [(1, 40), (1, 3), (2, 40), (3, 41), (5, 40), (6, 40), (9, 7)])
def test_solves(block, nodes, symmetric):
    """Also where the last panel of rows isn't whole, and where a node has more unknowns than a panel."""
    dense = strip(block, symmetric, 10 * block, nodes)
    right = np.random.default_rng(1).normal(size=len(dense))
    band = Band(rows_of(dense, block, symmetric), symmetric)
    assert band.pays
    assert band.entries <= len(dense) * 7 * block  # the order of nodes is found again
    assert band.factor(0.0)
    np.testing.assert_allclose(band.apply(right), np.linalg.solve(dense, right), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(band.solve(right), np.linalg.solve(dense, right), rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("symmetric", [True, False])
def test_what_it_cannot_do(symmetric):
    dense = strip(2, symmetric, 3)
    rows = rows_of(dense, 2, symmetric)
    band = Band(rows, symmetric)
    assert band.factor(1e-3)
    right = np.ones(len(dense))
    before = rows.values.copy()
    assert band.solve(right) is not None  # the shift is made good
    np.testing.assert_array_equal(rows.values, before)
    rows.values[:] *= -1.0
    assert band.factor(0.0) is not symmetric  # definite it has to be where it is symmetric
    rows.values[3] = np.nan
    assert not band.factor(0.0) or band.solve(right) is None
    assert not Band(rows_of(np.ones((500, 500)), 2, symmetric), symmetric).pays


def bar():
    grid = pm.Grid.box((0, 0), (10, 1), 0.5)
    material = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=1e5, alpha=0.0, beta=1e3, gamma=1e3)
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=material, points_per_cell=2), basis="mpm")
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0, -10.0))
    return problem


def test_slender_bodies_take_it_and_others_stand_in():
    problem = bar()
    system = problem.system_at(1.0)
    system.evaluate(True)
    solver, alone = system.solver, problem.comm.size == 1
    assert isinstance(solver, DirectSolver)
    assert solver.in_place is alone
    forces = -system.residual
    found = system.solve_free(forces, True)
    if alone:  # of a tangent that isn't definite
        system.pattern.values *= -1.0
        np.testing.assert_allclose(system.solve_free(-forces, True), found, atol=1e-9 * np.abs(found).max())
        assert solver._factored is None
        system.pattern.values *= -1.0  # the next tangent is the band's again
        np.testing.assert_array_equal(system.solve_free(forces, True), found)
        assert solver._factored is not None


def test_both_factors_lead_to_the_same_place(monkeypatch):
    places = []
    for pays in (True, False):
        problem = bar()
        with monkeypatch.context() as m:
            if not pays:
                m.setattr(Band, "pays", False)
            for _ in problem.march(2):
                assert problem.system.solver.in_place is (pays and problem.comm.size == 1)
        places.append(problem.points.x[np.argsort(problem.points.id)])
    np.testing.assert_allclose(places[0], places[1], rtol=0, atol=1e-10)
