"""The solver of the recipe finds what the direct one finds; what can't be a solver is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.solvers.choice import SOLVERS
from polarmpm.solvers.linear import ACCURACY, SingularTangent
from tests.conftest import HENCKY, MICROPOLAR, beam, by_id
from tests.helpers.bodies import box
from tests.recipes.solver import Diagonal


def bent(dim: int, material: pm.Material, solver: str, **options: Any) -> np.ndarray:
    problem = beam(dim, material, solver=solver, basis="mpm", reset=None, **options)
    problem.body_load(force=(0.0, -3.0, 1.0)[:dim])
    list(problem.march(2, progress=False))
    return by_id(problem.points, problem.points.displacement)


@pytest.mark.parametrize("material", [HENCKY, MICROPOLAR], ids=["classical", "micropolar"])
@pytest.mark.parametrize("dim", [2, 3])
def test_same_answer_as_the_direct_solver(dim, material):
    expected, found = (bent(dim, material, solver) for solver in ("direct", "diagonal"))
    assert abs(expected).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * abs(expected).max())


def test_elements_take_it_too():
    found = []
    for solver in ("direct", "diagonal"):
        elements = pm.Elements(box("quadrilateral", (4, 3)), material=MICROPOLAR)
        problem = pm.QuasiStaticFEM(elements, solver=solver)
        problem.fix(pm.plane(x=0.0), u=0, theta=0)
        problem.traction(pm.plane(x=1.0), force=(0.0, 40.0))
        list(problem.march(1, progress=False))
        found.append(elements.mean_displacement())
    np.testing.assert_allclose(found[1], found[0], rtol=1e-8)


def test_one_that_fails_cuts_the_step():
    class Helpless(Diagonal):
        def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
            raise SingularTangent("no idea")

    if "helpless" not in SOLVERS:
        pm.register_solver("helpless", Helpless)
    with pytest.raises(pm.NotConverged, match="no idea"):
        bent(2, MICROPOLAR, "helpless")


@pytest.mark.parametrize("name", ["direct", "auto", 3])
def test_names_that_are_taken(name):
    with pytest.raises(pm.InputError, match="a name other than auto, direct, multigrid"):
        pm.register_solver(name, Diagonal)


def test_bad_choices():
    with pytest.raises(pm.InputError, match="a function of a Tangent is needed"):
        pm.register_solver("nothing", None)  # type: ignore[arg-type]
    with pytest.raises(pm.InputError, match="solver = 'nothing': allowed are auto, direct, multigrid"):
        beam(2, solver="nothing")
