"""Grids that change in the course of a run.

This file is also the script that the ranks run: `mpirun -n 3 python test_regridding.py CASE OUTPUT`.
"""

from __future__ import annotations

import copy
import math
from contextlib import nullcontext
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.bodies.lineage import Lineage
from polarmpm.bodies.splitting import points_per_cell, split
from polarmpm.geometry.lines import refined
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.ranks import on_ranks, report

ELASTIC = pm.MicropolarElastic.bounded_stiffness(lam=4e9, mu=4e9, kappa=4e8, l_b=2e-3)
CONE = {"phi": math.radians(8.6), "psi": math.radians(2), "cone": "compression", "l_p": 2e-3}
STRONG, WEAK = (pm.DruckerPrager(ELASTIC, k=k, **CONE) for k in (100e6, 90e6))
STRICT = pm.Controls(force_tolerance=1e-11, energy_tolerance=1e-22)


# points -------------------------------------------------------------------------------------------------
def deformed(dim: int = 2) -> pm.Points:
    """A turned and strained ball of points, some of them cut by its surface."""
    grid = pm.Grid.box((0,) * dim, (1,) * dim, 0.25)
    points = pm.seed(grid, lambda x: np.linalg.norm(x - 0.5, axis=1) < 0.41, material=STRONG)
    rng = np.random.default_rng(3)
    H = np.zeros((3, 3))
    H[:dim, :dim] = 0.2 * rng.standard_normal((dim, dim))
    points.F = points.F + H
    points.x = points.X @ (np.eye(dim) + H[:dim, :dim]).T
    wave = np.sin(points.X.sum(axis=1))
    points.wryness = points.wryness + wave[:, None, None] * 0.1
    points.plastic_F = points.plastic_F * (1.0 + 0.1 * wave[:, None, None])
    points.hardening, points.dissipation = wave, 2.0 * wave
    return points


def sums(points: pm.Points) -> np.ndarray:
    """Volumes, first and second moments of the boxes, and what the state sums up to, over all ranks."""
    v, d = points.volume0, points.dim
    of_box = np.einsum("pki,pkj->pij", points.half_axes0, points.half_axes0) / 3.0
    second = np.einsum("pi,pj->pij", points.X, points.X) + of_box
    moved = np.einsum("pij,pkj->pki", points.F[:, :d, :d], points.half_axes0)
    now = np.einsum("pi,pj->pij", points.x, points.x) + np.einsum("pki,pkj->pij", moved, moved) / 3.0
    parts = [v, points.volume, v[:, None] * points.X, v[:, None] * points.x]
    parts += [v[:, None] * a.reshape(len(v), -1) for a in (second, now, points.F, points.q, points.wryness)]
    parts += [v[:, None] * a.reshape(len(v), -1) for a in (points.plastic_F, points.hardening[:, None])]
    found: np.ndarray = COMM.allreduce(np.concatenate([np.atleast_1d(a.sum(axis=0)) for a in parts]))
    return found


@pytest.mark.parametrize("dim", [2, 3])
def test_parts_have_what_their_points_had(dim):
    points = deformed(dim)
    before, number = sums(points), points.total
    half = points.half_length0.copy()
    parts = 1 + (np.abs(np.sin(37.0 * points.X)) * 3).astype(np.int64)
    made = split(points, parts, pm.Grid.box((-2,) * dim, (3,) * dim, 0.25))
    assert points.total > 2 * number
    np.testing.assert_allclose(sums(points), before, rtol=1e-13, atol=1e-13 * np.abs(before).max())
    ids = np.concatenate(COMM.allgather(points.id))
    assert len(np.unique(ids)) == len(ids)
    assert np.all(points.half_length0 <= half[made.rows] * (1 + 1e-12))
    whole = made.number == 1
    np.testing.assert_array_equal(points.half_length0[whole], half[made.rows][whole])


def balance(problem: pm.QuasiStatic) -> np.ndarray:
    """Energies (J) of the body, volumes (m^3) and first moments, over all ranks."""
    p, found = problem.points, problem.energies()
    energies = [
        found["stored"],
        found["dissipated"],
        found["residue"],
        problem.box_record.energy(problem.system),
    ]
    sums = np.concatenate([[p.volume0.sum(), p.volume.sum()], p.volume0 @ p.x, p.volume0 @ p.X])
    return np.concatenate([energies, COMM.allreduce(sums)])


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_stays(dim):
    """Of bodies that bend, in the plane flow and harden: at points, and in their boxes."""
    hard = pm.DruckerPrager(ELASTIC, k=40e6, H=1e9, **CONE)
    grid = pm.Grid.box((0,) * dim, (4, 2, 1)[:dim], 0.5)
    points = pm.seed(
        grid, bounds=((0,) * dim, (3, 1.3, 0.7)[:dim]), material=hard if dim == 2 else NEO_HOOKEAN
    )
    problem = pm.QuasiStatic(grid, points, regrid=lambda problem: None, reset=1)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, 7e6, 0)[:dim] if dim == 2 else (0, 1.0, 0))
    list(problem.march(2, progress=False))
    before = balance(problem)
    assert np.all(before[[0, 3]] > 0.0)
    assert dim == 3 or before[1] > 1e3
    told = dim == 2 and COMM.rank == 0
    with pytest.warns(pm.TrustWarning, match="flowed before cells become finer") if told else nullcontext():
        problem._take_grid(pm.Grid.box((0,) * dim, (4, 2, 1)[:dim], 0.25), late=True)
    assert problem.regrids[0].split > 0
    after = balance(problem)
    np.testing.assert_allclose(after, before, rtol=1e-13, atol=1e-13 * before[0])


def test_lineage_over_generations():
    one = Lineage.none().with_split(np.array([1, 4]), np.array([2, 3]), 10)  # 1: 10 11, 4: 12 13 14
    two = one.with_split(np.array([3, 13]), np.array([2, 2]), 20)  # 3: 20 21, 13: 22 23
    ids, share = two.descendants(np.array([1, 2, 4]))
    np.testing.assert_array_equal(ids, [2, 10, 11, 12, 14, 22, 23])
    np.testing.assert_allclose(share, [1, 1 / 2, 1 / 2, 1 / 3, 1 / 3, 1 / 6, 1 / 6])
    ids, share = two.roots(np.array([0, 10, 14, 22, 21, 99]))
    np.testing.assert_array_equal(ids, [0, 1, 4, 4, 3, 99])
    np.testing.assert_allclose(share, [1, 1 / 2, 1 / 3, 1 / 6, 1 / 2, 1])


def test_selections_regions_and_means_follow():
    points = deformed()
    right = points.where(lambda x: x[:, 0] > 0.5)
    ids = right.ids.copy()
    value = np.cos(3.0 * points.X[:, 1])
    means = points.mean(value), points.mean(value, right)
    parts = np.where(points.X[:, :1] > 0.4, [[2, 2]], [[1, 1]])
    made = split(points, parts, pm.Grid.box((-2, -2), (3, 3), 1))
    points.check(right)
    assert COMM.allreduce(len(points.rows(right))) == 4 * len(ids)
    found = points.mean(made.copied(value)), points.mean(made.copied(value), right)
    np.testing.assert_allclose(found, means, rtol=1e-13)
    later = points.where(lambda x: x[:, 0] > 0.6)
    points.check(later)
    volume = points.volume_of(later)
    twin = copy.deepcopy(points)
    twin.check(right)
    split(points, np.full((len(points), 2), 2), pm.Grid.box((-2, -2), (3, 3), 1))
    assert points.volume_of(later) == pytest.approx(volume, rel=1e-12)


def test_points_stay_whole_where_parts_would_leave_the_grid():
    points = deformed()
    low = COMM.allreduce(float(points.x.min(initial=np.inf)), op=MPI.MIN)
    split(points, np.full((len(points), 2), 4), pm.Grid.box((low, low), (3 + low, 3 + low), 1))
    assert COMM.allreduce(float(points.x.min(initial=np.inf)), op=MPI.MIN) >= low - 1e-12


# lines --------------------------------------------------------------------------------------------------
def test_lines_of_zones_that_grow_stay():
    base = np.linspace(0, 1, 11)
    one = refined(base, [(0.42, 0.48)], 0.025)
    two = refined(base, [(0.42, 0.48), (0.31, 0.55)], 0.025)
    inside = one[(one >= 0.4) & (one <= 0.5)]
    assert len(inside) == 5
    np.testing.assert_allclose(two[(two >= 0.4 - 1e-9) & (two <= 0.5 + 1e-9)], inside, atol=1e-15)
    for lines in (one, two):
        ratio = np.diff(lines)[1:] / np.diff(lines)[:-1]
        assert np.maximum(ratio, 1 / ratio).max() < 1.15 * (1 + 1e-9)
    graded = pm.lines(0, 1, fine=0.01, where=(0, 0.1), growth=1.15)
    more = refined(graded, [(0.8, 0.85)], 0.02, keep=[0.5])
    assert 0.5 in more
    assert np.diff(more)[:10].max() <= 0.011  # about as fine as they were
    assert np.diff(more)[(more[:-1] >= 0.8) & (more[1:] <= 0.85)].max() <= 0.02 * (1 + 1e-9)


# a shear layer --------------------------------------------------------------------------------------------
def layer(
    steps: int = 8, regrid: Any = "bands", lines: Any = None, **options: Any
) -> tuple[pm.QuasiStatic, Any]:
    """A shear layer with a weak row; by default its grid has cells of 2 l. It is marched `steps` of 10."""
    y = np.linspace(0, 0.1, 26) if lines is None else lines
    grid = pm.Grid.graded(x=np.linspace(0, 0.05, 6), y=y)
    points = pm.seed(grid, bounds=((0, 0), (0.01, 0.1)), material=STRONG)
    points.assign(points.where(lambda x: np.abs(x[:, 1] - 0.05) < 2e-3), WEAK)
    policy = pm.AlongBands(h=1e-3, margin=8e-3) if regrid == "bands" else regrid
    problem = pm.QuasiStatic(grid, points, regrid=policy, controls=STRICT, **options)
    problem.fix(lambda x: np.ones(len(x), dtype=bool), uy=0)
    base = problem.fix(pm.plane(y=0.0), ux=0)
    problem.fix(pm.plane(y=0.1), ux=0.01)
    problem.rows["seeded"] = points.X.copy()
    if steps:
        march(problem, steps)
    return problem, base


def march(problem: pm.QuasiStatic, steps: int) -> None:
    first = problem.progress.step
    list(problem.march(steps - first, to=steps / 10, progress=False))


def band(problem: pm.QuasiStatic) -> float:
    """Integral of chi over its maximum (m)."""
    p = problem.points
    most = max(COMM.allgather(p.hardening.max(initial=0.0)))
    return float(COMM.allreduce(p.volume0 @ p.hardening) / 0.01 / most)


def measured(problem: pm.QuasiStatic, base: Any) -> list[float]:
    p = problem.points
    return [
        problem.reaction(base)[0][0],
        band(problem),
        problem.energies()["residue"],
        p.total,
        *problem.grid.shape,
    ]


@pytest.mark.slow
def test_shear_layer():
    """As on a grid that is as fine from the start, although it begins with cells of 2 l."""
    problem, base = layer(reset=None)
    done = problem.regrids
    assert 1 <= len(done) <= 4
    assert done[0].split > 0
    assert problem.grid.shape[0] == 5  # nothing changes along x
    flowed = problem.points.hardening > 0
    size = problem.grid.sizes(problem.grid.cells_of(problem.points.x[flowed]))
    assert np.all(size[:, 1] <= 1e-3 * (1 + 1e-6))
    own = problem.points.half_length0[flowed, 1]
    assert np.all(own <= 0.25e-3 * 1.3)
    steps = {step.number: step.regrids for step in problem.steps}
    assert all(steps[one.step + 1] for one in done)
    assert sum(steps.values()) == len(done)
    # rows of a script follow
    seeded = problem.rows["seeded"]
    assert np.abs(seeded - problem.points.X).max(initial=0.0) < 3e-3
    fine, held = layer(regrid=None, lines=problem.grid.lines[1], reset=ResetAt([one.step for one in done]))
    found, expected = (np.array([p.reaction(b)[0][0], band(p)]) for p, b in ((problem, base), (fine, held)))
    np.testing.assert_allclose(found, expected, rtol=1e-3)


@pytest.mark.slow
def test_a_quarter_of_the_unknowns():
    """Lines that are fine in the band give the force and the width of equal cells within a thousandth."""
    found = []
    for lines in (np.linspace(0, 0.1, 201), pm.lines(0, 0.1, fine=5e-4, where=(0.045, 0.055), growth=1.25)):
        problem, base = layer(0, regrid=None, lines=lines, reset=None)
        list(problem.march(20, to=0.5, progress=False))
        system = problem.system
        assert system is not None
        found.append([problem.reaction(base)[0][0], band(problem), system.nodes.total])
    assert found[1][2] <= 0.25 * found[0][2]
    np.testing.assert_allclose(found[1][:2], found[0][:2], rtol=1e-3)


class ResetAt:
    """Resets after some steps."""

    def __init__(self, steps: list[int]):
        self.steps, self.number = steps, 0

    def due(self, steps: int, gradient: np.ndarray, comm: Any) -> bool:
        self.number += 1
        return self.number in self.steps


@pytest.mark.slow
def test_restart(tmp_path):
    """A run that goes on from a file, written after the grid has changed, ends alike."""
    whole, base = layer(7)
    path = COMM.bcast(str(tmp_path / "state"))
    part, _ = layer(5)
    assert part.regrids
    pm.save_restart(part, path)
    again, held = layer(0)
    pm.load_restart(again, path)
    assert again.regrids == part.regrids
    assert again.points.total == part.points.total
    assert [s.regrids for s in again.steps] == [s.regrids for s in part.steps]
    march(again, 7)
    np.testing.assert_allclose(measured(again, held), measured(whole, base), rtol=1e-9)
    with pytest.raises(pm.InputError, match="grid has been changed since it was made"):
        pm.load_restart(again, path)


def answers(case: str = "layer") -> dict[str, Any]:
    problem, base = layer(6)
    force, width, _, *numbers = measured(problem, base)
    return {"force": force, "width": width, "numbers": numbers}


@pytest.mark.mpi
@pytest.mark.slow
def test_ranks_agree():
    serial = answers()
    for found in on_ranks(3, "layer", script=__file__):
        for name, expected in serial.items():
            np.testing.assert_allclose(found[name], expected, rtol=1e-9)


# other bodies ---------------------------------------------------------------------------------------------
def bar(regrid: Any, **options: Any) -> tuple[pm.QuasiStatic, pm.Selection, Any]:
    """A bar under a load at its end, between planes in the grid."""
    grid = pm.Grid.box((0, -1), (4, 2), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (3, 1)), material=NEO_HOOKEAN)
    problem = pm.QuasiStatic(grid, points, regrid=regrid, reset=1, controls=STRICT, **options)
    held = problem.fix(pm.plane(x=0.0), u=0)
    end = points.farthest((1, 0))
    problem.load(end, force=(0.0, -8.0))
    return problem, end, held


def finer(problem: pm.QuasiStatic) -> pm.Grid | None:
    if problem.progress.step == 2 and not problem.regrids:
        return pm.Grid.graded(x=pm.lines(0, 4, fine=0.125, where=(0, 1)), y=np.linspace(-1, 2, 13))
    return None


def test_a_function_chooses_grids_and_loads_follow():
    problem, end, held = bar(finer)
    list(problem.march(4, progress=False))
    assert [one.step for one in problem.regrids] == [2]
    np.testing.assert_allclose(problem.reaction(held)[0], (0.0, 8.0), atol=1e-8)
    plain, tip, _ = bar(None)
    list(plain.march(4, progress=False))
    one, other = problem.points.mean_displacement(end), plain.points.mean_displacement(tip)
    np.testing.assert_allclose(one, other, rtol=0.02)
    stored = problem.energies()
    assert abs(stored["residue"]) < 0.05 * stored["stored"]


def test_a_function_of_trials_has_steps_taken_again():
    """Nothing flows in coarse cells; the grid that there is already changes nothing."""
    fine = pm.Grid.graded(x=np.linspace(0, 0.05, 6), y=np.linspace(0, 0.1, 51))
    asked = []

    def resolved(problem: pm.QuasiStatic, trial: Any) -> pm.Grid | None:
        asked.append((problem.progress.step, bool(COMM.allreduce(int(trial.flowed.any())))))
        return fine if asked[-1][1] else None

    problem, base = layer(5, resolved, reset=None)
    first = next(step for step, flows in asked if flows)
    assert [one.step for one in problem.regrids] == [first]
    assert [step for step, _ in asked].count(first) == 2  # the trial, and once more
    whole, held = layer(5, None, fine.lines[1], reset=ResetAt([first]))
    found, expected = (np.array([p.reaction(b)[0][0], band(p)]) for p, b in ((problem, base), (whole, held)))
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_a_function_that_always_returns_its_grid_changes_nothing():
    problem, *_ = bar(lambda problem: pm.Grid.box((0, -1), (4, 2), 0.5))
    list(problem.march(3, progress=False))
    assert problem.regrids == ()


def test_planes_of_supports_have_to_stay():
    problem, *_ = bar(
        lambda problem: pm.Grid.box((0, -1), (4, 2), (0.5, 0.25)) if problem.progress.step else None,
        basis="mpm",
    )
    problem.fix(pm.plane(y=0.5), ux=0)
    list(problem.march(2, progress=False))
    problem, *_ = bar(
        lambda problem: pm.Grid.box((0, -1), (4, 2), (0.5, 1.0)) if problem.progress.step else None,
        basis="mpm",
    )
    problem.fix(pm.plane(y=0.5), ux=0)
    steps = problem.march(2, progress=False)
    next(steps)
    with pytest.raises(pm.InputError, match=r"regrid: support 2 .* plane y = 0.5, which the new grid hasn't"):
        next(steps)
    assert problem.progress.step == 1
    assert not problem.regrids


@pytest.mark.parametrize("basis", ["bspline", "mpm"])
def test_moving_planes_go_on(basis, tmp_path):
    """A block under a platen is compressed evenly, whatever the grid becomes on the way."""

    def halved(problem: pm.QuasiStatic) -> pm.Grid | None:
        if problem.progress.step != 2 or problem.regrids:
            return None
        y = problem.regridding.now(problem).lines[1]
        assert y[-1] == pytest.approx(0.8)
        return pm.Grid.graded(x=np.linspace(0, 1, 5), y=np.linspace(0, y[-1], 9))

    found, path = [], COMM.bcast(str(tmp_path / "state"))
    for regrid in (halved, None):
        grid = pm.Grid.box((0, 0), (1, 1), 0.25)
        points = pm.seed(grid, material=NEO_HOOKEAN)
        problem = pm.QuasiStatic(grid, points, basis=basis, regrid=regrid, reset=1, controls=STRICT)
        for x in (0.0, 1.0):
            problem.fix(pm.plane(x=x), ux=0)
        problem.fix(pm.plane(y=0.0), uy=0)
        top = problem.fix(pm.plane(y=1.0, moving=True), uy=-0.4)
        list(problem.march(4, progress=False))
        assert problem.grid.upper[1] == pytest.approx(0.7)  # at the last reset
        found.append(problem.reaction(top)[0][1])
        if regrid:
            assert problem.points.total == 2 * 64
            ends = []
            pm.save_restart(problem, path)
            again = pm.QuasiStatic(
                grid, pm.seed(grid, material=NEO_HOOKEAN), basis=basis, reset=1, controls=STRICT
            )
            for x in (0.0, 1.0):
                again.fix(pm.plane(x=x), ux=0)
            again.fix(pm.plane(y=0.0), uy=0)
            held = again.fix(pm.plane(y=1.0, moving=True), uy=-0.4)
            pm.load_restart(again, path)
            for one, support in ((problem, top), (again, held)):
                list(one.march(1, to=1.25, progress=False))
                ends.append([one.points.total, *one.grid.lines[1], one.reaction(support)[0][1]])
            np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9, atol=1e-12)
            list(problem.march(1, to=1.0, progress=False))
            late = problem.fix(pm.plane(y=1.0), ux=0)  # where it was at first
            assert late.where.index == 8
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


def test_the_grid_goes_on_with_a_body_that_moves():
    """A block on springs that is carried beyond the grid that was given."""
    ends = []
    for upper, regrid in ((2.0, pm.FollowBody(margin=0.5)), (6.0, None)):
        grid = pm.Grid.box((0, 0), (upper, 1), 0.25)
        points = pm.seed(grid, bounds=((0.25, 0), (1.25, 0.75)), material=MICROPOLAR)
        problem = pm.QuasiStatic(grid, points, regrid=regrid, reset=1, controls=STRICT)
        problem.fix(pm.plane(y=0.0), uy=0)
        problem.fix(pm.Surface.line((0.25, 0.75), (0.25, 0.0), 6), ux=3.0)
        list(problem.march(6, progress=False))
        ends.append(points.mean_displacement())
        if regrid:
            assert problem.grid.upper[0] > 4.0
            assert problem.grid.lower == (0.0, 0.0)
            assert all(one.split == 0 for one in problem.regrids)
            assert len(problem.regrids) < 6
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9, atol=1e-9)


def test_the_grid_goes_on_with_a_body_in_motion():
    ends = []
    for upper, regrid in ((2.0, pm.FollowBody(margin=0.5)), (8.0, None)):
        grid = pm.Grid.box((0, 0), (upper, 1), 0.25)
        points = pm.seed(grid, bounds=((0.25, 0.25), (1.0, 0.75)), material=NEO_HOOKEAN)
        problem = pm.Dynamic(grid, points, density=2.0, reset=1, regrid=regrid)
        problem.velocity(v=(3.0, 0.0))
        list(problem.march(1.0, steps=10, progress=False))
        ends.append(points.mean_displacement())
    assert ends[0][0] == pytest.approx(3.0, rel=1e-6)
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9, atol=1e-9)
    with pytest.raises(pm.InputError, match="bodies in motion don't split"):
        pm.Dynamic(grid, points, density=2.0, regrid=pm.FollowBody(margin=0.5, h=0.1))


def test_fine_cells_follow_a_part():
    grid = pm.Grid.box((0, 0), (4, 1), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=NEO_HOOKEAN)
    part = points.nearest((0.5, 0.9), 2)
    policy = pm.FollowBody(margin=0.6, h=0.125, part=part, axes="x")
    problem = pm.QuasiStatic(grid, points, regrid=policy, reset=1, controls=STRICT)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(x=4.0, moving=True), ux=1.0)
    list(problem.march(3, progress=False))
    assert problem.regrids[0].step == 0
    x = problem.points.x[problem.points.rows(part)]
    assert np.all(problem.grid.sizes(problem.grid.cells_of(x))[:, 0] <= 0.13 * 1.25)
    assert problem.grid.smallest[1] == problem.grid.largest[1] == 0.5
    assert points_per_cell(points, problem.grid)[1] == 2


# what can't be ------------------------------------------------------------------------------------------
def test_what_cannot_be_regridded_is_refused():
    grid = pm.Grid.box((0, 0), (2, 1), 0.25)
    body = {"material": STRONG, "bounds": ((0, 0), (1, 1))}
    points = pm.seed(grid, **body)
    bands = pm.AlongBands(h=0.1)

    def refused(what: str, **options: Any) -> None:
        given = {"points": points, "regrid": bands} | options
        with pytest.raises(pm.InputError, match=what):
            pm.QuasiStatic(grid, **given)

    refused("none of the materials yields", points=pm.seed(grid, material=MICROPOLAR))
    classical = pm.DruckerPrager(pm.Hencky(lam=1e6, mu=1e6), phi=0.3, k=1e3, cone="compression")
    refused("DruckerPrager of a classical material has no length", points=pm.seed(grid, material=classical))
    refused("points have no boxes", points=pm.seed(grid, layout="gauss", **body))
    refused("balanced_reset = False: with regrid", balanced_reset=False)
    refused("regrid", regrid=3.0)
    refused("axes: 'z', but the grid has 2 dimensions", regrid=pm.AlongBands(h=0.1, axes="z"))
    ring = pm.seed(grid, material=NEO_HOOKEAN, axisymmetric=True)
    refused("points of a body of revolution", points=ring, regrid=lambda problem: None)
    problem = pm.QuasiStatic(grid, points, regrid=bands)
    with pytest.raises(pm.InputError, match="goes along with points one by one"):
        problem.obstacle(pm.HalfSpace((0, 0), (0, 1)), stiffness=1e9)
    left = pm.seed(grid, bounds=((0.25, 0), (1, 1)), material=STRONG)
    problem = pm.QuasiStatic(grid, left, basis="mpm", regrid=bands)
    with pytest.raises(pm.InputError, match="in the midst of the grid"):
        problem.symmetry(pm.plane(x=0.25))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: pm.AlongBands(h=0.0),
        lambda: pm.AlongBands(h=0.1, margin=-1),
        lambda: pm.AlongBands(h=0.1, axes="w"),
        lambda: pm.AlongBands(h=0.1, growth=1.0),
        lambda: pm.AlongBands(h=0.1, keep={"x": [math.nan]}),
        lambda: pm.FollowBody(margin=0.0),
        lambda: pm.FollowBody(margin=1.0, axes="x"),
        lambda: pm.FollowBody(margin=1.0, h="fine"),
        lambda: pm.FollowBody(margin=1.0, h=0.1, part=[1, 2]),
    ],
)
def test_arguments_of_policies(wrong):
    with pytest.raises(pm.InputError):
        wrong()


if __name__ == "__main__":
    report(answers)
