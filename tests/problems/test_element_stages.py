"""Excavation and fill with finite elements: they leave the body, and come in again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import InputError
from tests.conftest import COMM, assert_repeated, by_id
from tests.helpers.bodies import box
from tests.helpers.ground import COSSERAT, HENCKY, LAM, MU, SOIL, WEIGHT, largest, run

CLAY = pm.CamClay(
    pm.Houlsby(p_0=20e3, swelling=0.01, mu=3e6), M=1.0, compression=0.08, p_c=100e3, cohesion=8e3
)


def corner(x: np.ndarray) -> np.ndarray:
    return (x[:, 0] < 1.0) & (x[:, 1] > 1.5)


# a trench ---------------------------------------------------------------------------------------------
def trench(
    material: pm.Material,
    degree: int = 1,
    rest: bool = True,
    before: Any = None,
    overconsolidation: float | None = None,
    **options: Any,
) -> Any:
    """Ground at rest of 3 x 2 m; `before` is removed from it before it has any stress."""
    body = box("quadrilateral", (6, 4), size=(3.0, 2.0))
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=material, degree=degree), **options)
    if before is not None:
        problem.remove(problem.points.where(before))
    for x in (0.0, 3.0):
        problem.fix(pm.plane(x=x), ux=0.0)
    problem.fix(pm.plane(y=0.0), u=0.0)
    ground = pm.K0(weight=WEIGHT, K0=0.6, surface=2.0)
    if rest:
        problem.initial_stress(ground, overconsolidation=overconsolidation, balanced=before is None)
    problem.body_load(force=ground.force)
    return problem


def by_points(material: pm.Material, overconsolidation: float | None = None) -> Any:
    grid = pm.Grid((0, 0), (0.5, 0.5), (6, 5), comm=COMM)
    points = pm.seed(grid, bounds=((0, 0), (3, 2)), material=material)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None)
    for x in (0.0, 3.0):
        problem.fix(pm.plane(x=x), ux=0.0)
    problem.fix(pm.plane(y=0.0), u=0.0)
    ground = pm.K0(weight=WEIGHT, K0=0.6, surface=2.0)
    problem.initial_stress(ground, overconsolidation=overconsolidation)
    problem.body_load(force=ground.force)
    return problem


@pytest.mark.parametrize(("material", "degree"), [(HENCKY, 2), (SOIL, 1), (COSSERAT, 1)])
@pytest.mark.parametrize("after", [0, 1])
def test_nothing_jumps_when_elements_are_taken_out(material: Any, degree: int, after: int) -> None:
    problem = trench(material, degree)
    points, count = problem.points, problem.points.total
    selection = points.where(corner)
    if after:
        run(problem, 1, 0.5)
    problem.remove(selection, over=1.0)
    start = problem.progress.factor
    assert points.total == count - len(selection)
    run(problem, 1, start + 1e-9)
    assert largest(points.displacement) < 1e-10 * 2.0
    run(problem, 2, start + 1.0)
    assert not problem.loads[1:]  # all that was handed over has faded
    balance, below = problem.balance(), problem.reaction(problem.supports[-1]).force[1]
    np.testing.assert_allclose(below, WEIGHT * (6.0 - 0.5), rtol=1e-6)
    assert np.abs(balance.force).max() < 1e-6 * below
    energies = problem.energies()
    assert abs(energies["residue"]) < 1e-4 * energies["stored"]


@pytest.mark.parametrize("material", [HENCKY, SOIL])
def test_points_heave_as_elements_do(material: pm.Material) -> None:
    heaves = []
    for problem in (trench(material), by_points(material)):
        problem.remove(problem.points.where(corner), over=1.0)
        run(problem, 2, 1.0)
        near = problem.points.where(lambda x: (x[:, 0] < 0.9) & (np.abs(x[:, 1] - 1.25) < 0.26))
        heaves.append(problem.points.mean_displacement(near)[1])
    assert heaves[0] > 5e-4
    np.testing.assert_allclose(*heaves, rtol=0.02)


@pytest.mark.slow  # where its kernels aren't compiled yet
def test_clay_heaves_alike_as_it_is_dug_out_in_stages() -> None:
    heaves = []
    for problem in (make(CLAY, overconsolidation=1.5) for make in (trench, by_points)):
        points = problem.points
        run(problem, 1, 1e-9)
        assert largest(points.displacement) < 1e-10
        for stage, depth in enumerate((1.5, 1.0), start=1):
            dug = points.where(lambda x, depth=depth: (x[:, 0] < 1.0) & (x[:, 1] > depth))
            problem.remove(dug, over=1.0)
            run(problem, 2, float(stage))
            below = problem.reaction(problem.supports[-1]).force[1]
            np.testing.assert_allclose(below, WEIGHT * (6.0 - 0.5 * stage), rtol=1e-6)
        near = points.where(lambda x: (x[:, 0] < 0.9) & (np.abs(x[:, 1] - 0.75) < 0.26))
        heaves.append(points.mean_displacement(near)[1])
        assert problem.energies()["dissipated"] > 0.0
    assert heaves[0] > 5e-4
    np.testing.assert_allclose(*heaves, rtol=0.02)


@pytest.mark.parametrize("degree", [1, 2])
def test_what_is_taken_out_is_as_if_it_had_never_been(degree: int) -> None:
    """An elastic body doesn't know in which order it was unloaded."""
    answers = []
    for before, over in ((None, None), (None, 1.0), (corner, None)):
        problem = trench(HENCKY, degree, before=before)
        if before is None:
            problem.remove(problem.points.where(corner), over=over)
        run(problem, 1, 1.0)
        answers.append(by_id(problem.points, problem.points.displacement))
    for answer in answers[1:]:
        np.testing.assert_allclose(answer, answers[0], rtol=0, atol=1e-6 * np.abs(answers[0]).max())


def test_followers_on_facets_of_what_is_gone_act_no_more() -> None:
    """A pressure on the top, on the ground and on a corner that goes: its tangent knows the mesh, the body
    has fewer elements."""
    problem = trench(HENCKY, 2, rest=False)
    problem.pressure(pm.plane(y=2.0), lambda f: 1e4)
    run(problem, 1, 1.0)
    bottom = problem.supports[-1]
    np.testing.assert_allclose(problem.reaction(bottom).force[1], WEIGHT * 6.0 + 3e4, rtol=1e-6)
    problem.remove(problem.points.where(corner))
    steps = list(problem.march(1, to=2.0, progress=False))
    assert steps[0].iterations < 7
    np.testing.assert_allclose(problem.reaction(bottom).force[1], WEIGHT * 11.0 / 2 + 2e4, rtol=5e-3)
    assert problem.elements.facets(pm.plane(y=2.0)).area == pytest.approx(2.0)
    with pytest.raises(InputError, match="no facet"):
        problem.elements.facets(lambda x: (x[:, 1] > 1.99) & (x[:, 0] < 1.01))


# a fill -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("over", [None, 1.0])
def test_a_fill_in_layers_settles_as_columns_do(over: float | None) -> None:
    h, modulus = 2.0, 100 * (LAM + 2 * MU)
    elements = pm.Elements(
        box("quadrilateral", (1, 12), size=(0.5, 3 * h)), material=pm.Hencky(lam=100 * LAM, mu=100 * MU)
    )
    problem, points = pm.QuasiStaticFEM(elements), elements.points
    layers = [points.where(lambda x, k=k: (x[:, 1] > k * h) & (x[:, 1] < (k + 1) * h)) for k in (1, 2)]
    removed = [problem.remove(layer) for layer in layers]
    for x in (0.0, 0.5):
        problem.fix(pm.plane(x=x), ux=0.0)
    problem.fix(pm.plane(y=0.0), u=0.0)
    problem.body_load(force=lambda f: (0.0, -WEIGHT))
    run(problem, 1, 1.0)
    for k, layer in enumerate(removed):
        problem.add(layer, over=over)
        run(problem, 2, 2.0 + k)
    y = points.X[:, 1]
    number = np.clip(np.floor(y / h + 1e-3), 0, 2).astype(int)
    u = np.zeros(len(y))
    for n in range(3):
        here, own = np.minimum(y, n * h), np.clip(y - n * h, 0.0, h)
        added = (h * here + h * own - own**2 / 2) * WEIGHT / modulus
        u -= np.where(number <= n, added, 0.0)
    assert largest(points.displacement[:, 1] - u) < 0.02 * largest(u)
    sigma = problem.fields("stress").stress[:, 1, 1]
    assert largest(sigma + WEIGHT * (3 * h - y)) < 0.05 * WEIGHT * 3 * h
    np.testing.assert_allclose(problem.reaction(problem.supports[-1]).force[1], WEIGHT * 3.0, rtol=1e-3)


@pytest.mark.parametrize(("degree", "locking"), [(1, "auto"), (2, "always"), (2, None)])
def test_elements_come_in_undeformed_where_the_mesh_has_moved_to(degree: int, locking: str | None) -> None:
    """A quarter turn of a body that has been sheared strains the new ones little: by what the hole's walls,
    which are still strained, do to them."""
    body = box("quadrilateral", (4, 4), size=(1.0, 1.0))
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=HENCKY, degree=degree), locking=locking)
    points = problem.points
    new = problem.remove(points.where(lambda x: (np.abs(x - 0.5) < 0.25).all(axis=1)))
    problem.fix(lambda x: np.isin(x, (0.0, 1.0)).any(axis=1), u=lambda f, x: _shear(f, x))
    run(problem, 5, 1.0)
    problem.add(new)
    here = points.rows(new.points)
    volume = COMM.allreduce(points.volume0[here].sum())
    run(problem, 1, 1.0 + 1e-9)
    stress = problem.fields("stress").stress
    assert largest(stress[here]) < 1e-6 * MU
    run(problem, 8, 1.5)  # a turn of all by a quarter, about the origin
    assert largest(problem.fields("stress").stress[here]) < 2e-3 * MU
    now = COMM.allreduce(points.volume[here].sum())
    np.testing.assert_allclose(now, volume, rtol=1e-3)


def _shear(factor: float, x: np.ndarray) -> np.ndarray:
    angle = max(factor - 1.0, 0.0) * np.pi
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    sheared = x + 0.1 * min(factor, 1.0) * np.column_stack([x[:, 1], np.zeros(len(x))])
    return sheared @ turn.T - x


def test_a_fill_with_a_stress_keeps_it() -> None:
    problem = trench(SOIL, before=lambda x: x[:, 1] > 1.5)
    points = problem.points
    layer = pm.Selection(np.setdiff1d(np.arange(4 * 24), _ids(points)))
    problem.rows["mark"] = np.ones((len(points), 2))
    run(problem, 1, 1.0)
    problem.add(layer, over=1.0, stress=-2e3 * np.eye(3))
    here = points.rows(layer)
    assert COMM.allreduce(len(here)) == 24
    stress = problem.fields("stress").stress[here]
    np.testing.assert_allclose(stress, np.broadcast_to(-2e3 * np.eye(3), stress.shape), rtol=1e-9, atol=1e-6)
    assert COMM.allreduce(problem.rows["mark"].sum()) == 2 * 3 * 24
    run(problem, 2, 2.0)
    np.testing.assert_allclose(problem.reaction(problem.supports[-1]).force[1], WEIGHT * 6.0, rtol=1e-3)


def _ids(points: pm.Points) -> np.ndarray:
    ids: np.ndarray = np.concatenate(COMM.allgather(points.id))
    return ids


def test_restart_goes_on_with_the_elements(tmp_path: Path) -> None:
    def begin(late: bool) -> Any:
        problem = trench(SOIL)
        upper = problem.remove(problem.points.where(corner), over=1.0)
        if late:
            run(problem, 1, 1.0)
        problem.remove(problem.points.where(lambda x: x[:, 1] - 1.5 > 0.0), until=1.5)
        problem.add(upper, until=2.0)
        if late:
            run(problem, 1, 1.25)
        return problem

    path = COMM.bcast(tmp_path) / "state.h5"
    problem = begin(True)
    pm.save_restart(problem, path)
    with pytest.raises(InputError, match="hasn't given"):
        pm.load_restart(trench(SOIL), path)
    again = begin(False)
    pm.load_restart(again, path)
    for one in (problem, again):
        run(one, 3, 2.0)
    assert problem.points.total == 4 * 20
    for name in ("displacement", "hardening", "X"):
        found, expected = (by_id(one.points, getattr(one.points, name)) for one in (again, problem))
        assert_repeated(found, expected)


def test_a_ring_of_revolution_is_built_in_lifts() -> None:
    """Two lifts on rigid ground: each stands in the stresses of a column of its own weight."""
    body = box("quadrilateral", (2, 8), size=(1.0, 2.0))
    body.geometry.x[:, 0] += 1.0
    problem = pm.QuasiStaticFEM(
        pm.Elements(body, material=pm.Hencky(lam=0.0, mu=100 * MU), degree=1, axisymmetric=True)
    )
    points = problem.points
    upper = problem.remove(points.where(lambda x: x[:, 1] > 1.0))
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.body_load(force=lambda f: (0.0, -WEIGHT))
    run(problem, 1, 1.0)
    problem.add(upper)
    run(problem, 1, 2.0)
    whole = np.pi * (2.0**2 - 1.0) * 2.0 * WEIGHT
    np.testing.assert_allclose(problem.reaction(problem.supports[0]).force[1], whole, rtol=1e-3)
    stress = problem.fields("stress").stress[:, 1, 1]
    assert largest(stress + WEIGHT * (2.0 - points.X[:, 1])) < 0.1 * 2.0 * WEIGHT


# refused ----------------------------------------------------------------------------------------------
def test_stages_that_cannot_be_are_refused() -> None:
    problem = trench(SOIL)
    points = problem.points
    whole, half = points.where(corner), points.where(lambda x: x[:, 0] < 0.25)
    surface = problem.elements.surface(pm.plane(y=2.0))
    held = problem.fix(surface, u=0.0, method="penalty")
    for message, call in [
        ("Selection", lambda: problem.remove("the trench")),
        ("no point", lambda: problem.remove(pm.Selection(np.zeros(0, int)))),
        ("nothing would be left", lambda: problem.remove(pm.Selection(np.arange(4 * 24)))),
        ("aren't of this body", lambda: problem.remove(pm.Selection([10**6]))),
        ("one of them", lambda: problem.remove(whole, over=1.0, until=2.0)),
        ("2 of 4 quadrature points", lambda: problem.remove(half)),
        ("release it before", lambda: problem.remove(whole)),
        ("is in the body", lambda: problem.add(whole)),
        ("the mesh has 96", lambda: problem.add(pm.Selection([10**6]))),
        ("elements have over", lambda: problem.add(whole, counts="total")),
        ("is not a Term", lambda: problem.add(3)),
        ("over belongs to elements", lambda: problem.add(3, over=1.0)),
        ("is part of the mesh", lambda: problem.add(points)),
    ]:
        with pytest.raises(InputError, match=message):
            call()
    problem.release(held)
    with pytest.raises(InputError, match=r"y = 0.* would hold nothing"):
        problem.remove(points.where(lambda x: x[:, 1] < 0.5))
    assert points.total == 4 * 24
    stage = problem.remove(whole)
    with pytest.raises(InputError, match="can be released"):
        problem.release(stage)
    with pytest.raises(InputError, match="aren't of this body"):
        problem.remove(whole)
    other = pm.QuasiStaticFEM(
        pm.Elements(box("quadrilateral", (2, 1)), material=HENCKY), assembly="dolfinx", locking=None
    )
    with pytest.raises(InputError, match="dolfinx"):
        other.remove(pm.Selection(np.arange(4)))
