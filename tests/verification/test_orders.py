"""Orders of convergence: material points, splines and finite elements against manufactured solutions."""

from __future__ import annotations

import argparse
import itertools
import math

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.basis.registry import basis_of
from polarmpm.study import manufactured
from tests.conftest import COMM
from tests.helpers.bodies import box, everywhere
from tests.helpers.demos import demo_module

pytestmark = pytest.mark.slow


# material points ------------------------------------------------------------------------------------
def assert_quadratic(history, floor=1e-10):
    """Near the solution the force measure squares from one iteration to the next, up to a constant."""
    force = [f for f, _ in history]
    late = [(a, b) for a, b in itertools.pairwise(force[1:]) if a < 1e-2 and b > floor]
    assert late, force
    for a, b in late:
        assert b < 50 * a**2 + floor, force


def test_material_points():
    """T 3.5.1: order 2 in u and theta, 1 in stress, couple stress supralinear; Newton is quadratic."""
    demo = demo_module("manufactured_solution")
    args = argparse.Namespace(points_per_cell=2, basis="mpm", steps=1)
    errors = []
    for cells in (4, 8, 16):
        problem, found = demo.solve(cells, args)
        errors.append(found)
        assert_quadratic(problem.steps[-1].history)
    order = {name: math.log2(errors[1][name] / errors[2][name]) for name in errors[0]}
    assert order["displacement"] >= 1.9
    assert order["rotation"] >= 1.7
    assert order["stress"] >= 1.0
    assert order["couple_stress"] >= 1.3


WAVE = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=170.0)


def wave(X):
    product = ufl.sin(np.pi * X[0]) * ufl.sin(np.pi * X[1]) * ufl.sin(np.pi * X[2]) / 30
    return ufl.as_vector((product, -product, product))


def wave_orders(basis, grids):
    """Orders of all errors between two grids of the unit cube, the second with twice as many cells."""
    degree, errors = basis_of(basis).degree, []
    for grid in grids:
        points = pm.seed(grid, material=WAVE, points_per_cell=degree + 1, layout="gauss")
        exact = manufactured.Solution(WAVE, wave, wave, grid.comm)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, balanced_reset=False)
        for axis in "xyz":
            for wall in (0.0, 1.0):
                problem.fix(pm.plane(**{axis: wall}), u=0, theta=0)
        problem.body_load(
            force=lambda t, X, s=exact: t * s.sources(X)[:, :3],
            couple=lambda t, X, s=exact: t * s.sources(X)[:, 3:],
        )
        list(problem.march(1))
        errors.append(exact.errors(problem))
    return {k: np.log2(errors[0][k] / errors[1][k]) for k in errors[0]}


def unit_lines(kind, cells):
    k = np.arange(cells)
    size = {
        "smooth": 4.0 ** (k / cells),
        "1:3": np.where(k < cells // 2, 1.0, 3.0),
        "jittered": 1.0 + 0.4 * np.sin(5.0 * k),
    }[kind]
    lines = np.concatenate([[0.0], np.cumsum(size)])
    return lines / lines[-1]


@pytest.mark.parametrize(("basis", "least"), [("mpm", 1.8), ("bspline", 3.3)])
@pytest.mark.parametrize("kind", ["smooth", "1:3", "jittered"])
def test_graded_lines(kind, basis, least):
    """Displacements keep their order."""
    axes = [unit_lines(kind, cells) for cells in (4, 8)]
    assert wave_orders(basis, [pm.Grid.graded(a, a, a) for a in axes])["displacement"] > least


@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
def test_splines(basis):
    """In a smooth problem without resets: displacement and rotation of order degree + 1, stresses of order
    degree."""
    degree = basis_of(basis).degree
    order = wave_orders(basis, [pm.Grid.box((0, 0, 0), (1, 1, 1), 1 / cells) for cells in (3, 6)])
    assert min(order["displacement"], order["rotation"]) > degree + 0.7
    assert min(order["stress"], order["couple_stress"]) > degree - 0.3


# finite elements ------------------------------------------------------------------------------------
def manufactured_errors(cells, degree, gamma):
    demo = demo_module("manufactured_solution")
    moduli = {**demo.MATERIAL.parameters(), "gamma": gamma, "beta": gamma}
    material = pm.MicropolarElastic(**moduli)
    exact = manufactured.Solution(material, demo.field, demo.field, COMM)
    body = pm.Elements(box("hexahedron", (cells,) * 3), material=material, degree=degree)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(body.facets(everywhere), u=0, theta=0)
    problem.body_load(
        force=lambda t, X: t * exact.sources(X)[:, :3], couple=lambda t, X: t * exact.sources(X)[:, 3:]
    )
    list(problem.march(1))
    return exact.errors(problem)


@pytest.mark.parametrize(
    ("degree", "gamma", "sizes", "least"),
    [
        pytest.param(1, 50.0, (4, 8, 16), (1.9, 1.7, 1.0, 1.3), id="1-published"),
        pytest.param(2, 50.0, (4, 8), (2.9, 1.5, 1.9, 0.8), id="2-published"),
        pytest.param(1, 1e9, (4, 8, 12), (1.95, 1.95, 1.0, 1.0), id="1-long"),
        pytest.param(2, 1e9, (4, 8), (2.9, 2.9, 1.9, 1.9), id="2-long"),
        pytest.param(3, 1e9, (2, 4), (3.8, 3.8, 2.8, 2.8), id="3-long"),
    ],
)
def test_elements(degree, gamma, sizes, least, capsys):
    """T 3.5.1: displacement and rotation converge with order degree + 1, stresses with order degree.

    The published length sqrt(gamma / kappa) is 0.1 mm, cells are a thousand times as large: there rotations
    follow the gradient of displacement, whose order is the degree. With a length of 0.5 m they have their
    own. Numbers of cells are multiples of 4, with which no point lies where a stress is zero.
    """
    errors = [manufactured_errors(cells, degree, gamma) for cells in sizes]
    steps = list(itertools.pairwise(zip(sizes, errors, strict=True)))
    for name, expected in zip(("displacement", "rotation", "stress", "couple_stress"), least, strict=True):
        orders = [np.log(a[name] / b[name]) / np.log(n / m) for (m, a), (n, b) in steps]
        with capsys.disabled():
            row = "  ".join(f"{e[name]:.3e}" for e in errors)
            print(f"\ndegree {degree} {name:>13}: {row}  orders {np.round(orders, 2)}", end="")
        assert orders[-1] >= expected, (name, orders)
