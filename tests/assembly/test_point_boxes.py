"""Points integrate over their own boxes: one potential, its derivatives, what it is exact for, and what is
left out."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly.pointboxes import FLOWED
from polarmpm.basis.registry import basis_of
from polarmpm.kinematics.motion import Motion
from tests.assembly.test_system import (
    make_system,
    put,
    random_increment,
    residual_at,
    scattered,
    tangent_at,
)
from tests.conftest import (
    ANISOTROPIC,
    COMM,
    GENERAL,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    by_id,
    derivative_error,
)

CASES = [
    pytest.param(2, MICROPOLAR, "bspline", id="2d"),
    pytest.param(2, ANISOTROPIC, "bspline3", id="2d-anisotropic-cubic"),
    pytest.param(2, HENCKY, "bspline", id="2d-hencky"),
    pytest.param(3, NEO_HOOKEAN, "bspline", id="3d-neo-hookean"),
    pytest.param(3, GENERAL, "bspline", id="3d-reference-frame"),
]


def boxed(dim: int, material: pm.Material, basis: str):
    """Points at random with oblique boxes, a fifth of a cell."""
    points = scattered(dim, material, count=9)
    rng = np.random.default_rng(4)
    points.half_axes0 = rng.uniform(-0.2, 0.2, (9, dim, dim))[points.id]
    return points, make_system(points, basis, boxes=True)


def energy_in_boxes(system) -> float:
    """By the compiled energy, of all ranks."""
    total = 0.0
    for boxes, form in zip(system.interpolation.boxes, system.interpolation.forms, strict=True):
        total += boxes.energies(form.compile_energy(COMM), system.x).sum()
    return COMM.allreduce(float(total))


@pytest.mark.parametrize("name", ["bspline", "bspline3", "bspline-averaged"])
def test_second_derivatives_of_the_functions(name):
    """Against differences of the gradients, in inner cells and at walls, within cells and continued beyond
    them."""
    basis, grid = basis_of(name), pm.Grid.box((0, 0), (5, 4), (1.0, 0.8))
    x = np.random.default_rng(1).uniform(0.0, 1.0, (200, 2)) * [5, 4]
    cells, h = np.clip(grid.cells_of(x) + np.array([1, 0]), 0, [4, 3]), 1e-5
    difference = (basis.lines(grid, x + h, cells) - basis.lines(grid, x - h, cells))[:, :, 1] / (2 * h)
    np.testing.assert_allclose(basis.curvatures(grid, x, cells), difference, atol=1e-8)


@pytest.mark.parametrize(("dim", "material", "basis"), CASES)
def test_residual_is_the_derivative_of_the_energy(dim, material, basis):
    """The boxes' forces, by difference from those of a system without, against that of the boxes' energy."""
    points, system = boxed(dim, material, basis)
    alone = make_system(points, basis)
    x = random_increment(system, 0.1)
    forces = residual_at(system, x) - residual_at(alone, x)
    assert np.linalg.norm(forces) > 1e-3 * np.linalg.norm(residual_at(alone, x))
    for d in np.random.default_rng(8).standard_normal((4, len(x))):
        energies = []
        for h in (1e-5, -1e-5):
            put(system, x + h * d)
            energies.append(energy_in_boxes(system))
        slope = (energies[0] - energies[1]) / 2e-5
        assert slope == pytest.approx(forces @ d, abs=1e-7 * np.linalg.norm(forces) * np.linalg.norm(d))


@pytest.mark.parametrize(("dim", "material", "basis"), CASES)
def test_tangent_is_the_derivative_of_the_residual(dim, material, basis):
    _, system = boxed(dim, material, basis)
    x = random_increment(system, 0.1)

    def tangent(y):
        system.box_tangent, system.step.tangents = None, 0  # a step begins
        return tangent_at(system, y[0])[None]

    assert derivative_error(lambda y: residual_at(system, y[0])[None], tangent, x[None]) < 1e-7


def test_right_after_a_reset_the_moduli_of_the_points_serve():
    """Without increments the sides have no other moduli: the cheap sum is the whole tangent."""
    _, system = boxed(2, MICROPOLAR, "bspline")
    x = random_increment(system, 1e-9)
    whole = tangent_at(system, x)
    system.box_tangent, system.step.tangents = None, 0
    np.testing.assert_allclose(tangent_at(system, 0 * x), whole, atol=1e-6 * abs(whole).max())


def test_a_boxs_energy_is_exact_for_bending():
    """One point in a cell, and a quadratic displacement: the box holds what Gauss' rule finds in it."""
    mu, kappa = 1e3, 1e-4
    grid = pm.Grid.box((0, 0), (3, 3), 1.0)
    mine = slice(0, int(COMM.rank == 0))
    at, half = np.array([[1.5, 1.5]]), np.full((1, 2), 0.5)
    points = pm.Points(at[mine], np.ones(1)[mine], half[mine], pm.NeoHookean(lam=0.0, mu=mu), COMM)
    problem = pm.QuasiStatic(grid, points, reset=None)
    system = problem.system_at(0.0)
    # control values of u_x = kappa x y, u_y = -kappa x^2 / 2 about the middle: products at the Greville
    # positions, squares less a quarter of a cell's square
    at = system.nodes.position - 1.5
    system.x[:, 0], system.x[:, 1] = kappa * at[:, 0] * at[:, 1], -0.5 * kappa * (at[:, 0] ** 2 - 0.25)
    # e_xx = kappa y: mu e_xx^2 summed over the cell is mu kappa^2 / 12
    assert energy_in_boxes(system) == pytest.approx(mu * kappa**2 / 12, rel=1e-3)


def test_points_alone_have_no_boxes():
    """Gauss points integrate squares already; and the papers' functions stay as they were."""
    grid = pm.Grid.box((0, 0), (3, 2), 1.0)
    gauss = pm.seed(grid, material=MICROPOLAR, layout="gauss")
    assert pm.QuasiStatic(grid, gauss).system_at(0.0).interpolation.boxes is None
    square = pm.seed(grid, material=MICROPOLAR)
    assert pm.QuasiStatic(grid, square).system_at(0.0).interpolation.boxes is not None
    assert pm.QuasiStatic(grid, square, boxes=False).system_at(0.0).interpolation.boxes is None
    published = pm.QuasiStatic(grid, square, **pm.PUBLISHED).system_at(0.0).interpolation
    assert published.boxes is None
    assert published.batches[0].batch.orders == 2


@pytest.mark.parametrize("basis", ["mpm", "gimpm"])
def test_boxes_need_second_derivatives(basis):
    grid = pm.Grid.box((0, 0), (3, 2), 1.0)
    with pytest.raises(pm.InputError, match=f"boxes = True: basis = '{basis}' has no second derivatives"):
        pm.QuasiStatic(grid, pm.seed(grid, material=MICROPOLAR), basis=basis, boxes=True)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_new_base_of_the_rotations_keeps_the_boxes(dim):
    """Increments that turn the body about an axis: with a new base in the middle of the way, forces and
    energy of the boxes come out the same."""
    found = []
    for rebased in (False, True):
        points = scattered(dim, MICROPOLAR, finite=False, count=9)
        system = make_system(points, "bspline", boxes=True)
        at, motion = system.nodes.position, Motion(system.layout, COMM)
        field = np.zeros_like(system.x)
        field[:, 0] = 0.02 * at[:, 1] ** 2
        field[:, -1] = 0.2 * at[:, 0] + 0.1 * at[:, 1] ** 2  # about one axis: increments of rotations add up
        system.x[:] = field
        if rebased:
            system.x[:] = 0.5 * field
            system.interpolation.update_points(system.interpolation.gather(system.x), motion)
            system.rebase_rotations()
            system.x[:, dim:] = 0.5 * field[:, dim:]
            system.x[:, :dim] = field[:, :dim]
        forces = system.assemble(False).forces
        about = [*range(dim), -1]  # couples about other axes do work on other increments after a turn
        at_points = system.interpolation.gather(forces).value[:, about]
        found.append((energy_in_boxes(system), by_id(points, at_points)))
    assert found[0][0] > 0.1
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-9)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-9 * abs(found[0][1]).max())


def test_points_that_have_flowed_keep_a_hundredth():
    soft = pm.VonMises(MICROPOLAR, k=1.0, H=0.0, l_p=0.3)
    points = scattered(2, soft, finite=False)
    points.hardening[points.id < 5] = 0.1
    grid = pm.Grid.box((-2, -2), (4, 4), 1.0)
    boxes = pm.QuasiStatic(grid, points).system_at(0.0).interpolation.boxes[0]
    expected = np.where(points.id[boxes.rows] < 5, FLOWED, 1.0)
    np.testing.assert_array_equal(boxes.share, expected)


# the measure of trust ---------------------------------------------------------------------------------------
def strip(thickness: float, number: int, load: float = 0.02, **options) -> pm.QuasiStatic:
    """A strip of 6 cells length, bent by its own weight."""
    grid = pm.Grid.box((0, -3), (8, 3), 1.0)
    points = pm.seed(
        grid, bounds=((0, 0.1), (6, 0.1 + thickness)), material=NEO_HOOKEAN, points_per_cell=number
    )
    problem = pm.QuasiStatic(grid, points, **options)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, -load * thickness**2))
    return problem


def test_a_strip_of_one_row_of_points_warns_once():
    """Of large increments: small ones of thin bodies are seen by the boxes alone."""
    problem = strip(0.5, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(problem.march(1, progress=False))
    assert "resolved" in problem.trust()
    problem = strip(0.5, 1, 2.0, reset=None)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        steps = list(problem.march(3, progress=False))
    told = [str(w.message) for w in found if w.category is pm.TrustWarning]
    assert len(told) == int(COMM.rank == 0)
    assert all("points_per_cell" in text for text in told)
    assert min(step.unresolved for step in steps) > 0.5
    assert "in doubt" in problem.trust()
    assert 0.5 < COMM.allreduce(float(problem.points.unresolved.sum())) / problem.points.total <= 1.0


def test_a_thick_strip_does_not():
    problem = strip(2.0, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        steps = list(problem.march(3, progress=False))
    assert max(step.unresolved for step in steps) < 0.1
    assert "resolved" in problem.trust()
    assert strip(2.0, 3, boxes=False).trust().startswith("no measure")


def test_energy_balance_with_boxes():
    """External work is what is stored, boxes included, up to the trapezoidal rule's error: its square falls
    by four."""
    residues = []
    for number in (4, 8, 16):
        problem = strip(0.7, 2, reset=None)
        list(problem.march(number, progress=False))
        e = problem.energies()
        assert COMM.allreduce(float(problem.box_record.energies(problem.system).sum())) > 0.01 * e["stored"]
        residues.append(abs(e["residue"]) / e["external"])
    np.testing.assert_array_less(np.array(residues[1:]), np.array(residues[:-1]) / 3.5)
