"""Finite elements: the same model as with material points, patch tests, tangents, orders of convergence."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.kinematics import rotations
from tests.assembly.test_system import SHAPES, collected, polar_vector
from tests.assembly.test_system import residual_at as residual_of_points
from tests.assembly.test_system import tangent_at as tangent_of_points
from tests.conftest import (
    ANISOTROPIC,
    COMM,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    by_id,
    derivative_error,
    release_supports,
    rotation,
)
from tests.helpers.bodies import (
    DIMENSION,
    at_nodes,
    box,
    cantilever,
    everywhere,
    own_rows,
    prepared,
    residual_at,
    tangent_at,
)

# the same material for points and for elements ------------------------------------------------------
ONE_CELL = [
    pytest.param("quadrilateral", MICROPOLAR, id="2d"),
    pytest.param("quadrilateral", ANISOTROPIC, id="2d-anisotropic"),
    pytest.param("quadrilateral", HENCKY, id="2d-hencky"),
    pytest.param("hexahedron", MICROPOLAR, id="3d"),
    pytest.param("hexahedron", NEO_HOOKEAN, id="3d-neo-hookean"),
    pytest.param("hexahedron", ANISOTROPIC, id="3d-anisotropic", marks=pytest.mark.slow),
]


def points_and_element(cell, material):
    """One element, and points at its quadrature points, after the same deformation and random rotations.

    The points' grid is reset in the deformed state, where the element is the unit cell; the deformation
    gradient is the same at all points, as a mesh that moves with its nodes can't follow another one.
    """
    dim, rng = DIMENSION[cell], np.random.default_rng(5)
    F = np.eye(3)
    F[:dim, :dim] += rng.uniform(-0.2, 0.2, (dim, dim))
    mesh = box(cell, (1,) * dim)
    mesh.geometry.x[:, :dim] = mesh.geometry.x[:, :dim] @ np.linalg.inv(F[:dim, :dim]).T
    body = pm.Elements(mesh, material=material)
    grid = pm.Grid.box((0,) * dim, (1,) * dim, 1.0)
    points = pm.seed(grid, material=material, layout="gauss", points_per_cell=2)
    points.volume0 = points.volume0 / np.linalg.det(F)
    gauss = by_id(points, points.x)
    wryness, vector = np.zeros((2**dim, 3, 3)), np.zeros((2**dim, 3))
    if dim == 3:
        wryness, vector = rng.uniform(-1, 1, (8, 3, 3)), rng.uniform(-2, 2, (8, 3))
    else:
        wryness[:, 2, :2], vector[:, 2] = rng.uniform(-1, 1, (4, 2)), rng.uniform(-2, 2, 4)
    for state, x in ((points, points.x), (body.points, body.points.X @ F[:dim, :dim].T)):
        row = np.array([np.argmin(np.linalg.norm(gauss - one, axis=1)) for one in x], dtype=int)
        state.F = np.tile(F, (len(x), 1, 1))
        if material.micropolar:
            state.q, state.wryness = rotations.from_vector(vector[row]), wryness[row]
    volume = COMM.allreduce(body.points.volume0.sum())
    assert volume == pytest.approx(COMM.allreduce(points.volume0.sum()), rel=1e-14)
    body.displacement = body.nodes.position @ (F[:dim, :dim] - np.eye(dim)).T
    by_points = pm.QuasiStatic(grid, points, basis="mpm", reset=1, balanced_reset=False, locking=None)
    return by_points, pm.QuasiStaticFEM(body, locking=None)


@pytest.mark.parametrize(("cell", "material"), ONE_CELL)
def test_one_element_is_one_cell_of_points(cell, material):
    """Residual and tangent of an element and of points at its quadrature points agree to 1e-12."""
    by_points, by_elements = points_and_element(cell, material)
    system, other = by_elements.system_at(0.0), by_points.system_at(0.0)
    size, block = by_elements.unknowns, by_elements.layout.block
    body = by_elements.elements
    here = own_rows(by_elements, body.nodes.position + body.displacement).reshape(-1, body.dim)
    there = collected(other, other.nodes.position).reshape(-1, body.dim)
    match = np.argmin(np.linalg.norm(here[:, None] - there, axis=2), axis=1)
    rows = (match[:, None] * block + np.arange(block)).ravel()
    x = np.random.default_rng(6).uniform(-0.15, 0.15, size)
    mixed = np.empty(size)
    mixed[rows] = x
    expected, found = residual_of_points(other, mixed)[rows], residual_at(by_elements, system, x)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * abs(expected).max())
    expected, found = tangent_of_points(other, mixed)[np.ix_(rows, rows)], tangent_at(by_elements, system, x)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_a_script_changes_its_method_in_two_lines(strict):
    """Points on a grid and elements that fill the same cells: the script is the same after its set-up, and
    so is the answer, as points at Gauss positions without resets are an element method."""

    def script(points: bool):
        if points:
            grid = pm.Grid.box((0, 0), (4, 1), 0.5)
            body = pm.seed(grid, material=MICROPOLAR, layout="gauss")
            problem = pm.QuasiStatic(
                grid, body, basis="mpm", reset=None, controls=strict, balanced_reset=False
            )
        else:
            body = pm.Elements(box("quadrilateral", (8, 2), (4.0, 1.0)), material=MICROPOLAR)
            problem = pm.QuasiStaticFEM(body, controls=strict)
        support = problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.fix(pm.plane(x=4.0), uy=-1.5)
        problem.body_load(force=(30.0, -10.0), couple=lambda t, X: 20.0 * t * X[:, 0])
        steps = list(problem.march(3))
        force, couple = problem.reaction(support)
        return steps, problem.energy(), body.mean_displacement(), [*force, *couple], problem.unknowns

    one, two = script(True), script(False)
    assert [s.iterations for s in one[0]] == [s.iterations for s in two[0]]
    assert two[1] == pytest.approx(one[1], rel=1e-11)
    np.testing.assert_allclose(two[3], one[3], rtol=1e-10)
    assert two[4] == one[4]


@pytest.mark.mpi
def test_points_need_nothing_of_dolfinx():
    """A run with material points loads neither dolfinx nor its form compiler, which take seconds."""
    script = (
        "import sys, polarmpm as pm\n"
        "grid, rubber = pm.Grid.box((0, 0), (2, 1), 1.0), pm.NeoHookean(lam=3e3, mu=2e3)\n"
        "points = pm.seed(grid, material=rubber)\n"
        "problem = pm.QuasiStatic(grid, points, basis='mpm')\n"
        "problem.fix(pm.plane(x=0.0), u=0)\n"
        "problem.load(points.farthest((1, 0)), force=(1.0, 0.0))\n"
        "list(problem.march(1, progress=False))\n"
        "assert not {'dolfinx', 'ffcx'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


@pytest.mark.mpi
def test_a_second_run_compiles_nothing(tmp_path):
    """Forms are found in the cache by their signature, which compilers of old alter while they work."""
    script = (
        "import dolfinx.mesh, polarmpm as pm\n"
        "from mpi4py import MPI\n"
        "mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, 1, 1)\n"
        "problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=pm.NeoHookean(lam=3e3, mu=2e3)))\n"
        "problem.fix(pm.plane(x=0.0), u=0)\n"
        "problem.pressure(pm.plane(x=1.0), 10.0)\n"
        "list(problem.march(1, progress=False))\n"
    )
    found = []
    for _ in range(2):
        env = {**os.environ, "POLARMPM_CACHE": str(tmp_path)}
        subprocess.run([sys.executable, "-c", script], check=True, timeout=120, env=env)
        found.append(sorted(path.name for path in tmp_path.rglob("*.so")))
    assert found[0] == found[1] != []


# patch tests ---------------------------------------------------------------------------------------
PATCHES = [
    pytest.param("triangle", 1, MICROPOLAR, id="triangle-1"),
    pytest.param("triangle", 2, MICROPOLAR, id="triangle-2"),
    pytest.param("quadrilateral", 1, MICROPOLAR, id="quadrilateral-1"),
    pytest.param("quadrilateral", 2, MICROPOLAR, id="quadrilateral-2"),
    pytest.param("quadrilateral", 2, HENCKY, id="quadrilateral-2-hencky"),
    pytest.param("tetrahedron", 1, NEO_HOOKEAN, id="tetrahedron-1-neo-hookean"),
    pytest.param("tetrahedron", 2, NEO_HOOKEAN, id="tetrahedron-2-neo-hookean"),
    pytest.param("hexahedron", 1, MICROPOLAR, id="hexahedron-1"),
    pytest.param("hexahedron", 2, NEO_HOOKEAN, id="hexahedron-2-neo-hookean"),
    pytest.param("tetrahedron", 1, MICROPOLAR, id="tetrahedron-1", marks=pytest.mark.slow),
    pytest.param("tetrahedron", 2, MICROPOLAR, id="tetrahedron-2", marks=pytest.mark.slow),
    pytest.param("hexahedron", 2, MICROPOLAR, id="hexahedron-2", marks=pytest.mark.slow),
]


def patch(cell, degree, material, motion, vector, controls):
    """Distorted cells whose boundary follows x = motion(t) X, with rotations t * vector."""
    dim = DIMENSION[cell]
    body = pm.Elements(box(cell, (2,) * dim, distort=0.12), material=material, degree=degree)
    problem = pm.QuasiStaticFEM(body, controls=controls)
    theta = {"theta": vector if dim == 3 else vector[2]} if material.micropolar else {}
    boundary = body.facets(everywhere)
    problem.fix(boundary, u=lambda t, X: X @ (motion(t) - np.eye(3))[:dim, :dim].T, **theta)
    assert COMM.allreduce(int((~boundary.nodes[: body.nodes.owned]).sum())) > 0  # some nodes are free
    return problem


@pytest.mark.parametrize(("cell", "degree", "material"), PATCHES)
def test_patch_homogeneous_deformation(cell, degree, material, strict):
    """A stretch with matching microrotation is reproduced to 1e-10 on distorted cells."""
    dim = DIMENSION[cell]
    F = np.eye(3) + SHAPES[dim]
    vector = polar_vector(F)
    problem = patch(cell, degree, material, lambda t: np.eye(3) + t * SHAPES[dim], vector, strict)
    list(problem.march(1))
    body, p = problem.elements, problem.points
    np.testing.assert_allclose(p.F, np.broadcast_to(F, p.F.shape), rtol=0, atol=1e-10)
    np.testing.assert_allclose(p.x, p.X @ F[:dim, :dim].T, rtol=0, atol=1e-10)
    expected = body.nodes.position @ SHAPES[dim][:dim, :dim].T
    np.testing.assert_allclose(body.displacement, expected, rtol=0, atol=1e-10)
    if material.micropolar:
        for found in (p.rotation_vector, body.rotation_vector):
            np.testing.assert_allclose(found, np.broadcast_to(vector, found.shape), rtol=0, atol=1e-10)
        np.testing.assert_allclose(p.wryness, 0.0, atol=1e-9)
    stress = np.concatenate(COMM.allgather(problem.fields().stress))
    limit = 1e-9 * abs(stress).max()
    np.testing.assert_allclose(stress, np.broadcast_to(stress[0], stress.shape), atol=limit)


@pytest.mark.parametrize(
    ("cell", "degree", "material"),
    [
        ("triangle", 2, MICROPOLAR),
        ("quadrilateral", 1, MICROPOLAR),
        ("quadrilateral", 1, HENCKY),
        ("hexahedron", 1, MICROPOLAR),
        ("tetrahedron", 1, NEO_HOOKEAN),
    ],
)
def test_rigid_rotation_leaves_no_stress(cell, degree, material, strict):
    """Three quarters of a turn in five steps: the body turns as a whole and stays free of stress."""
    dim, angle = DIMENSION[cell], 1.5 * np.pi
    vector = angle * (np.array([0, 0, 1.0]) if dim == 2 else np.array([1.0, 2.0, -2.0]) / 3)
    problem = patch(cell, degree, material, lambda t: rotation(t * vector), vector, strict)
    list(problem.march(5))
    p, R = problem.points, rotation(vector)
    np.testing.assert_allclose(p.F, np.broadcast_to(R, p.F.shape), rtol=0, atol=1e-10)
    if material.micropolar:
        turned = rotations.to_tensor(p.q)
        np.testing.assert_allclose(turned, np.broadcast_to(R, turned.shape), rtol=0, atol=1e-10)
        turned = rotations.to_tensor(problem.elements.q)
        np.testing.assert_allclose(turned, np.broadcast_to(R, turned.shape), rtol=0, atol=1e-10)
    fields = problem.fields()
    np.testing.assert_allclose(fields.stress, 0.0, atol=1e-9 * MICROPOLAR.mu)
    np.testing.assert_allclose(fields.couple_stress, 0.0, atol=1e-9 * MICROPOLAR.mu)


# tangent and Newton --------------------------------------------------------------------------------
TANGENTS = [
    ("triangle", 1, MICROPOLAR),
    ("triangle", 2, MICROPOLAR),
    ("quadrilateral", 2, HENCKY),
    ("quadrilateral", 1, ANISOTROPIC),
    ("tetrahedron", 1, NEO_HOOKEAN),
    ("hexahedron", 1, MICROPOLAR),
]


@pytest.mark.parametrize(("cell", "degree", "material"), TANGENTS)
def test_tangent_is_the_derivative_of_the_residual(cell, degree, material):
    """Every entry against central differences, after a step, on distorted cells; and it is symmetric."""
    dim = DIMENSION[cell]
    F = np.eye(3) + 0.5 * SHAPES[dim]
    problem = patch(cell, degree, material, lambda t: np.eye(3) + t * (F - np.eye(3)), 0.6 * np.ones(3), None)
    list(problem.march(1))
    release_supports(problem)
    problem._stale = True
    system = prepared(problem)
    x = np.random.default_rng(7).uniform(-0.05, 0.05, (1, problem.unknowns))
    error = derivative_error(
        lambda y: residual_at(problem, system, y[0])[None],
        lambda y: tangent_at(problem, system, y[0])[None],
        x,
    )
    assert error < 1e-7
    k = tangent_at(problem, system, x[0])
    np.testing.assert_allclose(k, k.T, rtol=0, atol=1e-13 * abs(k).max())


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_newton_converges_quadratically(cell, degree):
    """Near the solution the force measure squares, up to a constant."""
    problem = cantilever(
        cell, degree=degree, controls=pm.Controls(force_tolerance=1e-12, energy_tolerance=0.0)
    )
    tip = problem.elements.farthest((1, 0))
    problem.load(tip, force=(0.0, -40.0), couple=30.0)
    (step,) = problem.march(1)
    assert abs(problem.elements.mean_displacement(tip)).max() > 0.2
    force = [f for f, _ in step.history]
    late = [(a, b) for a, b in itertools.pairwise(force) if a < 1e-2 and b > 1e-11]
    assert late, force
    assert all(b < 50 * a**2 for a, b in late), force


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_classical_materials_have_no_rotation_unknowns(cell):
    """A node has as many unknowns as the space has dimensions, and there is no microrotation."""
    dim = DIMENSION[cell]
    problem = cantilever(cell, NEO_HOOKEAN)
    problem.load(problem.elements.farthest((1, 0, 0)[:dim]), force=(0.0, -5.0, 0.0)[:dim])
    list(problem.march(1))
    assert problem.unknowns == dim * problem.elements.nodes.total
    assert np.all(problem.elements.rotation_vector == 0.0)
    assert np.all(problem.fields().couple_stress == 0.0)
    assert abs(at_nodes(problem.elements, problem.elements.displacement)).max() > 1e-3


@pytest.mark.parametrize("kind", ["micropolar", "hencky"])
def test_units_of_length_do_not_matter(kind, strict):
    """Metres, nanometres and kilometres, with the moduli to match, give the same numbers."""
    m, answers = MICROPOLAR, []
    for scale in (1.0, 1e9, 1e-3):
        pascal = scale**-2
        if kind == "micropolar":
            moduli = {name: getattr(m, name) * pascal for name in ("lam", "mu", "kappa")}
            material = pm.MicropolarElastic(**moduli, alpha=m.alpha, beta=m.beta, gamma=m.gamma)
        else:
            material = pm.Hencky(lam=m.lam * pascal, mu=m.mu * pascal)
        body = pm.Elements(box("quadrilateral", (4, 1), (4 * scale, scale)), material=material)
        problem = pm.QuasiStaticFEM(body, controls=strict)
        problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
        couple = 8.0 if material.micropolar else None
        tip = body.facets(pm.plane(x=4 * scale))
        problem.load(tip, force=np.multiply(1 / scale, (4.0, -8.0)), couple=couple)
        problem.pressure(body.facets(lambda x, s=scale: x[:, 1] > 0.9 * s), 20.0 * pascal)
        problem.traction(pm.plane(y=0.0), force=(3.0 * pascal, pascal), follows=True)
        list(problem.march(2))
        answers.append(at_nodes(body, body.displacement) / scale)
    assert abs(answers[0]).max() > 0.05
    for other in answers[1:]:
        np.testing.assert_allclose(other, answers[0], rtol=0, atol=1e-9 * abs(answers[0]).max())
