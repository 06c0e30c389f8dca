"""Rigid bodies with a mass that bodies of points and elements push, in statics and dynamics."""

import math
import re

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm
from tests.conftest import COMM

GRAVITY = 9.81


def bed(h=0.1, young=1e5, nu=0.3):
    """An elastic block of 1 x 0.3 m, as points, on the lower wall of its grid."""
    box = pm.Grid.box((-0.2, 0.0), (1.2, 0.6), h, comm=COMM)
    material = pm.NeoHookean.from_engineering(E=young, nu=nu)
    return box, pm.seed(box, material=material, bounds=((0.0, 0.0), (1.0, 0.3)))


def dropped(rho_inf=1.0, mass=40.0):
    """A heavy disc that hits a bed in free flight, beside its middle, with a spin."""
    grid, points = bed()
    problem = pm.Dynamic(grid, points, density=1000.0, rho_inf=rho_inf)
    centre, radius = (0.45, 0.43), 0.1
    ball = pm.RigidBody(
        centre, mass=mass, inertia=0.5 * mass * radius**2, velocity=(0.5, -2.0), spin=3.0, name="ball"
    )
    problem.obstacle(pm.Sphere(centre, radius), friction=0.3, body=ball)
    return problem, ball


def totals(problem, ball):
    return ball.momentum + problem.momentum(), ball.angular_momentum() + problem.angular_momentum()


def test_a_ball_that_is_dropped_keeps_all_momenta(folder):
    problem, ball = dropped()
    momentum, turning = totals(problem, ball)
    pushed = np.zeros(2)
    for step in problem.march(0.06, dt=3e-3, progress=False):
        pushed += 3e-3 * ball.contact_force
        if step.number == 12:
            pm.save_restart(problem, folder / "a.h5")
    assert ball.velocity[1] > -1.0  # it has been slowed down
    assert ball.spin[0] < 2.0
    assert np.allclose(pushed, ball.momentum - 40.0 * np.array([0.5, -2.0]), atol=1e-11 * 80)
    now, turned = totals(problem, ball)
    assert np.allclose(now, momentum, atol=1e-9 * np.abs(momentum).max())
    assert np.allclose(turned, turning, atol=1e-9 * abs(turning[0]))
    lost = problem.energies()
    assert abs(lost["residue"]) < 2e-3 * 0.5 * 40.0 * 4.25
    other, _ = dropped(mass=41.0)
    with pytest.raises(pm.InputError, match="mass is 40"):
        pm.load_restart(other, folder / "a.h5")
    again, same = dropped()
    pm.load_restart(again, folder / "a.h5")
    for _ in again.march(0.06, steps=8, progress=False):
        pass
    assert np.allclose(same.centre, ball.centre, rtol=1e-12)
    assert np.allclose(same.velocity, ball.velocity, rtol=1e-9)
    if COMM.size == 1:
        assert np.array_equal(same.centre, ball.centre)
        assert np.array_equal(same.spin, ball.spin)


@pytest.mark.parametrize("elements", [False, True])
def test_a_footing_settles_and_tilts(elements):
    """On soft springs of its surface: depth P / k A, tilt P e / k I."""
    k, width, push, off = 1e4, 0.8, -30.0, 0.05
    if elements:
        shape = mesh.create_rectangle(COMM, [(0, 0), (1, 0.3)], [20, 3], mesh.CellType.quadrilateral)
        material = pm.NeoHookean.from_engineering(E=1e9, nu=0.0)
        problem = pm.QuasiStaticFEM(pm.Elements(shape, material=material, degree=1))
        problem.fix(lambda x: x[:, 1] < 1e-9, ux=0, uy=0)
        places, width = (lambda x: x[:, 1] > 0.3 - 1e-9), 1.0
    else:
        grid, points = bed(young=1e9, nu=0.0)
        problem = pm.QuasiStatic(grid, points)
        problem.fix(pm.plane(y=0.0), ux=0, uy=0)
        x = (np.arange(80) + 0.5) / 100 + 0.1
        places = pm.Surface(
            np.column_stack([x, np.full(80, 0.3)]), np.full(80, 0.01), np.tile((0.0, 1.0), (80, 1))
        )
    plate = pm.RigidBody((0.5, 0.35), force=(0.0, push), moment=off * push, held=["ux"])
    problem.obstacle(pm.HalfSpace((0.5, 0.3), (0, -1)), on=places, body=plate, stiffness=k)
    for step in problem.march(2, progress=False):
        assert step.iterations <= 6
    depth, tilt = -push / (k * width), off * push / (k * width**3 / 12)
    assert plate.displacement[1] == pytest.approx(-depth, rel=3e-3)
    assert plate.turn == pytest.approx(tilt, rel=1e-2)
    assert plate.contact_force[1] == pytest.approx(-push, rel=1e-9)
    assert plate.contact_moment[0] == pytest.approx(-off * push, rel=1e-9)
    assert plate.reaction["ux"] == pytest.approx(-plate.contact_force[0], rel=1e-9)


@pytest.mark.slow
def test_a_weight_on_a_column_swings():
    """With the frequency of a bar with a mass at its end, x tan x = mass of the bar over the mass; the column
    carries the weight before."""
    young, density, mass, height, h = 1e5, 100.0, 60.0, 1.0, 0.125
    grid = pm.Grid.box((0.0, 0.0), (0.75, 1.5), h, comm=COMM)
    points = pm.seed(
        grid, material=pm.Hencky.from_engineering(E=young, nu=0.0), bounds=((0, 0), (0.5, height))
    )
    start = pm.QuasiStatic(grid, points)
    start.fix(pm.plane(y=0.0), uy=0)
    start.fix(pm.plane(x=0.0), ux=0)
    weight = pm.RigidBody((0.25, 1.25), mass=mass, gravity=(0.0, -0.05 * GRAVITY), held=["ux", "w"])
    start.obstacle(pm.HalfSpace((0, height), (0, -1)), body=weight)
    for _ in start.march(2, progress=False):
        pass
    assert weight.displacement[1] == pytest.approx(-0.05 * mass * GRAVITY * height / (young * 0.5), rel=0.02)
    problem = pm.Dynamic.of(start, density=density, rho_inf=1.0)
    moving = next(term for term in problem.terms if isinstance(term, pm.RigidBody))
    moving.velocity = np.array([0.0, -0.01])
    low, high = 0.0, 0.5 * math.pi - 1e-9
    ratio = density * 0.5 * height / mass
    for _ in range(60):
        x = 0.5 * (low + high)
        low, high = (x, high) if x * math.tan(x) < ratio else (low, x)
    period = 2 * math.pi / (x * math.sqrt(young / density) / height)
    rest, times, speeds = moving.centre[1], [0.0], [-0.01]
    for step in problem.march(1.1 * period, steps=44, progress=False):
        times.append(step.time)
        speeds.append(moving.velocity[1])
    assert abs(moving.centre[1] - rest) < 1e-2
    found = least_period(np.array(times), np.array(speeds))
    assert found == pytest.approx(period, rel=6e-3)


def least_period(times, values):
    """Of a cosine with its amplitude and phase, by least squares."""
    best = None
    for period in np.linspace(0.5, 2.0, 3001) * times[-1]:
        basis = np.column_stack([np.cos(2 * np.pi * times / period), np.sin(2 * np.pi * times / period)])
        rest = np.linalg.lstsq(basis, values, rcond=None)[1]
        if best is None or rest[0] < best[0]:
            best = rest[0], period
    return best[1]


@pytest.mark.slow
def test_a_block_slides_until_friction_has_stopped_it():
    """On an elastic bed, after v^2 / 2 mu g."""
    friction, speed, mass = 0.3, 1.0, 20.0
    grid = pm.Grid.box((-0.2, -0.2), (1.2, 0.4), 0.1, comm=COMM)
    material = pm.NeoHookean.from_engineering(E=2e6, nu=0.0)
    points = pm.seed(grid, material=material, bounds=((0.0, -0.2), (1.0, 0.0)))
    start = pm.QuasiStatic(grid, points)
    start.fix(pm.plane(y=-0.2), ux=0, uy=0)
    block = pm.RigidBody((0.5, 0.1), mass=mass, inertia=mass * 0.2 / 12, gravity=(0, -GRAVITY))
    start.obstacle(pm.Box((0.3, 0.0), (0.7, 0.2)), friction=friction, body=block)
    for _ in start.march(1, progress=False):
        pass
    problem = pm.Dynamic.of(start, density=100.0, rho_inf=0.5)
    moving = next(term for term in problem.terms if isinstance(term, pm.RigidBody))
    moving.velocity, before = np.array([speed, 0.0]), moving.centre[0]
    for _ in problem.march(0.45, dt=0.015, progress=False):
        pass
    assert moving.centre[0] - before == pytest.approx(speed**2 / (2 * friction * GRAVITY), rel=0.02)
    assert abs(moving.velocity[0]) < 0.03 * speed
    assert abs(moving.turn) < 1e-3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"mass": -1.0}, "mass = -1"),
        ({"mass": 1.0, "inertia": 0.0}, "inertia = 0"),
        ({"mass": 1.0, "held": ["uz"]}, "held = 'uz'"),
        ({"mass": 1.0}, "inertia = None"),
        ({"inertia": 1.0}, "mass = None"),
        ({"gravity": (0, -1)}, "gravity"),
        ({"mass": 1.0, "inertia": 1.0, "velocity": (1.0, 0.0, 0.0)}, "velocity"),
    ],
)
def test_what_is_refused(options, said):
    grid, points = bed()
    problem = pm.Dynamic(grid, points, density=1000.0)
    with pytest.raises(pm.InputError, match=re.escape(said)):
        problem.obstacle(pm.Sphere((0.5, 0.5), 0.1), body=pm.RigidBody((0.5, 0.5), **options))


def test_more_that_is_refused():
    grid, points = bed()
    problem, ball = pm.Dynamic(grid, points, density=1000.0), pm.RigidBody((0.5, 0.5), mass=1.0, inertia=1.0)
    ball_shape = pm.Sphere((0.5, 0.5), 0.1)
    with pytest.raises(pm.InputError, match=re.escape("moves by itself")):
        problem.obstacle(ball_shape, body=ball, motion=(0, 1))
    with pytest.raises(pm.InputError, match=re.escape("polarmpm.RigidBody is")):
        problem.obstacle(ball_shape, body=3.0)
    with pytest.raises(pm.InputError, match=re.escape("depends on t")):
        problem.obstacle(lambda x, t: x[1] - 0.5 - t, body=ball)
    with pytest.raises(pm.InputError, match=re.escape("3 dimensions")):
        problem.obstacle(ball_shape, body=pm.RigidBody((0.5, 0.5, 0.0), mass=1.0, inertia=1.0))
    with pytest.raises(pm.InputError, match=re.escape("velocity")):
        pm.QuasiStatic(grid, points).obstacle(ball_shape, body=pm.RigidBody((0.5, 0.5), velocity=(1, 0)))


def pressed(scale=1.0, **options):
    """A static bed, on metres or other lengths."""
    box = pm.Grid.box((-0.2 * scale, 0.0), (1.2 * scale, 0.6 * scale), 0.1 * scale, comm=COMM)
    material = pm.NeoHookean.from_engineering(E=1e5 / scale**2, nu=0.3)
    points = pm.seed(box, material=material, bounds=((0.0, 0.0), (1.0 * scale, 0.3 * scale)))
    problem = pm.QuasiStatic(box, points, **options)
    problem.fix(pm.plane(y=0), u=0)
    return problem


BALL = pm.Sphere((0.5, 0.5), 0.2)


def test_what_is_held_moves_like_an_obstacle():
    one, other = pressed(), pressed()
    ball = pm.RigidBody((0.5, 0.5), held={"ux": 0, "uy": -0.02, "w": 0.1})
    held = one.obstacle(BALL, friction=0.5, body=ball)
    options = {"motion": (0, -0.02), "rotation": 0.1, "about": (0.5, 0.5)}
    led = other.obstacle(BALL, friction=0.5, **options)
    for problem in (one, other):
        list(problem.march(2, progress=False))
    assert np.allclose(held.force, led.force, rtol=1e-9)
    assert np.allclose(held.moment, led.moment, rtol=1e-9)
    assert ball.turn == pytest.approx(0.1, rel=1e-14)
    found = [ball.reaction[k] for k in ("ux", "uy", "w")]
    force, arm = -np.asarray(held.force), np.array([0.5, 0.48])
    moment = -held.moment[0] - (arm[0] * force[1] - arm[1] * force[0])
    assert np.allclose(found, [-force[0], -force[1], -moment], rtol=1e-9)


@pytest.mark.parametrize("solver", ["auto", "multigrid"])
def test_metres_or_millimetres(solver):
    found = []
    for scale in (1.0, 1e3):
        problem, middle = pressed(scale, solver=solver), (0.5 * scale, 0.5 * scale)
        ball = pm.RigidBody(middle, force=(30 / scale, -300 / scale), held=["w"])
        problem.obstacle(pm.Sphere(middle, 0.2 * scale), friction=0.9, body=ball)
        list(problem.march(2, progress=False))
        found.append(ball.displacement / scale)
    assert np.allclose(*found, rtol=1e-7)


def test_a_body_of_two_discs_that_share_the_load():
    problem = pressed()
    pair = pm.RigidBody((0.5, 0.35), force=(0, -300.0), held=["ux"])
    discs = [problem.obstacle(pm.Sphere((x, 0.4), 0.1), body=pair, gap=1e-5) for x in (0.3, 0.7)]
    list(problem.march(2, progress=False))
    assert np.allclose([disc.force[1] for disc in discs], -150.0, rtol=1e-7)
    assert abs(pair.turn) < 1e-9
    assert max(disc.penetration for disc in discs) < 1e-5


def test_nothing_holds_it():
    problem = pressed()
    problem.obstacle(BALL, body=pm.RigidBody((0.5, 0.5), force=(100.0, -10.0)))
    with pytest.raises(pm.NotConverged, match="does anything hold it"):
        list(problem.march(1, progress=False))


def of_revolution(**options):
    """A ball above a thick disc, both of revolution; a circle around the axis is one number here."""
    grid = pm.Grid.box((0.0, 0.0), (0.6, 0.6), 0.05, comm=COMM)
    material = pm.NeoHookean.from_engineering(E=1e5, nu=0.3)
    points = pm.seed(grid, material=material, bounds=((0.0, 0.0), (0.5, 0.3)), axisymmetric=True)
    kind = pm.Dynamic if "velocity" in options else pm.QuasiStatic
    inertia = {"density": 1000.0, "rho_inf": 1.0} if kind is pm.Dynamic else {}
    problem = kind(grid, points, **inertia)
    problem.fix(pm.plane(x=0.0), ux=0)
    ball = pm.RigidBody((0.0, 0.4 + 1e-6), **options)
    problem.obstacle(pm.Sphere((0.0, 0.4 + 1e-6), 0.1), friction=0.3, body=ball)
    return problem, ball


def test_a_ball_of_revolution_falls():
    """Along the axis; what it loses of its momentum goes to the whole disc."""
    problem, ball = of_revolution(mass=3.0, velocity=(0.0, -1.0))
    for _ in problem.march(0.03, dt=3e-3, progress=False):
        pass
    assert ball.velocity[1] > -0.9
    assert ball.velocity[0] == ball.displacement[0] == ball.turn == ball.contact_force[0] == 0.0
    along = problem.momentum()[1] + ball.momentum[1]
    assert along == pytest.approx(-3.0, rel=1e-9)
    assert ball.reaction == {"ux": 0.0, "w": 0.0}


def test_a_ball_of_revolution_is_pressed():
    """As far as one that is moved to where it is needs the same force."""
    problem, ball = of_revolution(force=(0.0, -20.0))
    problem.fix(pm.plane(y=0.0), uy=0)
    for _ in problem.march(2, progress=False):
        pass
    assert ball.contact_force == pytest.approx([0.0, 20.0], rel=1e-9)
    other, moved = of_revolution(held={"uy": float(ball.displacement[1])})
    other.fix(pm.plane(y=0.0), uy=0)
    for _ in other.march(2, progress=False):
        pass
    assert moved.contact_force[1] == pytest.approx(20.0, rel=1e-3)
    assert moved.reaction["uy"] == pytest.approx(-20.0, rel=1e-3)
    for options, said in (
        ({"velocity": (1.0, 0.0), "mass": 1.0}, "velocity"),
        ({"spin": 1.0, "velocity": (0.0, 0.0), "mass": 1.0}, "spin"),
        ({"held": {"ux": 0.1}}, "held"),
    ):
        with pytest.raises(pm.InputError, match=f"{said} = .*on the axis"):
            of_revolution(**options)
