"""Halves, quarters and eighths of symmetric bodies, with planes of symmetry, are the whole bodies.

This file is also the script that the ranks run: `mpirun -n 2 python test_symmetry.py CASE OUTPUT`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, assert_repeated, by_id
from tests.helpers.bodies import box
from tests.helpers.ranks import close, on_ranks, report

STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)
HALF = np.array([1.0, 0.5, 0.25])  # of the body: along x it fills the grid, beside it there is room


def bounds_of(halved: str, upper: bool, dim: int, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = -size[:dim], size[:dim].copy()
    for axis in map("xyz".index, halved):
        (high if upper else low)[axis] = 0.0
    return low, high


def push(dim: int, t: float, X: np.ndarray) -> np.ndarray:
    """A body force that is mirrored at x = 0, at y = 0 and at z = 0."""
    x, y, z = np.hstack([X, np.zeros((len(X), 3 - dim))]).T
    force = [900.0 * np.sin(2 * x), 1500.0 * (np.abs(x) - 0.2) * np.sin(3 * y), 400.0 * (1 + x**2) * z]
    return t * np.stack(force[:dim], axis=1)


def bar(
    material: pm.Material,
    halved: str = "",
    *,
    upper: bool = False,
    dim: int = 2,
    bend: float = 0.0,
    where: np.ndarray | None = None,
    **options: Any,
) -> tuple[pm.QuasiStatic, list[Any]]:
    """A bar between walls at x = -1 and x = 1, of which planes of symmetry leave a part, and its supports.

    `bend`: a force along y that isn't mirrored at y = 0."""
    low, high = bounds_of(halved, upper, dim, np.array([1.0, 1.0, 0.5]))
    grid = pm.Grid.box(low, high, 0.25)
    points = pm.seed(grid, material=material, bounds=bounds_of(halved, upper, dim, HALF))
    options = {"basis": "bspline", "reset": None, "controls": STRICT, **options}
    problem = pm.QuasiStatic(grid, points, **options)
    supports = [problem.symmetry(pm.plane(**{axis: 0.0})) for axis in halved]
    theta = {"theta": 0} if material.micropolar else {}
    for x in {-1.0, 1.0} - ({1.0 if upper else -1.0} if "x" in halved else set()):
        supports.append(problem.fix(pm.plane(x=x), u=0, **theta))

    def force(t: float, X: np.ndarray) -> np.ndarray:
        side = np.zeros(dim)
        side[1] = bend * t
        return push(dim, t, X) + side * (1 - X[:, :1] ** 2)

    problem.body_load(force=force)
    return problem, supports


def rows_of(problem: Any) -> dict[tuple[float, ...], np.ndarray]:
    """Displacements, rotation vectors and stresses of all points by their initial positions. Collective."""
    p = problem.points
    stress = problem.fields().stress.reshape(len(p), 9)
    rows = np.hstack([p.X, p.displacement, p.rotation_vector, 1e-3 * stress])
    every = np.concatenate(COMM.allgather(rows))
    return {tuple(row[: p.dim].round(6) + 0.0): row[p.dim :] for row in every}


def assert_same(part: Any, whole: Any, tolerance: float = 1e-11) -> None:
    of_part, of_whole = rows_of(part), rows_of(whole)
    expected = np.array([of_whole[x] for x in of_part])
    found = np.array(list(of_part.values()))
    assert np.abs(found[:, : part.points.dim]).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def solve(made: tuple[Any, list[Any]], steps: int = 2) -> tuple[Any, list[Any]]:
    list(made[0].march(steps, progress=False))
    return made


BASES = ["bspline", "bspline3", "bspline-averaged", "mpm", "gimpm"]


@pytest.mark.parametrize("upper", [False, True], ids=["lower", "upper"])
@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize("basis", BASES)
def test_half_and_quarter(basis, material, upper):
    options = {"upper": upper, "basis": basis}
    for halved, bend in (("x", 40.0), ("xy", 0.0)):
        whole, _ = solve(bar(material, bend=bend, basis=basis))
        part, supports = solve(bar(material, halved, bend=bend, **options))
        assert_same(part, whole)
        assert part.balance().residue == pytest.approx((0.0, 0.0), abs=1e-11)
        for axis, support in zip(range(2), supports, strict=False):
            if axis < len(halved):  # the reaction is along the normal
                force = part.reaction(support).force
                assert abs(force[axis]) > 1.0
                assert abs(force[1 - axis]) < 1e-11 * abs(force[axis])


@pytest.mark.parametrize("basis", ["bspline", "bspline3"])
def test_the_slope_support_makes_the_difference(basis):
    """Without it the half is the whole body to the order of the functions only."""
    whole, _ = solve(bar(NEO_HOOKEAN, basis=basis, bend=40.0))
    grid = pm.Grid.box((0.0, -1.0), (1.0, 1.0), 0.25)
    half, _ = bar(NEO_HOOKEAN, "x", basis=basis, bend=40.0)
    half.release(half.supports[0])
    half.fix(pm.plane(x=0.0), ux=0)
    list(half.march(2, progress=False))
    with pytest.raises(AssertionError):
        assert_same(half, whole, 1e-6)
    assert_same(half, whole, 0.1)
    assert grid.shape == (4, 8)


@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize("basis", ["bspline", "bspline3", "gimpm"])
def test_in_the_wake_of_resets(basis, material):
    """A balanced reset solves on the same unknowns. (Where points' domains overlap many cells, it shifts a
    matrix by its largest diagonal, which isn't that of the whole body: `gimpm` lets go here.)"""
    options = {"basis": basis, "reset": 1, "balanced_reset": basis != "gimpm", "bend": 40.0}
    whole, _ = solve(bar(material, **options), 3)
    half, _ = solve(bar(material, "x", **options), 3)
    assert_same(half, whole)
    assert half.balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)


def test_space():
    """Of the microrotation the component about the normal is even, those about tangents are odd."""
    for basis, halved in (("bspline", "xyz"), ("gimpm", "xz"), ("bspline3", "yz")):
        options = {"dim": 3, "basis": basis, "reset": 1, "balanced_reset": basis != "gimpm"}
        bend = 0.0 if "y" in halved else 20.0
        whole, _ = solve(bar(MICROPOLAR, bend=bend, **options))
        part, _ = solve(bar(MICROPOLAR, halved, bend=bend, **options))
        assert_same(part, whole)
        # tangential rotations are held at nodes that turn about the normal
        assert part.balance().residue == pytest.approx((0.0, 0.0), abs=1e-7)


def test_multigrid():
    whole, _ = solve(bar(MICROPOLAR, dim=3), 1)
    part, _ = solve(bar(MICROPOLAR, "xyz", dim=3, solver="multigrid"), 1)
    assert_same(part, whole, 1e-9)


def test_an_unsymmetric_tangent():
    """Points that yield, not associated: whole rows are folded."""
    material = pm.DruckerPrager(MICROPOLAR, phi=0.5, psi=0.1, k=200.0, l_p=0.1, cone="plane strain")
    whole, _ = solve(bar(material, bend=60.0), 3)
    half, _ = solve(bar(material, "x", bend=60.0), 3)
    flowed = half.comm.allreduce(int(np.sum(half.points.hardening > 0)))
    assert flowed > 10
    assert_same(half, whole, 1e-9)


def test_one_cell():
    """A layer of one cell between two planes of symmetry is plane strain, with cubic functions, too."""
    for basis in ("bspline", "bspline3", "mpm"):
        plane_strain = pm.QuasiStatic(*_sheet(2), basis=basis, reset=None, controls=STRICT)
        layer = pm.QuasiStatic(*_sheet(3), basis=basis, reset=None, controls=STRICT)
        supports = [layer.symmetry(pm.plane(z=z)) for z in (0.0, 0.5)]
        for problem in (plane_strain, layer):
            problem.fix(pm.plane(x=0.0), u=0, theta=0)
            weight = np.array([0.0, -30.0, 0.0])[: problem.layout.dim]
            problem.body_load(force=weight)
            list(problem.march(1, progress=False))
        of_layer = by_id(layer.points, np.hstack([layer.points.X, layer.points.displacement]))
        flat = rows_of(plane_strain)
        expected = np.array([flat[tuple(x[:2].round(6) + 0.0)][:2] for x in of_layer])
        np.testing.assert_allclose(of_layer[:, 3:5], expected, atol=1e-11)
        np.testing.assert_allclose(of_layer[:, 5], 0.0, atol=1e-13)
        assert layer.balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)
        first, second = (layer.reaction(support).force for support in supports)
        np.testing.assert_allclose(first, -second, atol=1e-9)


def _sheet(dim: int) -> tuple[pm.Grid, pm.Points]:
    grid = pm.Grid.box((0.0, -0.5, 0.0)[:dim], (2.0, 1.0, 0.5)[:dim], 0.5)
    return grid, pm.seed(grid, material=MICROPOLAR, bounds=((0.0,) * dim, (2.0, 0.5, 0.5)[:dim]))


# moving planes -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["bspline", "bspline3", "gimpm"])
def test_a_platen_that_moves(basis):
    """A block between two platens, or half of it on a plane of symmetry that the stretched grid keeps."""
    made = []
    for lower in (-1.0, 0.0):
        grid = pm.Grid.box((0.0, lower), (1.5, 1.0), 0.25)
        points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0.0, lower), (1.0, 1.0)))
        problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, balanced_reset=False, controls=STRICT)
        problem.symmetry(pm.plane(x=0.0))
        glued = {"ux": 0} if basis == "gimpm" else {"ux": 0, "slope": 0}
        problem.fix(pm.plane(y=1.0, moving=True), uy=-0.3, **glued)
        if lower:
            problem.fix(pm.plane(y=-1.0, moving=True), uy=0.3, **glued)
        else:
            problem.symmetry(pm.plane(y=0.0))
        list(problem.march(3, progress=False))
        assert problem.grid.upper[1] == pytest.approx(0.8)
        made.append(problem)
    whole, half = made
    of_half, of_whole = rows_of(half), rows_of(whole)
    expected = np.array([of_whole[x][:2] for x in of_half])
    found = np.array([row[:2] for row in of_half.values()])
    np.testing.assert_allclose(found, expected, atol=1e-10)


# in mid-run --------------------------------------------------------------------------------------------
def stays(problem: Any, force: float = 20.0) -> None:
    """A load that grows up to the load factor 1."""
    problem.body_load(force=lambda t: (0.0, force * min(t, 1.0)))


def half_bar(**options: Any) -> tuple[pm.QuasiStatic, Any]:
    """Half a bar, held at the wall x = 1, and its plane of symmetry."""
    grid = pm.Grid.box((0.0, -1.0), (1.0, 2.0), 0.25)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0.0, 0.0), (1.0, 0.5)))
    problem = pm.QuasiStatic(grid, points, controls=STRICT, **{"reset": None, **options})
    plane = problem.symmetry(pm.plane(x=0.0))
    problem.fix(pm.plane(x=1.0), u=0, theta=0)
    return problem, plane


def test_released_it_leaves_nothing():
    """At once, and over load factors: elastic and without resets, what is left is a cantilever."""
    free, plane = half_bar()
    free.release(plane)
    stays(free)
    list(free.march(3, progress=False))
    expected = by_id(free.points, free.points.displacement)
    for over in (None, 0.5):
        half, plane = half_bar()
        stays(half)
        list(half.march(2, progress=False))
        before = by_id(half.points, half.points.displacement)
        assert np.abs(before).max() < 0.6 * np.abs(expected).max()
        half.release(plane, over=over)
        if over:  # its forces, double forces among them, have been handed over to the points
            assert half.attempt(1.0).converged
            now = by_id(half.points, half.points.displacement)
            np.testing.assert_allclose(now, before, atol=1e-8)
            assert half.balance().residue == pytest.approx((0.0, 0.0), abs=1e-8)
        list(half.march(3, to=2.0, progress=False))
        found = by_id(half.points, half.points.displacement)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        assert half.balance().residue == pytest.approx((0.0, 0.0), abs=1e-8)
        work = half.energies()
        # released at once, the body gains what its sudden motion is worth by the trapezoidal rule
        assert abs(work["residue"]) < 0.05 * work["external"]


@pytest.mark.parametrize("reset", [None, 1])
def test_given_in_mid_run_it_counts_from_now(reset):
    """Nothing moves when it is given; from then on the slope stays as it is."""
    problem, plane = half_bar(reset=reset)
    problem.release(plane)
    stays(problem, 3.0)
    list(problem.march(2, progress=False))
    before = by_id(problem.points, problem.points.displacement)
    support = problem.symmetry(pm.plane(x=0.0))
    assert problem.attempt(1.0).converged
    np.testing.assert_allclose(by_id(problem.points, problem.points.displacement), before, atol=1e-9)
    top = problem.points.farthest((0.0, 1.0))
    problem.load(top, force=(0.0, 8.0), counts="from now")
    begin = problem.system.x.copy() if reset is None else np.zeros_like(problem.system.x)
    list(problem.march(2, to=2.0, progress=False))
    assert abs(problem.reaction(support).force[0]) > 0.1
    assert problem.balance().residue == pytest.approx((0.0, 0.0), abs=1e-9)
    system = problem.system
    if reset is None:
        ties, moved = system.prescribed.ties, system.x - begin
        assert COMM.allreduce(int(ties.tied[:, 1].sum())) > 0
        rows = np.flatnonzero(ties.tied[:, 1])
        np.testing.assert_allclose(moved[rows, 1], moved[ties.master[rows, 1], 1], atol=1e-15)


def test_a_restart_goes_on(folder):
    """Between resets, with what reactions need; and one with other ranks' rows would do the same."""
    whole, plane = half_bar(reset=3)
    stays(whole)
    list(whole.march(4, progress=False))
    pm.save_restart(whole, folder / "run.h5")
    again, same = half_bar(reset=3)
    stays(again)
    pm.load_restart(again, folder / "run.h5")
    for a, b in zip(again.reaction(same), whole.reaction(plane), strict=True):
        assert_repeated(a, b)
    assert_repeated(again.balance().moment, whole.balance().moment, tolerance=1e-6)
    for problem in (whole, again):
        problem.load(problem.points.farthest((0.0, 1.0)), force=(0.0, 8.0), counts="from now")
        list(problem.march(2, to=1.5, progress=False))
    assert_repeated(by_id(again.points, again.points.x), by_id(whole.points, whole.points.x))


def test_arc_length():
    """Other steps, the same path."""
    ends = []
    for halved in ("", "x"):
        problem, _ = bar(NEO_HOOKEAN, halved)
        list(problem.march_arc_length(0.004, to=1.0, progress=False))
        ends.append(problem)
    assert_same(ends[1], ends[0], 1e-9)


def test_a_step_that_fails_is_diagnosed():
    """A body on one plane of symmetry alone is free to slide along it; its ties hold that it turns."""
    problem, _ = bar(NEO_HOOKEAN, "x", bend=40.0)
    problem.release(problem.supports[1])
    with pytest.raises(pm.NotConverged) as caught:
        list(problem.march(1, progress=False))
    assert "the body can move along y: of it the supports hold" in str(caught.value)
    assert "symmetry, x = 0): ux, slopes" in str(caught.value)


# ranks ------------------------------------------------------------------------------------------------
def _case(name: str) -> dict[str, Any]:
    basis, dim = name.split()
    halved = "xyz"[: int(dim)]
    problem, supports = bar(MICROPOLAR, halved, basis=basis, dim=int(dim), reset=1, rebalance=1.01)
    list(problem.march(2, progress=False))
    reactions = [problem.reaction(s) for s in supports]
    found = {
        "x": by_id(problem.points, problem.points.x).tolist(),
        "reactions": [[*r.force, *r.moment] for r in reactions],
        "residue": max(problem.balance().residue),
    }
    problem.release(supports[0], over=0.5)
    list(problem.march(1, to=1.2, progress=False))
    return found | {"after": by_id(problem.points, problem.points.x).tolist()}


@pytest.mark.mpi
@pytest.mark.parametrize("case", ["bspline3 2", "bspline 3"])
def test_ranks(case):
    expected = on_ranks(1, case, __file__)[0]
    for ranks in (2, 3):
        for found in on_ranks(ranks, case, __file__):
            for name in ("x", "reactions", "after"):
                close(found[name], expected[name])
            assert found["residue"] < 1e-7


# elements ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("material", [NEO_HOOKEAN, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize("dim", [2, 3])
def test_elements(dim, material):
    cells = {2: "quadrilateral", 3: "hexahedron"}[dim]
    made = []
    for half in (False, True):
        mesh = box(cells, ((4, 2, 1) if half else (8, 2, 1))[:dim], ((1.0 if half else 2.0), 0.5, 0.25)[:dim])
        mesh.geometry.x[:, 0] -= 0.0 if half else 1.0
        problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=2), controls=STRICT)
        if half:
            plane = problem.symmetry(pm.plane(x=0.0))
        for x in (1.0,) if half else (-1.0, 1.0):
            problem.fix(pm.plane(x=x), u=0, **({"theta": 0} if material.micropolar else {}))
        problem.body_load(force=lambda t, X: push(dim, t, X))
        list(problem.march(2, progress=False))
        made.append(problem)
    assert_same(made[1], made[0], 1e-10)
    force = made[1].reaction(plane).force
    assert abs(force[0]) > 1.0
    np.testing.assert_allclose(force[1:], 0.0, atol=1e-9)


if __name__ == "__main__":
    report(_case)
