"""Boxes cut by a body's surface: volumes, centroids, second moments, symmetries, ranks."""

from __future__ import annotations

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.bodies.cutboxes import half_axes, inside_parts
from tests.conftest import COMM, MICROPOLAR, by_id, rotation
from tests.helpers.demos import demo_module


def in_block(x: np.ndarray, size, centre, angle: float) -> np.ndarray:
    """Whether points are in a block turned about z by an angle."""
    turned = (x - np.asarray(centre)) @ rotation([0.0, 0.0, angle])[: x.shape[1], : x.shape[1]]
    inside: np.ndarray = np.all(np.abs(turned) <= 0.5 * np.asarray(size), axis=1)
    return inside


def total(points: pm.Points, values: np.ndarray | float = 1.0):
    """Integral over the body of what is given for each point."""
    each = np.broadcast_to(values, (len(points), *np.shape(values)[1:]))
    return COMM.allreduce(np.tensordot(points.volume0, each, axes=1))


# one box ------------------------------------------------------------------------------------------
def wedge(dim: int, reach: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centroid and second moments of a simplex at the origin that reaches along the axes."""
    volume = float(np.prod(reach)) / (2.0 if dim == 2 else 6.0)
    square = (np.eye(dim) * (dim + 1.0) - 1.0) * np.multiply.outer(reach, reach)
    return volume, reach / (dim + 1), square / ((dim + 1) ** 2 * (dim + 2))


@pytest.mark.parametrize("share", [0.04, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_corner_cut_off_by_a_plane(dim, share):
    """A simplex in the corner of a box that isn't a cube, in closed form."""
    half = np.array([0.3, 0.5, 0.2])[:dim]
    reach, corner = 2 * half * share * np.array([1.0, 0.6, 0.8])[:dim], np.array([1.0, -2.0, 0.5])[:dim]
    x = (corner + half)[None]
    part = inside_parts(x, half[None], lambda y: np.sum((y - corner) / reach, axis=1) <= 1.0)
    volume, centre, square = wedge(dim, reach)
    assert part.cut.tolist() == [True]
    assert part.share[0] * np.prod(2 * half) == pytest.approx(volume, rel=1e-3)
    np.testing.assert_allclose(part.centre[0] - corner, centre, rtol=1e-3)
    np.testing.assert_allclose(part.covariance[0], square, atol=1e-3 * np.abs(square).max())
    axes = half_axes(part.covariance)[0]
    np.testing.assert_allclose(axes, axes.T, rtol=1e-12)
    np.testing.assert_allclose(axes.T @ axes / 3, part.covariance[0], rtol=1e-12)


@pytest.mark.parametrize("plane", [0.003, 0.25, 0.5, 0.61, 0.98])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_box_cut_across_is_a_box(axis, plane):
    """Its thickness is the plane's distance from the face."""
    half, x = np.array([[0.3, 0.5, 0.2]]), np.array([[1.0, 2.0, 3.0]])
    at = x[0, axis] + half[0, axis] * (2 * plane - 1)
    part = inside_parts(x, half, lambda y: y[:, axis] <= at)
    thin = half[0] * np.where(np.arange(3) == axis, plane, 1.0)
    assert part.share[0] == pytest.approx(plane, abs=1e-4)
    np.testing.assert_allclose(half_axes(part.covariance)[0], np.diag(thin), atol=1e-4)
    np.testing.assert_allclose(part.centre[0, axis], at - thin[axis], atol=1e-4)


@pytest.mark.parametrize("closed", [True, False])
def test_faces_along_boxes_leave_them_whole(closed):
    """Whichever side a predicate counts its face to; rounding of the face makes no cut."""
    x = np.stack(np.meshgrid([0.5, 1.5, 2.5], [0.5, 1.5], indexing="ij"), axis=-1).reshape(-1, 2)
    for off in (0.0, 1e-12, -1e-12, 1e-8, -1e-8):
        part = inside_parts(
            x, np.full(x.shape, 0.5), lambda y, b=2.0 + off: y[:, 0] <= b if closed else y[:, 0] < b
        )
        np.testing.assert_array_equal(part.kept, [0, 1, 2, 3])
        assert not np.any(part.cut)
        np.testing.assert_array_equal(part.centre, x[:4])


# bodies -------------------------------------------------------------------------------------------
BODIES = {
    "disc": (2, lambda x: np.hypot(x[:, 0] - 0.1, x[:, 1] - 0.2) <= 1.7, np.pi * 1.7**2),
    "slab": (2, lambda x: np.abs(x[:, 1] - 0.1) <= 0.63, 8 * 1.26),
    "block": (2, partial(in_block, size=(4, 1), centre=(0.1, 0.2), angle=0.5), 4.0),
    "block at 45 degrees": (
        2,
        partial(in_block, size=(4 * 2**0.5, 0.75 * 2**0.5), centre=(0, 0), angle=np.pi / 4),
        6.0,
    ),
    "block in space": (3, partial(in_block, size=(4, 1.2, 1.1), centre=(0.1, 0.2, 0.3), angle=0.5), 5.28),
    "ball": (3, lambda x: np.linalg.norm(x - 0.15, axis=1) <= 1.7, 4 / 3 * np.pi * 1.7**3),
}


@pytest.mark.parametrize("name", BODIES)
def test_volumes_of_bodies(name):
    """Within two thousandths with the default number of points; centres to a hundredth of a cell."""
    dim, inside, volume = BODIES[name]
    points = pm.seed(pm.Grid.box((-4,) * dim, (4,) * dim, 1.0), inside, material=MICROPOLAR)
    assert total(points) == pytest.approx(volume, rel=2e-3)
    centre = {"disc": (0.1, 0.2), "slab": (0.0, 0.1), "block": (0.1, 0.2), "ball": (0.15,) * 3}.get(name)
    if centre:
        np.testing.assert_allclose(total(points, points.x) / volume, centre, atol=0.01)
    assert np.all(inside(points.x))


def test_second_moments_of_a_turned_block():
    """About its axes: a twelfth of the squares of its sides, with what the boxes have themselves."""
    _, inside, volume = BODIES["block"]
    points = pm.seed(pm.Grid.box((-4, -4), (4, 4), 1.0), inside, material=MICROPOLAR)
    y = points.x - [0.1, 0.2]
    own = np.swapaxes(points.half_axes0, 1, 2) @ points.half_axes0 / 3
    square = total(points, y[:, :, None] * y[:, None, :] + own) / volume
    R = rotation([0.0, 0.0, 0.5])[:2, :2]
    np.testing.assert_allclose(R.T @ square @ R, np.diag([16 / 12, 1 / 12]), atol=4e-3)


@pytest.mark.parametrize(("y", "z"), [(-100.0, 0.0), (-99.75, 0.25), (-99.6, 0.3)])
def test_volume_of_the_arch(y, z):
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), 1.0)
    points = pm.seed(grid, demo_module("curved_cantilever").Arch(y, z), material=MICROPOLAR)
    assert total(points) == pytest.approx(100 * np.pi / 4, rel=5e-4)


@pytest.mark.parametrize("number", [1, 2, (3, 1, 2)])
@pytest.mark.parametrize("dim", [2, 3])
def test_bounds_are_the_body(dim, number):
    """Volume, centroid and second moments of the box asked for, to rounding."""
    number = number[:dim] if isinstance(number, tuple) else number
    low, high = np.array([0.1, -0.33, 2.0])[:dim], np.array([1.31, 0.6, 2.7])[:dim]
    grid = pm.Grid.box((-1.0, -0.5, 2.0)[:dim], (3.0, 1.5, 4.0)[:dim], 0.5)
    points = pm.seed(grid, material=MICROPOLAR, bounds=(low, high), points_per_cell=number)
    volume = np.prod(high - low)
    assert total(points) == pytest.approx(volume, rel=1e-13)
    np.testing.assert_allclose(total(points, points.x) / volume, 0.5 * (low + high), rtol=1e-13)
    y = points.x - 0.5 * (low + high)
    own = np.swapaxes(points.half_axes0, 1, 2) @ points.half_axes0 / 3
    square = total(points, y[:, :, None] * y[:, None, :] + own) / volume
    np.testing.assert_allclose(square, np.diag((high - low) ** 2) / 12, atol=1e-13)
    np.testing.assert_allclose(np.prod(2 * points.half_length0, axis=1), points.volume0, rtol=1e-13)


# thin bodies --------------------------------------------------------------------------------------
@pytest.mark.parametrize("dim", [2, 3])
def test_boxes_of_a_body_without_whole_ones_are_halved(dim):
    """Volume, centroid and second moments are the body's; ids and points are the same on any ranks."""
    size, centre = np.array([5.3, 0.44, 0.41])[:dim], np.array([4.2, 3.9, 3.6])[:dim]
    inside = partial(in_block, size=size, centre=centre, angle=0.4)
    grid = pm.Grid.box((0,) * dim, (8,) * dim, 1.0, COMM)
    points = pm.seed(grid, inside, material=MICROPOLAR)
    assert points.half_length0.max(initial=0.0) < 0.2501  # of a box .25
    fewer = pm.seed(grid, inside, material=MICROPOLAR, points_per_cell=1)
    assert points.total > 1.5 * fewer.total
    volume = total(points)
    assert volume == pytest.approx(np.prod(size), rel=1e-3)
    np.testing.assert_allclose(total(points, points.X) / volume, centre, atol=1e-3)
    away = points.X - centre
    square = away[:, :, None] * away[:, None, :]
    square += np.swapaxes(points.half_axes0, 1, 2) @ points.half_axes0 / 3.0
    turn = rotation([0.0, 0.0, 0.4])[:dim, :dim]
    np.testing.assert_allclose(
        total(points, square) / volume, turn @ np.diag(size**2 / 12) @ turn.T, atol=2e-3
    )
    ids, x = np.concatenate(COMM.allgather(points.id)), np.concatenate(COMM.allgather(points.X))
    alone = pm.seed(pm.Grid.box((0,) * dim, (8,) * dim, 1.0, MPI.COMM_SELF), inside, material=MICROPOLAR)
    np.testing.assert_allclose(x[np.argsort(ids)], alone.X[np.argsort(alone.id)], atol=1e-12)


def test_boxes_beside_whole_ones_stay():
    """A body in which whole boxes fit has the points that were asked for, thin tails of it too."""
    grid = pm.Grid.box((0, 0), (8, 8), 1.0, COMM)
    points = pm.seed(
        grid, partial(in_block, size=(3.0, 1.7), centre=(4.1, 4.2), angle=0.3), material=MICROPOLAR
    )
    boxes = np.floor(2 * points.X)
    assert len(np.unique(boxes, axis=0)) == len(points)


def test_predicates_are_called_with_many_positions():
    """The body's inside asks once, however many boxes there are."""
    calls = []

    def inside(x):
        calls.append(len(x))
        return np.hypot(x[:, 0], x[:, 1]) <= 30.0

    points = pm.seed(pm.Grid.box((-32, -32), (32, 32), 1.0), inside, material=MICROPOLAR)
    assert points.total > 10_000
    assert len(calls) <= 17
    assert min(calls, default=1) > 0


# symmetries ---------------------------------------------------------------------------------------
def test_shifts_turns_and_mirrors_change_nothing():
    """Of the grid and the body together, a face of it on a plane, corners anywhere: positions, volumes and
    second moments go along, to rounding."""
    for dim in (2, 3):
        size, centre = np.array([3.0, 1.2, 1.3])[:dim], np.array([0.5, 0.37, 0.2])[:dim]

        def body(x, dim=dim, size=size, centre=centre):
            cut = x[:, 0] + 0.7 * x[:, 1] <= 1.3
            return cut & np.all(np.abs(x - centre) <= size / 2, axis=1)

        turn, mirror = np.eye(dim), np.eye(dim)
        turn[:2, :2], mirror[0, 0] = [[0.0, -1.0], [1.0, 0.0]], -1.0
        plain = seeded(body, np.eye(dim), np.zeros(dim))
        for A, b in ((np.eye(dim), [7.0, -4.0, 2.0]), (turn, [0.0] * 3), (mirror, [3.0, 0.0, 0.0])):
            for expected, found in zip(plain, seeded(body, A, np.array(b)[:dim]), strict=True):
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def seeded(body, A: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """Positions, volumes and half axes of a body that A and b move, moved back, in order."""
    dim = len(b)
    corners = np.sort(np.stack([A @ np.full(dim, -3.0) + b, A @ np.full(dim, 3.0) + b]), axis=0)
    grid = pm.Grid.box(tuple(corners[0]), tuple(corners[1]), 1.0)
    points = pm.seed(grid, lambda x: body((x - b) @ A), material=MICROPOLAR)
    x = by_id(points, (points.x - b) @ A)
    order = np.lexsort(np.round(x, 6).T)
    axes = by_id(points, A.T @ points.half_axes0 @ A)
    return [x[order], by_id(points, points.volume0)[order], axes[order]]


def test_cut_boxes_do_not_depend_on_the_ranks():
    """Ids, positions, volumes and half axes are those of a run on one rank, and go with their points."""
    _, inside, _ = BODIES["block"]
    shared, alone = (
        pm.seed(pm.Grid.box((-4, -4), (4, 4), 1.0, comm), inside, material=MICROPOLAR)
        for comm in (COMM, MPI.COMM_SELF)
    )
    for name in ("x", "volume0", "half_length0", "half_axes0"):
        np.testing.assert_array_equal(
            by_id(shared, getattr(shared, name)), getattr(alone, name)[np.argsort(alone.id)]
        )


# surfaces -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["bspline", "bspline3", "mpm"])
@pytest.mark.parametrize("end", [4.02, 4.3, 4.75])
def test_a_surface_on_the_true_face(basis, end):
    """A traction on the face of a body whose last boxes are cut finds the cells behind it, slivers too: the
    force that it gives is held by the support, and stretches the body as it should."""
    grid = pm.Grid.box((0, 0), (7, 3), 1.0)
    material = pm.MicropolarElastic(lam=0.0, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)
    points = pm.seed(grid, material=material, points_per_cell=4, bounds=((0.0, 0.0), (end, 1.37)))
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=None)
    held = problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.traction(pm.Surface.line((end, 0.0), (end, 1.37), 12), force=(10.0, 0.0))
    list(problem.march(1, progress=False))
    np.testing.assert_allclose(problem.reaction(held)[0], [-13.7, 0.0], rtol=1e-9, atol=1e-8)
    strain = COMM.allreduce(points.volume0 @ (points.F[:, 0, 0] - 1)) / total(points)
    assert strain == pytest.approx(
        10.0 / (2 * 2e3), rel=1e-5
    )  # without lateral strain 2 mu is Young's modulus
