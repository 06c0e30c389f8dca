"""Runs on grids of graded lines.

This file is also the script that the ranks run: `mpirun -n 2 python test_graded.py CASE OUTPUT`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.assembly.points import PointSystem
from polarmpm.terms.ghost import Ghost, GhostPenalty, stencil
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id
from tests.helpers.ranks import close, on_ranks, report

STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)
BASES = ("mpm", "gimpm", "bspline", "bspline3", "bspline-averaged")
JITTERED = np.array([0.0, 0.9, 1.3, 2.3, 2.8, 3.4])


def linear(problem: pm.QuasiStatic) -> np.ndarray:
    """Prescribe u = H X on all walls, and solve; H."""
    grid, dim = problem.grid, problem.grid.dim
    H = 0.1 * np.random.default_rng(1).standard_normal((dim, dim))
    motion = {f"u{'xyz'[i]}": lambda t, x, i=i: t * (x @ H[i]) for i in range(dim)}
    for axis in range(dim):
        for wall in (grid.lower[axis], grid.upper[axis]):
            problem.fix(pm.plane(**{"xyz"[axis]: wall}, moving=False), **motion)
    list(problem.march(1, progress=False))
    return H


@pytest.mark.parametrize("options", [{}, {"locking": "always"}], ids=["", "cured"])
@pytest.mark.parametrize("basis", BASES)
def test_patch(basis, options):
    """A body that fills the grid takes a linear field; cubics with points that integrate them."""
    grid = pm.Grid.graded(x=JITTERED, y=-JITTERED[::-1])
    gauss = {"points_per_cell": 3, "layout": "gauss"} if basis == "bspline3" else {}
    points = pm.seed(grid, material=NEO_HOOKEAN, **gauss)
    problem = pm.QuasiStatic(grid, points, basis=basis, controls=STRICT, reset=None, **options)
    H = linear(problem)
    np.testing.assert_allclose(points.displacement, points.X @ H.T, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        points.F[:, :2, :2], np.broadcast_to(np.eye(2) + H, (len(points), 2, 2)), atol=1e-12
    )


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_patch_in_space(basis):
    grid = pm.Grid.graded(x=JITTERED[:4], y=-JITTERED[:4][::-1], z=[0, 0.5, 1.5, 2.0])
    points = pm.seed(grid, material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, basis=basis, controls=STRICT, reset=None)
    H = linear(problem)
    np.testing.assert_allclose(points.displacement, points.X @ H.T, rtol=0, atol=1e-12)


def test_projection_is_the_direct_sum():
    found = []
    for assembly in ("direct", "projection"):
        problem = cantilever("mpm", assembly=assembly, locking=None)
        found.append(by_id(problem.points, problem.points.displacement))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-10 * np.abs(found[0]).max())


def cantilever(basis: str, *, restart: Any = None, **options: Any) -> pm.QuasiStatic:
    """A bar that doesn't fit the lines, with an end that is loaded, a moved surface and resets."""
    x = pm.lines(0, 5, fine=0.2, where=(0, 1), growth=1.3)
    grid = pm.Grid.graded(x=x, y=pm.lines(-1, 2, fine=0.2, where=0.3, growth=1.3))
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3.7, 0.83)), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=2, controls=STRICT, **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(5.0, -9.0))
    problem.traction(pm.Surface.line((1.0, 0.83), (0.4, 0.83), 7), force=(3.0, 8.0))
    list(problem.march(3, progress=False))
    return problem


def test_bodies_at_any_height():
    """The deflection of a cantilever of splines hardly depends on how it lies on lines of 1:4."""
    x, y = (np.concatenate([[0.0], np.cumsum(4.0 ** (np.arange(n) / (n - 1)))]) for n in (14, 10))
    found = []
    for low in (0.11, 0.31, 0.47, 0.82, 1.13, 1.27):
        grid = pm.Grid.graded(x=5.2 * x / x[-1], y=2.5 * y / y[-1])
        points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, low), (4.0, low + 1.0)))
        problem = pm.QuasiStatic(grid, points)
        problem.fix(pm.plane(x=0.0), u=0)
        problem.body_load(force=(0.0, -0.05))
        list(problem.march(1, progress=False))
        sums = COMM.allreduce(np.array([points.volume0 @ points.displacement[:, 1], points.volume0.sum()]))
        found.append(sums[0] / sums[1])
    assert np.ptp(found) < 0.005 * abs(np.mean(found))


@pytest.mark.parametrize("basis", ["bspline", "gimpm"])
def test_halves_of_symmetric_bodies(basis):
    """With lines that are mirrored at the plane of symmetry, the half is the whole body."""
    half = np.array([0.0, 0.1, 0.25, 0.45, 0.8, 1.0])
    found = []
    for low, x in ((-1.0, np.concatenate([-half[:0:-1], half])), (0.0, half)):
        grid = pm.Grid.graded(x=x, y=half)
        points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((low, 0.0), (1.0, 0.6)))
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=None, controls=STRICT)
        if low == 0.0:
            problem.symmetry(pm.plane(x=0.0))
        else:
            problem.fix(pm.plane(x=-1.0), u=0)
        problem.fix(pm.plane(x=1.0), u=0)
        problem.body_load(force=lambda t, X: t * np.stack([500 * X[:, 0], -400 * (1 - X[:, 0] ** 2)], axis=1))
        list(problem.march(1, progress=False))
        rows = np.concatenate(COMM.allgather(np.hstack([points.X, points.displacement])))
        found.append({tuple(r[:2].round(6) + 0.0): r[2:] for r in rows})
    whole, part = found
    error = [part[x] - whole[x] for x in part]
    assert np.abs(error).max() < 1e-12 * 1e3 * np.abs(list(part.values())).max()


def test_domains_beyond_a_plane_of_symmetry_need_mirrored_lines():
    grid = pm.Grid.graded(x=[-0.8, 0, 0.3, 0.7, 1], y=[0, 0.5, 1])
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (1, 1)))
    problem = pm.QuasiStatic(grid, points, basis="gimpm")
    with pytest.raises(pm.InputError, match=r"symmetry: plane x = 0: domains of points reach beyond"):
        problem.symmetry(pm.plane(x=0.0))


@pytest.mark.parametrize("basis", BASES[:3])
def test_a_moving_plane_stretches_all_cells_alike(basis):
    """A block under a platen is compressed evenly, whatever the lines; the reaction is that of a box."""
    reactions = []
    for y in (np.linspace(0, 1.5, 6), [0, 0.4, 0.6, 1.1, 1.35, 1.5]):
        grid = pm.Grid.graded(x=[0, 0.3, 0.5, 1.0], y=y)
        points = pm.seed(grid, material=NEO_HOOKEAN)
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, controls=STRICT)
        for x in (0.0, 1.0):
            problem.fix(pm.plane(x=x), ux=0)
        problem.fix(pm.plane(y=0.0), uy=0)
        platen = problem.fix(pm.plane(y=1.5), uy=-0.6)
        list(problem.march(3, progress=False))
        assert problem.grid.upper[1] == pytest.approx(1.1)  # the last reset was before the last step
        reactions.append(problem.reaction(platen).force[1])
    assert reactions[1] == pytest.approx(reactions[0], rel=1e-10)


# terms ------------------------------------------------------------------------------------------------
def test_ghost_stencils_are_those_of_dolfinx():
    grid = pm.Grid.graded(x=[0, 1, 3, 4.2], y=[0, 0.2, 0.5], z=[0, 0.4, 1.0])
    layout = pm.QuasiStatic(grid, pm.seed(grid, material=NEO_HOOKEAN), basis="mpm").layout
    reached = grid.cell_number(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [1, 1, 0]]))
    faces = 0
    for power in (1, 3):
        for axis, piece in enumerate(
            Ghost(GhostPenalty(2.0, power=power), layout).faces(grid, np.sort(reached))
        ):
            for cell, matrix in zip(
                piece.boxes.lowest,
                np.broadcast_to(piece.matrix, (len(piece.boxes.lowest), *piece.matrix.shape[1:])),
                strict=True,
            ):
                index = grid.node_index(np.array([cell]))
                size, above = grid.sizes(index)[0], grid.sizes(index + np.eye(3, dtype=int)[axis])[0, axis]
                expected = 2.0 * stencil(tuple(map(float, size)), axis, power, float(above))
                np.testing.assert_allclose(
                    matrix[..., 0], expected, rtol=0, atol=1e-13 * np.abs(expected).max()
                )
                faces += 1
    assert COMM.allreduce(faces) > 0


# points -----------------------------------------------------------------------------------------------
def test_the_farthest_layer_is_one_layer():
    """Of fine cells at the end of a body with coarse ones, and of coarse ones beside fine ones."""
    x = pm.lines(0, 10, fine=0.1, where=0, growth=1.2)
    grid = pm.Grid.graded(x=x, y=[0, 1, 3])
    points = pm.seed(grid, material=NEO_HOOKEAN)
    for direction, depth in (((-1, 0), x[1] / 4), ((1, 0), 10 - (x[-1] - x[-2]) / 4)):
        layer = points.farthest(direction)
        assert len(layer) == 4
        np.testing.assert_allclose(points.x[points.rows(layer), 0], depth, rtol=1e-12)
    assert len(points.farthest((0, 1))) == 2 * (len(x) - 1)


def test_seeded_points_have_the_bodys_volume_and_moments():
    grid = pm.Grid.graded(x=JITTERED, y=JITTERED)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.3, 0.1), (3.1, 2.9)))
    total = COMM.allreduce(points.volume0.sum())
    second = COMM.allreduce(
        np.einsum("n,ni->i", points.volume0, points.X**2)
        + np.einsum("n,nki->i", points.volume0, points.half_axes0**2) / 3
    )
    assert total == pytest.approx(2.8**2, rel=1e-14)
    np.testing.assert_allclose(second, [2.8 * (3.1**3 - 0.3**3) / 3, 2.8 * (2.9**3 - 0.1**3) / 3], rtol=1e-13)


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_the_choice_of_a_solver_counts_lines(basis, monkeypatch):
    """Not lengths over the smallest cell, which would make a compact body a slender one."""
    asked = []
    monkeypatch.setattr(PointSystem, "_is_large", lambda self, n: bool(asked.append(n)))
    x = pm.lines(0, 10, fine=0.05, where=0, growth=2.5, keep=[0.2])
    grid = pm.Grid.graded(x=x, y=[0, 1, 3])
    problem = pm.QuasiStatic(grid, pm.seed(grid, material=NEO_HOOKEAN), basis=basis)
    problem.fix(pm.plane(x=0.0), u=0)
    list(problem.march(1, progress=False))
    assert set(asked) == {len(x) - 1.0 + (basis == "bspline")}


# files, ranks -------------------------------------------------------------------------------------------
def test_restart(folder):
    """A run goes on; other lines are another grid."""
    whole = cantilever("bspline")
    list(whole.march(2, progress=False, to=1.5))
    half = cantilever("bspline")
    pm.save_restart(half, folder / "run.h5")
    fresh = restarted(pm.lines(0, 5, fine=0.2, where=(0, 1), growth=1.3))
    pm.load_restart(fresh, folder / "run.h5")
    list(fresh.march(2, to=1.5, progress=False))
    expected = by_id(whole.points, whole.points.x)
    np.testing.assert_allclose(by_id(fresh.points, fresh.points.x), expected, rtol=0, atol=1e-9)
    with pytest.raises(pm.InputError, match="lines x"):
        pm.load_restart(restarted(pm.lines(0, 5, fine=0.2, where=(0, 1), growth=1.2)), folder / "run.h5")


def restarted(x: np.ndarray) -> pm.QuasiStatic:
    """The cantilever before its first step, with other lines along x, but nearly the same points."""
    grid = pm.Grid.graded(x=x, y=pm.lines(-1, 2, fine=0.2, where=0.3, growth=1.3))
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3.7, 0.83)), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, basis="bspline", reset=2, controls=STRICT)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(5.0, -9.0))
    problem.traction(pm.Surface.line((1.0, 0.83), (0.4, 0.83), 7), force=(3.0, 8.0))
    return problem


def answers(_: str = "") -> dict[str, Any]:
    found = {}
    for basis, options in (("bspline", {"locking": "always"}), ("gimpm", {"ghost": "light"})):
        problem = cantilever(basis, **options)
        found[basis] = by_id(problem.points, problem.points.displacement).tolist()
    return found


@pytest.mark.mpi
def test_ranks_agree():
    serial = answers()
    for found in on_ranks(2, "answers", script=__file__):
        for basis, expected in serial.items():
            close(found[basis], expected)


if __name__ == "__main__":
    report(answers)
