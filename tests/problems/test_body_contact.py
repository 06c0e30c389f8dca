"""Contact of bodies with each other, on common nodes."""

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated, by_id

SUM = MPI.SUM
FACE = 0.53  # m: where the blocks meet, within a cell


def blocks(material=NEO_HOOKEAN, per_cell=(2, 3), upper=(0.1, 1.1), gap=0.0, cell=0.2, **options):
    """Two blocks on each other whose points don't match."""
    grid = pm.Grid.box((0, 0), (1.2, 1.4), cell, COMM)
    low = pm.seed(grid, bounds=((0.1, 0), (1.1, FACE)), material=material, points_per_cell=per_cell[0])
    high = (upper[1], FACE + gap + 0.6)
    top = pm.seed(grid, bounds=((upper[0], FACE + gap), high), material=material, points_per_cell=per_cell[1])
    low.join(top, apart=True)
    return pm.QuasiStatic(grid, low, **options)


def spread_of(values):
    low, high = COMM.allreduce(values.min(initial=np.inf), MPI.MIN), COMM.allreduce(values.max(), MPI.MAX)
    return (high - low) / max(abs(high), abs(low))


@pytest.mark.parametrize(("basis", "reset"), [("mpm", None), ("gimpm", 1)])
def test_patch(basis, reset):
    """Blocks between walls, pressed upon each other: the stress is the same everywhere."""
    problem = blocks(basis=basis, locking=None, reset=reset)
    problem.fix(pm.plane(y=0), uy=0)
    walls = [problem.obstacle(lambda x: x[0] - 0.1), problem.obstacle(lambda x: 1.1 - x[0])]
    plate = problem.obstacle(pm.HalfSpace((0, FACE + 0.6), (0, -1)), motion=lambda t: (0, -0.02 * t))
    contact = problem.contact()
    for step in problem.march(2, progress=False):
        assert step.iterations <= 4
    assert spread_of(problem.fields("stress").stress[:, 1, 1]) < 1e-3
    assert np.ptp(contact.pressure[contact.touching]) < 1e-3 * contact.pressure.max()
    assert contact.force[1] == pytest.approx(plate.force[1], rel=1e-3)
    assert np.abs(contact.forces.sum(axis=0)).max() < 1e-12 * abs(contact.force[1])
    assert np.abs(contact.moments.sum(axis=0)).max() < 1e-12 * abs(contact.force[1])
    assert walls[0].force[0] == pytest.approx(-walls[1].force[0], rel=1e-4)
    assert max(problem.balance().residue) < 1e-8


@pytest.mark.parametrize("basis", ["bspline", "gimpm", "bspline-averaged", "bspline3"])
@pytest.mark.parametrize("balanced", [True, False])
def test_sliding_block(basis, balanced):
    """A pressed block sticks, then slides with Coulomb's friction, over the end of a cell."""
    material = MICROPOLAR if basis == "bspline" else NEO_HOOKEAN
    reset = 2 if balanced else None
    problem = blocks(material, upper=(0.3, 0.9), basis=basis, reset=reset, balanced_reset=balanced)
    turns = {"theta": 0} if problem.layout.rotations else {}
    problem.fix(pm.plane(y=0), u=0, **turns)
    way = [0.0, 0.0, 0.001, 0.04, 0.08]
    problem.fix(
        lambda x: x[:, 1] > FACE + 0.5,
        uy=lambda t: -0.01 * min(t, 1.0),
        ux=lambda t: np.interp(t, range(len(way)), way),
    )
    contact, found = problem.contact(friction=0.3), []
    for _ in problem.march(4, to=4.0, progress=False):
        force, most = contact.force, np.hypot(1.0, 0.3)
        found.append(force[0] / -force[1])
        pulled = (
            np.linalg.norm(contact.traction, axis=1)[contact.touching] / contact.pressure[contact.touching]
        )
        assert pulled.max() < most + 1e-4
        assert np.abs(contact.forces.sum(axis=0)).max() < 1e-12 * abs(force[1])
        assert max(problem.balance().residue) < 1e-8
    assert abs(found[0]) < 0.05
    assert 0.01 < abs(found[1]) < 0.29
    assert np.abs(found[2:]) == pytest.approx(0.3, rel=0.04)  # the surface isn't quite flat
    assert pulled == pytest.approx(most, abs=1e-4)
    assert len(contact.gap) == len(contact.area) == len(contact.body)


def test_augmentation():
    """Multipliers close the gap, whatever the springs."""
    depth = {}
    for gap in (None, 2e-6):
        problem = blocks(basis="mpm")
        problem.fix(pm.plane(y=0), u=0)
        problem.fix(lambda x: x[:, 1] > FACE + 0.5, ux=0, uy=-0.01)
        contact = problem.contact(gap=gap)
        for _ in problem.march(2, progress=False):
            pass
        depth[gap] = contact.penetration
    assert depth[2e-6] <= 2e-6 < depth[None]


def test_a_gap_is_closed_first():
    """Nothing is felt before the surfaces touch, although they share cells; then both are pressed."""
    problem = blocks(basis="bspline", gap=0.011, reset=None)
    problem.fix(pm.plane(y=0), u=0)
    problem.fix(lambda x: x[:, 1] > FACE + 0.5, ux=0, uy=-0.02)
    contact = problem.contact(stiffness=1e6)
    stress = []
    for _ in problem.march(4, progress=False):
        stress.append(COMM.allreduce(np.abs(problem.fields("stress").stress).max(initial=0.0), MPI.MAX))
    assert max(stress[:2]) < 1e-6
    assert stress[2] > 1.0
    assert contact.touching.any()


def test_released_bodies_part():
    problem = blocks(basis="bspline")
    problem.fix(pm.plane(y=0), u=0)
    problem.fix(lambda x: x[:, 1] > FACE + 0.5, ux=0, uy=lambda t: -0.01 * min(t, 1.0))
    contact = problem.contact(name="joint")
    for _ in problem.march(1, progress=False):
        pass
    assert contact.force[1] < -1.0
    problem.release(contact)
    for _ in problem.march(1, to=2.0, progress=False):
        pass
    assert np.abs(problem.fields("stress").stress).max(initial=0.0) < 1e-6


def discs(reset=None, basis="bspline", friction=0.2, cell=0.1, per_cell=4, apart=0.05):
    """Two that meet, not in the line of their middles."""
    middles = np.array([[0.0, 0.0], [0.4 + apart, 0.15]])
    grid = pm.Grid.box((-0.4, -0.4), (0.9, 0.6), cell, COMM)

    def disc(middle):
        inside = lambda x: np.linalg.norm(x - middle, axis=1) <= 0.2  # noqa: E731
        return pm.seed(grid, inside, material=pm.NeoHookean(600.0, 400.0), points_per_cell=per_cell)

    points = disc(middles[0])
    points.join(disc(middles[1]), apart=True)
    problem = pm.Dynamic(grid, points, density=1e3, rho_inf=1.0, basis=basis, reset=reset, locking=None)
    first = points.where(lambda x: x[:, 0] < 0.2)
    problem.velocity(v=(-0.1, 0.0))
    problem.velocity(first, v=(0.1, 0.0))
    arcs = [pm.Surface.arc(middle, 0.2, 80) for middle in middles]
    return problem, problem.contact(on=arcs, friction=friction)


@pytest.mark.parametrize("reset", [None, 3])
def test_discs_keep_their_momenta(reset):
    """Linear and angular momentum to rounding, with friction; felt when they touch."""
    problem, contact = discs(reset)
    spin = problem.angular_momentum()
    energy = problem.energies()["kinetic"]
    for step in problem.march(1.2, steps=30, progress=False):
        if not contact.touching.any():
            assert problem.energies()["stored"] < 1e-12 * energy
        assert step.iterations <= 8
        assert np.abs(problem.momentum()).max() < 1e-11
        assert np.abs(problem.angular_momentum() - spin).max() < 1e-9 * np.abs(spin).max()
        assert np.abs(contact.moments.sum(axis=0)).max() <= 1e-11 * np.abs(contact.force).max()
    assert contact.touching.any()
    assert np.linalg.norm(contact.force) > 0.1


def test_restart_goes_on_to_the_same_digits(folder):
    """In the middle of sliding contact, between two resets."""
    states = []
    for restarted in (False, True):
        problem, contact = discs(apart=0.01)
        if restarted:
            pm.load_restart(problem, folder / "a.h5")
        for step in problem.march(0.6, dt=0.04, progress=False):
            if step.number == 12 and not restarted:
                pm.save_restart(problem, folder / "a.h5")
        assert contact.touching.any()
        states.append((by_id(problem.points, problem.points.x), contact.pressure, contact.slip))
    for once, again in zip(*states, strict=True):
        assert_repeated(again, once)


def test_restart_where_sites_have_moved_to_other_cells(folder):
    """What carries sites is found where they were when increments began to count."""
    states = []
    for restarted in (False, True):
        grid = pm.Grid.box((0, 0), (3, 3), 0.25, COMM)
        points = pm.seed(grid, bounds=((0, 0), (2, 1)), material=NEO_HOOKEAN)
        points.join(pm.seed(grid, bounds=((0.1, 1), (2.1, 2)), material=NEO_HOOKEAN), apart=True)
        problem = pm.QuasiStatic(grid, points)
        problem.fix(pm.plane(y=0), u=0)
        problem.body_load(force=(0, -10.0))
        contact = problem.contact(friction=0.5)
        if restarted:
            pm.load_restart(problem, folder / "a.h5")
        else:
            list(problem.march(2, to=0.5, progress=False))
            pm.save_restart(problem, folder / "a.h5")
        list(problem.march(1, to=0.75, progress=False))
        states.append((by_id(points, points.x), contact.pressure))
    assert states[0][1].max() > 1.0
    for once, again in zip(*states, strict=True):
        assert_repeated(again, once)


def test_stack_in_space_with_three_bodies():
    """Blocks under their own weight: what they carry grows downwards; their points' faces find each other."""
    grid = pm.Grid.box((0, 0, 0), (1.2, 1.2, 1.6), 0.4, COMM)
    size, low = (0.13, 0.13), 0.0
    points = None
    for height in (0.4, 0.5, 0.3):
        bounds = (*size, low), (0.87, 0.87, low + height)
        block = pm.seed(grid, bounds=bounds, material=NEO_HOOKEAN, points_per_cell=2)
        low += height
        if points is None:
            points = block
        else:
            points.join(block, apart=True)
    assert points.bodies == 3
    problem = pm.QuasiStatic(grid, points, basis="mpm", locking=None)
    problem.fix(pm.plane(z=0), u=0)
    problem.body_load(force=(0, 0, -50.0))
    contact = problem.contact(friction=0.4)
    for _ in problem.march(2, progress=False):
        pass
    weight = 50.0 * 0.74**2
    assert contact.forces[:, 2] / weight == pytest.approx([-0.8, 0.5, 0.3], rel=1e-6)
    assert np.abs(contact.forces[:, :2]).max() < 1e-6 * weight
    assert max(problem.balance().residue) < 1e-8


def test_separated_points_are_a_body():
    """Selections that `separate` takes away behave as sets that join apart; others stay welded."""
    grid = pm.Grid.box((0, 0), (2, 1), 0.25, COMM)
    points = pm.seed(grid, bounds=((0.1, 0.1), (1.9, 0.9)), material=NEO_HOOKEAN, points_per_cell=2)
    points.separate(points.where(lambda x: x[:, 0] > 1.5))
    points.separate(points.where(lambda x: x[:, 0] < 0.5))
    assert points.bodies == 3
    problem = pm.QuasiStatic(grid, points)
    problem.fix(lambda x: x[:, 0] < 0.2, ux=0, uy=0)
    problem.fix(lambda x: (x[:, 0] > 0.8) & (x[:, 0] < 1.2), ux=0, uy=0)
    problem.fix(lambda x: x[:, 0] > 1.8, uy=0, ux=0.1)
    for _ in problem.march(1, progress=False):
        pass
    x, X, body = points.x, points.X, points.body
    assert np.allclose((x - X)[body == 0], 0.0, atol=1e-9)
    assert np.allclose((x - X)[body == 1], (0.1, 0.0), atol=1e-9)


def test_chosen_selections_only():
    """Of three bodies in a row two are told to touch; the third one goes through."""
    problem = blocks(basis="mpm")
    points = problem.points
    with pytest.raises(pm.InputError, match="points of body 0 are in both"):
        problem.contact(points.where(lambda x: x[:, 1] < 0.3), points.where(lambda x: x[:, 1] < FACE))
    with pytest.raises(pm.InputError, match="both or none"):
        problem.contact(points.where(lambda x: x[:, 1] < 0.3))
    contact = problem.contact(
        points.where(lambda x: x[:, 1] > FACE), points.where(lambda x: (x[:, 1] < FACE) & (x[:, 0] < 0.6))
    )
    problem.fix(pm.plane(y=0), u=0)
    problem.fix(lambda x: x[:, 1] > FACE + 0.5, ux=0, uy=-0.005)
    for _ in problem.march(1, progress=False):
        pass
    assert contact.force[1] > 1.0  # on the upper one, the first of the two
    assert contact.x[contact.touching][:, 0].max() < 0.7


def test_mistakes_are_named(folder):
    grid = pm.Grid.box((0, 0), (1, 1), 0.25, COMM)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN)
    one_body = pm.QuasiStatic(grid, points)
    with pytest.raises(pm.InputError, match="the points are one body"):
        one_body.contact()
    with pytest.raises(pm.InputError, match="contains all points"):
        points.separate(points.where(lambda x: x[:, 0] > -1))
    with pytest.raises(pm.InputError, match="contains no point"):
        points.separate(points.where(lambda x: x[:, 0] > 2))
    problem = blocks()
    with pytest.raises(pm.InputError, match="friction = -1"):
        problem.contact(friction=-1)
    with pytest.raises(pm.InputError, match="gap = 0"):
        problem.contact(gap=0.0)
    with pytest.raises(pm.InputError, match="of two at least"):
        problem.contact(on=pm.Surface.line((1.1, FACE), (0.1, FACE), 4))
    with pytest.raises(pm.InputError, match="'direct' is allowed"):
        blocks(basis="mpm", assembly="projection", locking=None)
    inside = blocks(gap=-0.15)
    inside.fix(pm.plane(y=0), u=0)
    inside.contact()
    with pytest.raises(pm.InputError, match="inside of each other"):
        inside.attempt(1.0)


def test_supports_of_one_body():
    """Nodes of the lower body alone are held where both have some."""
    problem = blocks(basis="mpm", locking=None)
    held = lambda x: np.abs(x[:, 1] - 0.6) < 0.21  # noqa: E731
    problem.fix(held, body=0, u=0)
    problem.fix(lambda x: x[:, 1] > 1.1, body=1, ux=0, uy=-0.02)
    problem.contact()
    before = problem.points.x.copy()
    list(problem.march(1, progress=False))
    moved = np.abs(problem.points.x - before)
    of = problem.points.body
    near = before[:, 1] > 0.41
    assert np.all(moved[(of == 0) & near] < 1e-12)
    assert problem.comm.allreduce(moved[of == 1].max(initial=0.0), MPI.MAX) > 0.01
    for bad, body in (("body = 2", 2), ("body = True", True), ("body = 'a'", "a")):
        with pytest.raises(pm.InputError, match=f"fix: {bad}"):
            problem.fix(held, body=body, u=0)
    alone = pm.QuasiStatic(problem.grid, pm.seed(problem.grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN))
    with pytest.raises(pm.InputError, match="one body only"):
        alone.fix(held, body=0, u=0)
