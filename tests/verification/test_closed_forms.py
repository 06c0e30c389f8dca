"""Closed forms of generalised continua: a hole under tension, bars in torsion, large bending, sheets."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.study.exact import hole_in_tension, twisted_bar
from tests.conftest import COMM
from tests.helpers.bodies import box
from tests.helpers.demos import demo_module

E, NU = 1e3, 0.3
MU, LAM = E / 2 / (1 + NU), E * NU / (1 + NU) / (1 - 2 * NU)


# a hole under tension -----------------------------------------------------------------------------------
def stress_at_hole(material: pm.Material, tension: float, far: float = 40.0) -> float:
    """Hoop stress over the tension at a hole of radius 1, by elements of a quarter: of the points near the
    place of the largest one a polynomial of the distance and the angle."""
    mesh = box("quadrilateral", (20, 24))
    x = mesh.geometry.x
    step = np.pi / 2 / 24
    r, t = far ** (x[:, 0] ** 2) * np.sqrt(step / np.sin(step)), np.pi / 2 * x[:, 1]  # the circles' areas
    x[:, 0], x[:, 1] = r * np.cos(t), r * np.sin(t)
    body = pm.Elements(mesh, material=material, degree=2)
    problem = pm.QuasiStaticFEM(body)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))

    def pull(factor: float, X: np.ndarray) -> np.ndarray:
        normal = X / np.linalg.norm(X, axis=1)[:, None]
        return factor * tension * normal * [1, 0]

    problem.traction(lambda x: np.linalg.norm(x, axis=1) > 0.99 * far, force=pull)
    list(problem.march(1, progress=False))
    at = problem.points.X
    radius, angle = np.hypot(*at.T), np.arctan2(at[:, 0], at[:, 1])
    near = (radius < 1.6) & (angle < 0.4)
    around = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    hoop = np.einsum("ni,nij,nj->n", around, problem.fields("stress").stress[:, :2, :2], around)
    mine = np.stack([radius - 1, angle, hoop], axis=1)[near]
    s, phi, hoop = np.concatenate(COMM.allgather(mine)).T
    powers = np.stack([s**i * phi ** (2 * j) for i in range(4) for j in range(3)], axis=1)
    return float(np.linalg.lstsq(powers, hoop, rcond=None)[0][0] / tension)


@pytest.mark.parametrize(("N", "l_b"), [(0.5**0.5, 0.02), (0.5**0.5, 0.25), (0.5**0.5, 1.0), (0.9, 0.5)])
def test_hole_in_a_plate_under_tension(N, l_b):
    kappa, bending = MU * N**2 / (1 - N**2), 2 * MU * l_b**2  # gamma + beta = 4 mu l_b^2
    solid = pm.MicropolarElastic(lam=LAM, mu=MU, kappa=kappa, alpha=0.0, gamma=bending, beta=bending)
    exact = hole_in_tension(radius=1, nu=NU, N=N, l_b=l_b)
    assert stress_at_hole(solid, 1e-5 * E) == pytest.approx(exact, rel=2.5e-3)


# torsion ------------------------------------------------------------------------------------------------
def twist_energy(material: pm.Material, n: int = 6) -> float:
    """Of a slice of a round bar of radius 1 between turned ends, quadratic hexahedra; they lie in a square
    that is mapped onto the disc."""
    mesh = box("hexahedron", (n, n, 1), (2.0, 2.0, 0.5))
    x = mesh.geometry.x
    x[:, :2] -= 1
    size = np.abs(x[:, :2]).max(axis=1)
    angle = np.pi / 4 * np.where(size > 0, x[:, :2].T / np.where(size > 0, size, 1), 0)
    along = np.abs(x[:, 0]) >= np.abs(x[:, 1])
    cos = np.where(along, np.sign(x[:, 0]) * np.cos(angle[1]), np.sin(angle[0]))
    sin = np.where(along, np.sin(angle[1]), np.sign(x[:, 1]) * np.cos(angle[0]))
    inner = 0.3 + 0.7 * size[:, None]  # square in the middle, round outside
    x[:, :2] = (1 - inner) * x[:, :2] + inner * size[:, None] * np.stack([cos, sin], axis=1)
    x[:, :2] *= np.sqrt(np.pi / 2 / n / np.sin(np.pi / 2 / n))  # the circle's area
    twist = 1e-4

    def turned(factor: float, X: np.ndarray) -> np.ndarray:
        t = factor * twist * X[:, 2]
        c, s = np.cos(t) - 1, np.sin(t)
        return np.stack([c * X[:, 0] - s * X[:, 1], s * X[:, 0] + c * X[:, 1], 0 * s], axis=1)

    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=2))
    for z in (0.0, 0.5):
        spin = {"theta_z": z * twist} if material.micropolar else {}
        problem.fix(pm.plane(z=z), u=turned, **spin)
    list(problem.march(1, progress=False))
    return float(problem.energies()["stored"])


def test_micropolar_round_bar_in_torsion():
    moduli = {"mu": MU, "kappa": MU / 2, "alpha": 0.03 * MU, "gamma": 0.1 * MU}
    solid = pm.MicropolarElastic(lam=LAM, beta=0.05 * MU, **moduli)
    found = twist_energy(solid) / twist_energy(pm.SaintVenantKirchhoff(lam=LAM, mu=MU))
    assert found == pytest.approx(twisted_bar(radius=1, **moduli), rel=5e-4)


def test_round_bar_of_second_gradients_in_torsion():
    """1 + l^2 / (3 R^2), two directors in the section."""
    plain = pm.SaintVenantKirchhoff(lam=LAM, mu=MU)
    found = twist_energy(pm.GradientElastic(plain, (0.8, 0.8, 0.0)), 4) / twist_energy(plain, 4)
    assert found == pytest.approx(1 + 0.8**2 / 3, rel=5e-4)


# large bending ------------------------------------------------------------------------------------------
def tip_of_elements(material: pm.Material, force: float) -> list[float]:
    body = pm.Elements(box("quadrilateral", (40, 1), (20.0, 1.0)), material=material, degree=2)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, slope=0)
    problem.load(pm.plane(x=20.0), force=(0.0, force))
    list(problem.march(4, progress=False))
    return list(body.mean_displacement(body.facets(pm.plane(x=20.0))) / 20)


def tip_of_points(material: pm.Material, force: float) -> list[float]:
    grid = pm.Grid.box((0, -1), (22, 12), 0.5)
    points = pm.seed(grid, material=material, points_per_cell=3, layout="gauss", bounds=((0, 0), (20, 1)))
    problem = pm.QuasiStatic(grid, points, reset=None)
    problem.fix(pm.plane(x=0.0), u=0, slope=0)
    problem.traction(pm.Surface.line((20, 0), (20, 1), 6), force=(0.0, force))
    last = points.where(lambda x: x[:, 0] > 19.9)
    list(problem.march(8, progress=False))
    moved = points.displacement + (points.F[:, :2, 0] - [1, 0]) * (20 - points.X[:, :1])
    return [points.mean(moved[:, i], last) / 20 for i in range(2)]


@pytest.mark.parametrize("elastic", [pm.SaintVenantKirchhoff, pm.NeoHookean])
def test_large_bending_by_points_and_by_elements(elastic):
    """P L^2 / EI_eff = 2, the director across the beam as long as it is thick, slopes held."""
    material = pm.GradientElastic(elastic.from_engineering(E=1e6, nu=0.0), (0.0, 1.0))
    force = 2 * 2 * 1e6 / 12 / 20**2
    elements, points = tip_of_elements(material, force), tip_of_points(material, force)
    if elastic is pm.SaintVenantKirchhoff:
        np.testing.assert_allclose(elements, (-0.15812, 0.48863), atol=3e-5)
        np.testing.assert_allclose(points, (-0.15744, 0.48736), atol=3e-5)
    assert np.linalg.norm(np.subtract(points, elements)) < 3e-3 * np.linalg.norm(elements)


# sheets -------------------------------------------------------------------------------------------------
def test_oriented_sheet_has_the_stiffness_of_the_series():
    """h = 20 um, 6 x 6 x 1 quadratic hexahedra of a quarter."""
    sheet = demo_module("oriented_sheet")
    args = argparse.Namespace(elements=6, model="micropolar")
    plain, one, both = (sheet.linear(name, 6000.0, args) for name in ("classical", "e_1", "both"))
    assert plain / one == pytest.approx(1.3877, rel=0.02)
    assert plain / both == pytest.approx(1.7717, rel=0.02)
