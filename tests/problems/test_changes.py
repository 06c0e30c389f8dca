"""Materials whose numbers change during a run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.errors import InputError
from tests.conftest import COMM, assert_repeated
from tests.helpers.bodies import box

ELASTIC = pm.Hencky(lam=2e6, mu=1e6)
MICROPOLAR = pm.MicropolarElastic.bounded_stiffness(lam=2e6, mu=1e6, kappa=1e6, l_b=0.1)
METAL = pm.VonMises(ELASTIC, k=4e3)
SOIL = pm.MohrCoulomb(ELASTIC, phi=math.radians(25), c=4e3)
COSSERAT = pm.DruckerPrager(MICROPOLAR, phi=0.4, c=4e3, cone="plane strain", l_p=0.1)


def on_points(material: pm.Material, **options: Any) -> Any:
    grid = pm.Grid((0, 0), (0.5, 0.5), (4, 2), comm=COMM)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=material)
    return pm.QuasiStatic(grid, points, **{"basis": "mpm", **options})


def on_elements(material: pm.Material, **options: Any) -> Any:
    elements = pm.Elements(box("quadrilateral", (2, 1), (1.0, 1.0)), material=material)
    return pm.QuasiStaticFEM(elements, **options)


def squeezed(problem: Any, by: Any = -0.02) -> Any:
    """A unit block between smooth walls, free at its right."""
    problem.fix(pm.plane(x=0.0), ux=0.0)
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.fix(pm.plane(y=1.0), uy=by)
    return problem


def held(f: float) -> float:
    return -0.02 * min(f, 1.0)


def mises(problem: Any) -> np.ndarray:
    """q (np,) of the Kirchhoff stress."""
    stress = problem.fields("stress").stress * np.linalg.det(problem.points.F)[:, None, None]
    s = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    q: np.ndarray = np.sqrt(1.5 * np.einsum("nij,nij->n", s, s))
    return q


def run(problem: Any, steps: int, to: float) -> None:
    for _ in problem.march(steps, to=to, progress=False):
        pass


MAKERS = [
    lambda m: on_points(m),
    lambda m: on_points(m, basis="bspline", reset=1),
    lambda m: on_points(m, locking=None, assembly="projection"),
    lambda m: on_elements(m),
    lambda m: on_elements(m, locking="always"),
    lambda m: on_elements(m, assembly="dolfinx"),
]


@pytest.mark.parametrize("make", MAKERS)
def test_stress_follows_a_strength_that_falls(make: Any) -> None:
    problem = squeezed(make(METAL), held)
    run(problem, 2, 1.0)
    np.testing.assert_allclose(mises(problem), 4e3, rtol=1e-9)
    problem.change(METAL, k=3e3)
    np.testing.assert_allclose(mises(problem), 4e3, rtol=1e-9)  # not before the next step
    run(problem, 1, 1.1)
    np.testing.assert_allclose(mises(problem), 3e3, rtol=1e-9)
    problem.change(METAL, k=2e3, until=1.5)
    for step in problem.march(2, to=1.5, progress=False):
        np.testing.assert_allclose(mises(problem), 3e3 - 1e3 * (step.factor - 1.1) / 0.4, rtol=1e-9)
    problem.change(METAL, k=lambda f: 3e3 / f)
    run(problem, 2, 2.0)
    np.testing.assert_allclose(mises(problem), 1.5e3, rtol=1e-9)
    assert METAL.k == 4e3


@pytest.mark.parametrize("make", [MAKERS[0], MAKERS[3], lambda m: on_elements(m, assembly="dolfinx")])
def test_elastic_numbers_change_to_the_answer_of_another_material(make: Any) -> None:
    other = pm.Hencky(lam=1e6, mu=8e5)
    ends = []
    for first in (ELASTIC, other):
        problem = make(first)
        problem.fix(pm.plane(x=0.0), u=0.0)
        problem.body_load(force=lambda f: (0.0, -3e4))
        run(problem, 1, 1.0)
        if first is ELASTIC:
            problem.change(first, lam=1e6, mu=8e5)
            run(problem, 1, 2.0)
        ends.append(problem.points.x - problem.points.X)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-9)
    assert problem.comm.allreduce(np.abs(ends[1]).max(initial=0.0)) > 1e-3


@pytest.mark.parametrize(("material", "to"), [(SOIL, {"c": 2e3, "phi": 0.3}), (COSSERAT, {"c": 2e3})])
@pytest.mark.parametrize("make", [on_points, on_elements])
def test_restart_goes_on_with_changed_numbers(make: Any, material: Any, to: Any, tmp_path: Path) -> None:
    def begin(last: float) -> Any:
        problem = squeezed(make(material), held)
        if last:
            run(problem, 2, 1.0)
        problem.change(material, over=1.0, **to)
        if last:
            run(problem, round(4 * (last - 1.0)), last)
        return problem

    path = COMM.bcast(tmp_path) / "state.h5"
    problem = begin(1.5)
    pm.save_restart(problem, path)
    run(problem, 2, 2.0)
    again = begin(0.0)
    pm.load_restart(again, path)
    assert again.points.materials[0].c == pytest.approx(3e3)
    run(again, 2, 2.0)
    assert_repeated(again.points.x, problem.points.x)
    assert_repeated(again.fields("stress").stress, problem.fields("stress").stress)
    missing = squeezed(make(material), held)
    with pytest.raises(InputError, match="change 1"):
        pm.load_restart(missing, path)


def test_a_change_that_no_step_has_seen_is_felt_after_a_restart(tmp_path: Path) -> None:
    path = COMM.bcast(tmp_path) / "state.h5"
    problem = squeezed(on_points(METAL, reset=1), held)
    run(problem, 1, 1.0)
    problem.change(METAL, k=3e3)
    pm.save_restart(problem, path)
    run(problem, 1, 2.0)
    again = squeezed(on_points(METAL, reset=1), held)
    again.change(METAL, k=3e3)
    pm.load_restart(again, path)
    np.testing.assert_allclose(mises(again), 4e3, rtol=1e-9)
    run(again, 1, 2.0)
    assert_repeated(again.points.x, problem.points.x)


def test_a_step_that_fails_or_ends_early_keeps_the_numbers() -> None:
    problem = squeezed(on_points(METAL), held)
    run(problem, 1, 1.0)
    before = problem.points.materials

    def falling(f: float) -> float:
        if f > 2.5:
            raise ValueError("no")
        return 3e3 if f < 1.5 else 1e3

    problem.change(METAL, k=falling)
    problem.controls = pm.Controls(max_iterations=1)
    assert not problem.attempt(2.0).converged
    assert problem.points.materials == before
    assert problem.forms[0].material == METAL
    problem.controls = pm.Controls()
    with pytest.raises(InputError, match=r"change 1 \(VonMises\).*load factor 3.*no"):
        problem.attempt(3.0)
    assert problem.forms[0].material == METAL
    assert problem.attempt(2.0).converged
    np.testing.assert_allclose(mises(problem), 1e3, rtol=1e-9)


def test_a_users_functions_have_numbers_that_change() -> None:
    user = pm.UserPlasticity(
        pm.UserEnergy(
            lambda F, p: p.m * (ufl.inner(F, F) - 3 - 2 * ufl.ln(ufl.det(F))), {"m": 1e6}, micropolar=False
        ),
        lambda tau, nu, chi, p: ufl.sqrt(1.5 * ufl.inner(ufl.dev(tau), ufl.dev(tau))) - p.y,
        {"y": 4e3},
    )
    problem = squeezed(on_points(user), held)
    run(problem, 1, 1.0)
    problem.change(user, y=2e3, m=9e5)
    run(problem, 1, 2.0)
    np.testing.assert_allclose(mises(problem), 2e3, rtol=1e-9)
    assert problem.points.materials[0].elastic.values["m"] == 9e5


def test_what_is_no_change_of_numbers_is_refused() -> None:
    problem = squeezed(on_points(SOIL))
    for message, to, numbers in [
        ("numbers such as|either numbers", None, {}),
        ("cohesion: the numbers of MohrCoulomb are phi, psi, c", None, {"cohesion": 1.0}),
        ("c = -1", None, {"c": -1.0}),
        ("regions", None, {"phi": 0.0}),
        ("another form of material", METAL, {}),
        ("its numbers are others: .*cut", pm.MohrCoulomb(ELASTIC, phi=0.4, c=4e3, cut=1e3), {}),
        ("c = nan|c = .*nan", None, {"c": math.nan}),
        ("k: the numbers", None, {"k": 3.0}),
        ("over", None, {"c": lambda f: 1e3, "over": 1.0}),
        ("one of them", None, {"c": 1e3, "over": 1.0, "until": 2.0}),
    ]:
        with pytest.raises(InputError, match=message):
            problem.change(SOIL, to, **numbers)
    with pytest.raises(InputError, match="none of the body's"):
        problem.change(METAL, k=3e3)
    change = problem.change(SOIL, c=lambda f: 4e3 - 1e2 * f)
    with pytest.raises(InputError, match="another change"):
        problem.release(change)
    with pytest.raises(InputError, match="arc-length method takes changes at once"):
        next(iter(problem.march_arc_length(0.1, steps=1)))
