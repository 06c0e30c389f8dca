"""Grids that are stretched to follow a platen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated, by_id
from tests.helpers.bodies import box

SIZE = (1.0, 1.5, 0.5)


def block(
    dim: int = 2,
    material: pm.Material = NEO_HOOKEAN,
    *,
    by: Any = -0.75,
    moving: bool = True,
    confined: bool = True,
    rough: bool = False,
    comm: MPI.Comm = COMM,
    **options: Any,
) -> pm.QuasiStatic:
    """A block between a wall at y = 0 and a platen at y = 1.5; free or held at its sides."""
    grid = pm.Grid.box((0.0, 0.0, 0.0)[:dim], (3.0, 2.0, 0.5)[:dim], 0.5, comm)
    points = pm.seed(grid, material=material, bounds=((0.0,) * dim, SIZE[:dim]))
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, **options})
    problem.fix(pm.plane(x=0.0), ux=0)
    if confined:
        problem.fix(pm.plane(x=1.0), ux=0)
    if dim == 3:
        problem.fix(pm.plane(z=0.0), uz=0)
        problem.fix(pm.plane(z=0.5), uz=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    held = {"ux": 0} if rough else {}
    problem.fix(pm.plane(y=1.5, moving=moving), uy=by, **held)
    return problem


def side_stretch(material: pm.Material, a: float, confined: bool) -> float:
    """Stretch along x of a block whose sides are free, at the stretch a along y, in plane strain."""
    if confined:
        return 1.0
    if material.micropolar:
        return 1.0 - material.lam / (material.lam + 2 * material.mu) * (a - 1.0)
    low, high = 0.5, 3.0  # P_xx = mu (s - 1/s) + lam ln(s a) / s grows with s
    for _ in range(80):
        s = 0.5 * (low + high)
        low, high = (s, high) if material.mu * (s * s - 1) + material.lam * np.log(s * a) < 0 else (low, s)
    return s


def axial_stress(material: pm.Material, a: float, s: float) -> float:
    """Cauchy stress along y of stretches s along x and a along y."""
    if material.micropolar:
        return (material.lam * (s + a - 2) + 2 * material.mu * (a - 1)) / s
    return (material.mu * (a * a - 1) + material.lam * np.log(s * a)) / (s * a)


@pytest.mark.parametrize("reset", [1, 3])
@pytest.mark.parametrize("confined", [True, False])
@pytest.mark.parametrize("basis", ["mpm", "gimpm"])
@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
def test_even_compression_to_a_half(material, basis, confined, reset, strict):
    """The state is the closed form at every step: the platen stays on the body's face at all resets."""
    problem = block(material=material, basis=basis, confined=confined, reset=reset, controls=strict)
    points, top = problem.points, problem.supports[-1]
    for step in problem.march(15):
        a = 1.0 - 0.5 * step.factor
        s = side_stretch(material, a, confined)
        np.testing.assert_allclose(points.x, points.X * [s, a], rtol=1e-9)
        sigma = axial_stress(material, a, s)
        np.testing.assert_allclose(problem.fields().stress[:, 1, 1], sigma, rtol=1e-8)
        np.testing.assert_allclose(problem.reaction(top)[0][1], sigma * s * SIZE[0], rtol=1e-8)
    assert problem.grid.shape == problem.initial_grid.shape
    last = (1.0 - 0.5 * problem.progress.reset_factor) * np.array([1.0, 4 / 3])
    np.testing.assert_allclose(problem.grid.upper[1], 1.5 * last[1], rtol=1e-12)
    assert problem.initial_grid.upper[1] == 2.0
    assert problem.grid.cell[0] == 0.5


def test_in_space():
    problem = block(3)
    for step in problem.march(5):
        a = 1.0 - 0.5 * step.factor
        np.testing.assert_allclose(problem.points.x, problem.points.X * [1.0, a, 1.0], rtol=1e-8)
        expected = axial_stress(NEO_HOOKEAN, a, 1.0)
        np.testing.assert_allclose(problem.fields().stress[:, 1, 1], expected, rtol=1e-7)


def test_a_fixed_grid_loses_the_platen():
    """What the moving plane is for: on a fixed grid the plane is in empty space after the first reset."""
    problem = block(moving=False)
    with pytest.raises(pm.SupportLost, match=r"\(y = 1.5\).*after step \d.*moving=True"):
        list(problem.march(10))
    assert problem.progress.step


def test_there_and_back(strict):
    """Stretching, compression and the way back: the grid follows the present factor alone."""
    problem = block(by=lambda t: 0.6 * np.sin(2 * np.pi * t), confined=False, controls=strict)
    for step in problem.march(12):
        a = 1.0 + 0.4 * np.sin(2 * np.pi * step.factor)
        s = side_stretch(NEO_HOOKEAN, a, False)
        np.testing.assert_allclose(problem.points.x, problem.points.X * [s, a], rtol=1e-8)
    np.testing.assert_allclose(problem.points.x, problem.points.X, rtol=1e-8)
    assert problem.attempt(1.0).converged
    np.testing.assert_allclose(problem.grid.cell, problem.initial_grid.cell, rtol=1e-14)


def test_the_lower_wall_moves():
    """The lower wall itself: then the upper one stays."""
    grid = pm.Grid.box((0.0, -1.0), (1.0, 1.0), 0.5)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, -1.0), (1.0, 1.0)))
    problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(x=1.0), ux=0)
    problem.fix(pm.plane(y=-1.0, moving=True), counts="from now", u=lambda t: (0, 0.2 + 0.8 * t))
    problem.fix(pm.plane(y=1.0), uy=0)
    for step in problem.march(4):
        a = 1.0 - 0.4 * step.factor
        np.testing.assert_allclose(1.0 - points.x[:, 1], a * (1.0 - points.X[:, 1]), rtol=1e-8)
    assert problem.grid.upper[1] == 1.0
    np.testing.assert_allclose(problem.grid.origin, (0.0, -0.4), atol=1e-12)


@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
def test_planes_of_two_axes(basis):
    """Each axis may have one; splines too, whose gradients Gauss points integrate exactly."""
    grid = pm.Grid.box((0.0, 0.0), (1.0, 1.5), 0.25)
    layout = "gauss" if basis == "bspline3" else "uniform"
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, 0.0), (1.0, 1.5)), layout=layout)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(x=1.0, moving=True), ux=0.3)
    problem.fix(pm.plane(y=1.5, moving=True), uy=-0.6)
    for step in problem.march(5):
        stretch = 1.0 + np.array([0.3, -0.4]) * step.factor
        np.testing.assert_allclose(points.x, points.X * stretch, rtol=1e-8)


def test_the_share_of_the_ranks_does_not_matter(strict):
    """An uneven state, between rough platens."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        problem = block(confined=False, rough=True, by=-0.3, comm=comm, controls=strict)
        list(problem.march(4))
        ids = np.argsort(problem.points.id)
        found.append(
            problem.points.x[ids] if comm is MPI.COMM_SELF else by_id(problem.points, problem.points.x)
        )
    assert abs(found[1][:, 0] / by_id(problem.points, problem.points.X)[ids, 0] - 1).max() > 0.05
    np.testing.assert_allclose(found[0], found[1], rtol=1e-10)


@pytest.mark.parametrize("stop", [2, 4, 5])
def test_restart_goes_on_to_the_same_digits(folder: Path, stop):
    """At a reset and between two; the grid follows from the factor in the file."""
    options = {"confined": False, "rough": True, "reset": 2, "by": -0.5}
    straight, first, second = (block(**options) for _ in range(3))
    list(straight.march(8))
    for step in first.march(8):
        if step.number == stop:
            break
    pm.save_restart(first, folder / "state.h5")
    pm.load_restart(second, folder / "state.h5")
    list(second.march(8 - stop))
    assert second.grid == straight.grid
    for name, values in second.points.arrays().items():
        expected = by_id(straight.points, getattr(straight.points, name))
        assert_repeated(by_id(second.points, values), expected, name)


def test_a_failed_step_leaves_the_grid():
    problem = block()
    list(problem.march(2, to=0.4))
    x = problem.points.x.copy()
    assert not problem.attempt(50.0).converged
    assert problem.attempt(0.4).converged
    np.testing.assert_allclose(problem.points.x, x, rtol=1e-12)
    np.testing.assert_allclose(problem.grid.cell[1], 0.5 * 0.8, rtol=1e-14)


def test_adaptive_steps():
    """Platens that move too far at once are brought there in shorter steps."""
    few = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26, max_iterations=4)
    problem = block(by=-1.05, confined=False, controls=few)
    steps = list(problem.march(1, adaptive=True, progress=False))
    assert sum(step.cuts for step in steps) > 0
    assert steps[-1].factor == 1.0
    s = side_stretch(NEO_HOOKEAN, 0.3, False)
    np.testing.assert_allclose(problem.points.x, problem.points.X * [s, 0.3], rtol=1e-9)
    np.testing.assert_allclose(problem.fields().stress[:, 1, 1], axial_stress(NEO_HOOKEAN, 0.3, s), rtol=1e-8)


def test_the_recorded_grid_is_the_stretched_one(folder: Path):
    meshio = pytest.importorskip("meshio")
    problem = block()
    with pm.Recorder(folder / "run.pvd", problem, grid=True, initial=False) as record:
        for step in problem.march(4, progress=False):
            record(step)
    files = sorted((folder / "run").glob("*grid_0004_*.vtu"))
    nodes = [meshio.read(file) for file in files]
    x = np.concatenate([n.points for n in nodes])
    moved = np.concatenate([n.point_data["displacement_increment"] for n in nodes])
    # the last reset was at 3/4 of the way
    np.testing.assert_allclose(x[:, 1].max(), 1.5 * (1 - 0.375), rtol=1e-12)
    np.testing.assert_allclose(moved[:, 1], -0.125 / (1 - 0.375) * x[:, 1], atol=1e-9)


def test_a_support_given_later_stands_on_the_stretched_grid():
    """Planes are named as in the initial grid."""
    problem = block()
    list(problem.march(2, to=0.5))
    late = problem.fix(pm.plane(y=0.5), ux=0)
    list(problem.march(1, to=0.6))
    np.testing.assert_allclose(late.where.value, 0.5 * (1.0 - 0.5 * 0.5), rtol=1e-12)
    assert late.where.side == 0
    np.testing.assert_allclose(problem.points.x[:, 1], 0.7 * problem.points.X[:, 1], rtol=1e-8)


def test_finite_elements_take_the_same_script():
    problem = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (2, 3), (1.0, 1.5)), material=NEO_HOOKEAN))
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(x=1.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(y=1.5, moving=True), uy=-0.75)
    list(problem.march(5))
    np.testing.assert_allclose(problem.points.x, problem.points.X * [1.0, 0.5], rtol=1e-8)


@pytest.mark.parametrize(
    ("where", "components", "message"),
    [
        ({"y": 2.0, "moving": 1}, {"uy": 0.1}, "moving = 1"),
        ({"y": 2.0, "moving": True}, {"ux": 0.1}, "uy is to be prescribed"),
        ({"y": 2.0, "moving": True}, {"uy": lambda t, x: 0 * x[:, 0]}, "uy depends on the position"),
        ({"y": 2.0, "moving": True}, {"uy": 0.1}, r"support \d \(y = 1.5\) moves the grid along y already"),
        ({"y": 1.0}, {"uy": 0.0}, r"prescribes uy.*from its wall y = 0"),
    ],
)
def test_bad_input(where, components, message):
    """Named before anything is done."""
    problem = block()
    number = len(problem.supports)
    with pytest.raises(pm.InputError, match=message):
        problem.fix(pm.plane(**where), **components)
    assert len(problem.supports) == number
    list(problem.march(1, to=0.1))


def test_a_moving_plane_needs_its_wall():
    """The support that the grid would be torn from may come first."""
    grid = pm.Grid.box((0.0, -0.5), (1.0, 1.5), 0.5)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, 0.0), (1.0, 1.5)))
    problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    problem.fix(pm.plane(y=0.0), u=0)
    with pytest.raises(pm.InputError, match=r"support 1 \(y = 0\) prescribes uy.*from its wall y = -0.5"):
        problem.fix(pm.plane(y=1.5, moving=True), uy=-0.1)


def test_too_late_for_a_moving_plane():
    problem = block(moving=False)
    list(problem.march(1, to=0.01))
    with pytest.raises(pm.InputError, match="before the first load step"):
        problem.fix(pm.plane(y=2.0, moving=True), uy=0.1)


def test_a_platen_that_reaches_the_wall():
    """A grid of no height is refused."""
    with pytest.raises(pm.InputError, match=r"plane y = -0\.1 has reached the wall 0"):
        block().initial_grid.stretched(1, 3, 0, -0.1)


# planes that nobody has asked for ---------------------------------------------------------------------
def bar(basis: str, reset: Any, **options: Any) -> pm.QuasiStatic:
    grid = pm.Grid.box((0, -1), (4, 2), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=pm.NeoHookean.from_engineering(E=1e6, nu=0.0))
    return pm.QuasiStatic(grid, points, basis=basis, reset=reset, **options)


@pytest.mark.parametrize("reset", [1, pm.WhenDistorted()])
@pytest.mark.parametrize("basis", ["bspline", "mpm", "gimpm"])
def test_an_even_displacement_is_followed(basis, reset):
    """Half of the bar's length in one way: the closed form P = mu (a - 1/a) at a = 1/2, both reactions."""
    problem = bar(basis, reset)
    left = problem.fix(pm.plane(x=0.0), u=0)
    right = problem.fix(pm.plane(x=4.0), ux=-2.0, uy=0)
    list(problem.march(10, progress=False))
    np.testing.assert_allclose(problem.points.x[:, 0], 0.5 * problem.points.X[:, 0], rtol=1e-8)
    for support, sign in ((left, 1.0), (right, -1.0)):
        assert problem.reaction(support).force[0] == pytest.approx(sign * 5e5 * 1.5, rel=1e-7)


def test_two_walls_that_move():
    """Each is the wall that the other one's plane is stretched from."""
    problem = bar("bspline", 1)
    problem.fix(pm.plane(x=0.0), ux=1.0, uy=0)
    problem.fix(pm.plane(x=4.0), ux=-0.5, uy=0)
    list(problem.march(5, progress=False))
    np.testing.assert_allclose(problem.points.x[:, 0], 1.0 + 0.625 * problem.points.X[:, 0], rtol=1e-8)


def uneven(t: float, x: np.ndarray) -> np.ndarray:
    return -2.0 * t + 0.0 * x[:, 0]


@pytest.mark.parametrize("reset", [1, pm.WhenDistorted()])
@pytest.mark.parametrize("basis", ["bspline", "mpm", "gimpm"])
@pytest.mark.parametrize(
    ("where", "components", "cure"),
    [
        (pm.plane(x=4.0, moving=False), {"ux": -2.0, "uy": 0}, "moving=True"),
        (pm.plane(x=4.0), {"ux": uneven, "uy": 0}, "moving=True"),
        (pm.plane(x=4.0), {"uy": 0.1}, "hold a Surface"),
        (lambda x: x[:, 0] > 3.6, {"uy": 0}, "hold a Surface"),
    ],
)
def test_a_body_that_leaves_its_support(where, components, cure, basis, reset):
    """Named at the reset where it shows, whatever it prescribes; the last state is intact, and goes on."""
    problem = bar(basis, reset)
    problem.fix(pm.plane(x=0.0), u=0)
    support = problem.fix(where, **components)
    if "ux" not in components:
        tip = problem.points.farthest((1, 0))
        problem.load(tip, force=lambda t: (-4e5 * t, 0.0))
    with pytest.raises(pm.SupportLost, match=rf"support 2 .*after step \d.*intact.*{cure}"):
        list(problem.march(20, adaptive=True, progress=False))
    step, x = problem.progress.step, by_id(problem.points, problem.points.x)
    assert step > 0
    with pytest.raises(pm.SupportLost):
        problem.attempt(problem.progress.factor)
    np.testing.assert_array_equal(by_id(problem.points, problem.points.x), x)
    problem.release(support)
    assert problem.progress.step == step
