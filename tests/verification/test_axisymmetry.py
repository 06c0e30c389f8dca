"""Bodies of revolution against Hill's thick cylinder and sphere, and a micropolar ring against space."""

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm
from tests.conftest import COMM

pytestmark = pytest.mark.slow
A, B, C = 1.0, 2.0, 1.5  # radii: inner, outer, and how far it flows
Y, E, NU = 1.0, 2e4, 0.3
ELASTIC = pm.Hencky.from_engineering(E=E, nu=NU)
TRESCA, MISES = pm.Tresca(ELASTIC, c=Y / 2), pm.VonMises(ELASTIC, k=Y)
CYLINDER = Y * (np.log(C / A) + (1 - C**2 / B**2) / 2)  # pressures
SPHERE = 2 * Y * (np.log(C / A) + (1 - C**3 / B**3) / 3)


def mean(values):
    return COMM.allreduce(float(np.sum(values))) / COMM.allreduce(len(values))


def of_cylinder(r):
    """Displacement where it is elastic, in plane strain."""
    return (1 + NU) / E * Y / 2 * (C / B) ** 2 * ((1 - 2 * NU) * r + B**2 / r)


def of_sphere(r):
    return 2 * Y / 3 * (C / B) ** 3 / E * ((1 - 2 * NU) * r + (1 + NU) / 2 * B**3 / r**2)


def press(problem, where, pressure):
    problem.pressure(where, pressure)
    list(problem.march(8, progress=False))


@pytest.mark.parametrize("basis", ["bspline", "mpm"])
def test_hills_cylinder_of_points(basis):
    n, top = 8, 0.25
    grid = pm.Grid.box((0, 0), (3, top), 1 / n)
    points = pm.seed(grid, bounds=((A, 0), (B, top)), material=TRESCA, axisymmetric=True)
    problem = pm.QuasiStatic(grid, points, basis=basis)
    for y in (0.0, top):
        problem.fix(pm.plane(y=y), uy=0)
    press(problem, pm.Surface.line((A, top), (A, 0), 8), CYLINDER)
    r = points.X[:, 0]
    outer = r > B - 0.3 / n
    assert mean((points.x - points.X)[outer, 0] / of_cylinder(r[outer])) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("degree", "cells"), [(1, 12), (2, 8)])
def test_hills_cylinder_of_elements(degree, cells):
    body = mesh.create_rectangle(COMM, [(A, 0), (B, 0.1)], [cells, 1], mesh.CellType.quadrilateral)
    elements = pm.Elements(body, material=TRESCA, degree=degree, axisymmetric=True)
    problem = pm.QuasiStaticFEM(elements)
    for y in (0.0, 0.1):
        problem.fix(pm.plane(y=y), uy=0)
    press(problem, pm.plane(x=A), CYLINDER)
    found = elements.mean_displacement(elements.facets(pm.plane(x=B)))[0]
    assert found == pytest.approx(of_cylinder(B), rel=0.01)


class Shell:
    bounds = ((0.0, 0.0), (B, B))

    def __call__(self, x):
        r = np.hypot(*x.T)
        return (r >= A) & (r <= B)


@pytest.mark.parametrize("basis", ["bspline", "gimpm"])
def test_hills_sphere_of_points(basis):
    n = 8
    grid = pm.Grid.box((0, 0), (2.5, 2.5), 1 / n)
    points = pm.seed(grid, Shell(), material=MISES, axisymmetric=True)
    volume = COMM.allreduce(points.volume0.sum())
    assert volume == pytest.approx(2 / 3 * np.pi * (B**3 - A**3), rel=1e-4)
    problem = pm.QuasiStatic(grid, points, basis=basis)
    problem.symmetry(pm.plane(y=0.0))
    angle = (np.arange(64) + 0.5) / 64 * np.pi / 2
    x = A * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    press(problem, pm.Surface(x, np.full(64, A * np.pi / 128), -x / A), SPHERE)
    r = np.hypot(*points.X.T)
    outer = r > B - 0.5 / n
    u = np.sum((points.x - points.X) * points.X, axis=1) / r
    assert mean(u[outer] / of_sphere(r[outer])) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("degree", "cells"), [(1, 12), (2, 8)])
def test_hills_sphere_of_elements(degree, cells):
    """Degree 1 errs by the square of its cells along the radius, and by nothing around it."""
    body = mesh.create_rectangle(COMM, [(A, 0), (B, np.pi / 2)], [cells, 16], mesh.CellType.quadrilateral)
    r, angle = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
    body.geometry.x[:, 0], body.geometry.x[:, 1] = r * np.cos(angle), r * np.sin(angle)
    elements = pm.Elements(body, material=MISES, degree=degree, axisymmetric=True)
    problem = pm.QuasiStaticFEM(elements)
    problem.fix(pm.plane(y=0.0), uy=0)
    assert problem.axis is not None
    press(problem, elements.facets(lambda x: np.hypot(*x.T) < A + 1e-6), SPHERE)
    at = np.hypot(*elements.nodes.position.T)
    outer = at > B - 1e-6
    u = np.sum(elements.displacement * elements.nodes.position, axis=1)[outer] / B
    assert mean(u / of_sphere(B)) == pytest.approx(1, abs=0.01)


def test_a_micropolar_ring_is_that_of_space():
    """A ring that is held at its outer side and bends under its weight; a quarter in space, of straight
    elements, comes near with the square of their size."""
    material = pm.MicropolarElastic(lam=600.0, mu=400.0, kappa=300.0, alpha=20.0, beta=30.0, gamma=60.0)
    inner, outer, height, found = 0.5, 1.5, 0.5, []

    def weigh(problem, force):
        problem.body_load(force=force)
        list(problem.march(2, progress=False))
        return problem.energy()

    body = mesh.create_rectangle(COMM, [(inner, 0), (outer, height)], [6, 3], mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=material, degree=2, axisymmetric=True))
    problem.fix(pm.plane(x=outer), u=0, theta=0)
    flat = weigh(problem, (0.0, -30.0))
    for around in (5, 10):
        corner, far = (inner, 0, 0), (outer, np.pi / 2, height)
        body = mesh.create_box(COMM, [corner, far], [6, around, 3], mesh.CellType.hexahedron)
        r, angle = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
        body.geometry.x[:, 0], body.geometry.x[:, 1] = r * np.cos(angle), r * np.sin(angle)
        body.geometry.x[np.abs(body.geometry.x) < 1e-12] = 0.0
        elements = pm.Elements(body, material=material, degree=2)
        problem = pm.QuasiStaticFEM(elements)
        problem.fix(elements.facets(lambda x: np.hypot(x[:, 0], x[:, 1]) > outer - 1e-6), u=0, theta=0)
        problem.fix(pm.plane(x=0.0), ux=0, theta_y=0, theta_z=0)
        problem.fix(pm.plane(y=0.0), uy=0, theta_x=0, theta_z=0)
        found.append(4 * weigh(problem, (0.0, 0.0, -30.0)))
    assert found[1] == pytest.approx(flat, rel=0.02)
    assert found[1] + (found[1] - found[0]) / 3 == pytest.approx(flat, rel=1e-3)


@pytest.mark.parametrize(("rough", "limit"), [(True, 6.05), (False, 5.69)])
def test_a_circular_footing_bears_its_limit_load(rough, limit):
    """On Tresca's soil, elements of degree 1, eight under the radius; the load counts over the circle that
    ends between the last node that is held and the first that is free."""
    radius, width, depth, settlement = 1.0, 4.0, 2.5, 0.02
    body = mesh.create_rectangle(COMM, [(0, 0), (width, depth)], [32, 20], mesh.CellType.quadrilateral)
    soil = pm.Tresca(pm.Hencky.from_engineering(E=1e4, nu=0.3), c=1.0)
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=soil, axisymmetric=True), locking="always")
    problem.fix(pm.plane(x=width), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)

    def under(x):
        return (x[:, 0] < radius + 1e-6) & (x[:, 1] > depth - 1e-6)

    footing = problem.fix(under, uy=-settlement, **({"ux": 0} if rough else {}))
    list(problem.march(30, adaptive=True, progress=False))
    load = -problem.reaction(footing).force[1] / (np.pi * (radius + 1 / 16) ** 2)
    assert load == pytest.approx(limit, rel=0.03)
