"""B-splines: supports, slivers, patch test, bending, output; quadratic ones, and what averaged and cubic
ones must fulfil as they do."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import meshio
import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import basis_of
from polarmpm.bodies.points import Points
from tests.conftest import COMM, HENCKY, MICROPOLAR, NEO_HOOKEAN, by_id, release_supports

SPLINES = basis_of("bspline")
EACH = pytest.mark.parametrize("basis", ["bspline", "bspline-averaged", "bspline3"])
STRETCH = np.array([[0.2, 0.3, -0.1], [-0.15, -0.1, 0.2], [0.1, 0.05, 0.15]])


def full(problem: pm.QuasiStatic, steps: int = 1) -> list[pm.Step]:
    return list(problem.march(steps, progress=False))


# the basis ----------------------------------------------------------------------------------------
def test_one_and_two_cells_are_bernstein_and_half_open():
    """The polynomials of a single cell, and of two cells with a knot between them, as in the books."""
    x = np.linspace(0.05, 0.95, 10)
    bernstein = np.stack([(1 - x) ** 2, 2 * x * (1 - x), x**2], axis=1)
    first = np.stack([(1 - x) ** 2, 2 * x - 1.5 * x**2, 0.5 * x**2], axis=1)
    for cells, lower, upper in ((1, bernstein, bernstein), (2, first, first[::-1, ::-1])):
        grid = pm.Grid.box((0, 0), (cells, cells), 1.0)
        at = np.stack([x, x + cells - 1], axis=1)
        w = SPLINES.weights(grid, at, np.zeros_like(at))
        np.testing.assert_array_equal(w.lowest, np.broadcast_to([0, cells - 1], w.lowest.shape))
        np.testing.assert_allclose(w.table[:, 0, 0], lower, atol=1e-14)
        np.testing.assert_allclose(w.table[:, 1, 0], upper, atol=1e-14)


@pytest.mark.parametrize("cells", [1, 2, 3, 6])
def test_functions_are_smooth_across_planes(cells):
    """Values and gradients don't jump at the inner planes; second derivatives do."""
    grid = pm.Grid.box((0, 0), (0.5 * cells, 1.0), (0.5, 1.0))

    def dense(x: float) -> np.ndarray:
        w = SPLINES.weights(grid, np.array([[x, 0.5]]), np.zeros((1, 2)))
        out = np.zeros((2, cells + 2))
        out[:, w.lowest[0, 0] : w.lowest[0, 0] + 3] = w.table[0, 0]
        return out

    for k in range(1, cells):
        np.testing.assert_allclose(dense(0.5 * k - 1e-7), dense(0.5 * k + 1e-7), atol=1e-5)
    walls = dense(0.0)[0], dense(0.5 * cells)[0]
    np.testing.assert_array_equal(walls[0], np.eye(cells + 2)[0])
    np.testing.assert_array_equal(walls[1], np.eye(cells + 2)[-1])


def test_positions_of_nodes():
    """Cells' centres and the boundary planes."""
    grid = pm.Grid.box((1, 0), (4, 2), (1.0, 2.0))
    numbers = grid.node_number(np.array([[0, 0], [1, 1], [3, 2], [4, 2]]))
    expected = [[1, 0], [1.5, 1], [3.5, 2], [4, 2]]
    np.testing.assert_allclose(SPLINES.positions(grid, numbers), expected)
    np.testing.assert_allclose(basis_of("mpm").positions(grid, numbers), grid.node_position(numbers))


# slivers ------------------------------------------------------------------------------------------
def test_slivers_take_the_polynomials_of_the_cell_behind_the_face():
    """In one direction, in two, and not if nothing is behind the face."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    x = np.array([[2.5, 2.5], [3.02, 2.5], [3.04, 2.4], [2.4, 1.97], [3.03, 1.95], [5.01, 5.5], [0.5, 4.0]])
    expected = [[2, 2], [2, 2], [2, 2], [2, 2], [2, 2], [5, 5], [0, 4]]
    share = np.arange(len(x)) % COMM.size == COMM.rank
    np.testing.assert_array_equal(SPLINES.supporting_cells(grid, x[share]), np.array(expected)[share])


def test_deep_cells_stay_as_they_are():
    """One point that is far from the face makes its whole cell one that stands by itself."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    x = np.array([[2.5, 2.5], [3.02, 2.5], [3.5, 2.5]])
    share = np.arange(len(x)) % COMM.size == COMM.rank
    np.testing.assert_array_equal(SPLINES.supporting_cells(grid, x[share])[:, 0], np.array([2, 3, 3])[share])


def test_of_cells_that_are_all_thin_only_the_last_ones_lean():
    """One point a cell near the cells' lower planes is no reason to lean on each other; but no other point
    reaches the tails in the body's last cells."""
    grid = pm.Grid.box((0, 0), (6, 6), 1.0)
    x = np.stack(np.meshgrid(np.arange(6) + 0.05, np.arange(6) + 0.05), axis=-1).reshape(-1, 2)
    x = np.array_split(x, COMM.size)[COMM.rank]
    np.testing.assert_array_equal(SPLINES.supporting_cells(grid, x), np.minimum(grid.cells_of(x), 4))


@EACH
def test_slivers_of_seeded_bodies_move_with_the_grid(basis):
    """Any number of points a cell, equal or Gauss positions, or a last box cut at a simple place: shifted by
    whole cells of .7 m, or mirrored, the same points lean on the cell behind."""
    splines, h = basis_of(basis), 0.7
    for n in range(1, 13):
        equal, gauss = (np.arange(n) + 0.5) / n, 0.5 * (1 + np.polynomial.legendre.leggauss(n)[0])
        for rule in (equal, gauss, (np.arange(n) + 1) / n):
            # a row of cells for each end
            ends = [rule[:k] for k in range(1, n + 1)] + [np.array([t / 40]) for t in range(1, 11)]
            x = [np.concatenate([2 + rule[rule < 1], 3 + end]) for end in ends]
            rows = np.repeat(np.arange(len(x)), [len(r) for r in x])
            y = np.stack([np.concatenate(x), rows + 0.5], axis=1)
            y = np.array_split(y, COMM.size)[COMM.rank]
            size = np.array([6, len(x)]) * h
            expected = splines.supporting_cells(pm.Grid.box((0, 0), size, h), y * h)[:, 0]
            for k in (-17, 3, 1001):
                low = np.array([k * h, 0.0])
                found = splines.supporting_cells(pm.Grid.box(low, low + size, h), y * h + low)[:, 0]
                np.testing.assert_array_equal(found, expected)
            mirrored = np.array([6.0, 0.0]) + y * [-1.0, 1.0]
            found = splines.supporting_cells(pm.Grid.box((0, 0), size, h), mirrored * h)[:, 0]
            free = np.abs(y[:, 0] - np.rint(y[:, 0])) > 1e-9  # on a plane either cell will do
            np.testing.assert_array_equal(5 - found[free], expected[free])


@EACH
@pytest.mark.parametrize("number", [1, 2, 3, 5])
@pytest.mark.parametrize("end", [4.0, 4.05, 4.4, 4.97])
def test_points_on_planes_have_no_side(basis, number, end):
    """Weights of a block of which many points are on planes, its end in the middle of a cell or not, with
    second derivatives: mirrored in a mirrored grid."""
    splines = basis_of(basis)
    along, across = np.arange(2.0, end + 1e-9, 1 / number), np.arange(1.0, 3.0 + 1e-9, 1 / number)
    x = np.stack(np.meshgrid(np.append(along, end), across, indexing="ij"), axis=-1).reshape(-1, 2)
    x = np.array_split(x, COMM.size)[COMM.rank]
    grid, half = pm.Grid.box((0, 0), (7, 4), 1.0), np.full(x.shape, 0.5 / number)

    def dense(at: np.ndarray, axis: int) -> np.ndarray:
        w = splines.weights(grid, at, half, splines.supporting_cells(grid, at), 3)
        out = np.zeros((len(at), 3, 12))
        for p in range(len(at)):
            n = w.count[p, axis]
            out[p, :, w.lowest[p, axis] : w.lowest[p, axis] + n] = w.table[p, axis, :, :n]
        return out[:, :, : grid.shape[axis] + splines.degree]

    for axis in (0, 1):
        mirror = np.where(np.arange(2) == axis, -1.0, 1.0)
        mirrored = dense(x * mirror + (1.0 - mirror) / 2 * grid.shape, axis)
        np.testing.assert_allclose(
            mirrored[:, :, ::-1] * [[1.0], [-1.0], [1.0]], dense(x, axis), rtol=0, atol=1e-9
        )


def block(
    dim: int, material: pm.Material, offset: float, basis: str = "bspline", **options
) -> pm.QuasiStatic:
    """A block of 4 x 1 (x 1) cells that stands on the grid's lower x boundary, in between other planes; as
    many points in a cell as it has functions, which a body of one cell across needs. Along x they integrate
    the functions' gradients exactly, those of cubic ones at Gauss positions."""
    per_cell, size = basis_of(basis).functions, (4, 1, 1)[:dim]
    axes = [(np.arange(n * per_cell) + 0.5) / per_cell for n in size]
    share = np.full(per_cell, 1.0 / per_cell)
    if per_cell > 3:
        gauss, weight = np.polynomial.legendre.leggauss(per_cell)
        axes[0] = (np.arange(size[0])[:, None] + 0.5 * (1.0 + gauss)).ravel()
        share = 0.5 * weight
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    x[:, 1:] += offset
    volume = np.repeat(np.tile(share, size[0]), per_cell ** (dim - 1)) / per_cell ** (dim - 1)
    x, volume = (np.array_split(a, COMM.size)[COMM.rank] for a in (x, volume))
    half = np.full(x.shape, 0.5 / per_cell)
    grid = pm.Grid.box((0, -5, -5)[:dim], (8, 6, 6)[:dim], 1.0)
    options = {**pm.PUBLISHED, "basis": basis, **options}
    problem = pm.QuasiStatic(grid, Points(x, volume, half, material, COMM), **options)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    return problem


@EACH
@pytest.mark.parametrize("dim", [2, 3])
def test_newton_converges_wherever_the_body_is_cut(dim, basis):
    """Positions just across a plane and in between: as few iterations as in any other place."""
    tips = []
    for offset in (0.0, 1e-9, 1e-4, 0.01, 0.05, 0.11, 0.17, 0.4, 0.66, 0.67, 0.83, 0.99):
        problem = block(dim, MICROPOLAR, offset, basis, reset=None)
        tip = problem.points.farthest((1, 0, 0)[:dim])
        problem.load(tip, force=(400.0, -40.0, 20.0)[:dim])
        assert max(s.iterations for s in full(problem, 5)) <= 9
        tips.append(problem.points.mean_displacement(tip))
    assert np.abs(np.array(tips) - tips[0]).max() < 0.03 * np.linalg.norm(tips[0])


# patch test ---------------------------------------------------------------------------------------
@EACH
@pytest.mark.parametrize("reset", [1, None])
@pytest.mark.parametrize(
    ("dim", "material"),
    [
        pytest.param(2, MICROPOLAR, id="2d"),
        pytest.param(2, HENCKY, id="2d-hencky"),
        pytest.param(3, MICROPOLAR, id="3d"),
        pytest.param(3, NEO_HOOKEAN, id="3d-neo-hookean"),
    ],
)
def test_patch_of_a_body_that_cuts_cells(dim, material, reset, basis, strict):
    """Prescribed around the body's middle, a homogeneous stretch is exact; with and without resets. The body
    reaches as far as the free functions do: of sums of gradients over cells cut somewhere only those of
    linear ones are exact."""
    cells, inner = (9, (2.9, 5.1)) if basis == "bspline3" else (7, (2.4, 4.0))
    grid = pm.Grid.box((0,) * dim, (cells,) * dim, 1.0)
    lower, upper = np.full(dim, 0.85), np.full(dim, cells - 1.4)
    points = pm.seed(grid, material=material, points_per_cell=3, bounds=(lower, upper), cut=False)
    shift = 0.003 * np.arange(1, dim + 1)
    points.x = points.X = points.x + shift
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=reset, controls=strict, balanced_reset=False)
    grad = 0.5 * (STRETCH + STRETCH.T)[:dim, :dim]
    theta = {"theta": 0} if material.micropolar else {}
    problem.fix(
        lambda x: np.any((x < inner[0]) | (x > inner[1]), axis=1),
        u=lambda t, x: t * (x - 3.0) @ grad.T,
        **theta,
    )
    full(problem)
    F = np.eye(3)
    F[:dim, :dim] += grad
    np.testing.assert_allclose(points.F, np.broadcast_to(F, points.F.shape), rtol=0, atol=1e-10)
    expected = points.X + (points.X - 3.0) @ grad.T
    np.testing.assert_allclose(points.x, expected, rtol=0, atol=1e-10)


@EACH
def test_rigid_rotation(basis, strict):
    """A body that cuts cells turns without strain; control values of a linear field are the field's."""
    problem = block(2, MICROPOLAR, 0.37, basis, reset=None, controls=strict)
    release_supports(problem)

    def turn(t: float, x: np.ndarray) -> np.ndarray:
        c, s = np.cos(0.5 * t), np.sin(0.5 * t)
        return x @ np.array([[c - 1, s], [-s, c - 1]])

    problem.fix(lambda x: x[:, 0] < 1.0, u=turn, theta=0.5)
    full(problem, 5)
    strain = np.swapaxes(problem.points.F, 1, 2) @ problem.points.F - np.eye(3)
    np.testing.assert_allclose(strain, 0.0, atol=1e-9)
    np.testing.assert_allclose(problem.points.rotation_vector[:, 2], 0.5, atol=1e-9)


# accuracy -----------------------------------------------------------------------------------------
@EACH
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 0.02, 0.3])
def test_tension_of_a_body_that_cuts_cells(dim, offset, basis, strict):
    """Free faces anywhere in their cells: without lateral strain the state is homogeneous to rounding."""
    material = pm.MicropolarElastic(lam=0.0, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)
    problem = block(dim, material, offset, basis, reset=None, controls=strict)
    problem.fix(lambda x: x[:, 0] > 2.0, ux=lambda t, x: 0.3 * t * x[:, 0], theta=0)
    full(problem, 2)
    F = np.diag([1.3, 1.0, 1.0])
    np.testing.assert_allclose(problem.points.F, np.broadcast_to(F, problem.points.F.shape), atol=1e-9)


def strip_deflection(basis: str, offset: float, per_cell: int = 3) -> float:
    """Deflection of a strip of 10 x 1 cells over that of Timoshenko's beam, for a tiny end force."""
    length, mu, force = 10.0, 1e3, 1e-4
    points = pm.seed(
        pm.Grid.box((0, offset), (length, 1 + offset), 1.0),
        material=pm.NeoHookean(lam=0.0, mu=mu),
        points_per_cell=per_cell,
        layout="gauss",
    )
    problem = pm.QuasiStatic(
        pm.Grid.box((0, -2), (12, 4), 1.0), points, basis=basis, reset=None, balanced_reset=False
    )
    problem.fix(pm.plane(x=0.0), u=0)
    # the last layer of points is one Gauss position short of the end
    end = points.farthest((1, 0))
    at = float(points.mean(points.X[:, 0], end))
    problem.load(end, force=(0, -force))
    full(problem)
    beam_deflection = force * (at**3 / (3 * 2 * mu / 12) + 1.2 * at / mu)
    return -problem.points.mean_displacement(end)[1] / beam_deflection


@pytest.mark.parametrize("offset", [0.0, 0.05, 0.35, 0.5])
def test_thin_strip_does_not_lock(offset):
    """One or two cells through the thickness: splines find the beam's deflection, bilinear weights don't."""
    assert strip_deflection("bspline", offset) == pytest.approx(1.0, abs=0.03)
    assert strip_deflection("mpm", offset) < 0.9


@pytest.mark.parametrize("offset", [0.0, 0.05, 0.35, 0.5])
def test_cubic_splines_bend_the_strip_better(offset):
    """A beam's deflection is a cubic: what is left of the error is the clamp's, a thirtieth."""
    error = [abs(strip_deflection(basis, offset, 4) - 1.0) for basis in ("bspline", "bspline3")]
    assert error[1] < min(error[0], 1e-4)


# use ----------------------------------------------------------------------------------------------
@EACH
@pytest.mark.parametrize("dim", [2, 3])
def test_a_grid_of_a_few_cells(dim, basis):
    """A tension test in one cell, in two, and in three gives the same with points that integrate gradients
    exactly; upper boundary planes can be supports."""
    found = []
    for cells in (1, 2, 3):
        grid = pm.Grid.box((0,) * dim, (1,) * dim, 1 / cells)
        layout = "gauss" if basis == "bspline3" else "uniform"
        number = (4, 2, 2)[cells - 1]
        points = pm.seed(grid, material=NEO_HOOKEAN, points_per_cell=number, layout=layout)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, balanced_reset=False)
        for axis in "xyz"[:dim]:
            problem.fix(pm.plane(**{axis: 0.0}), **{f"u{axis}": 0})
        right = problem.fix(pm.plane(x=1.0), ux=0.2)
        full(problem, 2)
        found.append([problem.reaction(right)[0][0], *by_id(points, points.F)[0, :dim, :dim].diagonal()])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
    np.testing.assert_allclose(found[0], found[2], rtol=1e-9)
    assert found[0][1] == pytest.approx(1.2)


def test_interior_planes_are_refused():
    """The message names the plane and the planes that are allowed; boundary planes are accepted."""
    grid = pm.Grid.box((-1, -3), (6, 3), 0.5)
    with pytest.raises(pm.InputError, match=r"plane x = 0 .*bspline.*allowed are -1 and 6"):
        SPLINES.check_plane(pm.plane(x=0.0), grid)
    SPLINES.check_plane(pm.plane(x=6.0), grid)
    basis_of("mpm").check_plane(pm.plane(x=0.0), grid)
    with pytest.raises(pm.InputError, match="plane y = 0 is not a boundary plane"):
        block(2, MICROPOLAR, 0.0).fix(pm.plane(y=0.0), u=0)


@EACH
@pytest.mark.parametrize("reset", [1, None])
def test_grid_file_shows_the_field_at_the_corners(folder, reset, basis):
    """Displacements at the cells' corners, not the control values; slivers are left out."""
    problem = block(2, MICROPOLAR, 0.05, basis, reset=reset)
    release_supports(problem)
    problem.fix(lambda x: np.full(len(x), True), ux=lambda t, x: 0.1 * t * x[:, 0], uy=0, theta=0.2)
    with pm.Recorder(folder / "strip.pvd", problem, grid=True) as record:
        for step in problem.march(1, progress=False):
            record(step)
    pieces = ET.parse(folder / "strip_grid.pvd").getroot().iter("DataSet")
    meshes = [meshio.read(folder / p.get("file")) for p in pieces if float(p.get("timestep")) == 1.0]
    x, u, w = (
        np.concatenate(rows)
        for rows in zip(
            *(
                (m.points, m.point_data["displacement_increment"], m.point_data["rotation_increment"])
                for m in meshes
            ),
            strict=True,
        )
    )
    assert {float(y) for y in x[:, 1]} == {0.0, 1.0}
    np.testing.assert_allclose(u[:, 0], 0.1 * x[:, 0], atol=1e-12)
    np.testing.assert_allclose(w[:, 2], 0.2, atol=1e-12)


@EACH
def test_restart_between_resets(folder, basis):
    """Lattice numbers and control values are enough to go on to the same digits."""
    runs = [block(2, MICROPOLAR, 0.05, basis, reset=None) for _ in range(2)]
    for problem in runs:
        tip = problem.points.farthest((1, 0))
        problem.load(tip, force=(0.0, -60.0))
    for step in runs[0].march(4, progress=False):
        if step.number == 2:
            pm.save_restart(runs[0], folder / "strip.h5")
    pm.load_restart(runs[1], folder / "strip.h5")
    list(runs[1].march(2, progress=False))
    found, expected = (by_id(p.points, p.points.x) for p in runs)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
