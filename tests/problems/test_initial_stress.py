"""Balanced resets carry stresses: loads and reactions keep their balance of forces and of moments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly import carrying
from polarmpm.assembly.carrying import Moduli
from polarmpm.kinematics import rotations
from tests.conftest import ANISOTROPIC, COMM, GENERAL, HENCKY, MICROPOLAR, NEO_HOOKEAN, by_id, rotation
from tests.helpers.balance import in_balance
from tests.helpers.bodies import box

YIELDING = pm.VonMises(NEO_HOOKEAN, k=120.0, H=300.0)


def cantilever(
    material: pm.Material = MICROPOLAR,
    dim: int = 2,
    force: float = -30.0,
    per_cell: int = 4,
    comm: MPI.Comm = COMM,
    **options: Any,
) -> pm.QuasiStatic:
    """A bar of 4 x 1.2 (x 1) cells, held at a wall of the grid, whose end is pushed down."""
    grid = pm.Grid.box((0.0, -4.0, -2.0)[:dim], (6.0, 3.0, 3.0)[:dim], 1.0, comm)
    bounds = ((0.0, 0.2, 0.0)[:dim], (4.0, 1.4, 1.0)[:dim])
    points = pm.seed(grid, bounds=bounds, material=material, points_per_cell=per_cell)
    problem = pm.QuasiStatic(grid, points, **{"reset": 1, **options})
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    problem.load(points.farthest((1.0, 0.0, 0.0)[:dim]), force=(0.0, force, 0.2 * force)[:dim])
    return problem


def march(problem: Any, steps: int = 11, **options: Any) -> Any:
    for _ in problem.march(steps, progress=False, **options):
        pass
    return problem


# what is carried ----------------------------------------------------------------------------------------
CASES: dict[str, tuple[Callable[[], pm.QuasiStatic], float]] = {
    "bspline": (lambda: cantilever(), 1e-9),
    "bspline3": (lambda: cantilever(basis="bspline3"), 1e-9),
    "mpm": (lambda: cantilever(basis="mpm"), 1e-9),
    "gimpm": (lambda: cantilever(basis="gimpm"), 1e-8),
    "hanging nodes": (lambda: cantilever(NEO_HOOKEAN, basis="mpm"), 1e-8),
    "classical": (lambda: cantilever(NEO_HOOKEAN), 1e-9),
    "hencky": (lambda: cantilever(HENCKY), 1e-9),
    "general": (lambda: cantilever(GENERAL), 1e-9),
    "fibres": (lambda: cantilever(ANISOTROPIC), 1e-9),
    "plastic": (lambda: cantilever(YIELDING), 1e-7),
    "space": (lambda: cantilever(NEO_HOOKEAN, 3, per_cell=3), 1e-9),
    "space-micropolar": (lambda: cantilever(MICROPOLAR, 3, per_cell=2), 1e-7),
    "projection": (lambda: cantilever(basis="mpm", assembly="projection"), 1e-9),
    "ghost": (lambda: cantilever(basis="mpm", ghost="thesis"), 1e-9),
    "multigrid": (lambda: cantilever(solver="multigrid"), 1e-9),
}


@pytest.mark.parametrize("case", CASES)
def test_loads_and_reactions_balance(case):
    """After ten resets, about any point; a body that bends by half its length."""
    make, moments = CASES[case]
    problem = march(make())
    force, moment = in_balance(problem)
    assert force < 1e-9
    assert moment < moments


def test_couples_count_in_the_moments():
    problem = cantilever(dim=3, per_cell=2, basis="mpm")
    problem.load(problem.loads[0].selection, couple=(10.0, -20.0, 15.0))
    force, moment = in_balance(march(problem))
    assert force < 1e-9
    assert moment < 1e-6


def test_each_of_several_supports_has_its_share():
    """A bar between two clamps, under a weight that grows towards one of them; finite elements know."""
    size, found = (6.0, 0.5), []
    grid = pm.Grid.box((0.0, -2.0), (6.0, 2.0), 0.5, COMM)
    points = pm.seed(grid, bounds=((0.0, 0.0), size), material=NEO_HOOKEAN, points_per_cell=4)
    mesh = box("quadrilateral", (24, 2), size)
    for problem in (
        pm.QuasiStatic(grid, points, reset=1),
        pm.QuasiStaticFEM(pm.Elements(mesh, material=NEO_HOOKEAN, degree=2)),
    ):
        clamps = [problem.fix(pm.plane(x=x), u=0) for x in (0.0, 6.0)]
        problem.body_load(force=lambda t, x: np.stack([0 * x[:, 0], -10.0 * t * x[:, 0]], axis=1))
        march(problem)
        found.append([problem.reaction(clamp)[0][1] for clamp in clamps])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


def test_a_platen_and_the_wall_behind_the_body_feel_the_same():
    """On a grid that is stretched at its resets."""
    grid = pm.Grid.box((0.0, 0.0), (3.0, 3.0), 0.5, COMM)
    points = pm.seed(grid, bounds=((0.0, 0.0), (1.2, 3.0)), material=YIELDING, points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=1)
    wall = problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(x=0.0), ux=0)
    platen = problem.fix(pm.plane(y=3.0, moving=True), ux=0, uy=-0.3)
    march(problem)
    below, above = problem.reaction(wall)[0][1], problem.reaction(platen)[0][1]
    assert abs(below + above) < 1e-9 * below


def test_springs_may_be_all_that_holds_the_body():
    problem = cantilever(NEO_HOOKEAN)
    for support in problem.supports:
        problem.release(support)
    spring = problem.fix(pm.Surface.line((0.0, 0.2), (0.0, 1.4), 12), u=0, stiffness=1e6)
    march(problem, 4)
    load = COMM.allreduce(problem._converged_loads[0].sum(axis=0))
    np.testing.assert_allclose(problem.reaction(spring)[0], -load, rtol=0, atol=1e-9 * abs(load).max())


def test_arc_length():
    problem = cantilever(NEO_HOOKEAN)
    for step in problem.march_arc_length(0.1, steps=11, progress=False):
        load = np.array([0.0, -30.0 * step.factor])
        error = problem.reaction(problem.supports[0])[0] + load
        assert np.abs(error).max() < 1e-8 * np.abs(load).max()


# how it is carried --------------------------------------------------------------------------------------
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", [MICROPOLAR, ANISOTROPIC, HENCKY, YIELDING])
def test_moduli_have_no_part_of_the_stresses(material, dim):
    """A turn of stressed points makes no stress, and those of a classical material are symmetric."""
    problem = march(cantilever(material, dim, per_cell=3, reset=None), 4, to=0.5)
    problem.progress.reset_due = True
    system = problem._prepare()
    x, layout = system.positions(), problem.layout
    spin = np.array([0.0, 0.0, 0.5] if dim == 2 else [0.3, -0.2, 0.5])
    w = np.zeros_like(system.x)
    w[:, :dim] = x @ rotations.hat(spin[None])[0, :dim, :dim].T
    w[:, dim:] = spin[3 - layout.rotations :]
    other = np.zeros_like(w)
    other[:, 0] = x[:, 1] ** 2
    a, i = Moduli(system, 0), system.interpolation
    turned, strained = (a.times(i.kernel_inputs(i.batches[0], v)[:, : layout.unknowns]) for v in (w, other))
    largest = COMM.allreduce(float(np.abs(strained).max(initial=0.0)))
    assert COMM.allreduce(float(np.abs(turned).max(initial=0.0))) < 1e-9 * largest
    if not material.micropolar:
        np.testing.assert_allclose(strained, np.swapaxes(strained, 1, 2), rtol=0, atol=1e-12 * largest)


@pytest.mark.parametrize("assembly", ["direct", "projection"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_new_rotation_base_changes_nothing(dim, assembly):
    problem = march(cantilever(dim=dim, per_cell=2, basis="mpm", reset=3, assembly=assembly), 5)
    system = problem.system
    assert system.initial.active()
    free = ~system.prescribed.fixed[: system.owned]
    free[:, dim:] &= dim == 2  # in space couples do the work of another variation, which balances as a whole
    system.evaluate(False)
    before, scale = system.residual.copy(), 30.0
    without = system.initial.interpolation.reference.initial_stress.copy()
    system.rebase_rotations()
    system.evaluate(False)
    assert np.abs(system.residual - before)[: system.owned][free].max(initial=0.0) < 1e-9 * scale
    assert np.abs(system.initial.interpolation.reference.initial_stress - without).max(initial=1.0) > 0


@pytest.mark.parametrize("material", [MICROPOLAR, NEO_HOOKEAN])
def test_it_does_the_work_that_its_energy_loses(material, strict):
    """The work of its forces on the nodes, by Simpson's rule between two states."""
    problem = cantilever(material, reset=4)
    problem.controls = strict
    march(problem, 5, to=0.5)
    system, x = problem.system, problem.system.x
    start, work = problem.progress.carried_work, 0.0
    march(problem, 1, to=0.6)
    end, stress = system.x, system.interpolation.reference.initial_stress.copy()
    assert system is problem.system
    for share, weight in ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6)):
        system.x = x + share * (end - x)
        system.initial.replace(stress)
        of_both = system.assemble(False).forces
        system.initial.replace(0 * stress)
        forces = (of_both - system.assemble(False).forces)[: system.owned]
        work += weight * float(np.sum(forces * (end - x)[: system.owned]))
    carried = problem.progress.carried_work - start
    assert carried == pytest.approx(-COMM.allreduce(work), rel=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_another_number_of_ranks_goes_on_from_a_file(folder: Path, dim):
    """Written by one rank between two resets; initial stresses move with their points."""
    options = {"dim": dim, "per_cell": 2, "reset": 3}
    straight = march(cantilever(**options), 8)
    if COMM.rank == 0:
        first = march(cantilever(**options, comm=MPI.COMM_SELF), 5, to=5 / 8)
        assert first.system.initial.active()
        pm.save_restart(first, folder / "state.h5")
    COMM.barrier()
    second = cantilever(**options)
    pm.load_restart(second, folder / "state.h5")
    assert second.system.initial.active()
    march(second, 3)
    expected = by_id(straight.points, straight.points.x)
    np.testing.assert_allclose(by_id(second.points, second.points.x), expected, rtol=0, atol=1e-8)


def test_stresses_are_reported_without_it():
    problem = march(cantilever(reset=2), 3)
    points = problem.points
    assert problem.system.initial.active()
    found = by_id(points, problem.fields().stress)
    fresh = pm.QuasiStatic(problem.grid, points, reset=None)  # takes the points over
    np.testing.assert_array_equal(by_id(points, fresh.fields().stress), found)


def test_what_is_let_go_needs_none():
    problem = march(cantilever(balanced_reset=False), 4)
    assert problem.system.initial is None
    assert not problem._resets.kernels
    assert not np.any(problem.system.carried)


# when it fails --------------------------------------------------------------------------------------------
def spoilt(system: Any) -> None:
    """A reset after which no step converges."""
    stress = system.interpolation.reference.initial_stress
    system.initial.replace(np.broadcast_to(-1e5 * np.eye(*stress.shape[1:]), stress.shape))


@pytest.mark.parametrize("along", [False, True])
def test_forces_are_carried_where_a_step_fails_with_stresses(along, monkeypatch):
    problem = march(cantilever(NEO_HOOKEAN, reset=2), 4, to=0.4)
    moved = by_id(problem.points, problem.points.displacement)
    monkeypatch.setattr(carrying, "carry_stress", spoilt)
    if along:
        assert problem.attempt_along(1e-3)[0].converged
    else:
        assert problem.attempt(0.4).converged
        assert np.abs(by_id(problem.points, problem.points.displacement) - moved).max() < 1e-9
    assert not problem.system.initial.active()
    force, moment = in_balance(problem)
    assert force < 1e-9
    assert moment < 1e-8
    assert problem.attempt(0.5).converged  # between two resets
    assert in_balance(problem)[0] < 1e-9


def test_a_step_that_fails_either_way_leaves_the_stresses():
    problem = march(cantilever(), 3, to=0.3)
    problem._prepare()
    reference, carried = problem.system.interpolation.reference, problem.system.carried
    stress = reference.initial_stress.copy()
    assert not problem.attempt(1e6).converged
    assert problem.system.interpolation.reference is reference
    np.testing.assert_array_equal(reference.initial_stress, stress)
    np.testing.assert_array_equal(problem.system.carried, carried)


@pytest.mark.parametrize("dim", [2, 3])
def test_closing_forces(dim):
    """They have the sum and the moment of what they close, and the least squares over volumes that can."""
    problem = march(cantilever(dim=dim, per_cell=2), 2)
    system = problem.system
    own, held = system.owned, system.prescribed.fixed
    rng = np.random.default_rng(COMM.rank)
    forces = np.where(held, 0.0, rng.normal(size=system.x.shape))
    closing = carrying.closing(system, forces)
    assert not np.any(closing[:own][~held[:own]])
    both, x = (forces + closing)[:own], system.positions()[:own]
    sums = [both[:, :dim].sum(axis=0)]
    moment = np.cross(x, both[:, :dim]).reshape(own, -1).sum(axis=0) + both[:, dim:].sum(axis=0)
    np.testing.assert_allclose(COMM.allreduce(np.concatenate([*sums, moment])), 0.0, atol=1e-9)


def test_rotations_are_those_of_the_reference():
    """`Reference.rebase_rotations` turns B0 and M0 by the turn since the last base."""
    problem = march(cantilever(dim=3, per_cell=2, force=-1.0), 1)
    points = problem.points
    reference = problem.system.interpolation.reference
    n = len(points)
    reference.initial_stress = np.random.default_rng(0).normal(size=(n, 6, 3))
    before, vector = reference.initial_stress.copy(), np.array([0.4, -0.9, 0.3])
    points.q = rotations.turned(reference.q, np.broadcast_to(vector, (n, 3)))
    reference.rebase_rotations(points)
    for rows in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(
            reference.initial_stress[:, rows], rotation(vector) @ before[:, rows], atol=1e-12
        )
