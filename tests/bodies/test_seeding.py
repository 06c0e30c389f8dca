"""The lattice, and filling bodies with points."""

from __future__ import annotations

import itertools
import warnings
from contextlib import nullcontext
from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.geometry.cells import cell_mesh, occupied_cells
from polarmpm.geometry.grid import MARGIN
from polarmpm.tools import compat
from tests.bodies.test_cut_boxes import in_block
from tests.conftest import COMM, HENCKY, MICROPOLAR, by_id, rotation


def block(dim: int = 2, cell: float = 0.5) -> pm.Grid:
    return pm.Grid.box((-1.0, -0.5, 2.0)[:dim], (3.0, 1.5, 4.0)[:dim], cell)


def disc(x: np.ndarray) -> np.ndarray:
    return np.sum((x[:, :2] - [0.9, 0.4]) ** 2, axis=1) < 0.64


# grid ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0), (1, 1), 0.3), r"cell = 0\.3 does not divide the box along x: 1 / 0\.3"),
        (((0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.4)), r"cell = 0\.4 does not divide the box along z"),
        (((0, 0), (1, 1), 2.0), "cell = 2 does not divide"),
        (((0, 0), (1, 1), 0.0), "cell = 0.0"),
        (((0, 0), (1, 1), -0.5), "cell = -0.5"),
        (((0, 0), (1, 1), np.nan), "cell = nan"),
        (((0, 0), (1, 1), (0.5, 0.5, 0.5)), "cell = "),
        (((0, 0), (1, 0), 0.5), "upper = .* must exceed lower"),
        (((0, 0), (np.inf, 1), 0.5), "upper = "),
        (((0,), (1,), 0.5), "two or three coordinates"),
        (((0, 0), (1, 1, 1), 0.5), "two or three coordinates"),
        (((0, 0, 0), (1e9, 1e9, 1e9), 1e-3), "2\\^62 nodes"),
    ],
)
def test_bad_boxes(arguments, message):
    """The argument and its value are named; for a cell, the axis that it doesn't divide."""
    with pytest.raises(pm.InputError, match=message):
        pm.Grid.box(*arguments)


@pytest.mark.parametrize("cell", [0.1, 1 / 3, 0.7, 1e-6, 1e6])
def test_cells_divide_boxes_up_to_rounding(cell):
    """Sizes that aren't binary fractions divide their multiples, anywhere."""
    for lower in (0.0, 0.3, -17.1, 1e3):
        grid = pm.Grid.box((lower * cell,) * 2, (lower * cell + 12 * cell,) * 2, cell)
        assert grid.shape == (12, 12)
        np.testing.assert_allclose(grid.upper, lower * cell + 12 * cell)


@pytest.mark.parametrize("dim", [2, 3])
def test_node_numbers(dim):
    """Numbers and indices are inverse and unique, margin included; positions follow."""
    grid = block(dim)
    axes = [np.arange(-MARGIN, n + 1 + MARGIN) for n in grid.shape]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    number = grid.node_number(index)
    np.testing.assert_array_equal(number, np.arange(len(index)))
    np.testing.assert_array_equal(grid.node_index(number), index)
    np.testing.assert_allclose(grid.node_position(number), np.array(grid.origin) + 0.5 * index)


def test_numbers_of_a_huge_grid():
    """Empty space costs nothing: 10^6 cells in each direction are only integers."""
    grid = pm.Grid.box((0, 0, 0), (1e6, 1e6, 1e6), 1.0)
    index = np.array([[10**6, 0, 3], [MARGIN + 10**6] * 3])
    np.testing.assert_array_equal(grid.node_index(grid.node_number(index)), index)


def test_cells_of_points():
    """Inner faces belong to the upper cell, the grid's upper faces to the last one; rounding is put right."""
    grid = pm.Grid.box((0, 0), (1, 1), 0.1)
    x = np.array([[0.05, 0.0], [0.3, 0.7], [0.1 * 3, 1.0], [0.3 - 1e-12, 0.7 + 1e-12]])
    np.testing.assert_array_equal(grid.cells_of(x), [[0, 0], [3, 7], [3, 9], [3, 7]])


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_as_a_mesh(dim):
    """Occupied cells as a dolfinx mesh have the volume and the place of the lattice's cells."""
    from dolfinx import fem

    grid = block(dim)
    points = pm.seed(grid, disc, material=MICROPOLAR)
    cells = occupied_cells(grid, points.x)
    count = COMM.allreduce(len(cells))
    made = cell_mesh(grid, cells)
    one = fem.Constant(made.mesh, np.float64(1.0))
    x = ufl.SpatialCoordinate(made.mesh)
    volume, moment = (
        COMM.allreduce(float(np.real(fem.assemble_scalar(fem.form(f * ufl.dx(domain=made.mesh))))))
        for f in (one, x[0])
    )
    assert volume == pytest.approx(count * 0.5**dim)
    centres = (grid.node_index(cells)[:, 0] + 0.5) * 0.5 + grid.origin[0]
    assert moment / volume == pytest.approx(COMM.allreduce(float(centres.sum())) / count)


# seeding ------------------------------------------------------------------------------------------
@pytest.mark.parametrize("layout", ["uniform", "gauss"])
@pytest.mark.parametrize("per_cell", [1, 2, 3, (3, 1, 2)])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_full_grid(dim, per_cell, layout):
    """Number of points, volumes that add up exactly, domains that tile the cells, an unloaded state."""
    grid = block(dim)
    number = np.broadcast_to(per_cell[:dim] if isinstance(per_cell, tuple) else per_cell, dim)
    points = pm.seed(grid, material=MICROPOLAR, points_per_cell=number.tolist(), layout=layout)
    assert points.total == np.prod(grid.shape) * np.prod(number)
    assert COMM.allreduce(points.volume0.sum()) == pytest.approx(np.prod(grid.shape) * 0.5**dim, rel=1e-13)
    np.testing.assert_allclose(points.half_length0, np.tile(0.25 / number, (len(points), 1)))
    along = np.diag(0.25 / number) if layout == "uniform" else np.zeros((dim, dim))
    np.testing.assert_allclose(points.half_axes0, np.tile(along, (len(points), 1, 1)))
    np.testing.assert_array_equal(by_id(points, points.id), np.arange(points.total))
    np.testing.assert_array_equal(points.X, points.x)
    np.testing.assert_array_equal(points.F, np.tile(np.eye(3), (len(points), 1, 1)))
    assert not np.any(points.rotation_vector)
    # Gauss' rule of n points is exact for degree 2 n - 1, equally spaced points for degree 1
    degree = 2 * int(number[0]) - 1 if layout == "gauss" else 1
    integral = COMM.allreduce(float(np.sum(points.volume0 * points.x[:, 0] ** degree)))
    side = np.prod(np.subtract(grid.upper, grid.origin)[1:])
    assert integral == pytest.approx(side * (3.0 ** (degree + 1) - 1.0) / (degree + 1), rel=1e-12)


def test_points_of_one_cell():
    """Uniform and Gauss positions in a cell."""
    grid = pm.Grid.box((0, 0), (1, 1), 1.0)
    for layout, expected in (("uniform", [0.25, 0.75]), ("gauss", [0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5])):
        points = pm.seed(grid, material=MICROPOLAR, layout=layout)
        x = by_id(points, points.x)
        np.testing.assert_allclose(np.unique(np.round(x, 14)), expected)


def test_predicates_and_bounds():
    """A predicate, the same with bounds that save time, an object with bounds of its own."""

    class Disc:
        bounds = ((0.0, -0.5), (1.8, 1.3))

        def __call__(self, x):
            assert np.all(x >= np.array([0.0, -0.5]) - 0.5)
            assert np.all(x <= np.array([2.0, 1.5]))
            return disc(x)

    grid = block(2, 0.25)
    made = [
        pm.seed(grid, disc, material=MICROPOLAR),
        pm.seed(grid, disc, material=MICROPOLAR, bounds=((0.0, -0.5), (1.8, 1.3))),
        pm.seed(grid, Disc(), material=MICROPOLAR),
    ]
    x = by_id(made[0], made[0].x)
    assert np.all(disc(x))
    assert COMM.allreduce(made[0].volume0.sum()) == pytest.approx(np.pi * 0.64, rel=2e-3)
    for other in made[1:]:
        # which axis runs slowest depends on the box searched, so compare the sets
        np.testing.assert_allclose(np.unique(by_id(other, other.x), axis=0), np.unique(x, axis=0))


def test_whole_boxes_by_their_centres():
    """The papers' seeding, also of boxes cut by bounds."""
    points = pm.seed(block(2), material=MICROPOLAR, bounds=((0.1, 0.1), (1.3, 0.6)), cut=False)
    x = by_id(points, points.x)
    assert np.all((x >= 0.1) & (x <= [1.3, 0.6]))
    assert len(x) == 5 * 2
    np.testing.assert_array_equal(points.volume0, 0.0625)
    np.testing.assert_array_equal(points.half_axes0, np.tile(0.125 * np.eye(2), (len(points), 1, 1)))


@pytest.mark.parametrize("options", [{"cut": False}, {"layout": "gauss"}])
def test_a_staircase_that_is_another_body_is_told(options):
    """A strip at 45 degrees, whose steps all lie on one side; a straight one, and a thick one, are right."""

    def strip(x: np.ndarray) -> np.ndarray:
        return np.abs(x[:, 1] - x[:, 0] + 0.14) <= 0.7

    grid = pm.Grid.box((0, 0), (8, 8), 1.0)
    with pytest.warns(pm.TrustWarning, match="staircase") if COMM.rank == 0 else nullcontext():
        pm.seed(grid, strip, material=MICROPOLAR, points_per_cell=4, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pm.seed(grid, strip, material=MICROPOLAR)
        pm.seed(grid, lambda x: np.abs(x[:, 1] - 4.0) <= 1.0, material=MICROPOLAR, **options)
        pm.seed(grid, lambda x: x[:, 1] <= 4.0 + 0.3 * x[:, 0], material=MICROPOLAR, **options)


def test_ids_do_not_depend_on_the_ranks():
    """Positions by id are those of a run on one rank (every rank seeds alone for comparison), to the rounding
    of the sums over parts of cut boxes."""
    shared = pm.seed(block(3), disc, material=MICROPOLAR, points_per_cell=(2, 1, 3))
    lower, upper = (-1.0, -0.5, 2.0), (3.0, 1.5, 4.0)
    alone = pm.seed(
        pm.Grid.box(lower, upper, 0.5, MPI.COMM_SELF), disc, material=MICROPOLAR, points_per_cell=(2, 1, 3)
    )
    order = np.argsort(alone.id)
    np.testing.assert_allclose(by_id(shared, shared.x), alone.x[order], rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_id(shared, shared.volume0), alone.volume0[order], rtol=1e-13)


def test_ranks_get_equal_shares():
    """28 cells of four points are distributed whole, in pieces along the longest axis."""
    points = pm.seed(block(2, 0.25), material=MICROPOLAR, bounds=((-1, -0.5), (2.5, 0.0)))
    counts = COMM.allgather(len(points))
    assert max(counts) - min(counts) <= (4 if 28 % COMM.size else 0)
    ends = COMM.allgather((points.x[:, 0].min(), points.x[:, 0].max()))
    for (_, before), (after, _) in itertools.pairwise(ends):
        assert before < after + 0.25  # both ranks may have cells of a column


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points_per_cell": 0}, "points_per_cell = 0"),
        ({"points_per_cell": 1.5}, "points_per_cell = 1.5"),
        ({"points_per_cell": (2, 2, 2)}, r"points_per_cell = \(2, 2, 2\)"),
        ({"cut": 1}, "cut = 1: True or False"),
        ({"layout": "random"}, "layout = 'random': one of 'uniform', 'gauss'"),
        ({"bounds": ((0, 0), (0, 1))}, "bounds = "),
        ({"bounds": ((0, 0), (1, 7))}, "bounds = .* outside the grid"),
        ({"bounds": ((0, 0, 0), (1, 1, 1))}, "bounds = "),
        ({"inside": 5}, "inside = 5"),
        ({"inside": lambda x: x}, "inside: returned .* of type float64"),
        ({"inside": lambda x: True}, r"inside: returned True of type bool and shape \(\)"),
        ({"inside": lambda x: x[:, 0] > 99}, "none of the candidate points"),
        ({"material": None}, "None is not a material"),
    ],
)
def test_bad_seeds(options, message):
    """The argument and its value are named."""
    with pytest.raises(pm.InputError, match=message):
        pm.seed(block(), **{"material": MICROPOLAR, **options})


def test_no_points():
    """A body that misses every candidate is an error that says where was searched."""
    with pytest.raises(pm.InputError, match=r"none of the candidate points.*\(-1\.0, -0\.5\)"):
        pm.seed(block(), lambda x: np.zeros(len(x), dtype=bool), material=MICROPOLAR)


def test_points_outside_the_grid():
    """They are named by their ids, when the problem is made."""
    points = pm.seed(block(), material=MICROPOLAR)
    points.x[np.isin(points.id, [3, 17])] += 100.0
    with pytest.raises(
        pm.PointsOutsideGrid, match=r"2 material point\(s\) outside the grid .*ids 3, 17"
    ) as e:
        pm.QuasiStatic(block(), points, **pm.PUBLISHED)
    assert e.value.ids == [3, 17]


def test_points_at_positions_without_meaning():
    """NaN is outside of any grid."""
    points = pm.seed(block(), material=MICROPOLAR)
    points.x[points.id == 5] = np.nan
    with pytest.raises(pm.PointsOutsideGrid, match="ids 5"):
        pm.QuasiStatic(block(), points, **pm.PUBLISHED)


def test_bodies_that_do_not_go_together():
    """Points of another dimension; micropolar and classical materials in one body."""
    points = pm.seed(block(3), material=MICROPOLAR)
    with pytest.raises(pm.InputError, match="points have 3 dimensions, the grid has 2"):
        pm.QuasiStatic(block(2), points, **pm.PUBLISHED)
    with pytest.raises(pm.InputError, match="dimensions"):
        points.join(pm.seed(block(2), material=MICROPOLAR))
    points.join(pm.seed(block(3), material=HENCKY))
    with pytest.raises(pm.InputError, match="can't be mixed"):
        pm.QuasiStatic(block(3), points, **pm.PUBLISHED)


def test_joined_points():
    """Ids follow on; materials are counted; volumes add up."""
    a = pm.seed(block(), material=MICROPOLAR, bounds=((-1, -0.5), (0, 0.5)))
    n = a.total
    a.join(pm.seed(block(), material=HENCKY, bounds=((0, -0.5), (2, 0.5))))
    np.testing.assert_array_equal(by_id(a, a.id), np.arange(3 * n))
    np.testing.assert_array_equal(by_id(a, a.material), np.repeat([0, 1], [n, 2 * n]))
    assert COMM.allreduce(a.volume0.sum()) == pytest.approx(3.0)


def test_domains_follow_the_stretch():
    """T (2.56)-(2.58): half-lengths U_ii l_i0, blind to rotations; volumes J V0."""
    points = pm.seed(block(3), material=MICROPOLAR, bounds=((0, 0, 2), (1, 1, 3)))
    rng = np.random.default_rng(0)
    C = rng.uniform(-0.2, 0.2, (3, 3))
    U = np.diag([1.3, 0.8, 1.1]) + C + C.T  # symmetric and positive definite
    initial = points.half_length0.copy()
    for R in (np.eye(3), rotation([0.0, 0.0, 0.5 * np.pi]), rotation([1.0, -2.0, 0.5])):
        points.F = np.tile(R @ U, (len(points), 1, 1))
        np.testing.assert_allclose(points.stretch, np.tile(U, (len(points), 1, 1)), atol=1e-14)
        np.testing.assert_allclose(points.half_length, np.diag(U) * initial, rtol=1e-13)
        np.testing.assert_allclose(points.volume, np.linalg.det(U) * points.volume0, rtol=1e-13)


def test_the_reset_grid_sees_stretched_domains():
    """Domains that have grown reach nodes that the initial ones don't, in GIMPM only."""
    counts = []
    for basis, stretch in (("gimpm", 1.0), ("gimpm", 1.5), ("mpm", 1.5)):
        points = pm.seed(block(2), material=MICROPOLAR, bounds=((0, 0), (1, 1)))
        points.F = points.F * [[stretch], [stretch], [1.0]]
        problem = pm.QuasiStatic(block(2), points, basis=basis, reset=1, balanced_reset=False)
        problem.fix(lambda x: np.ones(len(x), dtype=bool), u=0, theta=0)
        list(problem.march(1))
        counts.append(problem.unknowns // 3)
    assert counts == [9, 25, 9]


# selections ---------------------------------------------------------------------------------------
def test_selections():
    """By predicate, by direction, by distance (ties go to the lower ids); the same on every rank."""
    points = pm.seed(block(), material=MICROPOLAR, bounds=((0, 0), (2, 1)))
    x = by_id(points, points.x)
    np.testing.assert_array_equal(points.where(lambda x: x[:, 0] > 1.5).ids, np.flatnonzero(x[:, 0] > 1.5))
    np.testing.assert_array_equal(points.farthest((2, 0)).ids, np.flatnonzero(x[:, 0] > 1.8))
    np.testing.assert_array_equal(points.farthest((0, -1), tolerance=0.3).ids, np.flatnonzero(x[:, 1] < 0.45))
    np.testing.assert_array_equal(points.nearest((0.0, 0.0)).ids, [int(np.argmin(np.linalg.norm(x, axis=1)))])
    four = points.nearest((1.0, 0.5), count=4)
    np.testing.assert_array_equal(four.ids, np.sort(np.argsort(np.linalg.norm(x - [1.0, 0.5], axis=1))[:4]))
    one = points.nearest((1.0, 0.5))
    assert one.ids.tolist() == [four.ids.min()]
    points.x = points.x + 1.0
    np.testing.assert_allclose(points.mean_displacement(four), [1.0, 1.0])
    for bad in (
        lambda: points.farthest((0, 0)),
        lambda: points.nearest((0, 0, 0)),
        lambda: points.where(lambda x: x),
    ):
        with pytest.raises(pm.InputError):
            bad()
    with pytest.raises(pm.InputError, match="no point"):
        points.mean_displacement(points.where(lambda x: x[:, 0] > 99))


@pytest.mark.parametrize("number", [1, 2, 3, 5])
@pytest.mark.parametrize("end", [3.5, 3.51, 3.6, 3.99, 4.0])
def test_the_end_layer_of_a_body_along_the_grid(number, end):
    """Whole, and alone, wherever the body ends in its last boxes, and however slightly those are cut."""
    grid = pm.Grid.box((0, 0), (5, 5), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, points_per_cell=number, bounds=((0.0, 0.23), (end, 2.4)))
    chosen = points.rows(points.farthest((1.0, 0.0)))
    most = COMM.allreduce(points.x[:, 0].max(initial=-np.inf), op=MPI.MAX)
    np.testing.assert_array_equal(chosen, np.flatnonzero(points.x[:, 0] > most - 1e-9))


@pytest.mark.parametrize("angle", [0.3, 0.6, np.pi / 4])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_end_layer_of_a_body_across_the_grid(number, angle):
    """All points whose boxes the end face cuts, none that is more than a box away from it."""
    grid, axis = pm.Grid.box((-4, -4), (4, 4), 1.0), np.array([np.cos(angle), np.sin(angle)])
    body = partial(in_block, size=(5.0, 2.0), centre=(0.1, 0.2), angle=angle)
    points = pm.seed(grid, body, material=MICROPOLAR, points_per_cell=number)
    depth = 2.5 - (points.x - [0.1, 0.2]) @ axis
    half, reach = 0.5 / number, 0.5 / number * np.abs(axis).sum()
    chosen = np.isin(np.arange(len(points)), points.rows(points.farthest(axis)))
    nominal = np.all(points.half_length0 > half * (1 - 1e-9), axis=1)
    assert np.all(depth[chosen] < 2 * reach)
    assert np.all(chosen[nominal & (depth < reach * (1 - 1e-5))])
    across = (points.x - [0.1, 0.2]) @ [-axis[1], axis[0]]
    found = np.concatenate(COMM.allgather(across[chosen]))
    assert found.min() < -0.5
    assert found.max() > 0.5


# meshes -------------------------------------------------------------------------------------------
def disc_mesh(dim: int, quads: bool = False):
    """A mesh of a box in the grid, of simplices or of boxes."""
    from dolfinx import mesh

    if dim == 2:
        kind = mesh.CellType.quadrilateral if quads else mesh.CellType.triangle
        return mesh.create_rectangle(COMM, [[0.0, 0.0], [2.0, 1.0]], [5, 3], kind)
    kind = mesh.CellType.hexahedron if quads else mesh.CellType.tetrahedron
    return mesh.create_box(COMM, [[0.0, 0.0, 2.0], [2.0, 1.0, 3.0]], [4, 3, 2], kind)


def distorted(dim: int, quads: bool):
    """The same with its nodes moved, boundary ones too, and its volume, centroid and second moments."""
    made = disc_mesh(dim, quads)
    x = made.geometry.x
    x[:, 0] += 0.2 * x[:, 0] * x[:, 1] + 0.03 * np.sin(9 * x[:, 1])
    x[:, 1] += 0.04 * np.cos(7 * x[:, 0]) + 0.1 * x[:, 0] * (x[:, 2] - 2.0)
    points, volume = compat.mesh_quadrature(made, 6)
    return made, moments(points, volume)


def moments(x: np.ndarray, volume: np.ndarray, spread: np.ndarray | float = 0.0):
    """Volume, centroid and second moments about it, over the volume, of points with moments of their own."""
    total = COMM.allreduce(volume.sum())
    centre = COMM.allreduce(volume @ x) / total
    y = x - centre
    square = volume[:, None, None] * (y[:, :, None] * y[:, None, :] + spread)
    return total, centre, COMM.allreduce(square.sum(axis=0)) / total


def body_moments(points: pm.Points):
    a = points.half_axes0
    return moments(points.x, points.volume0, np.swapaxes(a, 1, 2) @ a / 3.0)


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("quads", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_parts_of_the_cells_of_a_mesh(dim, quads, number):
    """As many of each cell; a mesh's volume, centroid and second moments, exact but for the latter of parts
    that are no parallelepipeds."""
    grid, (made, expected) = pm.Grid.box((-1,) * dim, (5,) * dim, 1.0), distorted(dim, quads)
    points = pm.seed_mesh(grid, made, material=MICROPOLAR, points_per_cell=number)
    assert points.total == number**dim * made.topology.index_map(dim).size_global
    found = body_moments(points)
    assert found[0] == pytest.approx(expected[0], rel=1e-13)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-13)
    error = np.abs(found[2] - expected[2]).max() / np.abs(expected[2]).max()
    assert error < (2e-3 / number**2 if quads else 1e-13)
    square = np.einsum("nki,nki->ni", points.half_axes0, points.half_axes0)
    np.testing.assert_allclose(points.half_length0**2, square)


def test_parts_of_boxes_are_boxes():
    """Half axes of parts of cells along the grid are those that seeding the grid gives."""
    from dolfinx import mesh

    made = mesh.create_box(COMM, [[0, 0, 2], [2, 1, 3]], [4, 2, 2], mesh.CellType.hexahedron)
    points = pm.seed_mesh(block(3), made, material=MICROPOLAR, points_per_cell=2)
    np.testing.assert_allclose(
        np.abs(points.half_axes0), np.tile(0.125 * np.eye(3), (len(points), 1, 1)), atol=1e-15
    )
    same = pm.seed(block(3), material=MICROPOLAR, bounds=((0, 0, 2), (2, 1, 3)))
    found, expected = (np.round(by_id(p, p.x), 9) for p in (points, same))
    np.testing.assert_allclose(np.unique(found, axis=0), np.unique(expected, axis=0))


@pytest.mark.parametrize("number", [0, 1.5, (2, 2), True])
def test_bad_numbers_of_parts(number):
    with pytest.raises(pm.InputError, match="points_per_cell = "):
        pm.seed_mesh(block(2), disc_mesh(2), material=MICROPOLAR, points_per_cell=number)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("quads", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_points_of_a_mesh(dim, quads, degree):
    """Volumes add up to the mesh's, moments up to the rule's degree too; domains are as large as shares."""
    if (dim, degree, quads) == (3, 3, False):
        pytest.skip("the rule has negative weights")
    points = pm.seed_mesh(block(dim), disc_mesh(dim, quads), material=MICROPOLAR, degree=degree)
    assert COMM.allreduce(points.volume0.sum()) == pytest.approx(2.0, rel=1e-13)
    moment = COMM.allreduce(float(points.volume0 @ points.x[:, 0] ** degree))
    assert moment == pytest.approx(2.0 ** (degree + 1) / (degree + 1), rel=1e-12)
    np.testing.assert_allclose(np.prod(2 * points.half_length0, axis=1), points.volume0)
    assert not np.any(points.half_axes0)  # the rule integrates squares itself
    assert np.all(points.volume0 > 0)
    ids = by_id(points, points.id)
    np.testing.assert_array_equal(ids, np.arange(len(ids)))


def test_mesh_outside_the_grid_or_of_another_dimension():
    """Errors are raised on every rank."""
    with pytest.raises(pm.PointsOutsideGrid, match="ids"):
        pm.seed_mesh(pm.Grid.box((0, 0), (1, 1), 0.5), disc_mesh(2), material=MICROPOLAR)
    with pytest.raises(pm.InputError, match="2 dimensions, the grid has 3"):
        pm.seed_mesh(block(3), disc_mesh(2), material=MICROPOLAR)


def test_rules_with_negative_weights():
    """A point needs a positive volume: some rules of tetrahedra are refused, with the degree."""
    with pytest.raises(pm.InputError, match="degree = 3"):
        pm.seed_mesh(block(3), disc_mesh(3), material=MICROPOLAR, degree=3)


def test_quadrature_of_a_skewed_triangle():
    """Positions and weights of a cell far from the reference one, by its centroid and area."""
    from dolfinx import mesh

    if COMM.size > 1:
        pytest.skip("a mesh of one cell")
    x = np.array([[0.0, 0.0], [2.0, 0.3], [0.4, 1.1]])
    domain = ufl.Mesh(compat.coordinate_element("triangle", 2))
    cells = np.array([[0, 1, 2]], dtype=np.int64)
    try:
        made = mesh.create_mesh(COMM, cells, x, domain)
    except TypeError:  # newer versions take the domain first
        made = mesh.create_mesh(COMM, cells, domain, x)
    position, volume = compat.mesh_quadrature(made, 2)
    assert volume.sum() == pytest.approx(0.5 * (2.0 * 1.1 - 0.3 * 0.4))
    np.testing.assert_allclose(volume @ position / volume.sum(), x.mean(axis=0))


@pytest.mark.parametrize("dim", [2, 3])
def test_gmsh_model(dim):
    """A body drawn with gmsh: points fill it, and their volumes add up to that of its mesh."""
    gmsh = pytest.importorskip("gmsh")
    io = __import__("dolfinx.io", fromlist=["gmshio"])
    reader = getattr(io, "gmsh", None) or io.gmshio
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        if COMM.rank == 0:
            if dim == 2:
                tag = gmsh.model.occ.addDisk(0.9, 0.4, 0, 0.8, 0.5)
            else:
                tag = gmsh.model.occ.addSphere(0.9, 0.4, 3.0, 0.7)
            gmsh.model.occ.synchronize()
            gmsh.model.addPhysicalGroup(dim, [tag], 1)
            gmsh.option.setNumber("Mesh.MeshSizeMax", 0.2)
            gmsh.model.mesh.generate(dim)
        found = reader.model_to_mesh(gmsh.model, COMM, 0, gdim=dim)
        made = found[0] if isinstance(found, tuple) else found.mesh
    finally:
        gmsh.finalize()
    points = pm.seed_mesh(block(dim), made, material=MICROPOLAR)
    exact = np.pi * 0.8 * 0.5 if dim == 2 else 4 / 3 * np.pi * 0.7**3
    volume = COMM.allreduce(points.volume0.sum())
    assert exact * 0.93 < volume < exact
    local = (points.x[:, :2] - [0.9, 0.4]) / [0.8, 0.5 if dim == 2 else 0.8]
    assert np.all(np.linalg.norm(local, axis=1) < 1.0)


@pytest.mark.parametrize("quads", [False, True])
def test_a_body_from_a_mesh_deforms(quads):
    """A rectangle of a mesh stretches like one of a grid: the unstructured points carry the load."""
    points = pm.seed_mesh(block(2), disc_mesh(2, quads), material=MICROPOLAR, degree=3)
    problem = pm.QuasiStatic(block(2), points, basis="mpm", reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0), tolerance=0.3), force=(50.0, 0.0))
    list(problem.march(1))
    stretch = points.mean(points.F[:, 0, 0])
    assert stretch == pytest.approx(1 + 50.0 / 6.5e3, rel=0.05)
