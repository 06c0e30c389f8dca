"""Distances from the shapes of obstacles, in numbers and as they are refused."""

import re

import meshio
import numpy as np
import pytest

import polarmpm as pm
from polarmpm.geometry.shapes import shape_of
from polarmpm.kernels.kernel import PointSpace, compile_expressions
from polarmpm.tools import compat
from tests.conftest import COMM

L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0)]


def distances(shape, x):
    """What the compiled code of a shape gives at places x (n, d)."""
    space, numbers = PointSpace(compat.point_domain()), shape.numbers()
    place, p = space.coefficient(x.shape[1]), space.coefficient(len(numbers))
    value = shape.distance(place, p)
    kernel = compile_expressions(
        [value], {place: 0, p: x.shape[1]}, x.shape[1] + len(numbers), space.domain, COMM
    )
    return kernel(x, np.tile(numbers, (len(x), 1)))[:, 0]


def of_polygon(corners, x):
    """By the nearest place on the outline, and the number of sides that a ray crosses."""
    a, b = np.array(corners), np.roll(corners, -1, axis=0)
    out = np.full(len(x), np.inf)
    inside = np.zeros(len(x), dtype=bool)
    for first, last in zip(a, b, strict=True):
        side = last - first
        s = np.clip((x - first) @ side / (side @ side), 0, 1)
        out = np.minimum(out, np.linalg.norm(x - first - s[:, None] * side, axis=1))
        above = (first[1] > x[:, 1]) != (last[1] > x[:, 1])
        if side[1]:
            inside ^= above & (x[:, 0] < first[0] + (x[:, 1] - first[1]) / side[1] * side[0])
    return np.where(inside, -out, out)


@pytest.mark.parametrize("corners", [L_SHAPE, L_SHAPE[::-1]], ids=["left", "right"])
def test_distance_from_a_polygon_with_a_notch(corners):
    x = np.random.default_rng(3).uniform(-1.0, 3.0, (400, 2))
    assert np.allclose(distances(pm.Polygon(corners), x), of_polygon(corners, x), atol=1e-12)


def test_distance_from_a_box():
    lower, upper = np.array([-1.0, 0.0, 1.0]), np.array([0.5, 2.0, 4.0])
    x = np.random.default_rng(4).uniform(-3.0, 6.0, (400, 3))
    beyond = np.maximum(lower - x, x - upper)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    expected = np.where(beyond.max(axis=1) > 0, outside, beyond.max(axis=1))
    assert np.allclose(distances(pm.Box(lower, upper), x), expected, atol=1e-12)


def test_distance_from_a_cylinder_with_ends():
    x = np.random.default_rng(5).uniform(-2.0, 2.0, (300, 3))
    beside, along = np.hypot(x[:, 1], x[:, 2]) - 0.5, np.abs(x[:, 0]) - 0.75
    outside = np.hypot(np.maximum(beside, 0), np.maximum(along, 0))
    most = np.maximum(beside, along)
    expected = np.where(most > 0, outside, most)
    shape = pm.Cylinder((0, 0, 0), (2, 0, 0), 0.5, length=1.5)
    assert np.allclose(distances(shape, x), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pm.HalfSpace((0, 0), (0, 0)), "HalfSpace: normal = (0, 0): a direction isn't zero"),
        (lambda: pm.HalfSpace((0, 0), (0, 0, 1)), "HalfSpace: normal"),
        (lambda: pm.HalfSpace((0,), (1,)), "HalfSpace: point"),
        (lambda: pm.HalfSpace((0, np.nan), (0, 1)), "HalfSpace: point"),
        (lambda: pm.Sphere((0, 0), -1.0), "Sphere: radius = -1.0"),
        (lambda: pm.Sphere((0, 0), 1.0, hollow="yes"), "Sphere: hollow = 'yes'"),
        (lambda: pm.Cylinder((0, 0), (1, 0), 1.0), "Cylinder: point"),
        (lambda: pm.Cylinder((0, 0, 0), (1, 0, 0), 1.0, length=0), "Cylinder: length = 0"),
        (lambda: pm.Box((0, 0), (1, 0)), "Box: upper = (1, 0): it has to lie above lower = (0, 0)"),
        (lambda: pm.Polygon([(0, 0), (1, 0)]), "Polygon: corners has the shape (2, 2)"),
        (lambda: pm.Polygon([(0, 0), (1, 0), (1, 0), (0, 1)]), "two that follow each other are the same"),
        (lambda: pm.Polygon([(0, 0), (1, 1), (1, 0), (0, 1)]), "the sides from corner 0 and from corner 2"),
        (lambda: shape_of("phi", 3.0), "phi = 3.0: a shape (HalfSpace"),
        (lambda: shape_of("phi", pm.Sphere), "phi = "),
        (lambda: shape_of("phi", lambda: 1), "it is called with 1 argument(s)"),
        (lambda: shape_of("phi", lambda a, b, c: 1), "it is called with 1 argument(s)"),
    ],
)
def test_shapes_that_are_none(make, message):
    with pytest.raises(pm.InputError, match=re.escape(message)):
        make()


def box_of_triangles(lower, upper):
    """Corners of a box and twelve triangles, outward."""
    low, high = np.array(lower, float), np.array(upper, float)
    x = np.array(
        [[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)]
    )
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def sampled(shape, x):
    """Distances from a shape whose numbers depend on the place."""
    space = PointSpace(compat.point_domain())
    place, p = space.coefficient(3), space.coefficient(31)
    value = shape.distance(place, p)
    kernel = compile_expressions([value], {place: 0, p: 3}, 34, space.domain, COMM)
    return kernel(x, shape.at(x))[:, 0]


def test_distance_from_a_solid(folder):
    """A box of triangles, from arrays and from a file: exact before its faces, near enough elsewhere."""
    x, triangles = box_of_triangles((0.0, 0.0, 0.0), (1.0, 0.6, 0.4))
    solid = pm.Solid((x, triangles), spacing=0.05)
    places = np.random.default_rng(1).uniform(-0.4, 1.4, (300, 3))
    exact = distances(pm.Box((0, 0, 0), (1, 0.6, 0.4)), places)
    near = np.abs(exact) < 0.1
    assert np.abs(sampled(solid, places) - exact)[near].max() < 0.02
    assert np.allclose(sampled(solid, places), exact, atol=0.1)
    before = np.array([[0.5, 0.3, 0.47], [0.5, 0.3, 0.36], [1.07, 0.3, 0.2], [0.5, -0.04, 0.2]])
    assert np.allclose(sampled(solid, before), [0.07, -0.04, 0.07, 0.04], atol=1e-12)
    far = np.array([[9.0, 0.3, 0.2], [0.5, -7.0, 0.2]])
    assert np.allclose(sampled(solid, far), [8.0, 7.0], rtol=0.03)
    if COMM.rank == 0:
        meshio.write_points_cells(folder / "box.stl", 1e3 * x, [("triangle", triangles)])
    COMM.barrier()
    read = pm.Solid(folder / "box.stl", spacing=0.05, scale=1e-3)
    assert np.allclose(sampled(read, places), sampled(solid, places), atol=1e-7)


def test_solids_that_are_none(folder):
    x, triangles = box_of_triangles((0, 0, 0), (1, 1, 1))
    with pytest.raises(pm.InputError, match="its surface isn't closed: 3 edge"):
        pm.Solid((x, triangles[1:]))
    with pytest.raises(pm.InputError, match="rows of three numbers"):
        pm.Solid((x, triangles + 1))
    with pytest.raises(pm.InputError, match=re.escape("spacing = 0.0001: the lattice would have")):
        pm.Solid((x, triangles), spacing=1e-4)
    with pytest.raises(pm.InputError, match="no STL file that can be read"):
        pm.Solid(folder / "none.stl")
