"""Krylov methods with multigrid: the direct solver's answers, and what their coarse spaces hold."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id

import polarmpm as pm
from polarmpm import rotations
from polarmpm.multigrid import MultigridSolver, rigid_motions


def block(solver: str, material=MICROPOLAR, *, metre=1.0, pascal=1.0, corner=0.0, dim=3, **options):
    """A cube of 6 cells a side that is held below, bent and pressed by a body force."""
    units = {"lam": pascal, "mu": pascal, "kappa": pascal}
    moduli = {k: v * units.get(k, pascal * metre**2) for k, v in material.parameters().items()}
    grid = pm.Grid.box((-2 * metre,) * (dim - 1) + (0.0,), (3 * metre,) * (dim - 1) + (2 * metre,), metre / 6)
    low, high = np.full(dim, corner * metre), np.full(dim, (1 + corner) * metre)
    low[-1], high[-1] = 0.0, metre
    points = pm.seed(grid, material=type(material)(**moduli), bounds=(low, high), points_per_cell=2)
    settings = {**pm.PUBLISHED, "basis": "mpm", "controls": pm.Controls(force_tolerance=1e-10), **options}
    problem = pm.QuasiStatic(grid, points, solver=solver, **settings)
    plane = pm.plane(z=0.0) if dim == 3 else pm.plane(y=0.0)
    problem.fix(plane, u=0, **({"theta": 0} if material.micropolar else {}))
    force = np.array([60.0, 30.0, -90.0]) if dim == 3 else np.array([60.0, -90.0])
    problem.body_load(force=tuple(force * pascal / metre))
    return problem


@pytest.mark.parametrize(
    ("material", "options"),
    [
        pytest.param(MICROPOLAR, {}, id="micropolar"),
        pytest.param(MICROPOLAR, {"basis": "gimpm", "corner": 0.013}, id="small-cuts"),
        pytest.param(MICROPOLAR, {"basis": "bspline"}, id="splines"),
        pytest.param(MICROPOLAR, {"dim": 2}, id="plane"),
        pytest.param(NEO_HOOKEAN, {}, id="classical"),
    ],
)
def test_same_answer_as_the_direct_solver(material, options):
    answers = []
    for solver in ("direct", "multigrid"):
        problem = block(solver, material, **options)
        steps = list(problem.march(2))
        answers.append((by_id(problem.points, problem.points.displacement), len(steps)))
        if solver == "multigrid":
            assert isinstance(problem.system.solver, MultigridSolver)
            assert 0 < problem.system.solver.iterations < 400
    size = abs(answers[0][0]).max()
    assert size > 1e-3
    np.testing.assert_allclose(answers[1][0], answers[0][0], rtol=0, atol=1e-8 * size)


@pytest.mark.parametrize(("metre", "pascal"), [(1e-9, 1e12), (1e3, 1e-6)])
def test_units_do_not_matter(metre, pascal):
    """The same block in other units: the same answer, in about as many iterations (what a correction's error
    is measured by adds forces and couples)."""
    found = []
    for units in ({}, {"metre": metre, "pascal": pascal}):
        problem = block("multigrid", controls=pm.Controls(force_tolerance=3e-11), **units)
        list(problem.march(1))
        found.append((by_id(problem.points, problem.points.displacement), problem.system.solver.iterations))
    np.testing.assert_allclose(found[1][0] / metre, found[0][0], rtol=0, atol=1e-8 * abs(found[0][0]).max())
    assert found[1][1] < 1.5 * found[0][1]


def test_dead_couples_in_space():
    """An unsymmetric tangent: GMRES."""
    answers = []
    for solver in ("direct", "multigrid"):
        problem = block(solver)
        problem.load(problem.points.farthest((0, 0, 1)), couple=(4.0, 8.0, 15.0))
        list(problem.march(1))
        answers.append(by_id(problem.points, problem.points.displacement))
    np.testing.assert_allclose(answers[1], answers[0], rtol=0, atol=1e-8 * abs(answers[0]).max())


def test_finite_elements():
    from bodies import cantilever

    answers = []
    for solver in ("direct", "multigrid"):
        made = cantilever("hexahedron")
        problem = pm.QuasiStaticFEM(made.elements, solver=solver, controls=pm.Controls(force_tolerance=1e-10))
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.body_load(force=(0, 2.0, -5.0))
        list(problem.march(1))
        answers.append(problem.elements.mean_displacement())
    np.testing.assert_allclose(answers[1], answers[0], rtol=1e-8)


def test_rigid_motions_cost_nothing():
    """The stress-free tangent without supports maps them to zero; turned by quaternions, to second order."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(7, 3))
    turned = 0.3 * rng.normal(size=(7, 3))
    motions = rigid_motions(x, turned, COMM)
    centre = COMM.allreduce(x.sum(axis=0)) / COMM.allreduce(len(x))
    h = 1e-6
    for axis in range(3):
        spin = np.eye(3)[axis]
        np.testing.assert_array_equal(motions[axis, :, :3], np.tile(spin, (7, 1)))
        np.testing.assert_array_equal(motions[axis, :, 3:], 0.0)
        turn = rotations.from_vector(np.tile(h * spin, (7, 1)))
        moved = np.einsum("nij,nj->ni", rotations.to_tensor(turn), x - centre) - (x - centre)
        np.testing.assert_allclose(motions[3 + axis, :, :3], moved / h, atol=1e-5)
        after = rotations.to_vector(rotations.multiply(turn, rotations.from_vector(turned)))
        change = (after - turned) / h
        assert abs(motions[3 + axis, :, 3:] - change).max() < 0.2 * np.linalg.norm(turned, axis=1).max() ** 2


def test_unknown_solver():
    with pytest.raises(pm.InputError, match="solver = 'lu': allowed are auto, direct, multigrid"):
        block("lu")
