"""Contact of bodies with rigid obstacles, of points and of elements."""

import re
from contextlib import nullcontext

from mpi4py import MPI

import meshio
import numpy as np
import pytest
import scipy.optimize
import ufl
from dolfinx import mesh

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated

LOW, SIZE = 0.137, 1.0  # m: a block that doesn't fit its grid
PRESS = 0.02


def block(material=NEO_HOOKEAN, *, basis="mpm", size=(SIZE, SIZE), **options):
    grid = pm.Grid((0.0, 0.0), (0.2, 0.2), (8, 8), COMM)
    points = pm.seed(grid, bounds=((LOW, LOW), (LOW + size[0], LOW + size[1])), material=material)
    return pm.QuasiStatic(grid, points, basis=basis, **options)


def floor_of(problem, **options):
    return problem.obstacle(pm.HalfSpace((0, LOW), (0, 1)), **options)


def pressed(problem, low=LOW, **options):
    """Floor, walls and a plate that moves down; each another kind of obstacle."""
    high = low + SIZE
    return [
        problem.obstacle(pm.HalfSpace((0, low), (0, 1)), **options),
        problem.obstacle(lambda x: (x[0] - low) * (2 + x[1] ** 2), **options),
        problem.obstacle(pm.Box((high, -1), (high + 1, 3)), **options),
        problem.obstacle(lambda x, t: high - PRESS * t - x[1], **options),
    ]


def uniform(stress):
    low, high = stress.min(axis=0, initial=np.inf), stress.max(axis=0, initial=-np.inf)
    low, high = COMM.allreduce(low, op=MIN), COMM.allreduce(high, op=MAX)
    return np.abs(high - low).max() / np.abs(high).max()


MIN, MAX = MPI.Op.Create(lambda a, b, _: np.minimum(a, b)), MPI.Op.Create(lambda a, b, _: np.maximum(a, b))


def test_uniform_pressure_through_obstacles_anywhere():
    """A block between walls that aren't on the grid's lines: its stress is uniform, as are the pressures, and
    the obstacles' forces are in balance."""
    problem = block()
    obstacles = pressed(problem)
    for step in problem.march(2, progress=False):
        assert step.iterations <= 4
    assert uniform(problem.fields("stress").stress) < 1e-3
    for one in obstacles:
        pressure = one.pressure[one.touching]
        assert np.ptp(pressure) < 1e-2 * pressure.max()
        assert np.isclose(np.linalg.norm(one.force), pressure.mean() * SIZE, rtol=1e-2)
    force = sum(one.force for one in obstacles)
    assert np.abs(force).max() < 1e-8 * obstacles[0].force[1]
    assert np.allclose(problem.reaction(obstacles[0]).force, obstacles[0].force)
    balance = problem.balance()
    assert max(balance.residue) < 1e-8
    assert [part.name for part in balance.parts] == [one.name for one in obstacles]


@pytest.mark.parametrize("degree", [1, 2])
def test_uniform_pressure_on_elements(degree):
    square = mesh.create_rectangle(COMM, [(0, 0), (SIZE, SIZE)], [3, 3], mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(square, material=NEO_HOOKEAN, degree=degree))
    obstacles = pressed(problem, low=0.0, gap=1e-5)
    for _ in problem.march(2, progress=False):
        assert max(one.penetration for one in obstacles) <= 1e-5
    assert uniform(problem.fields("stress").stress) < 1e-4
    assert np.abs(sum(one.force for one in obstacles)).max() < 1e-8 * obstacles[0].force[1]
    assert max(problem.balance().residue) < 1e-8


def test_augmentation_keeps_the_gap():
    depth = {}
    for gap in (None, 1e-5):
        problem = block(basis="bspline")
        problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, ux=0, uy=-0.01)
        floor = floor_of(problem, gap=gap)
        for _ in problem.march(2, progress=False):
            pass
        depth[gap] = floor.penetration
        close = floor.gap[floor.touching]
    assert depth[None] > 1e-4
    assert depth[1e-5] <= 1e-5
    assert np.abs(close).max() <= 1e-5


def test_a_barrier_is_never_touched():
    problem = block()
    problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, ux=0, uy=-0.02)
    floor = problem.obstacle(pm.HalfSpace((0, LOW - 0.005), (0, 1)), barrier=0.01, stiffness=1e5)
    for _ in problem.march(4, adaptive=True, progress=False):
        assert floor.gap.min() > 0.0
    assert floor.force[1] > 0.0
    assert floor.gap.min() < 0.0095


# friction -------------------------------------------------------------------------------------------------
def drag(problem, friction, **options):
    """A block pressed on a floor that then drags it against a wall."""
    problem.obstacle(pm.HalfSpace((0, LOW + 0.5), (0, -1)), motion=lambda t: (0, -0.005 * min(t, 1.0)))
    wall = problem.obstacle(pm.HalfSpace((LOW + SIZE, 0), (-1, 0)))
    motion = lambda t: (0.02 * max(0.0, t - 1.0), 0.0)  # noqa: E731
    floor = floor_of(problem, friction=friction, motion=motion, **options)
    return floor, wall


def test_a_dragged_block_slips_with_coulombs_friction():
    """The ratio of the forces is the coefficient, whatever the resets; at first most of it sticks."""
    problem = block(size=(SIZE, 0.5), basis="bspline", reset=3)
    floor, wall = drag(problem, 0.3)
    ratios, iterations = [], []
    for step in problem.march(12, to=3.0, adaptive=True, progress=False):
        ratios.append(floor.force[0] / floor.force[1])
        iterations.append(step.iterations)
    assert ratios[3] < 0.2
    assert np.isclose(ratios[-1], 0.3, rtol=1e-6)
    assert np.isclose(wall.force[0], -floor.force[0], rtol=1e-3)
    assert max(iterations) <= 15


def test_a_turned_scene_is_the_same():
    """Obstacle, body and motion turned: forces turn, too. The floor turns by its `rotation`."""
    turn = 0.5
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    found = []
    for Q in (np.eye(2), R):
        square = mesh.create_rectangle(COMM, [(0, 0), (1, 0.5)], [4, 2], mesh.CellType.quadrilateral)
        square.geometry.x[:, :2] = square.geometry.x[:, :2] @ Q.T
        problem = pm.QuasiStaticFEM(pm.Elements(square, material=NEO_HOOKEAN, degree=1))
        angle = 0.0 if Q is not R else turn
        floor = problem.obstacle(
            pm.HalfSpace((0, 0), (0, 1)),
            friction=0.4,
            motion=lambda t, Q=Q: Q @ (0.0, 0.004 * t),
            rotation=lambda t, angle=angle: angle,
        )
        down = Q @ (0.002, 0.0)
        held = lambda x, Q=Q: (x @ Q)[:, 1] > 0.5 - 1e-9  # noqa: E731
        problem.fix(held, u=lambda t, down=down: down * t)
        for _ in problem.march(3, progress=False):
            pass
        found.append(floor.force @ Q)
    assert np.allclose(found[0], found[1], rtol=1e-6)
    assert found[0][0] < 0.0 < found[0][1]


def test_rolling_resistance_is_capped():
    """The microrotation of a block on a turning floor: the couple of slipping sites is their share of the
    pressure."""
    problem = block(MICROPOLAR, basis="bspline")
    problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, ux=0, uy=-0.01, theta=lambda t: 0.2 * t)
    floor = floor_of(problem, rolling=1e-3)
    for _ in problem.march(4, adaptive=True, progress=False):
        pass
    share = np.abs(floor.couple[floor.touching, 0]) / floor.pressure[floor.touching]
    assert share.max() <= 1e-3 * (1 + 1e-9)
    assert share.max() > 0.99e-3
    assert max(problem.balance().residue) < 1e-7


# runs -----------------------------------------------------------------------------------------------------
def test_restart_goes_on_to_the_same_digits(folder):
    def make():
        problem = block(size=(SIZE, 0.5), basis="bspline", reset=3)
        return problem, *drag(problem, 0.3, gap=1e-4)

    problem, floor, _ = make()
    for step in problem.march(8, to=2.0, progress=False):
        if step.number == 5:
            pm.save_restart(problem, folder / "a.h5")
    again, same, _ = make()
    pm.load_restart(again, folder / "a.h5")
    for _ in again.march(3, to=2.0, progress=False):
        pass
    for name in ("force", "gap", "pressure", "traction"):
        assert_repeated(getattr(same, name), getattr(floor, name), name)


def test_a_failed_step_changes_nothing():
    problem = block(size=(SIZE, 0.5))
    floor, _ = drag(problem, 0.3)
    for _ in problem.march(1, progress=False):
        pass
    before = {name: np.array(a) for name, a in floor.state().items()}
    tight = problem.controls
    problem.controls = pm.Controls(max_iterations=1, force_tolerance=1e-14)
    assert not problem.attempt(2.5).converged
    problem.controls = tight
    for name, a in floor.state().items():
        assert np.array_equal(a, before[name], equal_nan=True), name


def test_what_passes_through_in_a_step_is_refused():
    """A plate that would jump through the whole body in one step."""
    problem = block(size=(SIZE, 0.5))
    problem.fix(pm.plane(x=0.2), u=0)
    problem.obstacle(pm.HalfSpace((0, LOW + 1.6), (0, -1)), motion=(0, -2.0))
    outcome = problem.attempt(1.0)
    assert not outcome.converged
    assert "smaller steps are needed" in outcome.reason


# arguments ------------------------------------------------------------------------------------------------
FLOOR = pm.HalfSpace((0, LOW), (0, 1))


@pytest.mark.parametrize(
    ("phi", "options", "message"),
    [
        (3.0, {}, "obstacle 1: phi = 3.0: a shape (HalfSpace"),
        (pm.HalfSpace((0, 0, 0), (0, 0, 1)), {}, "3 dimensions, the body has 2"),
        (FLOOR, {"friction": -0.1}, "obstacle 1: friction = -0.1"),
        (FLOOR, {"friction": np.nan}, "obstacle 1: friction = nan"),
        (FLOOR, {"rolling": 0.1}, "a classical material has no rotations"),
        (FLOOR, {"stiffness": 0.0}, "obstacle 1: stiffness = 0.0"),
        (FLOOR, {"gap": -1.0}, "obstacle 1: gap = -1.0"),
        (FLOOR, {"gap": 1e-3, "barrier": 1e-2}, "gap = 0.001 belongs to springs"),
        (FLOOR, {"barrier": True}, "obstacle 1: barrier = True"),
        (FLOOR, {"motion": 1.0}, "obstacle 1, motion = 1.0: one number for 2 components"),
        (FLOOR, {"motion": (1, 2, 3)}, "obstacle 1, motion = (1, 2, 3)"),
        (FLOOR, {"rotation": (0, 0, 1)}, "obstacle 1, rotation = (0, 0, 1)"),
        (FLOOR, {"about": (0, 0, 0)}, "obstacle 1: about = (0, 0, 0)"),
        (FLOOR, {"name": ""}, "obstacle: name = ''"),
        (FLOOR, {"on": 3}, "obstacle 1: on = 3"),
        (FLOOR, {"on": pm.Surface.line((9, 0), (9, 1), 2)}, "it isn't on this body"),
        (lambda x: 1.0, {}, "phi doesn't depend on the place x"),
        (lambda x: x, {}, "phi returned the shape (2,)"),
        (lambda x: np.sin(x), {}, "obstacle: phi"),
        (lambda x: "far", {}, "obstacle: phi = 'far'"),
        (lambda x: x[5], {}, "obstacle: phi can't be evaluated"),
    ],
)
def test_obstacles_that_are_none(phi, options, message):
    problem = block()
    with pytest.raises(pm.InputError, match=re.escape(message)):
        problem.obstacle(phi, **options)
    assert not problem.terms


def test_a_body_that_begins_inside_is_refused():
    problem = block()
    problem.obstacle(lambda x: LOW - x[1])
    with pytest.raises(pm.InputError, match="is the sign of phi right"):
        problem.attempt(1.0)


def test_level_sets_needn_t_be_distances():
    """A disc as x^2 + y^2 - r^2 presses like one by its distance."""
    force = []
    for phi in (
        pm.Sphere((LOW + 0.5, LOW - 0.5), 0.5),
        lambda x: 7 * ((x[0] - LOW - 0.5) ** 2 + (x[1] - LOW + 0.5) ** 2 - 0.25),
        lambda x: ufl.sqrt((x[0] - LOW - 0.5) ** 2 + (x[1] - LOW + 0.5) ** 2) - 0.5,
    ):
        problem = block(basis="bspline")
        problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, ux=0, uy=-0.01)
        one = problem.obstacle(phi)
        for _ in problem.march(1, progress=False):
            pass
        force.append(one.force[1])
    assert np.isclose(force[0], force[2], rtol=1e-9)
    assert np.isclose(force[0], force[1], rtol=3e-3)


def test_sites_for_paraview_and_forces_for_tables(folder):
    problem = block(MICROPOLAR, basis="bspline")
    problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, ux=0, uy=-0.01, theta=0)
    floor = floor_of(problem, rolling=1e-3)
    ceiling = problem.obstacle(pm.HalfSpace((0, LOW + 2 * SIZE), (0, -1)))
    table = pm.Table(folder / "forces.csv", floor=lambda: floor, ceiling=lambda: ceiling.force)
    with pm.Recorder(folder / "run.pvd", problem, contact=True) as recorder, table:
        for step in problem.march(2, progress=False):
            recorder(step)
            table(step)
    pieces = sorted(path for path in (folder / "run").iterdir() if "contact" in path.name)
    assert len(pieces) == 3 * COMM.size
    found = [meshio.read(piece) for piece in pieces[-COMM.size :]]
    total = sum(
        float(
            (one.point_data["traction"][:, 1] * one.point_data["area"])[one.point_data["obstacle"] == 1].sum()
        )
        for one in found
        if len(one.points)
    )
    assert np.isclose(total, floor.force[1])
    head = (folder / "forces.csv").read_text().splitlines()[0]
    assert "floor_force_y" in head
    assert "floor_penetration" in head


@pytest.mark.parametrize("basis", ["bspline-averaged", "gimpm"])
def test_a_released_obstacle_leaves_no_nodes_behind(basis):
    """Its sites act on nodes of their points only, so that nothing is without stiffness when it is gone."""
    problem = block(basis=basis, reset=1)
    floor = floor_of(problem, friction=0.5)
    problem.body_load(force=(1.0, -10.0))
    for _ in problem.march(2, progress=False):
        pass
    assert np.allclose(floor.force, [-1.0, 10.0], rtol=1e-6)
    problem.fix(lambda x: x[:, 1] > LOW + SIZE - 0.2, u=0)
    problem.release(floor)
    for step in problem.march(1, to=1.1, progress=False):
        assert step.iterations <= 5
    assert max(problem.balance().residue) < 1e-6


@pytest.mark.parametrize("on", [None, pm.Surface.line((1, 1), (0, 1), 40)], ids=["corners", "surface"])
def test_a_ring_of_sites_counts_a_whole_turn(on):
    """A cylinder between plates against the closed form of its uniform state."""
    grid = pm.Grid.box((0, 0), (2, 2), 0.2)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN, axisymmetric=True)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None)
    problem.fix(pm.plane(y=0.0), uy=0)
    plate = pm.HalfSpace((0, 1), (0, -1))
    plate = problem.obstacle(plate, motion=lambda t: (0, -0.05 * t), on=on, gap=1e-5)
    list(problem.march(2, progress=False))
    lam, mu, along = NEO_HOOKEAN.lam, NEO_HOOKEAN.mu, 0.95
    across = scipy.optimize.brentq(lambda t: mu * (t - 1 / t) + lam * np.log(t * t * along) / t, 0.9, 1.2)
    stress = mu * (along - 1 / along) + lam * np.log(across**2 * along) / along
    assert plate.force[1] == pytest.approx(np.pi * stress, rel=2e-4)


@pytest.mark.parametrize("elements", [False, True])
def test_an_obstacle_within_the_body_is_refused(elements):
    """The boundary doesn't see it."""
    if elements:
        square = mesh.create_unit_square(COMM, 10, 10, mesh.CellType.quadrilateral)
        problem = pm.QuasiStaticFEM(pm.Elements(square, material=NEO_HOOKEAN, degree=1))
    else:
        grid = pm.Grid.box((0, 0), (1, 1), 0.1, comm=COMM)
        problem = pm.QuasiStatic(grid, pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (1, 1))))
    problem.obstacle(pm.Sphere((0.5, 0.5), 0.2))
    with pytest.raises(pm.InputError, match="begins within the body"):
        problem.attempt(1.0)


def test_a_body_that_begins_a_little_inside_is_told():
    problem = block()
    problem.obstacle(lambda x: x[1] - LOW - 0.1)
    told = pytest.warns(pm.TrustWarning, match=re.escape("0.5 cells; it is pushed out"))
    with told if COMM.rank == 0 else nullcontext():
        problem.system_at(1.0)


def test_a_point_alone_is_refused():
    grid = pm.Grid((0.0, 0.0), (1.0, 1.0), (2, 2), COMM)
    points = pm.seed(grid, bounds=((0.5, 0.5), (1.0, 1.0)), material=NEO_HOOKEAN, points_per_cell=1)
    problem = pm.QuasiStatic(grid, points)
    with pytest.raises(pm.InputError, match="one material point alone"):
        problem.obstacle(pm.HalfSpace((0, 0), (0, 1)))
