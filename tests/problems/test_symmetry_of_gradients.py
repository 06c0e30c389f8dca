"""Slopes of second-gradient bodies on planes: there they are conditions of their own, without which a part of
a symmetric body is another body."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from tests.conftest import COMM
from tests.problems.test_symmetry import STRICT, assert_same, bar


def gradient_elastic(lam: float, mu: float, length: float, directors: int = 2) -> pm.UserEnergy:
    """psi(E) + l^2/12 sum_a psi(E,a) of Green's strain E and its derivatives."""

    def psi(A: Any, p: Any) -> Any:
        return 0.5 * p.lam * ufl.tr(A) ** 2 + p.mu * ufl.inner(A, A)

    def energy(F: Any, H: Any, p: Any) -> Any:
        W = psi(0.5 * (F.T * F - ufl.Identity(3)), p)
        for a in range(directors):
            slope = ufl.as_matrix([[H[i, j, a] for j in range(3)] for i in range(3)])
            W += p.length**2 / 12 * psi(ufl.sym(F.T * slope), p)
        return W

    numbers = {"lam": lam, "mu": mu, "length": length}
    return pm.UserEnergy(energy, numbers, micropolar=False, second_gradient=True)


@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
def test_half_and_quarter(basis):
    material = gradient_elastic(3e3, 2e3, 0.6)
    for halved, bend in (("x", 40.0), ("xy", 0.0)):
        parts = []
        for part in ("", halved):
            problem, _ = bar(material, part, bend=bend, basis=basis, reset=1)
            list(problem.march(2, progress=False))
            parts.append(problem)
        assert_same(parts[1], parts[0])
        assert parts[1].balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)


def test_space():
    material = gradient_elastic(3e3, 2e3, 0.4, 3)
    parts = []
    for halved in ("", "xyz"):
        problem, _ = bar(material, halved, dim=3)
        list(problem.march(1, progress=False))
        parts.append(problem)
    assert_same(parts[1], parts[0])


# a round excavation -----------------------------------------------------------------------------------
INNER, OUTER, LENGTH, YOUNG, PRESSURE = 2.0, 5.0, 4.0, 20e9, 54.0189e6
EXACT = -9.49126e-3  # radial displacement of the wall (m), closed form for small strains


def excavation(cell: float, *, symmetric: bool) -> tuple[np.ndarray, np.ndarray]:
    """A quarter of a thick ring under pressure from outside, 3 x 3 Gauss points in polar cells: radii and
    radial displacements of the points. A hundredth of the pressure, as strains are to be small."""
    g, w = (a * 0.5 for a in np.polynomial.legendre.leggauss(3))
    g = g + 0.5
    nr, nt = round((OUTER - INNER) / cell), round(0.25 * np.pi * (INNER + OUTER) / cell)
    dr, dt = (OUTER - INNER) / nr, 0.5 * np.pi / nt
    r, angle = INNER + (np.arange(nr)[:, None] + g).ravel() * dr, (np.arange(nt)[:, None] + g).ravel() * dt
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    X = (r[:, None, None] * normals).reshape(-1, 2)
    volume = (np.tile(w * dr, nr) * r)[:, None] * np.tile(w * dt, nt)
    mine = slice(COMM.rank, None, COMM.size)
    mu = YOUNG / 2
    material = gradient_elastic(0.0, mu, LENGTH)
    points = pm.Points(X[mine], volume.ravel()[mine], np.zeros_like(X[mine]), material, COMM)
    grid = pm.Grid.box((0.0, 0.0), (6.0, 6.0), cell)
    problem = pm.QuasiStatic(grid, points, reset=None, controls=STRICT)
    for axis in "xy":
        plane = pm.plane(**{axis: 0.0})
        if symmetric:
            problem.symmetry(plane)
        else:
            problem.fix(plane, **{f"u{axis}": 0})
    surface = pm.Surface(OUTER * normals, OUTER * np.tile(w * dt, nt), normals)
    problem.pressure(surface, 1e-2 * PRESSURE)
    assert problem.attempt(1.0).converged
    away = np.linalg.norm(points.X, axis=1)
    rows = np.stack([away, np.einsum("ni,ni->n", points.displacement, points.X) / away * 1e2], axis=1)
    return tuple(np.concatenate(COMM.allgather(rows)).T)


def at_the_wall(r: np.ndarray, u: np.ndarray) -> tuple[float, float]:
    """Mean radial displacement of the wall, continued from the points nearest to it, and how much the
    displacement varies there around the hole."""
    circles = np.unique(r.round(6))[:6]
    means = [u[np.abs(r - one) < 1e-5].mean() for one in circles]
    of_first = u[np.abs(r - circles[0]) < 1e-5]
    spread = (of_first.max() - of_first.min()) / abs(of_first.mean())
    return float(np.polyval(np.polyfit(circles, means, 3), INNER)), float(spread)


@pytest.mark.parametrize(("cell", "bound"), [(0.5, 1.3e-3), (0.25, 2e-4)])
def test_a_round_excavation_stays_round(cell, bound):
    wall, spread = at_the_wall(*excavation(cell, symmetric=True))
    assert wall == pytest.approx(EXACT, rel=bound)
    assert spread < 2 * bound


def test_without_the_slope_it_does_not():
    """The same quarter, with displacements along the normals alone: 5 % off, and not round."""
    wall, spread = at_the_wall(*excavation(0.5, symmetric=False))
    assert wall / EXACT - 1.0 == pytest.approx(0.0475, abs=0.01)
    assert spread > 0.06


# a bar that is clamped ----------------------------------------------------------------------------------
def pulled(cells: int, slope: bool) -> float:
    """Displacement of the end of a bar of length 1 under a traction E, over the traction over E."""
    young, small = 1e4, 1e-6
    material = gradient_elastic(0.0, 0.5 * young, 1.0, 1)
    grid = pm.Grid.box((0.0, 0.0), (1.0, 1.0 / cells), 1.0 / cells)
    points = pm.seed(grid, material=material, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=None, controls=STRICT)
    problem.fix(pm.plane(x=0.0), ux=0, **({"slope": 0} if slope else {}))
    for y in (0.0, 1.0 / cells):
        problem.symmetry(pm.plane(y=y))
    end = pm.Surface.line((1.0, 0.0), (1.0, 1.0 / cells), 3)
    problem.traction(end, force=(young * small, 0.0))
    assert problem.attempt(1.0).converged
    nodes = problem.system.nodes.position[:, 0] > 1.0 - 1e-9
    return COMM.allreduce(float(problem.system.x[nodes, 0].max(initial=0.0)), op=MPI.MAX) / small


def test_the_end_of_a_bar():
    """u(L) = L - g tanh(L / g), g = l / sqrt(12), with the slope held, and order 2; else the classical L."""
    g = 12.0**-0.5
    exact = 1.0 - g * np.tanh(1.0 / g)
    errors = [abs(pulled(cells, True) - exact) for cells in (4, 8, 16)]
    assert np.all(errors <= np.array([9.0e-3, 2.3e-3, 5.8e-4]))
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 4.0, rtol=0.02)
    assert pulled(8, False) == pytest.approx(1.0, rel=1e-3)
