"""Experiments that are runs: curves, fields at places, load paths, ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm

from ..conftest import MICROPOLAR
from .scenes import SHEET, sheet

COMM = MPI.COMM_WORLD
PLACES = np.array([(0.3, 0.2), (1.0, 0.9), (2.1, 0.05), (3.9, 0.5)])
START = {"mu": 2.4e3, "kappa": 700.0, "gamma": 130.0}


def computed(at, **options):
    problem, see = sheet(SHEET, **options)
    rows = {name: [] for name in see}
    for factor in at:
        list(problem.march(1, to=factor, progress=False))
        for name, of in see.items():
            rows[name].append(of())
    return {name: np.array(of) for name, of in rows.items()}


def test_a_curve_and_a_field():
    at = np.array([0.0, 0.5, 1.0])
    true = computed(at[1:], places=PLACES)
    curve = np.append(0.0, true["deflection"])
    curve[1] = np.nan
    data = {"deflection": (curve, 1e-4), "field": (true["field"][1:], 1e-4, [1.0])}
    fit = pm.identify(
        pm.Experiment(sheet, at=at, data=data, places=PLACES), start=START, free=["mu", "gamma"]
    )
    assert fit.dof == 1 + PLACES.size - 2  # nothing is compared at load factor 0
    for name, value in fit.values.items():
        assert abs(value / SHEET[name] - 1) < 1e-4, name
    assert fit.evaluations <= 10
    assert not fit.unidentifiable


def test_heights_show_what_one_beam_does_not():
    def tests(heights):
        return [
            pm.Experiment(
                sheet, data={"deflection": (computed([1.0], height=h)["deflection"][0], 1e-3)}, height=h
            )
            for h in heights
        ]

    free = ["mu", "gamma"]
    alone = pm.plan(tests([1.0]), values=SHEET, free=free)
    assert alone.unidentifiable == free
    both = pm.identify(tests([1.0, 2.0]), start={**SHEET, "mu": 3e3, "gamma": 100.0}, free=free)
    for name in free:
        assert abs(both.values[name] / SHEET[name] - 1) < 1e-4


def strip(p):
    """A cantilever of elements; its deflection, displacements and rotations."""
    cells = mesh.create_rectangle(COMM, [(0, 0), (4, 1)], [8, 2], mesh.CellType.quadrilateral)
    body = pm.Elements(cells, material=pm.MicropolarElastic(lam=3e3, alpha=0.0, beta=0.0, kappa=700.0, **p))
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(body.farthest((1, 0)), force=(0, -40.0))
    seen = pm.Places(body, [(1.0, 0.5), (3.0, 0.2)])
    return problem, {"field": seen.displacement, "turn": seen.rotation}


def test_elements():
    true = {"mu": 2e3, "gamma": 170.0}
    problem, see = strip(true)
    list(problem.march(1, progress=False))
    data = {name: (of(), 1e-3) for name, of in see.items()}
    fit = pm.identify(pm.Experiment(strip, data=data), start={"mu": 2.5e3, "gamma": 130.0}, free=list(true))
    for name, value in fit.values.items():
        assert abs(value / true[name] - 1) < 1e-5, name
    assert fit.dof == 2 * (2 + 3) - 2


@pytest.mark.parametrize("method", ["twins", "differences"])
def test_a_load_path_that_turns_back(method):
    at = [0.5, 1.0, 0.5]
    true = computed(at)["deflection"]
    test = pm.Experiment(sheet, at=at, data={"deflection": (true, 1e-3)}, march={"steps": 4}, method=method)
    fit = pm.identify(test, start={**SHEET, "mu": 2.6e3}, free=["mu"])
    assert abs(fit.values["mu"] / SHEET["mu"] - 1) < 1e-5


def test_a_shape_that_does_not_fit():
    test = pm.Experiment(sheet, data={"field": (np.zeros((3, 2)), 1.0)}, places=PLACES)
    with pytest.raises(pm.InputError, match=r"field: the measured values have the shape \(1, 3, 2\)"):
        pm.identify(test, start=SHEET, free=["mu"])


@pytest.mark.timeout(200)
@pytest.mark.skipif(COMM.size > 1, reason="processes of one rank")
def test_a_pool_finds_the_same_digits():
    """Two processes share the parameters of one experiment."""
    true = computed([1.0], places=PLACES)
    data = {name: (of[0], 1e-3) for name, of in true.items()}
    test = pm.Experiment(sheet, data=data, places=PLACES)
    options = {"start": SHEET | START, "free": ["mu", "gamma", "kappa"], "most": 2}
    serial, pool = (pm.identify(test, workers=n, **options) for n in (1, 2))
    assert serial.values == pool.values
    np.testing.assert_array_equal(serial.covariance, pool.covariance)


# places ---------------------------------------------------------------------------------------------
def quadratic(X):
    x, y = X[:, 0], X[:, 1]
    return np.stack([0.1 + 0.3 * x - 0.2 * y, 0.02 * x**2 - 0.05 * x * y + 0.03 * y**2], axis=1)


@pytest.mark.parametrize("layout", ["uniform", "gauss"])
def test_polynomials_are_met_at_places_of_points(layout):
    grid = pm.Grid.box((-1, -3), (6, 3), 0.5)
    points = pm.seed(grid, bounds=((0.1, 0.2), (4.0, 1.3)), material=MICROPOLAR, layout=layout)
    X = np.array([(0.1, 0.2), (4.0, 1.3), (1.234, 0.777), (3.2, 0.21)])
    places = pm.Places(points, X)
    np.testing.assert_allclose(places.values(quadratic(points.X)), quadratic(X), atol=1e-10)
    points.x = points.X + quadratic(points.X)
    np.testing.assert_allclose(places.displacement(), quadratic(X), atol=1e-10)
    np.testing.assert_allclose(places.rotation(), 0, atol=1e-14)
    with pytest.raises(pm.InputError, match=r"1 of 2 places lie outside.*\(9, 9\)"):
        pm.Places(points, [(1.0, 1.0), (9.0, 9.0)])
    with pytest.raises(pm.InputError, match="X = "):
        pm.Places(points, [(1.0, 1.0, 0.0)])
    with pytest.raises(pm.InputError, match="values"):
        places.values(np.zeros(len(points) + 1))


def test_polynomials_are_met_at_places_of_a_mesh_and_in_space():
    cells = mesh.create_rectangle(COMM, [(0, 0), (2, 1)], [6, 3], mesh.CellType.quadrilateral)
    body = pm.Elements(cells, material=MICROPOLAR)
    own = body.nodes.position[: body.nodes.owned, :2]
    X = np.array([(0.0, 0.0), (1.23, 0.4), (2.0, 1.0)])
    places = pm.Places(body, X)
    np.testing.assert_allclose(places.values(quadratic(own)), quadratic(X), atol=1e-10)
    assert places.displacement().shape == (3, 2)
    grid = pm.Grid.box((0, 0, 0), (3, 3, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0, 0), (2, 2, 2)), material=MICROPOLAR)
    X = np.array([(0.1, 0.2, 0.3), (1.9, 1.0, 1.1)])
    np.testing.assert_allclose(pm.Places(points, X).values(points.X**2), X**2, atol=1e-10)


def test_places_in_long_elements():
    """They are far from all nodes, and in the body all the same."""
    cells = mesh.create_rectangle(COMM, [(0, 0), (10, 1)], [2, 10], mesh.CellType.quadrilateral)
    body = pm.Elements(cells, material=MICROPOLAR)
    places = pm.Places(body, [(2.5, 0.5), (7.4, 0.32)])
    own = body.nodes.position[: body.nodes.owned, :1]
    np.testing.assert_allclose(places.values(own)[:, 0], [2.5, 7.4], rtol=1e-12)
    with pytest.raises(pm.InputError, match=r"\(2\.5, 7\.5\) lies outside the undeformed body"):
        pm.Places(body, [(2.5, 7.5)])


def test_few_points_have_places():
    grid = pm.Grid.box((0, 0), (3, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=MICROPOLAR, points_per_cell=1)
    assert points.total == 1
    np.testing.assert_allclose(pm.Places(points, [(0.6, 0.5)]).values(3 * np.ones(len(points))), [3.0])


# errors ---------------------------------------------------------------------------------------------
def uneven(p, at):
    """Fails on the last rank, away from the start."""
    if p["a"] != 1.0 and COMM.rank == COMM.size - 1:
        raise RuntimeError("a bug of the script")
    return {"y": p["a"] * at}


def overloaded(p):
    """A sheet that no step carries where it is a little softer than it should be."""
    problem, see = sheet({**SHEET, **p})
    if p["mu"] < 0.995 * SHEET["mu"]:
        problem.body_load(force=(0, -1e7))
    return problem, see


def test_runs_that_fail_on_the_way():
    """On several ranks, too: they all step back, and go on together."""
    data = {"deflection": (computed([1.0])["deflection"][0], 1e-3)}
    test = pm.Experiment(overloaded, data=data, march={"adaptive": False, "steps": 1})
    start = {"mu": np.exp(0.28) * SHEET["mu"]}  # a straight step goes .3 down
    fit = pm.identify(test, start=start, free=["mu"])
    assert abs(fit.values["mu"] / SHEET["mu"] - 1) < 1e-3
    assert fit.converged
    assert fit.failures
    assert "mu = " in fit.failures[0]
    assert "runs failed" in str(fit)


def test_errors_of_a_script_are_raised_on_all_ranks():
    test = pm.Experiment(uneven, at=[1.0, 2.0], data={"y": ([3.0, 6.0], 0.1)})
    here = RuntimeError if COMM.rank == COMM.size - 1 else pm.ErrorOnAnotherRank
    with pytest.raises(here, match="a bug of the script"):
        pm.identify(test, start={"a": 1.0}, free=["a"])


def test_contact_has_no_derivatives():
    def build(p):
        problem, found = sheet({**SHEET, **p})
        problem.obstacle(pm.HalfSpace((0, -1), (0, -2.5)))
        return problem, found

    test = pm.Experiment(build, data={"deflection": (-1.0, 0.1)})
    with pytest.raises(pm.InputError, match="contact"):
        pm.identify(test, start={"mu": 2e3}, free=["mu"])
