"""Bodies of revolution, of points and of elements: patch tests, tangents, closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm
from tests.assembly import test_system as points_tests
from tests.conftest import (
    COMM,
    GENERAL,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    assert_repeated,
    by_id,
    derivative_error,
)
from tests.helpers.bodies import own_rows, residual_at, tangent_at
from tests.helpers.plasticity import L_P

SOFT = pm.NeoHookean(lam=2e5, mu=400.0)  # nearly incompressible: its volumes are projected
PLASTIC = pm.VonMises(MICROPOLAR, k=40.0, l_p=L_P)
INNER, OUTER = 1.0, 2.0


def section(kind="quadrilateral", lower=(INNER, 0.0), upper=(OUTER, 0.5), cells=(4, 2)):
    return mesh.create_rectangle(COMM, [lower, upper], cells, getattr(mesh.CellType, kind))


def of_elements(material, degree=1, kind="quadrilateral", assembly="native", **options):
    body = pm.Elements(section(kind, **options), material=material, degree=degree, axisymmetric=True)
    return pm.QuasiStaticFEM(body, assembly=assembly)


def of_points(material, basis="bspline", lower=(INNER, 0.0), upper=(OUTER, 0.5), cell=0.25, **options):
    grid = pm.Grid.box((0.0, 0.0), (3.0, upper[1]), cell)
    points = pm.seed(grid, bounds=(lower, upper), material=material, axisymmetric=True)
    return pm.QuasiStatic(grid, points, basis=basis, **options)


# patch tests ------------------------------------------------------------------------------------------
def stretched(problem, lower, upper):
    """Stretch the boundary evenly along the radius and the axis; by how much F and x miss it. Collective."""
    (left, bottom), (right, top), at = lower, upper, 0.26 if isinstance(problem, pm.QuasiStatic) else 1e-6

    def outside(x):
        far = (x[:, 0] > right - at) | (x[:, 1] > top - at) | (x[:, 1] < bottom + at)
        return far | (x[:, 0] < left + at) if left else far

    problem.fix(outside, u=lambda f, x: f * x * np.array([0.1, -0.2]))
    list(problem.march(2, progress=False))
    p = problem.points
    F = np.abs(p.F - np.diag([1.1, 0.8, 1.1])).max(initial=0.0)
    return max(F, np.abs(p.x - p.X * np.array([1.1, 0.8])).max(initial=0.0))


@pytest.mark.parametrize("material", [NEO_HOOKEAN, SOFT, MICROPOLAR], ids=["soft", "stiff", "micropolar"])
@pytest.mark.parametrize("inner", [0.0, INNER])
@pytest.mark.parametrize("kind", ["quadrilateral 1", "triangle 2", "mpm", "gimpm", "bspline"])
def test_patch(kind, inner, material):
    """A whole body and a tube, stretched along the radius as much as along the hoop."""
    lower, upper = (inner, 0.0), (inner + 1.0, 1.0)
    if " " in kind:
        cell, degree = kind.split()
        problem = of_elements(material, int(degree), cell, lower=lower, upper=upper, cells=(4, 4))
    else:
        problem = of_points(material, kind, lower, upper)
    # boxes of splines end a little before the axis
    assert stretched(problem, lower, upper) < (1e-6 if kind == "bspline" and not inner else 1e-9)
    assert (problem.axis is not None) == (inner == 0.0)


# tangents ---------------------------------------------------------------------------------------------
def put_state(points):
    """A state of finite strain, of points in the unloaded body."""
    r, z = points.X.T
    points.x = points.X + np.stack([0.05 * r + 0.02 * r * z, 0.03 * r**2 - 0.04 * z], axis=1)
    points.F = np.tile(np.eye(3), (len(r), 1, 1))
    points.F[:, :2, :2] += np.stack(
        [np.stack([0.05 + 0.02 * z, 0.02 * r], axis=1), np.stack([0.06 * r, 0 * r - 0.04], axis=1)], axis=1
    )
    points.F[:, 2, 2] = points.x[:, 0] / r
    if points.materials[0].micropolar:
        points.q = np.stack([np.cos(0.1 * r), 0 * r, 0 * r, np.sin(0.1 * r)], axis=1)
        points.wryness = np.zeros((len(r), 3, 3))
        points.wryness[:, 2, 0] = 0.2
        points.wryness[:, 0, 2], points.wryness[:, 1, 2] = (
            -np.sin(0.2 * r) / r,
            (1 - np.cos(0.2 * r)) / r,
        )


MATERIALS = [SOFT, MICROPOLAR, pytest.param(PLASTIC, marks=pytest.mark.slow)]


@pytest.mark.parametrize("material", MATERIALS, ids=["soft", "micropolar", "plastic"])
def test_tangent_of_elements(material):
    problem = of_elements(material, 2)
    put_state(problem.points)
    problem._rebase(None)
    system = problem.system_at(0.0)
    x = 0.01 * np.random.default_rng(4).standard_normal((1, len(own_rows(problem, system.x))))
    error = derivative_error(
        lambda y: residual_at(problem, system, y[0])[None],
        lambda y: tangent_at(problem, system, y[0])[None],
        x,
    )
    assert error < 1e-6


def boxed_points(material, locking=None):
    """A system of a tube's points with oblique boxes, in a state of finite strain, without supports."""
    grid = pm.Grid.box((0.0, 0.0), (3.0, 1.0), 0.5)
    points = pm.seed(grid, bounds=((INNER, 0.2), (OUTER, 0.9)), material=material, axisymmetric=True)
    turn = np.array([[0.9, 0.3], [-0.4, 0.8]])
    points.half_axes0 = points.half_axes0 @ turn
    put_state(points)
    return pm.QuasiStatic(grid, points, locking=locking)._prepare()


CASES = [
    pytest.param(HENCKY, None, id="classical"),
    pytest.param(MICROPOLAR, None, id="rotated"),
    pytest.param(GENERAL, None, id="reference"),
    pytest.param(NEO_HOOKEAN, "always", id="projected"),
    pytest.param(MICROPOLAR, "always", id="projected-rotation"),
]


@pytest.mark.parametrize(("material", "locking"), CASES)
def test_tangent_of_points(material, locking):
    system = boxed_points(material, locking)
    x = points_tests.random_increment(system, 0.02)

    def tangent(y):
        system.step.boxes = system.step.projected = None  # a step begins
        return points_tests.tangent_at(system, y[0])[None]

    if locking:  # patches, too, couple nodes: the whole matrix is compared along a direction
        way = np.random.default_rng(3).standard_normal(len(x))
        up, down = (points_tests.residual_at(system, x + h * way) for h in (1e-6, -1e-6))
        exact = tangent(x[None])[0] @ way
        assert np.abs((up - down) / 2e-6 - exact).max() < 1e-6 * np.abs(exact).max()
    else:
        assert (
            derivative_error(lambda y: points_tests.residual_at(system, y[0])[None], tangent, x[None]) < 1e-6
        )


@pytest.mark.parametrize("material", [HENCKY, MICROPOLAR], ids=["classical", "micropolar"])
def test_forces_of_boxes_are_the_derivative_of_their_energy(material):
    system = boxed_points(material)
    boxes, form = system.interpolation.boxes[0], system.interpolation.forms[0]
    x = points_tests.random_increment(system, 0.02)
    kernel = form.compile_energy(COMM)

    def energy(y):
        points_tests.put(system, y)
        batch = system.interpolation.batches[0].batch
        z, _, _ = boxes.gather(system.x)
        numbers = np.tile(batch.kept["param"], (len(z), 1))
        at_points = kernel(z, batch.kept["state"], numbers)[:, 0] @ batch.kept["volume"]
        return COMM.allreduce(float(at_points + boxes.energies(kernel, system.x).sum()))

    forces = points_tests.residual_at(system, x)
    way = np.random.default_rng(3).standard_normal(len(x))
    slope = (energy(x + 1e-5 * way) - energy(x - 1e-5 * way)) / 2e-5
    assert slope == pytest.approx(forces @ way, abs=1e-7 * np.linalg.norm(forces) * np.linalg.norm(way))


def test_native_elements_are_those_of_dolfinx():
    found = []
    for assembly in ("native", "dolfinx"):
        for material in (MICROPOLAR, PLASTIC):
            problem = of_elements(material, 1, "triangle", assembly)
            problem.fix(pm.plane(y=0.0), uy=0)
            problem.pressure(pm.plane(x=INNER), 15.0)
            problem.body_load(force=(0.0, -20.0))
            problem.traction(problem.elements.facets(pm.plane(x=OUTER)), force=(3.0, 5.0), follows=True)
            list(problem.march(2, progress=False))
            found.append((by_id(problem.points, problem.points.F), problem.energy()))
    for one, other in ((found[0], found[2]), (found[1], found[3])):
        np.testing.assert_allclose(one[0], other[0], rtol=0, atol=1e-9)
        assert one[1] == pytest.approx(other[1], rel=1e-8)


# closed forms -----------------------------------------------------------------------------------------
def lame(r, p=1.0, E=1e6, nu=0.3):
    """Displacement of a thick cylinder in plane strain under an inner pressure."""
    return (1 + nu) / E * p / (OUTER**2 - INNER**2) * ((1 - 2 * nu) * r + OUTER**2 / r)


def thick_cylinder(problem, top, pressure):
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(y=top), uy=0)
    at = pm.plane(x=INNER)
    if isinstance(problem, pm.QuasiStatic):
        at = pm.Surface.line((INNER, top), (INNER, 0.0), 8)
    problem.pressure(at, pressure)
    list(problem.march(1, progress=False))
    assert problem.balance().residue[0] < 1e-9


LINEAR = pm.SaintVenantKirchhoff.from_engineering(E=1e6, nu=0.3)


@pytest.mark.parametrize(("degree", "rate", "error"), [(1, 1.9, 3e-3), (2, 3.0, 1e-4)])
def test_elements_converge_to_lame(degree, rate, error):
    errors = []
    for n in (4, 8):
        problem = of_elements(LINEAR, degree, upper=(OUTER, 1.0 / n), cells=(n, 1))
        thick_cylinder(problem, 1.0 / n, 1.0)
        e = problem.elements
        r = e.nodes.position[:, 0]
        errors.append(COMM.allreduce(np.abs(e.displacement[:, 0] / lame(r) - 1).max(), op=pm_max()))
        volume = COMM.allreduce(e.points.volume0.sum())
        assert volume == pytest.approx(np.pi * (OUTER**2 - INNER**2) / n, rel=1e-12)
    assert np.log2(errors[0] / errors[1]) > rate
    assert errors[1] < error


def pm_max():
    from mpi4py import MPI

    return MPI.MAX


@pytest.mark.parametrize("basis", ["bspline", "bspline-averaged", "mpm", "gimpm"])
def test_points_converge_to_lame(basis):
    errors = []
    for n in (4, 8):
        problem = of_points(LINEAR, basis, upper=(OUTER, 2.0 / n), cell=1.0 / n)
        thick_cylinder(problem, 2.0 / n, 1.0)
        p = problem.points
        missed = (p.x - p.X)[:, 0] / lame(p.X[:, 0]) - 1
        sums = COMM.allreduce(np.array([np.sum(missed**2), len(p)]))
        errors.append(np.sqrt(sums[0] / sums[1]))
    assert errors[1] < 0.5 * errors[0] < 2e-3


def test_a_rubber_tube_is_blown_up():
    """To twice its radius: R^2 - A^2 = r^2 - a^2, p = mu (ln(b A / (a B)) + (A^2 - a^2) (1/b^2 - 1/a^2) / 2)
    with the undeformed radii A, B; nearly incompressible, in plane strain."""
    mu, a = 400.0, 2.0
    b = np.sqrt(OUTER**2 + a**2 - INNER**2)
    # sigma_hoop - sigma_r = mu (r^2/R^2 - R^2/r^2), integrated over ln r
    r = np.linspace(a, b, 20001)
    R2 = r**2 - a**2 + INNER**2
    f = mu * (r**2 / R2 - R2 / r**2) / r
    p = float(np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(r)))
    for problem in (
        of_elements(pm.NeoHookean(lam=1e5 * mu, mu=mu), 2, upper=(OUTER, 0.25), cells=(8, 1)),
        of_points(pm.NeoHookean(lam=1e4 * mu, mu=mu), upper=(OUTER, 0.25), cell=0.125),
    ):
        top = 0.25
        problem.fix(pm.plane(y=0.0), uy=0)
        problem.fix(pm.plane(y=top), uy=0)
        at = pm.plane(x=INNER)
        if isinstance(problem, pm.QuasiStatic):
            at = pm.Surface.line((INNER, top), (INNER, 0.0), 8)
        problem.pressure(at, lambda f: 0.95 * p * f)
        list(problem.march(6, progress=False, adaptive=True))
        now, first = problem.points.x[:, 0], problem.points.X[:, 0]
        inner = np.sqrt(now**2 - first**2 + INNER**2)
        spread = COMM.allgather((inner.min(initial=9.0), inner.max(initial=0.0)))
        low, high = min(s[0] for s in spread), max(s[1] for s in spread)
        assert high - low < 0.01  # the volume inside stays
        r = np.sqrt(np.linspace(0.5 * (low + high), 10, 2)[0] ** 2 + np.linspace(0, 3, 20001))
        R2 = r**2 - r[0] ** 2 + INNER**2
        f = mu * (r**2 / R2 - R2 / r**2) / r
        assert float(np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(r))) == pytest.approx(0.95 * p, rel=5e-3)


# loads and supports -----------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["bspline", "gimpm"])
def test_a_column_under_its_weight(basis):
    """Its weight is borne by the ground; by springs on its side, too."""
    for held in ("ground", "side"):
        problem = of_points(MICROPOLAR, basis, (0.0, 0.0), (0.93, 1.0))
        if held == "ground":
            support = problem.fix(pm.plane(y=0.0), uy=0)
        else:
            support = problem.fix(pm.Surface.line((0.93, 0.0), (0.93, 1.0), 16), u=0, method="penalty")
        problem.body_load(force=(0.0, -10.0))
        list(problem.march(1, progress=False))
        assert problem.reaction(support).force[1] == pytest.approx(10 * np.pi * 0.93**2, rel=1e-8)
        assert problem.balance().residue[0] < 1e-8
        assert problem.axis in problem.supports


def test_loads_and_surfaces_of_elements():
    problem = of_elements(MICROPOLAR, lower=(0.0, 0.0), upper=(1.0, 1.0), cells=(4, 4))
    e = problem.elements
    support, top = problem.fix(pm.plane(y=0.0), uy=0), e.facets(pm.plane(y=1.0))
    assert top.area == pytest.approx(np.pi, rel=1e-12)
    problem.load(top, force=(0.0, -7.0))
    problem.traction(e.surface(top), force=(0.0, -1.0))
    problem.fix(e.surface(pm.plane(x=1.0)), ux=0)
    list(problem.march(2, progress=False))
    assert problem.reaction(support).force[1] == pytest.approx(7 + np.pi, rel=1e-9)
    assert problem.balance().residue[0] < 1e-9


@pytest.mark.parametrize("reset", [1, 2])
def test_restart(folder, reset):
    """Of a column that is pressed, with resets; it goes on to the same digits."""

    def column():
        problem = of_points(MICROPOLAR, "bspline", (0.0, 0.0), (1.0, 1.0), reset=reset)
        problem.fix(pm.plane(y=0.0), u=0)
        problem.fix(pm.plane(y=1.0), uy=-0.2)
        return problem

    first, second = column(), column()
    for step in first.march(4, progress=False):
        if step.number == 2:
            pm.save_restart(first, folder / "column.h5")
    pm.load_restart(second, folder / "column.h5")
    list(second.march(2, progress=False))
    for name in ("x", "F", "wryness"):
        one, other = (by_id(p.points, getattr(p.points, name)) for p in (first, second))
        assert_repeated(other, one, name)
    assert abs(first.energies()["residue"]) < 1e-3 * first.energies()["external"]


# what there isn't -------------------------------------------------------------------------------------
def test_refusals():
    flat, solid = pm.Grid.box((0, 0), (1, 1), 0.5), pm.Grid.box((0, 0, 0), (1, 1, 1), 0.5)
    with pytest.raises(pm.InputError, match="the body has 3 dimensions"):
        pm.seed(solid, material=NEO_HOOKEAN, axisymmetric=True)
    with pytest.raises(pm.InputError, match=r"point at the radius x = -0\.875"):
        pm.seed(pm.Grid.box((-1, 0), (1, 1), 0.5), material=NEO_HOOKEAN, axisymmetric=True)
    with pytest.raises(pm.InputError, match="axisymmetric = 2: True or False"):
        pm.seed(flat, material=NEO_HOOKEAN, axisymmetric=2)
    points = pm.seed(flat, material=NEO_HOOKEAN, axisymmetric=True)
    with pytest.raises(pm.InputError, match="it begins at x = -1"):
        pm.QuasiStatic(pm.Grid.box((-1, 0), (1, 1), 0.5), points)
    with pytest.raises(pm.InputError, match="assembly = 'projection'"):
        pm.QuasiStatic(flat, points, basis="mpm", assembly="projection")
    with pytest.raises(pm.InputError, match="only these points are a body of revolution"):
        points.join(pm.seed(flat, material=NEO_HOOKEAN))
    with pytest.raises(pm.InputError, match=r"node at x = -0\.1"):
        of_elements(NEO_HOOKEAN, lower=(-0.1, 0.0))
    problem = of_points(NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="'nitsche': tractions on a body of revolution"):
        problem.fix(pm.Surface.line((INNER, 0.5), (INNER, 0.0), 4), u=0, method="nitsche")
    with pytest.raises(pm.InputError, match="the surface has a point at the radius x = -"):
        problem.pressure(pm.Surface.line((0.0, 0.5), (-1.0, 0.5), 4), 1.0)
