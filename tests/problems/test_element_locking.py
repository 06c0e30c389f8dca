"""The cure of locking on elements: projected volumes and relative rotations (docs/theory.md)."""

from __future__ import annotations

import warnings
from contextlib import nullcontext

import numpy as np
import pytest

import polarmpm as pm
from tests.assembly.test_element_sums import random_state
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN, derivative_error, release_supports, rotation
from tests.helpers import plasticity
from tests.helpers.bodies import (
    DIMENSION,
    at_nodes,
    box,
    cantilever,
    own_rows,
    prepared,
    residual_at,
    tangent_at,
)

CASES = [
    ("quadrilateral", 1, HENCKY),
    ("quadrilateral", 2, NEO_HOOKEAN),
    ("triangle", 2, NEO_HOOKEAN),
    ("quadrilateral", 1, MICROPOLAR),
    ("hexahedron", 1, NEO_HOOKEAN),
    ("quadrilateral", 1, plasticity.cylinder(plasticity.HENCKY)),
    pytest.param("hexahedron", 1, plasticity.cylinder(NEO_HOOKEAN), marks=pytest.mark.slow),
    pytest.param("quadrilateral", 1, plasticity.cone(plasticity.HENCKY), marks=pytest.mark.slow),
]


def cook(cells: int, degree: int, material: pm.Material, **options: object) -> pm.QuasiStaticFEM:
    """Cook's membrane, 48 wide, 44 high at its support and 16 at its end, which is pulled up."""
    mesh = box("quadrilateral", (cells, cells))
    s, t = mesh.geometry.x[:, 0].copy(), mesh.geometry.x[:, 1].copy()
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = 48 * s, 44 * s + t * (44 - 28 * s)
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=degree), **options)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.load(pm.plane(x=48.0), force=(0.0, 100.0))
    return problem


@pytest.mark.parametrize(("degree", "within"), [(1, 0.02), (2, 0.001)])
def test_cooks_membrane(degree, within):
    """Nearly incompressible, 16 cells a side: the corner moves by 6.92, three iterations a step, no cuts."""
    nu, mu = 0.4999, 80.1938
    problem = cook(16, degree, pm.NeoHookean(lam=2 * mu * nu / (1 - 2 * nu), mu=mu))
    steps = list(problem.march(10, progress=False))
    corner = at_nodes(problem.elements, problem.elements.displacement)[-1, 1]
    assert corner == pytest.approx(6.92, rel=within)
    assert len(steps) == 10
    assert sum(step.iterations for step in steps) <= 35


def smooth_increments(problem: pm.QuasiStaticFEM) -> np.ndarray:
    """Increments of up to 0.02 that depend on the nodes' positions alone: the same state, and as far from the
    yield surface, however nodes are numbered and ranks share them. Collective."""
    at = np.concatenate(
        [problem.elements.nodes.position, np.ones((len(problem.elements.nodes.position), 1))], 1
    )
    waves = np.random.default_rng(7).uniform(-1, 1, (at.shape[1], problem.layout.block))
    return own_rows(problem, 0.02 * np.sin(7 * at @ waves))


@pytest.mark.parametrize(("cell", "degree", "material"), CASES)
def test_tangent_is_the_derivative_of_the_residual(cell, degree, material):
    """After a step, in which the points have got the projected deformation; symmetric where it's elastic."""
    dim = DIMENSION[cell]
    body = pm.Elements(box(cell, (2,) * dim, distort=0.12), material=material, degree=degree)
    problem = pm.QuasiStaticFEM(body, locking="always")
    problem.fix(lambda x: x[:, 0] < 0.3, u=0)
    problem.fix(lambda x: x[:, 0] > 0.8, uy=0.05)
    list(problem.march(1, progress=False))
    release_supports(problem)
    problem._stale = True
    system = prepared(problem)
    x = smooth_increments(problem)[None]

    def tangent(y: np.ndarray) -> np.ndarray:
        system.step.projected = None  # not predicted: the derivative itself
        return tangent_at(problem, system, y[0])[None]

    error = derivative_error(lambda y: residual_at(problem, system, y[0])[None], tangent, x)
    assert error < 1e-7
    if not material.plastic:
        k = tangent(x)[0]
        np.testing.assert_allclose(k, k.T, rtol=0, atol=1e-13 * abs(k).max())


@pytest.mark.parametrize("material", [HENCKY, MICROPOLAR, plasticity.cylinder(plasticity.HENCKY)])
@pytest.mark.parametrize("degree", [1, 2])
def test_a_turned_body_is_the_same_body(degree, material, strict):
    """A bar and its load, turned by a radian: the displacement and the stresses turn with it."""
    turn, found = rotation(np.array([0.0, 0.0, 1.0]))[:2, :2], []
    for q in (np.eye(2), turn):
        mesh = box("quadrilateral", (6, 2), (6.0, 2.0), distort=0.05)
        mesh.geometry.x[:, :2] = mesh.geometry.x[:, :2] @ q.T
        body = pm.Elements(mesh, material=material, degree=degree)
        problem = pm.QuasiStaticFEM(body, controls=strict, locking="always")
        problem.fix(body.facets(lambda x, q=q: (x @ q)[:, 0] < 0.3), u=0)
        problem.load(body.facets(lambda x, q=q: (x @ q)[:, 0] > 5.7), force=tuple(q @ np.array([2.0, 9.0])))
        list(problem.march(3, progress=False))
        F = problem.points.F[:, :2, :2]
        found.append((body.displacement @ q, q.T @ F @ q, problem.energy()))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * np.abs(other).max())


def test_a_turned_plastic_body_in_space_is_the_same_body(strict):
    """Micropolar: relative rotations are averaged in one frame, whatever the points' own."""
    turn, found = rotation(np.array([0.7, -0.4, 1.0])), []
    for q in (np.eye(3), turn):
        mesh = box("hexahedron", (3, 1, 1), (3.0, 1.0, 1.0), distort=0.05)
        mesh.geometry.x[:] = mesh.geometry.x @ q.T
        body = pm.Elements(mesh, material=plasticity.cylinder(H=50.0))
        problem = pm.QuasiStaticFEM(body, controls=strict)
        assert problem.forms.parts[0].form.scalars == 4
        problem.fix(body.facets(lambda x, q=q: (x @ q)[:, 0] < 0.3), u=0, theta=0)
        problem.load(
            body.facets(lambda x, q=q: (x @ q)[:, 0] > 2.7),
            force=tuple(plasticity.K * q @ np.array([1.0, 0.05, -0.1])),
        )
        list(problem.march(3, progress=False))
        assert COMM.allreduce(float((problem.points.hardening > 0).sum())) > 0
        found.append((body.displacement @ q, q.T @ problem.points.F @ q, problem.energy()))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * np.abs(other).max())


@pytest.mark.slow  # where its kernels in space aren't compiled yet
def test_a_micropolar_footing_in_space_is_that_of_the_plane():
    """A slice of a strip footing on von Mises soil, l = b / 50: uncured it carries four times as much."""
    loads = []
    for dim in (2, 3):
        elastic = pm.MicropolarElastic.bounded_stiffness(lam=5.77e3, mu=3.85e3, kappa=3.85e3, l_b=0.02)
        soil = pm.VonMises(elastic, k=np.sqrt(3.0), l_p=0.02)
        mesh = box(("quadrilateral", "hexahedron")[dim - 2], (6, 3, 1)[:dim], (3.0, 1.5, 0.5)[:dim])
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=soil))
        for x in (0.0, 3.0):
            problem.fix(pm.plane(x=x), ux=0)
        problem.fix(pm.plane(y=0.0), u=0)
        if dim == 3:
            problem.fix(lambda x: np.ones(len(x), bool), uz=0, theta_x=0, theta_y=0)
        held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 1.5 - 1e-6), ux=0, uy=-0.02)
        list(problem.march(5, progress=False))
        loads.append(-problem.reaction(held).force[1] / (0.5 if dim == 3 else 1.0))
    assert loads[1] == pytest.approx(loads[0], rel=0.02)


def test_auto_leaves_bodies_alone_that_do_not_lock():
    problem = cantilever("quadrilateral", NEO_HOOKEAN)
    assert not any(form.scalars for form in problem.forms.point_forms)
    stiff = pm.NeoHookean(lam=9e4, mu=2e3)
    assert cantilever("quadrilateral", stiff).forms.point_forms[0].scalars == 1
    simple = cantilever("triangle", stiff)
    assert simple.forms.point_forms[0].scalars == 0


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("quadrilateral", 2), ("triangle", 2)])
def test_a_footing_on_elements_finds_its_limit_by_default(cell, degree):
    """(2 + pi) c b_eff, b_eff up to half the distance of nodes beyond the footing; else 8 to 50 % more."""
    soil = pm.VonMises(pm.Hencky.from_engineering(E=1e4, nu=0.3), k=np.sqrt(3.0))
    body = pm.Elements(box(cell, (16, 8), (4.0, 2.0)), material=soil, degree=degree)
    problem = pm.QuasiStaticFEM(body)
    for x in (0.0, 4.0):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 2 - 1e-6), ux=0, uy=-0.01)
    list(problem.march(4, progress=False))
    width = 1 + 0.125 / degree
    assert -problem.reaction(held).force[1] / width == pytest.approx(2 + np.pi, rel=0.06)


def test_a_footing_on_soil_that_dilates_finds_its_limit():
    """Prandtl: N_c = 14.835, psi = phi = 20 degrees; 8 % more, and rising, if whole volumes are averaged."""
    elastic = pm.Hencky.from_engineering(E=1e4, nu=0.3)
    soil = plasticity.cone(elastic, 20.0, 20.0, k=None, c=1.0, cone="plane strain")
    body = pm.Elements(box("quadrilateral", (28, 14), (7.0, 3.5)), material=soil, degree=1)
    problem = pm.QuasiStaticFEM(body)
    for x in (0.0, 7.0):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > 3.5 - 1e-6), ux=0, uy=-0.02)
    loads = [
        -problem.reaction(held).force[1] / 1.125 for _ in problem.march(8, adaptive=True, progress=False)
    ]
    assert loads[-1] == pytest.approx(14.835, rel=0.03)
    assert loads[-1] < 1.01 * loads[len(loads) // 2 - 1]


def test_plastic_elements_that_nothing_cures_warn():
    soil = pm.VonMises(HENCKY, k=1.0)
    first = COMM.rank == 0  # it warns
    for cell, options in (("triangle", {}), ("quadrilateral", {"assembly": "dolfinx"})):
        body = pm.Elements(box(cell, (2, 2)), material=soil)
        with pytest.warns(pm.TrustWarning, match="in plastic flow") if first else nullcontext():
            pm.QuasiStaticFEM(body, **options)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            pm.QuasiStaticFEM(body, locking=None, **options)


def test_micropolar_flow_that_dilates_warns_where_cells_have_means_alone():
    """A footing with psi = phi = 20 degrees, 4 cells of degree 1 under its half: 1.10 N_c, and rising."""
    micropolar = pm.MicropolarElastic.bounded_stiffness(lam=5.77e3, mu=3.85e3, kappa=3.85e3, l_b=0.02)
    for psi, degree, told in ((0.35, 1, True), (0.0, 1, False), (0.35, 2, False)):
        soil = pm.DruckerPrager(micropolar, cone="plane strain", phi=0.35, psi=psi, c=1.0, l_p=0.02)
        body = pm.Elements(box("quadrilateral", (2, 2)), material=soil, degree=degree)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            pm.QuasiStaticFEM(body)
        found = ["micropolar flow that dilates" in str(w.message) for w in said]
        assert any(found) == (told and COMM.rank == 0)


def test_arguments():
    body = pm.Elements(box("quadrilateral", (1, 1)), material=NEO_HOOKEAN)
    with pytest.raises(pm.InputError, match="locking = 'never'"):
        pm.QuasiStaticFEM(body, locking="never")
    with pytest.raises(pm.InputError, match=r"'always'.*'dolfinx'.*'native'"):
        pm.QuasiStaticFEM(body, locking="always", assembly="dolfinx")


def test_the_energy_balance_closes():
    """With the square of the step."""
    residues = []
    for steps in (4, 8):
        problem = cook(4, 1, pm.NeoHookean(lam=8e3, mu=80.0), locking="always")
        list(problem.march(steps, progress=False))
        e = problem.energies()
        assert e["patches"] == 0.0
        residues.append(abs(e["residue"]) / e["external"])
    assert residues[1] < 0.3 * residues[0] < 0.01


def test_random_states_need_no_displacements(strict):
    """States that were given without displacements are where a step begins."""
    body = pm.Elements(box("quadrilateral", (3, 3)), material=HENCKY)
    random_state(body, 2)
    problem = pm.QuasiStaticFEM(body, controls=strict, locking="always")
    problem.fix(pm.plane(x=0.0), u=0)
    list(problem.march(1, progress=False))
    assert COMM.allreduce(int(np.sum(np.linalg.det(body.points.F) <= 0))) == 0
