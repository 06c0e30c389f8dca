"""The assembled system: consistent tangent, patch tests, invariance, and what empty space costs."""

from __future__ import annotations

import gc
import tracemalloc

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly.interpolation import Interpolation
from polarmpm.assembly.points import PointSystem
from polarmpm.basis.registry import basis_of
from polarmpm.bodies.points import Points
from polarmpm.conditions.prescribed import Prescribed
from polarmpm.conditions.supports import make_support
from polarmpm.forms.couples import CoupleForm
from polarmpm.forms.points import PointForm
from polarmpm.forms.stresses import FieldForm
from polarmpm.kinematics import rotations
from polarmpm.kinematics.motion import Motion
from polarmpm.tools.timing import Timer
from tests.conftest import (
    ANISOTROPIC,
    COMM,
    GENERAL,
    HENCKY,
    MICROPOLAR,
    NEO_HOOKEAN,
    beam,
    by_id,
    derivative_error,
    release_supports,
    rotation,
)


def share(values: np.ndarray) -> np.ndarray:
    """This rank's part of an array that every rank has."""
    return np.array_split(values, COMM.size)[COMM.rank]


def scattered(
    dim: int, material: pm.Material, *, finite: bool = True, count: int = 13, seed: int = 0
) -> Points:
    """Points at random places of 2 x 2 (x 2) cells, with domains across faces and random F, Q, Gamma."""
    rng = np.random.default_rng(seed)
    x, half = rng.uniform(0.2, 1.8, (count, dim)), rng.uniform(0.05, 0.45, (count, dim))
    volume = rng.uniform(0.5, 1.5, count)
    F, gamma, vector = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 3)), np.zeros((count, 3))
    F[:, :dim, :dim] += rng.uniform(-0.2, 0.2, (count, dim, dim))
    if dim == 3:
        gamma, vector = rng.uniform(-1, 1, (count, 3, 3)), rng.uniform(-2, 2, (count, 3))
    else:
        gamma[:, 2, :2], vector[:, 2] = rng.uniform(-1, 1, (count, 2)), rng.uniform(-2, 2, count)
    points = Points(share(x), share(volume), share(half), material, COMM)
    if finite:
        points.F = share(F)
        if material.micropolar:
            points.q, points.wryness = rotations.from_vector(share(vector)), share(gamma)
    return points


def make_system(
    points: Points, basis: str, *, full: bool = False, supports=(), solver: str = "auto", boxes: bool = False
) -> PointSystem:
    """The system of points on a grid of unit cells; `full` asks for an unsymmetric tangent."""
    grid = pm.Grid.box((-2,) * points.dim, (4,) * points.dim, 1.0)
    forms = [PointForm(m, points.dim) for m in points.materials]
    interpolation = Interpolation(grid, points, basis_of(basis), forms, boxes=boxes, carries=boxes)
    layout = forms[0].layout
    made = [
        make_support(where, "nodes", components, layout, k) for k, (where, components) in enumerate(supports)
    ]
    kernels = [form.compile(COMM) for form in forms]
    couple = CoupleForm().compile(COMM) if full else None
    prescribed = Prescribed(interpolation.nodes, made, layout)
    return PointSystem(interpolation, kernels, couple, prescribed, Timer(), solver)


def size_of(system: PointSystem) -> int:
    return system.nodes.total * system.layout.block


def put(system: PointSystem, x: np.ndarray) -> None:
    """Set the nodal increments from a vector of all unknowns in global order."""
    system.x[:] = x.reshape(-1, system.layout.block)[system.nodes.number]


def collected(system: PointSystem, nodal: np.ndarray) -> np.ndarray:
    """Owned rows of all ranks as one vector."""
    return np.concatenate(COMM.allgather(nodal[: system.nodes.owned])).ravel()


def residual_at(system: PointSystem, x: np.ndarray) -> np.ndarray:
    put(system, x)
    system.evaluate(False)
    return collected(system, system.residual)


def stored_matrix(system: PointSystem) -> np.ndarray:
    """The stored entries of all ranks, dense."""
    p, block = system.pattern, system.layout.block
    p.complete()
    rows = np.repeat(np.arange(len(p.indptr) - 1), np.diff(p.indptr)) + system.nodes.start * block
    out = np.zeros((size_of(system),) * 2)
    for i, j, v in COMM.allgather((rows, p.indices, p.values[: p.owned_entries].copy())):
        out[i, j] = v
    return out


def tangent_at(system: PointSystem, x: np.ndarray) -> np.ndarray:
    put(system, x)
    system.evaluate(True)
    k = stored_matrix(system)
    return k + np.triu(k, 1).T if system.pattern.symmetric else k


def random_increment(system: PointSystem, size: float = 0.15) -> np.ndarray:
    return np.random.default_rng(7).uniform(-size, size, size_of(system))


TANGENTS = [
    pytest.param(2, MICROPOLAR, False, id="2d"),
    pytest.param(2, ANISOTROPIC, False, id="2d-anisotropic"),
    pytest.param(2, HENCKY, False, id="2d-hencky"),
    pytest.param(3, NEO_HOOKEAN, False, id="3d-neo-hookean"),
    pytest.param(3, MICROPOLAR, False, id="3d"),
    pytest.param(3, GENERAL, False, id="3d-reference-frame"),
    pytest.param(3, MICROPOLAR, True, id="3d-couples"),
]


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize(("dim", "material", "couples"), TANGENTS)
def test_tangent_is_the_derivative_of_the_residual(dim, material, couples, basis):
    """Every entry of the global tangent against central differences, below 1e-7 of the largest one."""
    points = scattered(dim, material)
    system = make_system(points, basis, full=couples)
    n = len(points)
    moments = np.zeros((n, system.layout.rotations))
    if couples:
        moments[::2] = np.random.default_rng(COMM.rank).uniform(-500, 500, (len(moments[::2]), 3))
    system.set_loads(np.ones((n, dim)), moments)
    x = random_increment(system)
    k = tangent_at(system, x)
    if couples:
        assert abs(k - k.T).max() > 1e-3 * abs(k).max()  # dead moments make it unsymmetric
    error = derivative_error(
        lambda y: residual_at(system, y[0])[None], lambda y: tangent_at(system, y[0])[None], x[None]
    )
    assert error < 1e-7


@pytest.mark.parametrize(
    ("dim", "material"), [(2, MICROPOLAR), (3, MICROPOLAR), (3, GENERAL), (2, HENCKY), (3, NEO_HOOKEAN)]
)
def test_residual_is_the_derivative_of_the_points_energy(dim, material):
    """Internal forces are differences of the energy that the *updated* points store.

    That ties the kernels to the update of F, Q and Gamma and to the fields for output.
    """
    points = scattered(dim, material)
    system = make_system(points, "gimpm")
    field, values = FieldForm(material).compile(COMM), list(material.parameters().values())
    motion = Motion(system.layout, COMM)

    def energy(x):
        put(system, x)
        system.interpolation.update_points(system.interpolation.gather(system.x), motion)
        rows = (
            field(points.F, points.q, points.wryness, np.tile(values, (len(points), 1)))
            if len(points)
            else None
        )
        return COMM.allreduce(float(rows[:, 0] @ points.volume0) if rows is not None else 0.0)

    x = random_increment(system)
    r = residual_at(system, x)
    direction = np.random.default_rng(8).standard_normal((6, len(x)))
    for d in direction:
        h = 1e-5
        difference = (energy(x + h * d) - energy(x - h * d)) / (2 * h)
        assert difference == pytest.approx(r @ d, abs=1e-7 * np.linalg.norm(r) * np.linalg.norm(d))


def test_differences_notice_a_wrong_assembly(monkeypatch):
    """A point that is left out of the tangent by a hundred thousandth of its volume is found."""
    points = scattered(2, MICROPOLAR)
    good, bad = make_system(points, "gimpm"), make_system(points, "gimpm")
    for b in bad.interpolation.batches:
        if len(b.rows):
            b.batch.kept["volume"][0] *= 1 + 1e-4
    x = random_increment(good)
    error = derivative_error(
        lambda y: residual_at(good, y[0])[None], lambda y: tangent_at(bad, y[0])[None], x[None]
    )
    assert error > 1e-7


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
def test_symmetric_storage_is_the_upper_triangle(basis):
    """Half the storage holds the same entries as the full matrix, which is symmetric without couples."""
    points = scattered(3, MICROPOLAR)
    half, full = make_system(points, basis), make_system(points, basis, full=True)
    x = random_increment(half)
    upper, k = tangent_at(half, x), tangent_at(full, x)
    assert half.pattern.symmetric
    assert not full.pattern.symmetric
    assert np.all(np.tril(stored_matrix(half), -1) == 0.0)
    np.testing.assert_allclose(np.triu(upper), np.triu(k), rtol=0, atol=1e-14 * abs(k).max())
    np.testing.assert_allclose(k, k.T, rtol=0, atol=1e-14 * abs(k).max())


@pytest.mark.parametrize("basis", ["gimpm", "bspline", "bspline3"])
def test_whole_rows_of_symmetric_sums(basis):
    """Multigrid on several ranks gets whole rows: half of them is summed, the rest is its mirror image."""
    points = scattered(3, MICROPOLAR)
    half, whole = make_system(points, basis), make_system(points, basis, solver="multigrid")
    assert whole.pattern.symmetric == (COMM.size == 1)
    x = random_increment(half)
    k = tangent_at(half, x)
    np.testing.assert_allclose(tangent_at(whole, x), k, rtol=0, atol=1e-14 * abs(k).max())


@pytest.mark.parametrize("solver", ["auto", "multigrid"])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_prescribed_increments_load_the_free_unknowns(dim, full, solver):
    """Rows and columns of prescribed unknowns are left out; what they do to the others is K_fp du_p."""
    if full and dim == 2:
        pytest.skip("couples in plane strain are nodal loads")
    points = scattered(dim, MICROPOLAR)
    supports = [
        (lambda x: x[:, 0] < 0.5, {"ux": 0.1, "theta": 0.2 if dim == 2 else (0.2,) * 3}),
        (lambda x: x[:, 1] > 1.5, {"uy": -0.3}),
    ]
    free_system = make_system(points, "gimpm", full=full)
    system = make_system(points, "gimpm", full=full, supports=supports, solver=solver)
    x = random_increment(system)
    k = tangent_at(free_system, x)
    put(system, x)
    system.set_prescribed(system.prescribed.increments(1.0))
    assert system.pending()
    system.evaluate(True)
    fixed = collected(system, system.prescribed.fixed)
    target = collected(system, system.prescribed.totals(1.0))
    reduced = stored_matrix(system)
    reduced = reduced + np.triu(reduced, 1).T if system.pattern.symmetric else reduced
    expected = np.where(fixed[:, None] | fixed[None, :], np.diag(np.diag(k)), k)
    np.testing.assert_allclose(reduced, expected, rtol=0, atol=1e-14 * abs(k).max())
    lift = collected(system, system.step.lifted)[~fixed]
    np.testing.assert_allclose(
        lift, (k @ np.where(fixed, target - x, 0.0))[~fixed], rtol=0, atol=1e-12 * abs(k).max()
    )


# patch tests --------------------------------------------------------------------------------------
SHAPES = {
    2: np.array([[0.15, 0.3, 0], [-0.25, -0.1, 0], [0, 0, 0]]),
    3: np.array([[0.2, 0.3, -0.1], [-0.2, -0.15, 0.25], [0.1, -0.3, 0.1]]),
}


def polar_vector(F: np.ndarray) -> np.ndarray:
    """Rotation vector of the rotation nearest to F."""
    u, _, vt = np.linalg.svd(F)
    R = u @ vt
    angle = np.arccos((np.trace(R) - 1) / 2)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return angle * axis / np.linalg.norm(axis)


def patch(
    dim: int,
    material: pm.Material,
    basis: str,
    F: np.ndarray,
    vector: np.ndarray,
    *,
    periodic: bool,
    **options,
):
    """5 cells a side full of points, with a homogeneous deformation prescribed around the inner nodes.

    Points are displaced at random. A homogeneous stress is in equilibrium with sums over points only when
    every cell has the same pattern of them (the gradients of the basis then cancel), hence `periodic`.
    """
    cells, per_cell = 5, 2
    grid = pm.Grid.box((0,) * dim, (cells,) * dim, 1.0)
    points = pm.seed(grid, material=material, points_per_cell=per_cell)
    rng = np.random.default_rng(3)
    jitter = rng.uniform(-0.24, 0.24, ((cells * per_cell) ** dim, dim))
    domain = rng.uniform(0.05, 0.45, ((cells * per_cell) ** dim, dim))
    lattice = np.rint(points.x * per_cell - 0.5).astype(int)
    if periodic:
        lattice %= per_cell
    which = np.ravel_multi_index(lattice.T, (cells * per_cell,) * dim)
    points.x = points.x + jitter[which]
    points.X, points.half_length0 = points.x.copy(), domain[which]
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": basis, **options})
    theta = {}
    if material.micropolar:
        theta["theta"] = vector if dim == 3 else vector[2]
    grad = F[:dim, :dim] - np.eye(dim)
    problem.fix(
        lambda x: np.any((x < 1.5) | (x > cells - 1.5), axis=1), u=lambda t, x: t * x @ grad.T, **theta
    )
    return problem


def prescribe_motion(problem: pm.QuasiStatic, F_at, vector: np.ndarray) -> None:
    """Replace the patch's support by one that follows F(t), with rotations t * vector."""
    dim = problem.grid.dim
    where = problem.supports[0].where
    release_supports(problem)
    theta = {"theta": vector if dim == 3 else vector[2]} if problem.layout.rotations else {}
    problem.fix(where, u=lambda t, x: x @ (F_at(t)[:dim, :dim] - np.eye(dim)).T, **theta)


PATCHES = [
    pytest.param(2, MICROPOLAR, id="2d"),
    pytest.param(2, HENCKY, id="2d-hencky"),
    pytest.param(3, NEO_HOOKEAN, id="3d-neo-hookean"),
    pytest.param(3, MICROPOLAR, id="3d"),
]


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize(("dim", "material"), PATCHES)
def test_patch_homogeneous_deformation(dim, material, basis, strict):
    """A stretch with matching microrotation is reproduced to 1e-10, points at random places in a cell."""
    F = np.eye(3) + SHAPES[dim]
    vector = polar_vector(F)
    problem = patch(dim, material, basis, F, vector, periodic=True, controls=strict)
    (step,) = problem.march(1)
    assert step.iterations <= 12
    points = problem.points
    np.testing.assert_allclose(points.F, np.broadcast_to(F, points.F.shape), rtol=0, atol=1e-10)
    np.testing.assert_allclose(points.x, points.X @ F[:dim, :dim].T, rtol=0, atol=1e-10)
    if material.micropolar:
        expected = np.broadcast_to(vector, (len(points), 3))
        np.testing.assert_allclose(points.rotation_vector, expected, rtol=0, atol=1e-10)
        np.testing.assert_allclose(points.wryness, 0.0, atol=1e-10)
    stress = np.concatenate(COMM.allgather(problem.fields().stress))
    np.testing.assert_allclose(
        stress, np.broadcast_to(stress[0], stress.shape), atol=1e-9 * abs(stress).max()
    )
    np.testing.assert_allclose(stress, np.swapaxes(stress, 1, 2), atol=1e-9 * abs(stress).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_patch_in_steps_with_kept_weights(dim, strict):
    """Without resets, increments of several steps and new rotation bases add up to the same deformation."""
    F = np.eye(3) + SHAPES[dim]
    vector = np.array([0.0, 0.0, 2.5]) if dim == 2 else 2.5 * np.array([1.0, 2.0, -2.0]) / 3
    turn = rotation(vector)
    stretch = np.eye(3) + 0.5 * (SHAPES[dim] + SHAPES[dim].T)
    problem = patch(dim, MICROPOLAR, "gimpm", F, vector, periodic=True, reset=None, controls=strict)

    prescribe_motion(
        problem, lambda t: rotation(t * vector) @ (np.eye(3) + t * (stretch - np.eye(3))), vector
    )
    steps = list(problem.march(4))
    assert len(steps) == 4
    assert problem.progress.rotation_factor > 0.0  # the angle made a new base necessary
    points = problem.points
    np.testing.assert_allclose(points.F, np.broadcast_to(turn @ stretch, points.F.shape), rtol=0, atol=1e-10)
    np.testing.assert_allclose(points.wryness, 0.0, atol=1e-9)
    expected = np.broadcast_to(vector, (len(points), 3))
    np.testing.assert_allclose(points.rotation_vector, expected, rtol=0, atol=1e-9)


# invariance ---------------------------------------------------------------------------------------
def turned_cantilever(R: np.ndarray, basis: str, controls: pm.Controls) -> np.ndarray:
    """Displacements by id, turned back, of a loaded block whose whole set-up is turned by R."""
    cell = np.array([1.0, 0.8, 1.25])
    corners = np.array([[-1, -2, -2], [5, 3, 3]]) * cell @ R.T
    grid = pm.Grid.box(corners.min(axis=0), corners.max(axis=0), abs(R) @ cell)
    index = np.stack(np.meshgrid(range(6), range(2), range(2), indexing="ij"), axis=-1).reshape(-1, 3)
    x = (index / 2 + 0.23) * cell
    n = len(x)
    half = np.tile(0.25 * cell, (n, 1)) @ abs(R).T
    points = Points(share(x @ R.T), share(np.full(n, cell.prod() / 8)), share(half), MICROPOLAR, COMM)
    problem = pm.QuasiStatic(grid, points, basis=basis, controls=controls, reset=1, balanced_reset=False)
    axis = "xyz"[int(np.argmax(abs(R[:, 0])))]
    problem.fix(pm.plane(**{axis: 0.0}), u=0, theta=0)
    tip = points.farthest(R @ [1.0, 0.0, 0.0])
    problem.load(tip, force=R @ [20.0, -60.0, 40.0], couple=R @ [30.0, 20.0, -50.0])
    problem.body_load(force=R @ [3.0, -8.0, 5.0])
    for _ in problem.march(3):
        pass
    return by_id(points, points.displacement) @ R


@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_answers_turn_with_the_problem(axis, basis, strict):
    """Grid, body, supports and loads turned by 90 degrees: displacements turn too, to 1e-9."""
    R = np.rint(rotation(0.5 * np.pi * np.eye(3)[axis]))
    straight, turned = (turned_cantilever(r, basis, strict) for r in (np.eye(3), R))
    assert abs(straight).max() > 0.2
    np.testing.assert_allclose(turned, straight, rtol=0, atol=1e-9 * abs(straight).max())


@pytest.mark.parametrize(("dim", "kind"), [(2, "micropolar"), (3, "micropolar"), (2, "hencky")])
def test_units_of_length_do_not_matter(dim, kind, strict):
    """Metres, micrometres and kilometres with the moduli to match give the same numbers."""
    answers = []
    for scale in (1.0, 1e6, 1e-3):
        m = MICROPOLAR
        pascal, newton = scale**-2, 1.0 if dim == 3 else 1.0 / scale  # in plane strain forces are N/m
        if kind == "micropolar":
            material = pm.MicropolarElastic(
                lam=m.lam * pascal,
                mu=m.mu * pascal,
                kappa=m.kappa * pascal,
                alpha=m.alpha,
                beta=m.beta,
                gamma=m.gamma,
            )
        else:
            material = pm.Hencky(lam=m.lam * pascal, mu=m.mu * pascal)
        problem = beam(
            dim, material, scale=scale, basis="mpm" if kind == "hencky" else "gimpm", controls=strict
        )
        tip = problem.points.farthest((1.0, 0.0, 0.0)[:dim])
        couple = None
        if kind == "micropolar":
            couple = 8.0 if dim == 2 else np.multiply(scale, (6.0, 4.0, -10.0))
        problem.load(tip, force=np.multiply(newton, (4.0, -8.0, 5.0)[:dim]), couple=couple)
        list(problem.march(2))
        answers.append(by_id(problem.points, problem.points.displacement) / scale)
    assert abs(answers[0]).max() > 0.05
    for other in answers[1:]:
        np.testing.assert_allclose(other, answers[0], rtol=0, atol=1e-9 * abs(answers[0]).max())


@pytest.mark.parametrize("dim", [2, 3])
def test_classical_materials_have_no_rotation_unknowns(dim):
    """A node has as many unknowns as the space has dimensions, and the microrotation stays the identity."""
    classical, micropolar = beam(dim, NEO_HOOKEAN, basis="mpm"), beam(dim, MICROPOLAR, basis="mpm")
    for problem in (classical, micropolar):
        problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), force=(0.0, -5.0, 0.0)[:dim])
        list(problem.march(1))
    rotations_of_a_node = 1 if dim == 2 else 3
    assert classical.unknowns * (dim + rotations_of_a_node) == micropolar.unknowns * dim
    assert np.all(classical.points.rotation_vector == 0.0)
    assert np.all(classical.fields().couple_stress == 0.0)
    assert abs(by_id(micropolar.points, micropolar.points.rotation_vector)).max() > 1e-3


def test_reactions_balance_the_loads(strict):
    """The supports hold exactly the loads: forces add up to zero in every direction."""
    problem = beam(3, controls=strict)
    support = problem.supports[0]
    problem.load(problem.points.farthest((1, 0, 0)), force=(5.0, -20.0, 10.0), couple=(8.0, 9.0, -7.0))
    problem.body_load(force=(1.0, 2.0, -3.0))
    list(problem.march(2))
    force, _ = problem.reaction(support)
    volume = COMM.allreduce(problem.points.volume0.sum())
    np.testing.assert_allclose(
        force, -np.array([5.0 + volume, -20.0 + 2 * volume, 10.0 - 3 * volume]), rtol=1e-8
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_empty_space_costs_nothing(dim):
    """A box ten times as long in every direction has the same unknowns, answer and memory (within 5 %)."""
    found = []
    for factor in (1, 1, 10):  # the first one fills caches
        grid = pm.Grid.box((-2 * factor,) * dim, (4 * factor,) * dim, 0.5)
        points = pm.seed(grid, material=MICROPOLAR, bounds=((0,) * dim, (1.0,) * dim))
        list_of = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
        list_of.fix(pm.plane(x=0.0), u=0, theta=0)
        list_of.load(points.farthest((1, 0, 0)[:dim]), force=(0.0, 1.0, 0.0)[:dim])
        list_of._compile()
        gc.collect()
        tracemalloc.start()
        try:
            list(list_of.march(1))
            memory = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        found.append((list_of.unknowns, memory, points.mean_displacement()))
    _, (n, memory, u), (n10, memory10, u10) = found
    assert n == n10
    assert COMM.allreduce(memory10, op=MPI.SUM) < 1.05 * COMM.allreduce(memory, op=MPI.SUM)
    np.testing.assert_allclose(u10, u, rtol=0, atol=1e-9 * abs(u).max())
