"""The material of CONTRIBUTING.md's recipe: its derivatives, a patch test, its ranges."""

from __future__ import annotations

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.forms.points import PointForm
from tests.conftest import by_id
from tests.forms.test_points import derivative_errors, draw, inputs
from tests.recipes.material import MicropolarNeoHookean

MATERIAL = MicropolarNeoHookean(lam=3e3, mu=2e3, kappa=7e2, l=0.1)


def test_residual_and_tangent_are_derivatives():
    """Against central differences of the energy and of the residual."""
    form = PointForm(MATERIAL, 2)
    assert max(derivative_errors(form, *inputs(form, draw(2)))) < 1e-7


def test_uniaxial_tension_is_homogeneous():
    """Pulled by a fifth between walls without friction: the same stretch everywhere, tau_yy = 0."""
    grid = pm.Grid.box((0, 0), (2, 2), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=MATERIAL, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=None)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.fix(pm.plane(x=1.0), ux=0.2)
    list(problem.march(2))
    F = by_id(points, points.F)
    np.testing.assert_allclose(F, np.broadcast_to(F[0], F.shape), rtol=0, atol=1e-9)
    stretch = F[0].diagonal()
    log_j = np.log(stretch.prod())
    assert stretch[0] == pytest.approx(1.2)
    assert stretch[1] < 1
    tau = MATERIAL.mu * (stretch**2 - 1) + MATERIAL.lam * log_j
    assert abs(tau[1]) < 1e-6 * tau[0]
    stress = by_id(points, problem.fields().stress)
    expected = np.broadcast_to(np.diag(tau) / stretch.prod(), stress.shape)
    np.testing.assert_allclose(stress, expected, rtol=0, atol=1e-8 * tau[0])


def test_ranges():
    with pytest.raises(pm.InputError, match=r"kappa = -1 is out of range: kappa >= 0"):
        MicropolarNeoHookean(lam=3e3, mu=2e3, kappa=-1.0, l=0.1)
