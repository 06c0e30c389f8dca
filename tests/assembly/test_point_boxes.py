"""Points integrate over their own boxes: one potential, its derivatives, what it is exact for, and what is
left out."""

from __future__ import annotations

import warnings

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly import pointboxes
from polarmpm.assembly.pointboxes import FLOWED, PointBoxes
from polarmpm.assembly.points import PointSystem
from polarmpm.basis.registry import basis_of
from polarmpm.kinematics import rotations
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
    assert_repeated,
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
CARRIED = CASES[:-1]  # micropolar points in space forget at resets what varies within their boxes
WITH_HISTORY = [pytest.param(*c.values, False, id=c.id) for c in CASES]
WITH_HISTORY += [pytest.param(*c.values, True, id=f"{c.id}-carried") for c in CARRIED]


def boxed(dim: int, material: pm.Material, basis: str):
    """Points at random with oblique boxes, a fifth of a cell."""
    points = scattered(dim, material, count=9)
    rng = np.random.default_rng(4)
    points.half_axes0 = rng.uniform(-0.2, 0.2, (9, dim, dim))[points.id]
    return points, make_system(points, basis, boxes=True)


def carried(points: pm.Points) -> None:
    """Let points have variations of what they have seen before a reset."""
    rng, d = np.random.default_rng(6), points.dim
    points.begin_sides()
    points.side_F[:] = rng.uniform(-0.05, 0.05, (9, d, d, d))[points.id]
    if points.materials[0].micropolar:
        points.side_wryness[:, 2, :d] += rng.uniform(-0.3, 0.3, (9, d))[points.id]
        points.side_gradients[:, :, 2] = rng.uniform(-0.1, 0.1, (9, d, d))[points.id]


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


@pytest.mark.parametrize(("dim", "material", "basis", "history"), WITH_HISTORY)
def test_residual_is_the_derivative_of_the_energy(dim, material, basis, history):
    """The boxes' forces, by difference from those of a system without, against that of the boxes' energy."""
    points, system = boxed(dim, material, basis)
    if history:
        carried(points)
        system = make_system(points, basis, boxes=True)
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


@pytest.mark.parametrize(("dim", "material", "basis", "history"), WITH_HISTORY)
def test_tangent_is_the_derivative_of_the_residual(dim, material, basis, history):
    points, system = boxed(dim, material, basis)
    if history:
        carried(points)
        system = make_system(points, basis, boxes=True)
    x = random_increment(system, 0.1)

    def tangent(y):
        system.box_tangent, system.step.tangents = None, 0  # a step begins
        return tangent_at(system, y[0])[None]

    assert derivative_error(lambda y: residual_at(system, y[0])[None], tangent, x[None]) < 1e-7


@pytest.mark.parametrize(("dim", "material", "basis"), CARRIED)
def test_what_is_carried_turns_with_the_body(dim, material, basis):
    """A turn of the whole body changes no energy."""
    points, _ = boxed(dim, material, basis)
    carried(points)
    system = make_system(points, basis, boxes=True)
    before, vector = energy_in_boxes(system), np.array([0.02, -0.03, 0.06] if dim == 3 else [0.0, 0.0, 0.6])
    turn = rotations.to_tensor(rotations.from_vector(vector[None]))[0, :dim, :dim]
    x = np.zeros_like(system.x)
    x[:, :dim] = system.nodes.position @ (turn - np.eye(dim)).T
    x[:, dim:] = vector[3 - system.layout.rotations :]
    system.x[:] = x
    assert energy_in_boxes(system) == pytest.approx(before, rel=1e-10)


def test_right_after_a_reset_the_moduli_of_the_points_serve():
    """Without increments the sides have no other moduli: the cheap sum is the whole tangent."""
    _, system = boxed(2, MICROPOLAR, "bspline")
    x = random_increment(system, 1e-9)
    whole = tangent_at(system, x)
    system.box_tangent, system.step.tangents = None, 0
    np.testing.assert_allclose(tangent_at(system, 0 * x), whole, atol=1e-6 * abs(whole).max())


def test_sides_of_boxes_that_count_for_little_have_the_moduli_of_their_points():
    """As of points that have flowed: in the tangent, by less than their share; the others' stay exact."""
    _, system = boxed(2, MICROPOLAR, "bspline")
    x, (own,) = random_increment(system, 0.1), system.interpolation.boxes
    found = {}
    for share in (0.0, FLOWED, 2 * 0.01):  # the last one counts
        own.put_shares(np.full(len(own.rows), share))
        system.box_tangent, system.step.tangents = None, 0
        found[share] = tangent_at(system, x)
    whole = (found[0.02] - found[0.0]) * (FLOWED / 0.02)
    off = abs(found[FLOWED] - found[0.0] - whole).max()
    assert 1e-3 * abs(whole).max() < off < 0.5 * abs(whole).max() or COMM.size > 1


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


# what the tangent costs -----------------------------------------------------------------------------
def sums(monkeypatch) -> list[bool]:
    """Notes each sum of the boxes' tangent: for prescribed increments alone, or all of it."""
    found: list[bool] = []
    add = PointBoxes.add_moduli

    def noted(self, *args, lift_only=False, **options):
        found.append(lift_only)
        add(self, *args, lift_only=lift_only, **options)

    monkeypatch.setattr(PointBoxes, "add_moduli", noted)
    return found


def bar(moved: float = 0.0, **options) -> pm.QuasiStatic:
    """Two cells thick, under its own weight; its other end moved along."""
    grid = pm.Grid.box((0, -3), (6 if moved else 8, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0), (6, 2)), material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, **({"reset": None} | options))
    problem.fix(pm.plane(x=0.0), u=0)
    if moved:
        problem.fix(pm.plane(x=6.0), u=(moved, 0))
    problem.body_load(force=(0, -2.0))
    return problem


@pytest.mark.parametrize("moved", [0.0, 0.05])
def test_small_steps_share_a_tangent_of_the_boxes(moved, monkeypatch):
    """It is summed again now and then, with hardly more iterations, and the same answer."""
    found = sums(monkeypatch)
    kept, renewed = bar(moved), bar(moved)
    steps = list(kept.march(10, progress=False))
    assert found.count(False) <= 7
    assert (True in found) == bool(moved)
    iterations = sum(step.iterations for step in steps)
    monkeypatch.setattr(PointSystem, "keep_boxes", lambda self, first: None)
    anew = sum(step.iterations for step in renewed.march(10, progress=False))
    assert iterations <= 1.25 * anew
    np.testing.assert_allclose(kept.points.x, renewed.points.x, atol=1e-8)


@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
def test_prescribed_increments_meet_the_tangent_that_is_kept(material):
    """What they add comes out as with a tangent that is summed at the same place."""
    _, system = boxed(2, material, "bspline")
    x, near = random_increment(system, 0.1), system.nodes.position[:, 0] < 1.0
    system.prescribed.fixed[near, 0] = system._fixed[near, 0] = True
    put(system, x)
    found = []
    for _ in range(2):  # first summed, then kept
        system.step.tangents = 1
        system.step.lift = np.where(system.prescribed.fixed, 0.1, 0.0)
        system._find_pending()
        system.evaluate(True)
        found.append(system.step.lifted)
    own = slice(0, system.nodes.owned)
    assert np.abs(found[0][own]).max(initial=0.0) > 0 or not near[own].any()
    free = ~system.prescribed.fixed[own]
    np.testing.assert_allclose(found[1][own][free], found[0][own][free], atol=1e-12 * abs(found[0]).max())


def test_a_failed_step_leaves_no_tangent_of_its_own():
    problem = bar()
    list(problem.march(4, to=0.4, progress=False))
    before = problem.system.box_tangent
    assert before is not None
    problem.body_load(force=(0, -1e5))
    problem.controls = pm.Controls(max_iterations=4)
    with pytest.raises(pm.NotConverged):
        list(problem.march(1, progress=False))
    kept = problem.system.box_tangent
    assert kept is None or np.array_equal(kept.x, before.x)


def test_a_run_goes_on_with_the_same_tangent(folder):
    """From a restart file, to the same digits."""
    whole, again = bar(), bar()
    list(whole.march(4, to=0.4, progress=False))
    assert whole.system.box_tangent is not None
    pm.save_restart(whole, folder / "run.h5")
    pm.load_restart(again, folder / "run.h5")
    for problem in (whole, again):
        list(problem.march(3, to=0.7, progress=False))
    assert [s.history for s in again.steps] == [s.history for s in whole.steps] or COMM.size > 1
    assert_repeated(again.points.x, whole.points.x)


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


def test_the_share_is_that_of_what_sums_have_stored(monkeypatch):
    """Or of what is evaluated again at both ends of a step, where that would take too much memory."""
    found = []
    for most in (pointboxes._STORED_MOST, 0):
        monkeypatch.setattr(pointboxes, "_STORED_MOST", most)
        problem = strip(1.0, 2, reset=3)
        steps = list(problem.march(5, progress=False))
        boxes = problem.system.interpolation.boxes[0]
        assert bool(boxes._stored) == (most > 0)
        found.append(([s.unresolved for s in steps], by_id(problem.points, problem.points.unresolved)))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-9)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-6, atol=1e-9)


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


@pytest.mark.parametrize(("dim", "material", "basis"), CARRIED)
def test_energy_is_carried_through_resets(dim, material, basis):
    """What has come to vary within the boxes has the same energy before and after a reset."""
    points, system = boxed(dim, material, basis)
    x = random_increment(system, 0.05)
    put(system, x)
    motion = Motion(system.layout, COMM)
    for _ in range(2):
        system.interpolation.update_points(system.interpolation.gather(system.x), motion)
        before = energy_in_boxes(system)
        system.interpolation.put_sides(system.x)
        system = make_system(points, basis, boxes=True)
        assert energy_in_boxes(system) == pytest.approx(before, rel=1e-10)
        put(system, random_increment(system, 0.03))


@pytest.mark.parametrize(("dim", "material", "basis"), CARRIED)
def test_a_reset_can_stop_what_a_change_has_made_rough(dim, material, basis):
    """Of a change of the increments only what varies evenly is carried along, and all of a turn."""
    points, _ = boxed(dim, material, basis)
    carried(points)

    def sides(system, x: np.ndarray, change: np.ndarray | None = None) -> np.ndarray:
        system.interpolation.put_sides(x, change)
        return np.concatenate([points.side_F, points.side_gradients], axis=2)

    system = make_system(points, basis, boxes=True)
    put(system, random_increment(system, 0.05))
    at, x = system.nodes.position, system.x
    taken = np.abs(sides(system, x, 0.5 * x) - sides(system, x)).max(initial=0.0)
    assert COMM.allreduce(taken, op=MPI.MAX) > 1e-3
    turned, turn = x.copy(), rotations.to_tensor(rotations.from_vector(np.array([[0.0, 0.0, 0.8]])))[0]
    turned[:, :dim] = (at + x[:, :dim]) @ turn[:dim, :dim].T - at
    np.testing.assert_allclose(sides(system, turned, turned - x), sides(system, turned), atol=1e-12)

    points.forget_sides()
    points.F[:] = np.eye(3)
    system = make_system(points, basis, boxes=True)
    even = np.tile(0.1 * system.nodes.position[:, :1] ** 2, system.x.shape[1])
    np.testing.assert_allclose(sides(system, even, even), sides(system, even), atol=1e-12)
