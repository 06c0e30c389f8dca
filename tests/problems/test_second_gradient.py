"""Second-gradient materials W(F, H) on material points: exact solutions, objectivity, resets, restart, bodies
of several materials, and what is refused."""

from __future__ import annotations

import copy

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.assembly.interpolation import Interpolation
from polarmpm.basis.registry import basis_of
from polarmpm.forms.choice import make_form
from polarmpm.kinematics import rotations
from polarmpm.kinematics.layout import SECOND, Layout
from polarmpm.kinematics.motion import Motion
from tests.assembly.test_system import (
    make_system,
    put,
    random_increment,
    residual_at,
    scattered,
    tangent_at,
)
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id, derivative_error
from tests.helpers.gradient import gradient_solid

STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)


def curved(points: pm.Points, size: float = 0.1) -> None:
    """Second gradients at random, the same on any number of ranks."""
    rng, d = np.random.default_rng(5), points.dim
    half = size * rng.standard_normal((64, d, d, d))[points.id]
    points.grad_F = np.zeros((len(points), 3, 3, 3))
    points.grad_F[:, :d, :d, :d] = half + np.swapaxes(half, 2, 3)


# sums over points -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("dim", "basis", "boxes"),
    [(2, "bspline", False), (2, "bspline3", True), (2, "bspline-averaged", True), (3, "bspline", True)],
)
def test_tangent_is_the_derivative_of_the_residual(dim, basis, boxes):
    points = scattered(dim, gradient_solid(1e3, 0.3, (0.5, 0.3, 0.2)[:dim]), count=9)
    curved(points)
    points.half_axes0 = np.random.default_rng(4).uniform(-0.2, 0.2, (9, dim, dim))[points.id]
    system = make_system(points, basis, boxes=boxes)
    x = random_increment(system, 0.1)

    def tangent(y):
        system.box_tangent, system.step.tangents = None, 0
        return tangent_at(system, y[0])[None]

    assert derivative_error(lambda y: residual_at(system, y[0])[None], tangent, x[None]) < 1e-9


@pytest.mark.parametrize("boxes", [False, True])
def test_residual_is_the_derivative_of_the_energy(boxes):
    points = scattered(2, gradient_solid(1e3, 0.3, (0.5, 0.3)), count=9)
    curved(points)
    system = make_system(points, "bspline", boxes=boxes)
    (batch,), x = system.interpolation.batches, random_increment(system, 0.1)
    kernel = batch.form.compile_energy(COMM)

    def energy(y):
        put(system, y)
        inputs = system.interpolation.kernel_inputs(batch, system.x)
        total = kernel(inputs)[:, 0] @ batch.batch.kept["volume"]
        for own in system.interpolation.boxes or ():
            total += own.energies(kernel, system.x).sum()
        return COMM.allreduce(float(total))

    forces = residual_at(system, x)
    for d in np.random.default_rng(8).standard_normal((4, len(x))):
        slope = (energy(x + 1e-5 * d) - energy(x - 1e-5 * d)) / 2e-5
        assert slope == pytest.approx(forces @ d, abs=1e-7 * np.linalg.norm(forces) * np.linalg.norm(d))


@pytest.mark.parametrize("dim", [2, 3])
def test_history_of_second_gradients(dim):
    """Of two motions one after the other, against differences of F of both at once."""
    rng = np.random.default_rng(2)
    a, b = (0.1 * rng.standard_normal((2, dim, dim, dim)) for _ in range(2))
    first, second = (0.3 * rng.standard_normal((dim, dim)) for _ in range(2))

    def motion(linear, curve, x):
        return x + linear @ x + np.einsum("ijk,j,k->i", curve, x, x)

    def gradient(linear, curve, x):
        return np.eye(dim) + linear + np.einsum("ijk,k->ij", curve + np.swapaxes(curve, 1, 2), x)

    a, b = a[0], b[0]
    X = 0.1 * rng.standard_normal(dim)
    x1 = motion(first, a, X)

    def both(X):
        return gradient(second, b, motion(first, a, X)) @ gradient(first, a, X)

    h = 1e-5
    exact = np.stack([(both(X + h * e) - both(X - h * e)) / (2 * h) for e in np.eye(dim)], axis=-1)
    F, H = np.eye(3)[None].copy(), np.zeros((1, 3, 3, 3))
    F[0, :dim, :dim] = gradient(first, a, X)
    H[0, :dim, :dim, :dim] = a + np.swapaxes(a, 1, 2)
    layout = Layout(dim, 0, SECOND)
    move = Motion(layout, COMM)
    du = (gradient(second, b, x1) - np.eye(dim))[None]
    z = layout.pack(np.zeros((1, dim)), du, (b + np.swapaxes(b, 1, 2))[None])
    now, curve = move((F, layout.in_space.state().pack_second(H)), z)
    np.testing.assert_allclose(now[0, :dim, :dim], both(X), atol=1e-14)
    np.testing.assert_allclose(curve[0, :dim, :dim, :dim], exact, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("turns", [1, 4])
def test_turned_by_two_radians_in_new_grids(dim, turns):
    """At once, or in parts with a reset after each: F and H turn, and the energy stays."""
    points = scattered(dim, gradient_solid(1e3, 0.3, (0.5, 0.3, 0.2)[:dim]))
    curved(points)
    points.x = points.x - 1.0
    axis = np.array([0.0, 0.0, 1.0]) if dim == 2 else np.array([0.6, 0.0, 0.8])
    part = rotations.to_tensor(rotations.from_vector(2.0 / turns * axis[None]))[0]
    whole = rotations.to_tensor(rotations.from_vector(2.0 * axis[None]))[0]
    grid, form = pm.Grid.box((-5,) * dim, (5,) * dim, 1.0), make_form(points.materials[0], dim)
    kernel = form.compile_energy(COMM)

    def energies(i):
        (batch,) = i.batches
        return kernel(i.kernel_inputs(batch, np.zeros((len(i.nodes), dim))))[:, 0][np.argsort(batch.rows)]

    F, H, before = points.F.copy(), points.grad_F.copy(), None
    for _ in range(turns):
        i = Interpolation(grid, points, basis_of("bspline"), [form])
        before = energies(i) if before is None else before
        x = np.ascontiguousarray(i.nodes.position @ (part[:dim, :dim] - np.eye(dim)).T)
        i.update_points(i.gather(x), Motion(form.layout, COMM))
    np.testing.assert_allclose(points.F, whole @ F, atol=1e-13)
    np.testing.assert_allclose(points.grad_F, np.einsum("ij,njkl->nikl", whole, H), atol=1e-13)
    after = energies(Interpolation(grid, points, basis_of("bspline"), [form]))
    np.testing.assert_allclose(after, before, rtol=1e-12)


# exact solutions ----------------------------------------------------------------------------------------
def bent(length: float, per_cell: int, layout: str) -> tuple[float, float]:
    """Strain energy of a strip of height 1 in pure bending over the classical one, and its largest force on
    free nodes over the largest. Of bending to both sides the mean, so that strains may be larger than
    rounding."""
    kappa, cell = 3e-6, 0.25
    grid = pm.Grid.box((0, 0), (2, 1), cell)
    points = pm.seed(
        grid, material=gradient_solid(1e3, 0.0, (0.0, length)), points_per_cell=per_cell, layout=layout
    )
    problem = pm.QuasiStatic(grid, points, reset=None)
    system = problem.system_at(0.0)
    # control values of u_x = kappa x y, u_y = -kappa x^2 / 2: products at the Greville positions, squares
    # less a quarter of a cell's square within
    at = system.nodes.position - [0.0, 0.5]
    inside = (at[:, 0] > 1e-9) & (at[:, 0] < 2 - 1e-9)
    forces, energy = 0.0, 0.0
    (batch,), kernel = system.interpolation.batches, problem.forms[0].compile_energy(COMM)
    for sign in (0.5, -0.5):
        system.x[:, 0] = 2 * sign * kappa * at[:, 0] * at[:, 1]
        system.x[:, 1] = -sign * kappa * (at[:, 0] ** 2 - 0.25 * cell**2 * inside)
        system.evaluate(False)
        forces = forces + sign * system.residual
        found = kernel(system.interpolation.kernel_inputs(batch, system.x))[:, 0]
        energy += 0.5 * float(found @ batch.batch.kept["volume"])
        for own in system.interpolation.boxes or ():
            energy += 0.5 * float(own.energies(kernel, system.x).sum())
    free = inside & (np.abs(at[:, 0] - 1.0) < 1.0 - 0.6 * cell)
    free, forces = free[: system.nodes.owned], forces[: system.nodes.owned]
    size = COMM.allreduce(float(np.abs(forces).max(initial=0.0)), op=MPI.MAX)
    left = COMM.allreduce(float(np.abs(forces[free]).max(initial=0.0)), op=MPI.MAX)
    return COMM.allreduce(energy) / (0.5 * 1e3 * kappa**2 * 2 / 12), left / size


@pytest.mark.parametrize(("per_cell", "layout"), [(3, "gauss"), (2, "uniform"), (1, "uniform")])
def test_pure_bending(per_cell, layout):
    """The classical field is exact, and the stiffness 1 + (l / h)^2; with boxes of few points, too."""
    classical, _ = bent(0.0, per_cell, layout)
    ratio, left = bent(0.5, per_cell, layout)
    assert classical == pytest.approx(1.0, rel=1e-9)
    assert ratio == pytest.approx(1.25, rel=1e-9)
    assert left < 1e-9


def square(cell: float, lengths: tuple[float, float] = (4.0, 4.0)) -> list[float]:
    """Of a square excavation under pressure from outside, a quarter of it: the largest compressive principal
    stress and shear stress (MPa) at a point, and how far its corner and the middle of its walls move (mm)."""
    grid = pm.Grid.box((0, 0), (5, 5), cell)
    points = pm.seed(
        grid,
        lambda x: np.max(x, axis=1) > 2.0,
        material=gradient_solid(20e9, 0.0, lengths),
        points_per_cell=3,
        layout="gauss",
    )
    problem = pm.QuasiStatic(grid, points, reset=None, controls=STRICT)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    n = round(15 / cell)
    for a, b in (((5, 0), (5, 5)), ((5, 5), (0, 5))):
        problem.pressure(pm.Surface.line(a, b, n), 60e4)
    assert problem.attempt(1.0).converged
    stress = problem.fields("stress").stress[:, :2, :2] * 1e-4
    low, high = np.linalg.eigvalsh(stress).T
    found = [float(v.max(initial=0.0)) for v in (-low, (high - low) / 2)]
    found = [COMM.allreduce(v, op=MPI.MAX) for v in found]
    for place in ((2.0, 2.0), (2.0, 0.0)):
        off = place - points.X
        near = np.linalg.norm(off, axis=1)
        moved = points.displacement + np.einsum("nij,nj->ni", points.F[:, :2, :2] - np.eye(2), off)
        one = min(zip(near, np.linalg.norm(moved, axis=1), strict=True), default=(np.inf, 0.0))
        found.append(float(min(COMM.allgather(one))[1]) * 1e5)
    return found


def test_the_corner_of_a_square_excavation():
    """Where the classical stress has no limit."""
    peak, shear, corner, middle = square(0.25)
    assert peak == pytest.approx(120.3, abs=0.5)
    assert shear == pytest.approx(30.9, abs=0.1)
    assert (corner, middle) == pytest.approx((14.054, 12.964), rel=1e-3)


def test_a_square_excavation_with_one_director():
    """Stress between the classical one and that of two, and no symmetry of the diagonal."""
    peak, shear, _, _ = square(0.125, (4.0, 0.0))
    assert (peak, shear) == pytest.approx((199.5, 82.7), abs=0.1)


def tip_of_cantilever(reset: int | None, balanced: bool = False) -> tuple[float, float]:
    """Displacement of the tip over the length of a cantilever, alpha = P L^2 / EI_eff = 2, slope held."""
    L, young = 20.0, 1e6
    grid = pm.Grid.box((0, -1), (22, 12), 0.5)
    points = pm.seed(
        grid,
        material=gradient_solid(young, 0.0, (0.0, 1.0)),
        points_per_cell=3,
        layout="gauss",
        bounds=((0, 0), (L, 1)),
    )
    problem = pm.QuasiStatic(grid, points, reset=reset, balanced_reset=balanced)
    problem.fix(pm.plane(x=0.0), ux=0, uy=0, slope=0)
    end = pm.Surface.line((L, 0), (L, 1), 6)
    problem.traction(end, force=(0.0, 2.0 * 2.0 * young / 12 / L**2))
    last = points.where(lambda x: x[:, 0] > L - 0.1)
    list(problem.march(16, progress=False))
    moved = points.displacement + (points.F[:, :2, 0] - [1, 0]) * (L - points.X[:, :1])
    x, y = (points.mean(moved[:, i], last) / L for i in range(2))
    return x, y


def test_a_cantilever_bends_like_the_elastica():
    """Also where resets let go of what they can't balance: the gradient's stiffness hardly feels them."""
    x, y = tip_of_cantilever(None)
    assert (x, y) == pytest.approx((-0.16064, 0.49346), rel=0.02)
    assert (x, y) == pytest.approx((-0.1579, 0.4882), rel=3e-3)
    let_go = tip_of_cantilever(1)
    assert let_go[1] == pytest.approx(y, rel=0.01)
    assert let_go[0] == pytest.approx(x, rel=0.025)


# a body in the course of a run --------------------------------------------------------------------------
LOAD = (0.0, -20.0)


def strip(material: pm.Material | None = None, **options):
    """A strip of 3 x 1 (m) held at its left end, with a load at the other one."""
    grid = pm.Grid.box((0, -3), (4, 2), 0.5)
    material = gradient_solid(1e3, 0.3, (0.4, 0.8)) if material is None else material
    points = pm.seed(grid, material=material, bounds=((0, 0), (3, 1)))
    problem = pm.QuasiStatic(grid, points, controls=STRICT, **options)
    problem.fix(pm.plane(x=0.0), ux=0, uy=0)
    problem.load(points.where(lambda x: x[:, 0] > 2.5), force=LOAD)
    return problem


def run(problem, steps: int = 4):
    list(problem.march(steps, progress=False))
    return problem


def state(problem) -> np.ndarray:
    p = problem.points
    rows = np.concatenate([p.x, p.F.reshape(len(p), -1), p.grad_F.reshape(len(p), -1)], axis=1)
    return by_id(p, rows)


def test_resets_and_energies():
    """A balanced reset leaves the answer nearly where it is; the balance of energies closes."""
    still = run(strip(reset=None), 8)
    balanced, let_go = run(strip(reset=1), 8), run(strip(reset=1, balanced_reset=False), 8)
    tips = [
        COMM.allreduce(float(p.points.x[:, 1].min(initial=9.0)), op=MPI.MIN)
        for p in (still, balanced, let_go)
    ]
    assert tips[0] < -0.7
    assert tips[1] == pytest.approx(tips[0], rel=0.005)
    assert tips[2] == pytest.approx(tips[0], rel=0.04)
    for problem in (still, balanced):
        found = problem.energies()
        assert abs(found["residue"]) < 0.01 * found["stored"]
        assert problem.balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)
    assert balanced.energies()["carried"] != 0.0


@pytest.mark.parametrize("reset", [None, 2])
def test_restart(reset, tmp_path_factory):
    folder = COMM.bcast(str(tmp_path_factory.mktemp("restart")) if COMM.rank == 0 else None)
    whole, half = run(strip(reset=reset)), strip(reset=reset)
    steps = half.march(4, progress=False)
    for _ in range(3):
        next(steps)
    pm.save_restart(half, f"{folder}/a.h5")
    again = strip(reset=reset)
    pm.load_restart(again, f"{folder}/a.h5")
    np.testing.assert_array_equal(again.fields().double_stress, half.fields().double_stress)
    run(again, 1)
    np.testing.assert_allclose(state(again), state(whole), atol=1e-11)


def test_a_failed_attempt_leaves_no_trace():
    problem = run(strip())
    before = problem.points.grad_F
    copy_of = before.copy()
    problem.tried(lambda: problem.attempt(5.0))
    np.testing.assert_array_equal(problem.points.grad_F, copy_of)


def test_points_are_sealed():
    problem = strip(reset=None)
    steps = problem.march(4, progress=False)
    next(steps)
    problem.points.grad_F[:, 0, 0, 0] += 1.0
    with pytest.raises(pm.InputError, match=r"points.grad_F was changed"):
        next(steps)


@pytest.mark.parametrize("solver", ["direct", "multigrid"])
def test_linear_solvers(solver):
    np.testing.assert_allclose(state(run(strip(solver=solver), 2)), state(run(strip(), 2)), atol=1e-7)


def test_without_lengths_it_is_the_classical_body():
    def energy(F, p):
        e = 0.5 * (ufl.dot(F.T, F) - ufl.Identity(3))
        return 0.5 * p.lam * ufl.tr(e) ** 2 + p.mu * ufl.inner(e, e)

    numbers = {"lam": 300 / 1.3 / 0.4, "mu": 1e3 / 2.6}
    classical = run(strip(pm.UserEnergy(energy, numbers, micropolar=False), reset=1))
    second = run(strip(gradient_solid(1e3, 0.3, (0.0, 0.0)), reset=1))
    both = [by_id(p.points, p.points.x) for p in (classical, second)]
    np.testing.assert_allclose(both[1], both[0], atol=1e-9)


def test_beside_a_classical_material():
    """One scene with both: where the lengths vanish, it doesn't matter which points have second gradients."""
    second = gradient_solid(1e3, 0.3, (0.0, 0.0))

    def energy(F, p):
        e = 0.5 * (ufl.dot(F.T, F) - ufl.Identity(3))
        return 0.5 * p.lam * ufl.tr(e) ** 2 + p.mu * ufl.inner(e, e)

    classical = pm.UserEnergy(energy, {k: second.values[k] for k in ("lam", "mu")}, micropolar=False)
    grid = pm.Grid.box((0, -3), (4, 2), 0.5)
    points = pm.seed(grid, material=second, bounds=((0, 0), (3, 1)))
    points.assign(points.where(lambda x: x[:, 0] > 1.2), classical)
    problem = pm.QuasiStatic(grid, points, controls=STRICT, reset=1)
    problem.fix(pm.plane(x=0.0), ux=0, uy=0)
    problem.load(points.where(lambda x: x[:, 0] > 2.5), force=LOAD)
    run(problem)
    alone = run(strip(second, reset=1))
    np.testing.assert_allclose(by_id(points, points.x), by_id(alone.points, alone.points.x), atol=1e-9)
    of_classical = points.material == 1
    assert not points.grad_F[of_classical].any()
    found = problem.fields()
    assert found.double_stress.shape == (len(points), 3, 3, 3)
    assert not found.double_stress[of_classical].any()


def test_stresses_are_objective():
    """The stress is symmetric and turns with the body, and the double stress, too."""
    points = scattered(3, gradient_solid(1e3, 0.3, (0.5, 0.3, 0.2)))
    curved(points)
    grid = pm.Grid.box((-3,) * 3, (5,) * 3, 1.0)
    before = pm.QuasiStatic(grid, points).fields()
    Q = rotations.to_tensor(rotations.from_vector(np.array([[0.3, -1.5, 1.2]])))[0]
    other = copy.deepcopy(points)
    other.F, other.grad_F = Q @ points.F, np.einsum("ij,njkl->nikl", Q, points.grad_F)
    after = pm.QuasiStatic(grid, other).fields()
    np.testing.assert_allclose(before.stress, np.swapaxes(before.stress, 1, 2), atol=1e-10)
    turned = Q @ by_id(points, before.stress) @ Q.T
    np.testing.assert_allclose(by_id(other, after.stress), turned, atol=1e-10)
    turned = np.einsum("ai,bj,ck,nijk->nabc", Q, Q, Q, by_id(points, before.double_stress))
    np.testing.assert_allclose(by_id(other, after.double_stress), turned, atol=1e-10)
    assert abs(turned).max() > 1.0


def test_fields_in_files(tmp_path_factory):
    meshio = pytest.importorskip("meshio")
    folder = COMM.bcast(str(tmp_path_factory.mktemp("files")) if COMM.rank == 0 else None)
    problem = strip()
    with pm.Recorder(f"{folder}/a.pvd", problem, fields=("grad_F", "double_stress")):
        run(problem, 1)
    if COMM.rank == 0:
        import pathlib

        found = sorted(pathlib.Path(folder).rglob("*.vtu"))
        assert found
        data = meshio.read(found[-1])
        rows = {**data.point_data, **{k: v[0] for k, v in data.cell_data.items()}}
        assert rows["double_stress"].shape[1] == rows["grad_F"].shape[1] == 27


# what is refused ------------------------------------------------------------------------------------------
def test_functions_without_second_derivatives_are_refused():
    for name in ("mpm", "gimpm"):
        with pytest.raises(pm.InputError, match=rf"basis = '{name}': .* second gradients, .* allowed are"):
            strip(basis=name)
    with pytest.raises(pm.InputError, match="assembly = 'projection': basis = 'bspline'"):
        strip(assembly="projection")


def test_materials_that_do_not_go_together():
    second = gradient_solid(1e3, 0.3, (0.4, 0.8))
    with pytest.raises(pm.InputError, match="write micropolar=False"):
        pm.UserEnergy(lambda F, H, p: ufl.tr(F), second_gradient=True)
    points = strip().points
    with pytest.raises(pm.InputError, match="micropolar and classical"):
        points.assign(points.where(lambda x: x[:, 0] > 1), MICROPOLAR)
    from polarmpm.materials.cones import VonMises

    with pytest.raises(pm.InputError, match=r"second gradients"):
        pm.seed(pm.Grid.box((0, 0), (1, 1), 0.5), material=VonMises(elastic=second, k=1.0))


def test_other_bodies_have_none():
    points = pm.seed(pm.Grid.box((0, 0), (1, 1), 0.5), material=NEO_HOOKEAN)
    assert "grad_F" not in points.arrays()
    with pytest.raises(pm.InputError, match="none of the materials has second gradients"):
        pm.QuasiStatic(pm.Grid.box((0, 0), (1, 1), 0.5), points).fields("double_stress")


def test_second_gradients_must_be_symmetric():
    problem = strip()
    problem.points.grad_F[:, 0, 0, 1] = 1.0
    with pytest.raises(pm.InputError, match=r"points.grad_F isn't symmetric"):
        pm.QuasiStatic(problem.grid, problem.points)
