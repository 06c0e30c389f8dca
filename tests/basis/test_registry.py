"""Bases by name, and one that a user adds."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.basis.registry import BASES, basis_of
from tests.conftest import NEO_HOOKEAN, by_id
from tests.recipes.basis import Hats


@pytest.fixture
def known():
    before = dict(BASES)
    BASES.pop("hats", None)
    yield
    BASES.clear()
    BASES.update(before)


def pulled(basis: str | pm.Basis) -> np.ndarray:
    """A bar between planes with a load at its end, a ghost penalty and a surface."""
    grid = pm.Grid.box((0, 0), (4, 3), 1.0)
    points = pm.seed(grid, material=NEO_HOOKEAN, bounds=((0, 0), (3, 1)))
    points.x = points.X = points.x + np.array([0.0, 0.4])
    problem = pm.QuasiStatic(grid, points, basis=basis, ghost="light")
    problem.fix(pm.plane(x=0.0), u=0)
    problem.load(points.farthest((1, 0)), force=(40.0, -5.0))
    problem.pressure(pm.Surface.line((2, 1.4), (1, 1.4), 4), 10.0)
    list(problem.march(2, progress=False))
    return by_id(points, points.x)


def test_a_basis_of_the_users_own(known):
    """As an instance, and by its name once it has been registered; it needs nothing else."""
    expected = pulled("mpm")
    np.testing.assert_allclose(pulled(Hats()), expected, rtol=0, atol=1e-12)
    pm.register_basis(Hats())
    np.testing.assert_allclose(pulled("hats"), expected, rtol=0, atol=1e-12)
    with pytest.raises(
        pm.InputError, match="allowed are gimpm, mpm, bspline, bspline3, bspline-averaged, hats"
    ):
        basis_of("hat")
    with pytest.raises(pm.InputError, match="Allowed are 'gimpm', 'mpm' and 'hats'"):
        pm.QuasiStatic(
            pm.Grid.box((0, 0), (1, 1), 1.0),
            pm.seed(pm.Grid.box((0, 0), (1, 1), 1.0), material=NEO_HOOKEAN),
            ghost="light",
        )


def test_names_stand_for_one_class(known):
    pm.register_basis(basis_of("mpm"))  # once more
    with pytest.raises(pm.InputError, match="'mpm': a Tents has this name already"):
        pm.register_basis(type("Other", (Hats,), {"name": "mpm"})())
    with pytest.raises(pm.InputError, match="basis = 'mpm': a Basis is needed"):
        pm.register_basis("mpm")


def test_every_basis_says_what_it_is():
    for name, basis in BASES.items():
        assert basis.name == name
        assert basis_of(name) is basis is basis_of(basis)
        assert basis.functions == basis.degree + 1 <= 6
