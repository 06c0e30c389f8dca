"""Mistakes in a user's energy are reported as such, before any work is done."""

import pytest
import ufl

import polarmpm as pm
from tests.conftest import COMM


def attempt(function, **options):
    grid = pm.Grid.box((0, 0), (2, 1), 0.5, COMM)
    material = pm.UserEnergy(function, {"a": 1.0}, **options)
    return pm.QuasiStatic(grid, pm.seed(grid, material=material), **pm.PUBLISHED)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda E, G, p: p.b * ufl.inner(E, E), "no attribute 'b'"),
        (lambda E, G, p: p.a * E, "scalar is needed"),
        (lambda E, G, p: p.a * ufl.inner(E, ufl.as_vector((1, 2))), "can't be evaluated"),
        (lambda E, p: p.a * ufl.inner(E, E), "it is called with 3 argument"),
        (lambda E, G, p: None, "can't be evaluated"),
    ],
)
def test_mistake_is_named(function, message):
    with pytest.raises(pm.InputError, match=message):
        attempt(function)


def test_material_without_energy():
    class Empty(pm.Material):
        """Forgets its energy."""

    grid = pm.Grid.box((0, 0), (2, 1), 0.5, COMM)
    with pytest.raises(pm.InputError, match="Empty has no energy"):
        pm.seed(grid, material=Empty())


def test_operator_that_has_no_meaning_at_a_point():
    problem = attempt(lambda E, G, p: p.a * ufl.inner(ufl.elem_mult(E, E), E))  # fine
    assert problem.forms[0].energy.ufl_shape == ()
    problem = attempt(lambda E, G, p: p.a * ufl.bessel_J(0, ufl.inner(E, E)))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    with pytest.raises(pm.KernelError, match="Bessel"):
        list(problem.march(1))
