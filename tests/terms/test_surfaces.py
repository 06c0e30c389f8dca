"""Tractions, pressures and supports on surfaces that don't follow the grid."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl

import polarmpm as pm
from tests.assembly.test_system import residual_at, tangent_at
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, beam, by_id, derivative_error, rotation
from tests.helpers.ranks import on_ranks

LAM, MU = MICROPOLAR.lam, MICROPOLAR.mu


def mine(values: Any) -> np.ndarray:
    return np.array_split(np.asarray(values), COMM.size)[COMM.rank]


def cuts(low: float, high: float, parts: int) -> np.ndarray:
    """The ends of an interval and the whole numbers in it, each part between them cut again."""
    ends = np.array([low, *np.arange(np.floor(low) + 1, np.ceil(high)), high])
    parted = [np.linspace(a, b, parts + 1)[:-1] for a, b in itertools.pairwise(ends)]
    return np.concatenate([*parted, [high]])


def block(
    low: tuple[float, ...], high: tuple[float, ...], material: pm.Material, parts: int = 2, **options: Any
) -> pm.QuasiStatic:
    """A box on unit cells whose faces lie inside cells; domains don't cross the grid's planes, so that sums
    over points are exact integrals of gradients."""
    dim = len(low)
    edges = [cuts(a, b, parts) for a, b in zip(low, high, strict=True)]
    centre = np.stack(np.meshgrid(*[0.5 * (e[1:] + e[:-1]) for e in edges], indexing="ij"), -1).reshape(
        -1, dim
    )
    half = np.stack(np.meshgrid(*[0.5 * np.diff(e) for e in edges], indexing="ij"), -1).reshape(-1, dim)
    points = pm.Points(mine(centre), mine(np.prod(2 * half, axis=1)), mine(half), material, COMM)
    return pm.QuasiStatic(pm.Grid.box((-1,) * dim, (5,) * dim, 1.0), points, **{**pm.PUBLISHED, **options})


def face(low: Any, high: Any, axis: int, side: int, parts: int = 2) -> pm.Surface:
    """A face of a box, cut at the grid's planes; side 0 is the lower one."""
    dim = len(low)
    edges = [cuts(a, b, parts) for k, (a, b) in enumerate(zip(low, high, strict=True)) if k != axis]
    x = np.stack(np.meshgrid(*[0.5 * (e[1:] + e[:-1]) for e in edges], indexing="ij"), -1).reshape(
        -1, dim - 1
    )
    size = np.stack(np.meshgrid(*[np.diff(e) for e in edges], indexing="ij"), -1).reshape(-1, dim - 1)
    x = np.insert(x, axis, (low, high)[side][axis], axis=1)
    return pm.Surface(x, np.prod(size, axis=1), np.tile((2 * side - 1) * np.eye(dim)[axis], (len(x), 1)))


def faces(low: Any, high: Any) -> list[pm.Surface]:
    return [face(low, high, axis, side) for axis in range(len(low)) for side in (0, 1)]


BOXES = {2: ((0.3, 0.2), (2.6, 1.7)), 3: ((0.3, 0.2, 0.4), (1.6, 1.7, 1.6))}


def hold(problem: pm.QuasiStatic, F: np.ndarray) -> None:
    """Keep the body from moving as a whole: some nodes take an affine displacement exactly."""

    def part(component: int) -> Any:
        return lambda factor, x: factor * ((x - 1.0) @ (F - np.eye(len(F))).T)[:, component]

    def node(*at: float) -> Any:
        return lambda x: np.all(np.abs(x - np.array(at)) < 1e-9, axis=1)

    if len(F) == 2:
        problem.fix(node(1, 1), ux=part(0), uy=part(1))
        problem.fix(node(2, 1), uy=part(1))
    else:
        problem.fix(node(1, 1, 1), ux=part(0), uy=part(1), uz=part(2))
        problem.fix(node(1, 1, 0), ux=part(0), uy=part(1))
        problem.fix(node(1, 0, 1), ux=part(0))


# surfaces -----------------------------------------------------------------------------------------
def test_line_and_rectangle():
    line = pm.Surface.line((0, 0), (3, 4), 5)
    assert len(line) == 5
    assert line.area.sum() == pytest.approx(5.0, rel=1e-14)
    assert np.allclose(line.normal, (0.8, -0.6), atol=1e-15)
    assert np.allclose(line.x[2], (1.5, 2.0), atol=1e-15)
    sheet = pm.Surface.rectangle((1, 0, 0), (0, 2, 0), (0, 0, 3), (2, 3))
    assert len(sheet) == 6
    assert sheet.area.sum() == pytest.approx(6.0, rel=1e-14)
    assert np.allclose(sheet.normal, (1, 0, 0), atol=1e-15)
    assert np.allclose(sheet.area @ sheet.x / 6, (1, 1, 1.5), atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: pm.Surface([[0, 0]], [1], np.eye(2)),
            r"normal = .*shape \(1, 2\) is needed .*its shape is \(2, 2\)",
        ),
        (lambda: pm.Surface([[0, 0]], [-1], [[1, 0]]), "area = -1 is not positive"),
        (lambda: pm.Surface([[0, 0]], [1], [[1, 1]]), r"normal 0 = \[1.0, 1.0\]: its length must be 1"),
        (lambda: pm.Surface([[0, np.nan]], [1], [[1, 0]]), "x = .*: finite numbers are needed"),
        (lambda: pm.Surface(np.zeros((0, 2)), [], np.zeros((0, 2))), r"x has the shape \(0, 2\)"),
        (lambda: pm.Surface("no", [1], [[1, 0]]), "x = 'no': numbers are needed"),
        (lambda: pm.Surface.line((0, 0), (0, 0), 3), "the same point"),
        (lambda: pm.Surface.line((0, 0, 0), (1, 0), 3), r"a = \(0, 0, 0\): .* of shape \(2,\)"),
        (lambda: pm.Surface.line((0, 0), (1, 0), 0), "points = 0: a positive whole number"),
        (lambda: pm.Surface.rectangle((0, 0, 0), (1, 0, 0), (2, 0, 0), 3), "parallel to edge1"),
        (
            lambda: pm.Surface.rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), (3, 2.5)),
            "points = 2.5: a positive whole number",
        ),
    ],
)
def test_bad_surfaces(make, message):
    with pytest.raises(pm.InputError, match=message):
        make()


# tractions ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["gimpm", "mpm"])
@pytest.mark.parametrize("dim", [2, 3])
def test_patch_of_dead_tractions(dim, basis):
    """A box whose faces lie inside cells, under the tractions of a homogeneous deformation on all faces: the
    answer is that deformation, exactly."""
    low, high = BOXES[dim]
    F = np.array([[1.1, 0.04, 0.0], [0.04, 0.93, 0.02], [0.0, 0.02, 1.05]])[:dim, :dim]
    strain = F - np.eye(dim)  # symmetric: no rotation, no couples
    stress = LAM * np.trace(strain) * np.eye(dim) + 2 * MU * strain
    problem = block(low, high, MICROPOLAR, basis=basis, controls=pm.Controls(force_tolerance=1e-12))
    for surface in faces(low, high):
        problem.traction(surface, force=stress @ surface.normal[0])
    hold(problem, F)
    list(problem.march(1, progress=False))
    p = problem.points
    assert np.abs(p.F[:, :dim, :dim] - F).max(initial=0.0) < 1e-9
    assert np.abs(p.x - 1.0 - (p.X - 1.0) @ F.T).max(initial=0.0) < 1e-9
    for condition, surface in zip(problem.surfaces, faces(low, high), strict=True):
        assert np.abs(surface.x + condition.u - 1.0 - (surface.x - 1.0) @ F.T).max() < 1e-9
        assert np.abs(condition.F - F).max() < 1e-9


def test_traction_on_a_grid_plane_is_the_load_of_the_points_there():
    """A face on a plane of the grid: the cell behind it carries it, although the plane belongs to the next
    one. The nodal forces of a uniform traction are those of the face's shape functions."""
    low, high = (0.0, 0.0), (2.0, 1.0)
    problem = block(low, high, NEO_HOOKEAN, basis="mpm")
    problem.traction(face(low, high, 0, 1), force=(6.0, 0.0))
    problem.fix(pm.plane(x=0.0), u=0)
    system = problem.system_at(1.0)
    forces = -system.term_forces()
    own = slice(0, system.nodes.owned)
    x = system.nodes.position[own]
    on = np.abs(x[:, 0] - 2.0) < 1e-9
    assert np.allclose(forces[own][on], (3.0, 0.0), atol=1e-14)
    assert np.abs(forces[own][~on]).max(initial=0.0) < 1e-14
    assert COMM.allreduce(int(on.sum())) == 2


def test_couples_do_work_on_the_spin():
    """A couple traction on a face of a body whose points all have the same rotation: the same forces as of a
    couple on the points of the face."""
    moment = np.array([30.0, -20.0, 50.0])
    residuals = []
    for on_surface in (True, False):
        low, high = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
        problem = block(low, high, MICROPOLAR, basis="mpm")
        if on_surface:
            problem.traction(face(low, high, 0, 1), couple=moment)
        else:
            problem.load(problem.points.where(lambda x: x[:, 0] > 0.5), couple=moment)
        system = problem.system_at(1.0)
        assert not system.pattern.symmetric
        w = np.array([0.4, -0.7, 0.3])
        x = np.zeros((system.nodes.total, 6))
        x[:, 3:] = w
        residuals.append(residual_at(system, x.ravel()).reshape(-1, 6)[:, 3:].sum(axis=0))
    assert np.abs(residuals[0] - residuals[1]).max() < 1e-11
    assert np.abs(residuals[0]).max() > 1.0


# pressure -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("dim", [2, 3])
def test_box_under_pressure(dim):
    """Pressure on all faces: F = s I with lam dim (s - 1) + 2 mu (s - 1) = -p s^(dim - 1)."""
    low, high = BOXES[dim]
    p = 900.0
    s = (2 * LAM + 2 * MU) / (2 * LAM + 2 * MU + p)
    if dim == 3:
        roots = np.roots([p, 3 * LAM + 2 * MU, -3 * LAM - 2 * MU])
        s = float(roots[np.argmin(np.abs(roots - 1))].real)
    problem = block(low, high, MICROPOLAR, controls=pm.Controls(force_tolerance=1e-12))
    for surface in faces(low, high):
        problem.pressure(surface, p)
    hold(problem, s * np.eye(dim))
    (step,) = problem.march(1, progress=False)
    assert np.abs(problem.points.F[:, :dim, :dim] - s * np.eye(dim)).max(initial=0.0) < 1e-9
    assert step.iterations <= 6


@pytest.mark.parametrize(("basis", "parts"), [("gimpm", 2), ("mpm", 2), ("bspline", 2), ("bspline3", 4)])
def test_face_runs_ahead_of_the_points(basis, parts):
    """A bar is pulled over several cells, its end ahead of the cells that its points reach. It moves as the
    bar whose end points are pulled by the same force."""
    low, high, ends = (0.0, 0.0), (2.0, 1.0), []
    for on_surface in (True, False):
        points = block(low, high, NEO_HOOKEAN, parts).points
        problem = pm.QuasiStatic(
            pm.Grid.box((0, 0), (5, 3), 1.0), points, basis=basis, reset=1, balanced_reset=False
        )
        problem.fix(pm.plane(x=0.0), ux=0)
        if on_surface:
            bottom = problem.fix(face(low, high, 1, 0), normal=0)
            problem.traction(face(low, high, 0, 1), force=(1000.0, 0.0))
        else:
            problem.fix(pm.plane(y=0.0), uy=0)
            problem.load(points.farthest((1.0, 0.0)), force=(1000.0, 0.0))
        list(problem.march(20, progress=False))
        if on_surface:
            end = problem.surfaces[1].surface.x + problem.surfaces[1].u
            assert np.all(end[:, 0] > COMM.allreduce(points.x[:, 0].max(initial=0.0), op=MPI.MAX))
            assert np.abs(bottom.u[:, 1]).max() < 2e-3
        ends.append(by_id(points, points.x)[:, 0].max())
    assert ends[0] > 2.05
    assert ends[0] == pytest.approx(ends[1], rel=0.02)


CONDITIONS = ["pressure", "couple", "support", "rollers"]


def slanted(dim: int) -> pm.Surface:
    """A surface across cells in no particular direction, within a bar."""
    if dim == 2:
        return pm.Surface.line((1.2, 0.5), (2.3, 1.1), 5)
    return pm.Surface.rectangle((1.2, 0.4, 0.4), (0.9, 0.3, 0.2), (-0.2, 0.6, 0.3), 3)


def conditioned(kind: str, dim: int, material: pm.Material, **options: Any) -> pm.QuasiStatic:
    problem = block((0.0, 0.3, 0.2)[:dim], (3.5, 1.3, 1.2)[:dim], material, **options)
    surface = slanted(dim)
    if kind == "pressure":
        problem.pressure(surface, 400.0)
    elif kind == "couple":
        couple = {2: 90.0, 3: (90.0, 30.0, -60.0)}[dim] if material.micropolar else None
        problem.traction(surface, force=np.arange(dim) * 100.0 + 50.0, couple=couple)
    elif kind == "rollers":
        problem.fix(surface, normal=0.02)
    else:
        theta = {"theta": 0.05 if dim == 2 else (0.05,) * 3} if material.micropolar else {}
        problem.fix(surface, stiffness=3e4, u=(0.03,) * dim, **theta)
    return problem


@pytest.mark.parametrize("kind", CONDITIONS)
@pytest.mark.parametrize(
    ("dim", "material", "basis"),
    [
        (2, MICROPOLAR, "gimpm"),
        (2, NEO_HOOKEAN, "mpm"),
        (2, MICROPOLAR, "bspline"),
        (2, NEO_HOOKEAN, "bspline3"),
        (3, MICROPOLAR, "mpm"),
        (3, NEO_HOOKEAN, "gimpm"),
    ],
)
def test_tangent_is_the_derivative_of_the_residual(kind, dim, material, basis):
    problem = conditioned(kind, dim, material, basis=basis)
    for condition in problem.surfaces:  # an earlier deformation that is no rotation
        condition.F = condition.F + 0.1 * np.arange(dim * dim).reshape(dim, dim)
    system = problem.system_at(1.0)
    n = system.nodes.total * system.layout.block
    x = np.random.default_rng(5).uniform(-0.05, 0.05, n)
    some = np.random.default_rng(6).choice(n, 12, replace=False)  # directions
    directions = np.zeros((n, len(some)))
    directions[some, range(len(some))] = 1.0
    k = tangent_at(system, x)
    if kind == "pressure":
        assert not system.pattern.symmetric
        assert abs(k - k.T).max() > 1e-3 * abs(k).max()
    error = derivative_error(
        lambda t: residual_at(system, x + directions @ t[0])[None],
        lambda t: (tangent_at(system, x + directions @ t[0]) @ directions)[None],
        np.zeros((1, len(some))),
    )
    assert error < 1e-7


def test_pressure_converges_quadratically_and_in_steps():
    """A cantilever under pressure from below through a surface inside its cells."""
    results = []
    for steps in (2, 4):
        problem = beam(2, reset=None, controls=pm.Controls(force_tolerance=1e-11))
        problem.pressure(pm.Surface.line((0.0, 0.31), (3.4, 0.31), 14), 25.0)
        for step in problem.march(steps, progress=False):
            assert step.iterations <= 7
        results.append(by_id(problem.points, problem.points.x))
    # a follower pressure on a body without a history depends on where it has got to only
    assert np.abs(results[0] - results[1]).max() < 1e-8
    assert np.abs(results[0] - by_id(problem.points, problem.points.X)).max() > 0.1


# supports -----------------------------------------------------------------------------------------
def clamped(h: float, offset: float, surface_support: bool, stiffness: float | None = None) -> float:
    """Tip deflection of a cantilever from x = 0 to 2, 0.5 high, on cells of size h whose planes are `offset`
    cells off the clamp."""
    origin = (-1.0 - offset * h, -0.5)
    grid = pm.Grid.box(origin, (origin[0] + 4.0, 1.5), h)
    n = round(8 / h)
    x = np.stack(
        np.meshgrid((np.arange(n) + 0.5) * 2 / n, (np.arange(n // 4) + 0.5) * 2 / n, indexing="ij"), -1
    )
    x = x.reshape(-1, 2)
    volume, half = np.full(len(x), (2 / n) ** 2), np.full(x.shape, 1 / n)
    points = pm.Points(mine(x), mine(volume), mine(half), MICROPOLAR, COMM)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=1, balanced_reset=False)
    if surface_support:
        line = pm.Surface.line((0.0, 0.5), (0.0, 0.0), 8 * round(0.5 / h))
        problem.fix(line, stiffness=stiffness, rotation_stiffness=stiffness, u=0, theta=0)
    else:
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1.0, 0.0)), force=(0.0, -0.5))
    list(problem.march(1, progress=False))
    low = by_id(points, points.displacement)[:, 1]
    return float(low.min())


def test_springs_on_a_grid_plane_tend_to_fixed_nodes():
    """The error falls with the stiffness of the springs."""
    fixed = clamped(0.25, 0.0, False)
    errors = [abs(clamped(0.25, 0.0, True, s) - fixed) / abs(fixed) for s in (1e6, 1e7, 1e8)]
    assert errors[0] < 0.02
    for coarse, fine in itertools.pairwise(errors):
        assert fine == pytest.approx(coarse / 10, rel=0.1)


def test_clamp_inside_cells_tends_to_the_conforming_one():
    """With refinement a clamp in the middle of cells and one on the grid's plane give the same deflection."""
    differences = []
    for h in (0.25, 0.125, 0.0625):
        conforming = clamped(h, 0.0, False)
        differences.append(abs(clamped(h, 0.4, True) - conforming) / abs(conforming))
    assert differences[0] < 0.2
    assert differences[1] < 0.7 * differences[0]
    assert differences[2] < 0.7 * differences[1]


@pytest.mark.parametrize(
    ("basis", "reset"), [("gimpm", 1), ("mpm", 1), ("bspline", 1), ("bspline3", 1), ("mpm", None)]
)
@pytest.mark.parametrize("dim", [2, 3])
def test_clamped_line_turns_the_body(dim, basis, reset):
    """A clamp that turns by 1.5 rad takes an unloaded body along as a rigid one, without forces; without a
    reset rotations get a new base on the way."""
    low, high = BOXES[dim]
    controls = pm.Controls(force_tolerance=1e-12)
    problem = block(low, high, MICROPOLAR, basis=basis, reset=reset, controls=controls)
    centre, angle = np.full(dim, 1.0), 1.5
    axis = np.array([0.0, 0.0, 1.0]) if dim == 2 else np.array([2.0, -1.0, 2.0]) / 3

    def turned(factor: float, x: np.ndarray) -> np.ndarray:
        return (x - centre) @ (rotation(factor * angle * axis)[:dim, :dim] - np.eye(dim)).T

    def vector(factor: float) -> Any:
        return factor * angle * (axis if dim == 3 else 1.0)

    surface = face(low, high, 0, 0)
    surface.x[:, 0] += 0.35  # into the body
    support = problem.fix(surface, u=turned, theta=vector)
    list(problem.march(4, progress=False))
    p = problem.points
    assert np.abs(p.x - p.X - turned(1.0, p.X)).max(initial=0.0) < 1e-8
    assert np.abs(support.u - turned(1.0, surface.x)).max() < 1e-8
    assert support.gap.max() < 1e-8
    force, couple = problem.reaction(support)
    assert np.abs(force).max() < 1e-5 * MU
    assert np.abs(couple).max() < 1e-5 * MU


def test_rollers():
    """A box between rollers on two faces, pulled at a third: uniaxial stress, whatever the springs do."""
    low, high = BOXES[2]
    problem = block(low, high, MICROPOLAR, controls=pm.Controls(force_tolerance=1e-12))
    left = problem.fix(face(low, high, 0, 0), normal=0, stiffness=1e6)
    problem.fix(face(low, high, 1, 0), normal=0, stiffness=1e6)
    t = 500.0
    problem.traction(face(low, high, 0, 1), force=(t, 0.0))
    list(problem.march(1, progress=False))
    # (lam + 2 mu) a + lam b = t, lam a + (lam + 2 mu) b = 0
    a, b = np.linalg.solve([[LAM + 2 * MU, LAM], [LAM, LAM + 2 * MU]], [t, 0.0])
    F = np.diag([1 + a, 1 + b])
    assert np.abs(problem.points.F[:, :2, :2] - F).max(initial=0.0) < 1e-9
    force, _ = problem.reaction(left)
    assert np.allclose(force, (-t * 1.5, 0.0), atol=1e-6)
    assert np.allclose(left.gap, t / 1e6, rtol=1e-8)


@pytest.mark.parametrize("dim", [2, 3])
def test_reaction_balances_the_load(dim):
    low, high = BOXES[dim]
    problem = block(low, high, MICROPOLAR, controls=pm.Controls(force_tolerance=1e-11))
    inside = face(low, high, 0, 0)
    inside.x[:, 0] += 0.2
    support = problem.fix(inside, u=0, theta=0)
    load = np.array([3.0, -5.0, 2.0])[:dim]
    problem.load(problem.points.farthest(np.eye(dim)[0]), force=load)
    with pytest.raises(pm.InputError, match="no load step has been solved yet"):
        problem.reaction(support)
    list(problem.march(2, progress=False))
    force, _ = problem.reaction(support)
    assert np.abs(force + load).max() < 1e-7
    with pytest.raises(pm.InputError, match="is not what fix has returned"):
        problem.reaction(problem.surfaces)


@pytest.mark.parametrize("balanced", [False, True])
def test_augmentation_closes_the_gap(balanced):
    """Under a load that stays the gap falls step by step; without augmentation it stays."""
    gaps = {}
    for augment in (False, True):
        low, high = BOXES[2]
        controls = pm.Controls(force_tolerance=1e-12)
        problem = block(low, high, MICROPOLAR, balanced_reset=balanced, controls=controls)
        inside = face(low, high, 0, 0)
        inside.x[:, 0] += 0.2
        support = problem.fix(inside, u=0, theta=0, stiffness=1e5, augment=augment)
        problem.load(problem.points.farthest((1.0, 0.0)), force=lambda f: (min(1.0, 4 * f) * 300.0, 0.0))
        history = []
        for _ in problem.march(4, progress=False):
            history.append(float(support.gap.max()))
        gaps[augment] = history
        force, _ = problem.reaction(support)
        assert force[0] == pytest.approx(-300.0, rel=1e-7)
    assert gaps[False][3] > 0.5 * gaps[False][0]
    assert gaps[True][0] == pytest.approx(gaps[False][0], rel=1e-9)
    for before, after in itertools.pairwise(gaps[True]):
        assert after < 0.5 * before


# runs ---------------------------------------------------------------------------------------------
def everything_at_once(dim: int, **options: Any) -> pm.QuasiStatic:
    """A body on surfaces only: clamped, pressed and pulled."""
    low, high = BOXES[dim]
    problem = block(low, high, MICROPOLAR, ghost="thesis", **options)
    inside = face(low, high, 0, 0)
    inside.x[:, 0] += 0.2
    theta = 0.1 if dim == 2 else (0.1, 0.1, 0.1)
    problem.fix(inside, u=lambda f, x: 0.1 * f * x, theta=theta, augment=True)
    problem.pressure(face(low, high, 1, 0), 60.0)
    problem.traction(
        face(low, high, 0, 1),
        force=np.array([40.0, -30.0, 20.0])[:dim],
        couple=5.0 if dim == 2 else (5.0,) * 3,
    )
    return problem


@pytest.mark.parametrize("dim", [2, 3])
def test_restart_between_resets(dim, folder):
    whole = everything_at_once(dim, reset=3)
    list(whole.march(5, progress=False))
    first = everything_at_once(dim, reset=3)
    list(first.march(4, to=0.8, progress=False))
    pm.save_restart(first, folder / "surfaces.h5")
    second = everything_at_once(dim, reset=3)
    pm.load_restart(second, folder / "surfaces.h5")
    list(second.march(1, progress=False))
    a, b = by_id(whole.points, whole.points.x), by_id(second.points, second.points.x)
    assert np.abs(a - b).max() < 1e-9
    assert np.abs(a - by_id(whole.points, whole.points.X)).max() > 0.01
    for c, e in zip(whole.surfaces, second.surfaces, strict=True):
        assert np.abs(c.u - e.u).max() < 1e-9
    with pytest.raises(pm.InputError, match="the saved state has 3 term"):
        beam(2).restore_terms(first.term_state())


def test_new_condition_in_a_balanced_run():
    """What is added to a body in equilibrium is felt, not carried along."""
    low, high = BOXES[2]
    problem = block(low, high, MICROPOLAR, balanced_reset=True)
    problem.fix(lambda x: x[:, 0] < 1.5, u=0, theta=0)
    list(problem.march(1, to=0.5, progress=False))
    before = by_id(problem.points, problem.points.x)
    problem.traction(face(low, high, 0, 1), force=lambda f: (50.0, 0.0))
    list(problem.march(1, progress=False))
    assert np.abs(by_id(problem.points, problem.points.x) - before).max() > 1e-3


def answer() -> dict[str, Any]:
    problem = everything_at_once(3, balanced_reset=True)
    list(problem.march(2, progress=False))
    force, couple = problem.reaction(problem.surfaces[0])
    return {
        "x": by_id(problem.points, problem.points.x).tolist(),
        "reaction": [*force.tolist(), *couple.tolist()],
        "u": problem.surfaces[1].u.tolist(),
    }


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_agree(ranks):
    serial = answer()
    for found in on_ranks(ranks, "answer", script=__file__):
        for name, tolerance in (("x", 1e-9), ("u", 1e-9), ("reaction", 1e-5)):
            assert np.abs(np.array(found[name]) - serial[name]).max() < tolerance


# input --------------------------------------------------------------------------------------------
LINE = pm.Surface.line((0.5, 0.5), (2.5, 0.5), 4)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda p: p.traction(LINE), "traction 1: neither force nor couple is given"),
        (lambda p: p.traction(LINE, force=(1, 2, 3)), "traction 1, force = .* 2 numbers are needed"),
        (lambda p: p.traction("face", force=1.0), "surface = 'face': a polarmpm.Surface is needed"),
        (lambda p: p.traction(slanted(3), force=(1.0, 0.0)), "the surface has 3 dimensions, the grid has 2"),
        (lambda p: p.pressure(LINE, (1, 2)), "pressure 1, p = .* one number is needed"),
        (lambda p: p.pressure(LINE, np.inf), "finite numbers are allowed"),
        (lambda p: p.fix(LINE), "names no component"),
        (lambda p: p.fix(LINE, uz=0), "unknown component 'uz'"),
        (lambda p: p.fix(LINE, normal=0, ux=0), "normal is given together with ux"),
        (lambda p: p.fix(LINE, u=0, stiffness=0.0), "stiffness = 0.0: a positive finite number"),
        (
            lambda p: p.fix(LINE, theta=0, rotation_stiffness=-1),
            "rotation_stiffness = -1: a positive finite number",
        ),
        (lambda p: p.fix(LINE, u=0, augment=1), "augment = 1: True or False"),
    ],
)
def test_bad_conditions(act, message):
    problem = beam(2)
    with pytest.raises(pm.InputError, match=message):
        act(problem)
    assert not problem.surfaces
    assert not problem.terms


def test_bad_conditions_of_a_material():
    with pytest.raises(pm.InputError, match="no microrotation"):
        beam(2, NEO_HOOKEAN).traction(LINE, couple=1.0)
    nameless = pm.UserEnergy(lambda E, G, p: p.a * (ufl.inner(E, E) + ufl.inner(G, G)), {"a": 1.0})
    quartic = pm.UserEnergy(lambda E, G, p: p.a * (ufl.inner(E, E) + ufl.inner(G, G)) ** 2, {"a": 1.0})
    with pytest.raises(
        pm.InputError, match=r"UserEnergy has no stiffness in the undeformed state .* give stiff"
    ):
        beam(2, quartic).fix(LINE, u=0)
    beam(2, nameless).fix(LINE, u=0, stiffness=1e5)


def test_points_outside_of_the_body():
    problem = beam(2, basis="mpm")
    problem.traction(pm.Surface.line((1.0, 0.8), (1.0, 3.2), 2), force=(1.0, 0.0))
    message = r"traction 1: surface point 1 at \(1.0, 2.6\) lies outside of the body"
    with pytest.raises(pm.InputError, match=message):
        list(problem.march(1, progress=False))


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps(answer()))


def test_a_pressure_whose_surface_has_the_body_in_front():
    """It would pull; the order of a line's ends is easily exchanged."""
    problem = beam()
    for line in (((0.5, 1.3), (3.0, 1.3)), ((3.0, 0.3), (0.5, 0.3)), ((3.5, 1.2), (3.5, 0.4))):
        with pytest.raises(pm.InputError, match="the surface's normals point into the body, such as at"):
            problem.pressure(pm.Surface.line(*line, 8), 1.0)
        problem.pressure(pm.Surface.line(*line[::-1], 8), 1.0)
    problem.pressure(pm.Surface.line((2.0, 0.4), (2.0, 1.2), 8), 1.0)  # within the body: on the wall of a cut
