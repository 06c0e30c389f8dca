"""Arguments of plastic materials: the numbers that follow from them, and what is refused."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import ufl

import polarmpm as pm
from tests.conftest import COMM
from tests.helpers.bodies import box
from tests.helpers.plasticity import ELASTIC, HENCKY, L_P, NEO_HOOKEAN, K, cone, cylinder


def f(tau: Any, nu: Any, chi: Any, p: Any) -> Any:
    return ufl.sqrt(ufl.inner(tau, tau)) - p.y


# numbers --------------------------------------------------------------------------------------------
def test_numbers_of_the_cone():
    """T (4.34)-(4.36) for 30 and 10 degrees: sin 30 = 1/2, so a = 6/5 and k = 6 c sqrt(3)/5."""
    material = pm.DruckerPrager(HENCKY, phi=math.pi / 6, psi=math.radians(10), c=5.0, cone="compression")
    numbers = material.plastic_parameters()
    assert numbers["friction"] == pytest.approx(1.2, rel=1e-14)
    assert numbers["dilatancy"] == pytest.approx(0.36863, rel=1e-4)
    assert numbers["k"] == material.strength == pytest.approx(6 * math.sqrt(3), rel=1e-14)
    assert material.parameters() == {**HENCKY.parameters(), **numbers}
    assert pm.DruckerPrager(HENCKY, phi=math.pi / 6, k=7.0, cone="compression").strength == 7.0


def regions(material: Any) -> list[str]:
    return [region.name for region in material.regions]


def test_what_a_material_is():
    for material in (cone(), cylinder(), pm.UserPlasticity(ELASTIC, f, {"y": 1.0})):
        assert material.plastic
        assert material.micropolar
        assert material.isotropic
    assert not cone(NEO_HOOKEAN).micropolar
    assert not cone(pm.UserEnergy(ELASTIC.energy, ELASTIC.parameters())).isotropic
    assert not ELASTIC.plastic
    assert regions(cone()) == ["surface", "apex"]
    for smooth in (cone(phi=0.0, psi=0.0), cone(tip=1.0), cylinder()):
        assert regions(smooth) == ["surface"]


# bad arguments --------------------------------------------------------------------------------------
CONE = {"phi": 0.5, "psi": 0.2, "k": K, "l_p": L_P, "cone": "compression"}
BAD_CONES = [
    ({"k": None, "c": -1.0}, r"c = -1 is out of range: c > 0"),
    ({"k": None, "c": 0.0}, r"c = 0 is out of range"),
    ({"k": -3.0}, r"k = -3 is out of range: k > 0"),
    ({"k": math.nan}, r"k = nan: a finite number"),
    ({"k": "40"}, r"k = '40': a finite number"),
    ({"c": 1.0}, r"c = 1.0, k = 40.0: exactly one of both"),
    ({"k": None}, r"c = None, k = None: exactly one of both"),
    ({"psi": 0.6}, r"psi = 0.6 is out of range: 0 <= psi <= phi = 0.5 rad"),
    ({"psi": -0.1}, r"psi = -0.1 is out of range"),
    ({"phi": 30.0}, r"phi = 30 is out of range: 0 <= phi < pi/2, in radians"),
    ({"phi": -0.1}, r"phi = -0.1 is out of range"),
    ({"phi": math.pi / 2}, r"phi = 1.5708 is out of range"),
    ({"phi": math.inf}, r"phi = inf: a finite number"),
    ({"H": math.nan}, r"H = nan: a finite number"),
    ({"l_p": 0.0}, r"l_p = 0 is out of range: l_p > 0"),
    ({"l_p": -1.0}, r"l_p = -1 is out of range"),
    ({"l_p": None}, r"l_p = None: a micropolar material needs the plastic length"),
    ({"elastic": NEO_HOOKEAN}, r"l_p = 0.4: a classical material has no plastic length"),
    ({"elastic": cone()}, r"elastic = DruckerPrager\(phi = .*: an elastic material is needed"),
    ({"elastic": None}, r"None is not a material"),
    ({"elastic": pm.MicropolarElastic}, r"is not a material"),
]


@pytest.mark.parametrize(("change", "message"), BAD_CONES)
def test_bad_cones(change, message):
    with pytest.raises(pm.InputError, match=message):
        pm.DruckerPrager(**{"elastic": ELASTIC, **CONE, **change})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "k = nan: a finite number"),
        ({"k": -1.0}, "k = -1 is out of range"),
        ({"k": 1.0, "l_p": None}, "l_p = None"),
        ({"k": 1.0, "l_p": 0.0}, "l_p = 0 is out of range"),
        ({"k": 1.0, "H": math.inf}, "H = inf"),
        ({"k": 1.0, "elastic": cylinder()}, "an elastic material is needed"),
    ],
)
def test_bad_cylinders(arguments, message):
    with pytest.raises(pm.InputError, match=message):
        pm.VonMises(**{"elastic": ELASTIC, "l_p": L_P, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"function": 3}, "function = 3: a function"),
        ({"function": lambda tau: ufl.tr(tau)}, "called with 4 argument"),
        ({"function": None}, "function = None: a function"),
        ({"flow": "g"}, "flow = 'g': a function"),
        ({"hardening": 1.0}, "hardening = 1.0: a function"),
        ({"values": {"mu": 1.0}}, "values: 'mu' is a parameter of the elastic material"),
        ({"values": {"y": math.nan}}, "y = nan: a finite number"),
        ({"length": 0.0}, "length = 0 is out of range"),
        ({"length": math.inf}, "length = inf"),
        ({"elastic": cone()}, "an elastic material is needed"),
    ],
)
def test_bad_user_plasticity(arguments, message):
    with pytest.raises(pm.InputError, match=message):
        pm.UserPlasticity(**{"elastic": ELASTIC, "function": f, "values": {"y": 1.0}, **arguments})


def test_names_that_clash_with_an_own_energys():
    """The numbers of cone and energy share one name space."""
    energy = pm.UserEnergy(lambda F, p: p.k * ufl.tr(F), {"k": 1.0}, micropolar=False)
    for law in (pm.DruckerPrager, pm.VonMises):
        with pytest.raises(
            pm.InputError, match=f"its parameter 'k' has the name of a plastic one of {law.__name__}"
        ):
            law(energy, k=2.0)
    friction = pm.UserEnergy(energy.function, {"friction": 1.0}, micropolar=False)
    assert pm.VonMises(friction, k=2.0).parameters()["friction"] == 1.0


@pytest.mark.parametrize("law", [pm.DruckerPrager, pm.VonMises])
def test_softening_without_a_length_warns(law):
    with pytest.warns(UserWarning, match="softening without a length scale") as caught:
        law(NEO_HOOKEAN, k=1.0, H=-1.0)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        law(NEO_HOOKEAN, k=1.0, H=1.0)
        law(ELASTIC, k=1.0, H=-1.0, l_p=L_P)


# bodies ---------------------------------------------------------------------------------------------
def body(material: Any = ELASTIC) -> tuple[pm.Grid, pm.Points]:
    grid = pm.Grid.box((0, 0), (2, 1), 0.5, COMM)
    return grid, pm.seed(grid, material=material)


def test_assign():
    _, points = body()
    assert not points.plastic
    assert not hasattr(points, "plastic_F")
    left = points.where(lambda x: x[:, 0] < 1.0)
    points.assign(left, cone())
    assert points.plastic
    np.testing.assert_array_equal(points.material == 1, points.x[:, 0] < 1.0)
    np.testing.assert_array_equal(points.plastic_F, np.tile(np.eye(3), (len(points), 1, 1)))
    points.assign(left, cone())  # known already
    assert points.materials == (ELASTIC, cone())


def test_bad_assignments():
    _, points = body()
    before = points.materials, points.material.copy()
    left, nothing = points.where(lambda x: x[:, 0] < 1.0), points.where(lambda x: x[:, 0] > 9.0)
    for selection, material, message in (
        (nothing, cone(), "selection: contains no point"),
        ("left", cone(), "selection = 'left': a Selection, as points.where"),
        (left, cone(NEO_HOOKEAN), "micropolar and classical materials can't be mixed"),
        (left, K, "40.0 is not a material"),
    ):
        with pytest.raises(pm.InputError, match=message):
            points.assign(selection, material)
    assert points.materials == before[0]
    np.testing.assert_array_equal(points.material, before[1])


def test_bad_regions():
    with pytest.raises(pm.InputError, match="weak"):
        pm.Elements(box("quadrilateral", (2, 1)), material={"weak": cone()})
    with pytest.raises(pm.InputError, match="is not a material"):
        pm.Elements(box("quadrilateral", (2, 1)), material=pm.DruckerPrager)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda tau, nu, chi, p: ufl.inner(tau, tau) - p.missing, "no attribute 'missing'"),
        (lambda tau, nu, chi, p: tau, "scalar"),
        (lambda tau, nu, chi, p: p.y / 0, "can't be evaluated"),
    ],
)
def test_mistakes_in_a_users_function_are_named(function, message):
    """When the problem is made."""
    grid, points = body(pm.UserPlasticity(ELASTIC, function, {"y": 1.0}))
    with pytest.raises(pm.InputError, match=message):
        pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    mesh = box("quadrilateral", (2, 1))
    elements = pm.Elements(mesh, material=pm.UserPlasticity(ELASTIC, function, {"y": 1.0}))
    with pytest.raises(pm.InputError, match=message):
        pm.QuasiStaticFEM(elements)


def test_materials_given_after_the_problem_are_refused():
    points = pm.seed(pm.Grid.box((0, 0), (2, 1), 1.0), material=ELASTIC, points_per_cell=2)
    problem = pm.QuasiStatic(pm.Grid.box((0, 0), (2, 1), 1.0), points, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    stiffer = pm.MicropolarElastic(**{**ELASTIC.parameters(), "lam": 2 * ELASTIC.lam})
    points.assign(points.where(lambda x: x[:, 0] > 1), stiffer)
    with pytest.raises(pm.InputError, match="another material after the problem had been made"):
        next(problem.march(1))
