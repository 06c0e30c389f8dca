"""Excavation and fill: points that are taken out of a body, and points that join it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import InputError
from tests.conftest import COMM, assert_repeated, by_id
from tests.helpers.ground import COSSERAT, HENCKY, LAM, MICROPOLAR, MU, SOIL, WEIGHT, largest, run


# a cavity ---------------------------------------------------------------------------------------------
def circle(radius: float, count: int = 64) -> pm.Surface:
    """A quarter of one about the origin, normals outward."""
    angle = (np.arange(count) + 0.5) * math.pi / 2 / count
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    return pm.Surface(radius * normal, np.full(count, radius * math.pi / 2 / count), normal)


@pytest.mark.parametrize("basis", ["mpm", "bspline"])
def test_a_cavity_in_a_pressure_opens_as_lame_says(basis: str) -> None:
    """A ring between a = 1 and b = 3, of whose inside the pressure goes while it stays outside."""
    a, b, p = 1.0, 3.0, 1e3
    grid = pm.Grid((0, 0), (0.25, 0.25), (14, 14), comm=COMM)

    def between(r0: float, r1: float) -> Any:
        return pm.seed(grid, lambda x: (np.hypot(*x.T) >= r0) & (np.hypot(*x.T) < r1), material=HENCKY)

    points = between(a, b)
    whole = points.total
    points.join(between(0.0, a))
    inside = pm.Selection(np.arange(whole, points.total))
    problem = pm.QuasiStatic(grid, points, basis=basis)
    problem.fix(pm.plane(x=0.0), ux=0.0)
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.pressure(circle(b), lambda f: p)
    problem.initial_stress(-p * np.eye(3))
    problem.remove(inside, over=1.0)
    assert points.total == whole
    run(problem, 1, 1e-9)
    assert largest(points.displacement) < 1e-10
    run(problem, 2, 1.0)
    r = np.hypot(*points.X.T)
    u = np.einsum("ni,ni->n", points.displacement, points.X) / r
    # of the change: sigma_r(a) = p, sigma_r(b) = 0; u = A r + B / r
    A, B = np.linalg.solve([[2 * (LAM + MU), -2 * MU / a**2], [2 * (LAM + MU), -2 * MU / b**2]], [p, 0.0])
    middle = (r > 1.3) & (r < 2.7)
    exact = A * r + B / r
    error = largest((u - exact)[middle]) / largest(exact[middle])
    assert error < 0.03
    stress = problem.fields("stress").stress
    radial = np.einsum("nij,ni,nj->n", stress[:, :2, :2], points.X, points.X) / r**2
    sr = -p + 2 * (LAM + MU) * A - 2 * MU * B / r**2
    assert np.sqrt(np.mean((radial - sr)[middle] ** 2)) < 0.05 * p if middle.any() else True
    energies = problem.energies()
    assert abs(energies["residue"]) < 1e-3 * energies["stored"]


# a trench ---------------------------------------------------------------------------------------------
def trench(material: pm.Material, **options: Any) -> tuple[Any, pm.Selection]:
    grid = pm.Grid((0, 0), (0.5, 0.5), (6, 5), comm=COMM)
    points = pm.seed(grid, bounds=((0, 0), (3, 2)), material=material)
    problem = pm.QuasiStatic(grid, points, **options)
    for x in (0.0, 3.0):
        problem.fix(pm.plane(x=x), ux=0.0)
    problem.fix(pm.plane(y=0.0), u=0.0)
    ground = pm.K0(weight=WEIGHT, K0=0.6, surface=2.0)
    problem.initial_stress(ground)
    problem.body_load(force=ground.force)
    return problem, points.where(lambda x: (x[:, 0] < 1.0) & (x[:, 1] > 1.5))


@pytest.mark.parametrize(
    ("material", "options"),
    [
        (HENCKY, {"basis": "mpm", "reset": None}),
        (SOIL, {"basis": "bspline", "reset": 1}),
        (COSSERAT, {"basis": "gimpm", "reset": 2}),
    ],
)
@pytest.mark.parametrize("after", [0, 1])
def test_nothing_jumps_when_points_are_taken_out(material: Any, options: Any, after: int) -> None:
    problem, selection = trench(material, **options)
    if after:
        run(problem, 1, 0.5)
    problem.remove(selection, over=1.0)
    start = problem.progress.factor
    assert problem.points.total == 4 * 24 - len(selection)
    run(problem, 1, start + 1e-9)
    assert largest(problem.points.displacement) < 1e-10 * 2.0
    run(problem, 2, start + 1.0)
    assert not problem.loads[1:]  # all that was handed over has faded
    heave = problem.points.where(lambda x: (x[:, 0] < 0.8) & (np.abs(x[:, 1] - 1.4) < 0.11))
    assert problem.points.mean_displacement(heave)[1] > 1e-4
    balance = problem.balance()
    below = problem.reaction(problem.supports[-1]).force[1]
    np.testing.assert_allclose(below, WEIGHT * (6.0 - 0.5), rtol=1e-6)
    assert np.abs(balance.force).max() < 1e-6 * below


def test_what_is_taken_out_at_once_is_gone_in_the_next_step() -> None:
    answers = []
    for over in (None, 1.0):
        problem, selection = trench(HENCKY, basis="mpm", reset=None)
        problem.remove(selection, over=over)
        run(problem, 1, 1.0)
        answers.append(by_id(problem.points, problem.points.displacement))
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-6 * np.abs(answers[0]).max())


@pytest.mark.parametrize("over", [None, 1.0])
def test_an_elastic_body_in_boxes_goes_on_without_points(over: float | None) -> None:
    """Between two resets it keeps what its boxes have added to the last tangent."""
    grid = pm.Grid.box((0, -1), (5, 2), cell=0.5, comm=COMM)
    points = pm.seed(grid, bounds=((0, 0), (4, 0.75)), material=pm.NeoHookean(lam=1e6, mu=4e5))
    problem = pm.QuasiStatic(grid, points)
    wall = problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=lambda f: (0, -100.0))
    run(problem, 3, 1.0)
    before = by_id(points, points.displacement)
    problem.remove(points.where(lambda x: x[:, 0] > 2.5), over=over)
    if over:
        run(problem, 1, 1.0 + 1e-9)
        np.testing.assert_allclose(by_id(points, points.displacement), before[: points.total], atol=1e-8)
    run(problem, 2, 2.0)
    np.testing.assert_allclose(problem.reaction(wall).force, [0.0, 2.5 * 0.75 * 100.0], atol=1e-6)


def test_a_removal_that_cannot_be_leaves_all_as_it_was() -> None:
    ends = []
    for tried in (False, True):
        problem, selection = trench(SOIL, reset=2)
        problem.load(problem.points.where(lambda x: x[:, 1] > 1.5), force=(0.0, -5e3))
        run(problem, 1, 0.5)
        if tried:
            with pytest.raises(pm.PolarMPMError, match=r"support .*y = 0"):
                problem.remove(problem.points.where(lambda x: x[:, 1] < 1.2), over=1.0)
            assert problem.points.total == 4 * 24
        run(problem, 1, 1.0)
        before = problem.energies()
        assert abs(before["residue"]) < 1e-4 * before["stored"]
        problem.remove(selection, over=0.5)
        assert abs(problem.energies()["residue"] - before["residue"]) < 1e-9 * before["stored"]
        run(problem, 2, 1.5)
        ends.append(by_id(problem.points, problem.points.displacement))
    assert_repeated(*ends)


def test_restart_goes_on_without_the_points(tmp_path: Path) -> None:
    def begin(late: bool) -> Any:
        problem, selection = trench(SOIL, reset=2)
        if late:
            run(problem, 1, 0.5)
        problem.remove(selection, over=1.0)
        if late:
            run(problem, 1, 1.0)
        layer = pm.seed(problem.grid, bounds=((2, 2), (3, 2.5)), material=SOIL)
        problem.add(layer, until=2.0)
        if late:
            run(problem, 1, 1.25)
        return problem

    path = COMM.bcast(tmp_path) / "state.h5"
    problem = begin(True)
    pm.save_restart(problem, path)
    again = begin(False)
    pm.load_restart(again, path)
    for one in (problem, again):
        run(one, 3, 2.0)
    assert problem.points.total == 4 * 24 - 8 + 8
    for name in ("displacement", "hardening"):
        found, expected = (by_id(one.points, getattr(one.points, name)) for one in (again, problem))
        assert_repeated(found, expected)
    assert np.array_equal(by_id(again.points, again.points.id), by_id(problem.points, problem.points.id))


# a fill -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["mpm", "bspline"])
@pytest.mark.parametrize("over", [None, 1.0])
def test_a_fill_in_layers_settles_as_columns_do(basis: str, over: float | None) -> None:
    """Layers that are unloaded when they are placed: each is compressed by what lies on it from then on."""
    h, modulus = 2.0, 100 * (LAM + 2 * MU)
    material = pm.Hencky(lam=100 * LAM, mu=100 * MU)
    grid = pm.Grid((0, 0), (0.5, 0.5), (1, 13), comm=COMM)

    def layer(k: int) -> pm.Points:
        return pm.seed(grid, bounds=((0, k * h), (0.5, (k + 1) * h)), material=material)

    points = layer(0)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=2)
    for x in (0.0, 0.5):
        problem.fix(pm.plane(x=x), ux=0.0)
    problem.fix(pm.plane(y=0.0), u=0.0)
    problem.body_load(force=lambda f: (0.0, -WEIGHT))
    run(problem, 1, 1.0)
    stages = []
    for k in (1, 2):
        stages.append(problem.add(layer(k), over=over))
        run(problem, 2, 1.0 + k)
    assert [len(stage.points) for stage in stages] == [16, 16]
    y = points.X[:, 1]
    number = np.floor(y / h).astype(int)
    # stress of the column below its top, then of each layer that was placed after the point's own
    u = np.zeros(len(y))
    for n in range(3):
        here = np.minimum(y, n * h)  # what lies below layer n is compressed by its weight
        own = np.clip(y - n * h, 0.0, h)
        added = (h * here + h * own - own**2 / 2) * WEIGHT / modulus
        u -= np.where(number <= n, added, 0.0)
    assert largest(points.displacement[:, 1] - u) < 0.02 * largest(u)
    sigma = problem.fields("stress").stress[:, 1, 1]
    assert largest(sigma + WEIGHT * (3 * h - y)) < 0.04 * WEIGHT * 3 * h
    below = problem.reaction(problem.supports[-1]).force[1]
    np.testing.assert_allclose(below, WEIGHT * 0.5 * 3 * h, rtol=1e-6)


def test_a_fill_of_another_material_and_with_a_stress() -> None:
    problem, _ = trench(HENCKY, basis="bspline")
    run(problem, 1, 0.5)
    problem.rows["mark"] = np.ones((len(problem.points), 2))
    layer = pm.seed(problem.grid, bounds=((0, 2), (3, 2.5)), material=SOIL)
    problem.add(layer, over=1.0, stress=-2e3 * np.eye(3))
    assert len(layer) == 24 or COMM.size > 1
    again = pm.seed(problem.grid, lambda x: np.zeros(len(x), bool) | (x[:, 1] > 2.0), material=HENCKY)
    assert problem.rows["mark"].sum() <= 2 * 4 * 24
    assert len(problem.points.materials) == 2
    stress = problem.fields("stress").stress[problem.points.X[:, 1] > 2.0]
    np.testing.assert_allclose(stress, np.broadcast_to(-2e3 * np.eye(3), stress.shape), rtol=1e-9, atol=1e-6)
    assert abs(problem.energies()["residue"]) < 1e-9
    run(problem, 3, 1.5)
    new = problem.points.X[:, 1] > 2.0
    assert problem.comm.allreduce(float(problem.points.dissipation[~new].sum())) == 0.0
    np.testing.assert_allclose(
        problem.reaction(problem.supports[-1]).force[1], WEIGHT * 6.0 + WEIGHT * 1.5, rtol=1e-6
    )
    assert again.total


# refused ----------------------------------------------------------------------------------------------
def test_stages_that_cannot_be_are_refused() -> None:
    problem, selection = trench(SOIL)
    points = problem.points
    everything = pm.Selection(np.arange(points.total))
    for message, call in [
        ("Selection", lambda: problem.remove("the trench")),
        ("no point", lambda: problem.remove(pm.Selection(np.zeros(0, int)))),
        ("nothing would be left", lambda: problem.remove(everything)),
        ("aren't of this body", lambda: problem.remove(pm.Selection([10**6]))),
        ("one of them", lambda: problem.remove(selection, over=1.0, until=2.0)),
        (
            "micropolar",
            lambda: problem.add(pm.seed(problem.grid, bounds=((0, 2), (1, 2.5)), material=MICROPOLAR)),
        ),
        ("counts belongs to terms", lambda: problem.add(points, counts="total")),
        ("is not a Term", lambda: problem.add(3)),
        ("over belongs to points", lambda: problem.add(3, over=1.0)),
    ]:
        with pytest.raises(InputError, match=message):
            call()
    stage = problem.remove(selection)
    with pytest.raises(InputError, match="can be released"):
        problem.release(stage)
    with pytest.raises(InputError, match="aren't of this body"):
        problem.remove(selection)
