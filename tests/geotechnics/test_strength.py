"""Factors of safety of bodies whose strength is known, and fields of soils."""

from __future__ import annotations

import math
import warnings
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm
from polarmpm.geotechnics import reduced, strength, strength_reduction
from polarmpm.materials.cones import cone_slopes

COMM = MPI.COMM_WORLD
HENCKY = pm.Hencky.from_engineering(E=1e4, nu=0.3)
ANGLE = math.radians(25)


def block(material: Any, pressure: float, kind: str, size: float = 1.0) -> Any:
    """A block on a smooth base, beside a smooth wall, that is pressed from above (Pa) in plane strain."""
    problem: Any
    if kind == "fem":
        body = mesh.create_rectangle(COMM, [(0, 0), (size, size)], [2, 2], mesh.CellType.quadrilateral)
        elements = pm.Elements(body, material=material, degree=1)
        problem, top = pm.QuasiStaticFEM(elements), elements.surface(pm.plane(y=size))
    else:
        grid = pm.Grid.box((0, 0), (2 * size, 2 * size), 0.5 * size)
        points = pm.seed(grid, bounds=((0, 0), (size, size)), material=material)
        problem = pm.QuasiStatic(grid, points, basis=kind, reset=None)
        x = (np.arange(4) + 0.5) * size / 4
        top = pm.Surface(
            np.stack([x, np.full(4, size)], axis=1), np.full(4, size / 4), np.tile([0, 1], (4, 1))
        )
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.traction(top, force=(0.0, -pressure))
    return problem


def bears(phi: float, c: float, factor: float) -> float:
    """Pressure that a block bears in plane strain with reduced strength, 2 c cos(phi)/(1 - sin(phi))."""
    phi = math.atan(math.tan(phi) / factor)
    return 2 * c / factor * math.cos(phi) / (1 - math.sin(phi))


@pytest.mark.parametrize("kind", ["fem", "mpm"])
@pytest.mark.parametrize("phi", [0.0, ANGLE])
def test_block_fails_where_mohr_and_coulomb_say(kind, phi):
    """And not before: the bracket holds the exact factor."""
    material = pm.MohrCoulomb(HENCKY, phi=phi, psi=phi, c=1.0)
    pressure = bears(phi, 1.0, 1.3)
    shown: list[Any] = []
    found = strength_reduction(
        lambda factor: block(reduced(material, factor), pressure, kind),
        low=1.25,
        high=1.4,
        width=0.05,
        report=shown.append,
    )
    low, high = found.factor
    assert low <= 1.3 <= high
    assert high - low <= 0.05
    assert found.middle == 0.5 * (low + high)
    assert tuple(shown) == found.trials
    assert max(t.factor for t in found.trials if t.stands) == low
    assert min(t.factor for t in found.trials if not t.stands) == high
    assert all(t.reason for t in found.trials if not t.stands)
    assert found.limit == pytest.approx(5 * found.reference)
    elastic = pressure / 1e4 * (1 - 0.3**2)  # of the height, and nu/(1 - nu) as much across
    assert found.reference == pytest.approx(elastic * math.hypot(1, 0.3 / 0.7), rel=0.3)
    assert f"factor of safety {low:.4g} to {high:.4g}" in repr(found)
    axes = found.plot(length=(1e3, "mm"))
    assert (axes is None) == (COMM.rank > 0)


def test_the_factor_has_no_unit_and_the_range_grows_as_needed():
    """Millimetres and MPa, with a range on either side of the factor."""
    pressure, found = bears(ANGLE, 1.0, 1.3), []
    soft = pm.Hencky.from_engineering(E=1e-2, nu=0.3)
    material = pm.MohrCoulomb(soft, phi=ANGLE, psi=ANGLE, c=1e-6)
    for low, high in ((1.1, 1.2), (1.4, 1.5)):
        result = strength_reduction(
            lambda factor: block(reduced(material, factor), 1e-6 * pressure, "fem", 1e3),
            low=low,
            high=high,
            width=0.1,
        )
        assert result.factor[0] <= 1.3 <= result.factor[1] <= result.factor[0] + 0.1
        found.append(result)
    assert found[0].reference == pytest.approx(found[1].reference, rel=0.05)


def test_a_displacement_counts_as_failure_and_a_march_of_ones_own(monkeypatch):
    material = pm.Tresca(HENCKY, c=1.0)
    limit = 2.0 / 1e4  # m
    factors: list[float] = []

    def make(factor: float) -> Any:
        factors.append(factor)
        return block(reduced(material, factor), 1.0, "fem")

    monkeypatch.setattr(strength, "_MOST", 3)
    with pytest.raises(pm.InputError, match=r"the body stands with the factor 2.5, after 3 trials"):
        strength_reduction(lambda factor: block(HENCKY, 1.0, "fem"), low=1.0, high=2.0, steps=1)
    monkeypatch.undo()
    found = strength_reduction(make, high=3.0, width=0.2, limit=limit, march=lambda problem: problem.march(2))
    assert found.limit == limit
    assert found.reference is None
    assert found.factor[0] <= 2.0 <= found.factor[1]
    assert factors == [t.factor for t in found.trials]
    assert len(found.standing.steps) == 2


BAD = [
    ({"low": 0.0}, "low = 0"),
    ({"low": 3.0}, "high = 2.*a factor above low = 3"),
    ({"width": 0.0}, "width = 0"),
    ({"growth": 1.0}, "growth = 1"),
    ({"limit": -1.0}, "limit = -1"),
    ({"steps": 0}, "steps = 0"),
    ({"smallest": 2.0}, "smallest = 2"),
    ({"make": 1}, "make = 1: a function of the factor that makes a problem is needed"),
    ({"make": lambda: None}, "make = .*called with 1 argument"),
    ({"make": lambda factor: factor}, r"make: make\(1\) = 1.0: a problem is needed"),
    ({"march": 1}, "march = 1"),
    ({"report": 1}, "report = 1"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_bad_arguments(change, message):
    with pytest.raises(pm.InputError, match=message):
        strength_reduction(**{"make": lambda factor: None, **change})


def test_a_problem_serves_once_and_has_to_move():
    same = block(pm.Tresca(HENCKY, c=1.0), 1.0, "fem")
    with pytest.raises(pm.InputError, match="gives the same problem twice"):
        strength_reduction(lambda factor: same)
    with pytest.raises(pm.InputError, match=r"limit = None: .* moves by 0 m"):
        strength_reduction(lambda factor: block(pm.Tresca(HENCKY, c=1.0), 0.0, "fem"))


# reduced materials ----------------------------------------------------------------------------------
def test_reduced_materials():
    """c and tan(phi) are divided, whatever the cone and the way in which its strength is given."""
    factor, phi, psi = 1.4, math.radians(30), math.radians(10)
    less = [math.atan(math.tan(angle) / factor) for angle in (phi, psi)]
    pyramid = reduced(pm.MohrCoulomb(HENCKY, phi=phi, psi=psi, c=2.0, H=3.0, cut=1.0, tip=0.5), factor)
    assert [pyramid.phi, pyramid.psi] == pytest.approx(less)
    assert [pyramid.c, pyramid.H, pyramid.cut, pyramid.tip] == pytest.approx(
        [x / 1.4 for x in (2.0, 3.0, 1.0, 0.5)]
    )
    assert reduced(pm.VonMises(HENCKY, k=2.0, H=1.0), 2.0) == pm.VonMises(HENCKY, k=1.0, H=0.5)
    assert reduced(pm.Tresca(HENCKY, c=2.0), 2.0) == pm.Tresca(HENCKY, c=1.0)
    assert reduced(HENCKY, factor) is HENCKY
    for cone in ("compression", "extension", "plane strain", "inscribed"):
        by_c = pm.DruckerPrager(HENCKY, phi=phi, psi=psi, c=2.0, H=3.0, cone=cone)
        by_k = pm.DruckerPrager(HENCKY, phi=phi, psi=psi, k=by_c.strength, H=3.0, cone=cone)
        want = 2.0 / factor * cone_slopes(cone, *less)[2]
        assert reduced(by_c, factor).strength == pytest.approx(want)
        assert reduced(by_k, factor).plastic_parameters() == pytest.approx(
            reduced(by_c, factor).plastic_parameters()
        )
    with pytest.raises(pm.InputError, match="factor = 0"):
        reduced(HENCKY, 0.0)
    with pytest.raises(pm.InputError, match=r"material = .*reduce the strength yourself"):
        reduced(pm.CamClay(pm.Houlsby(p_0=1.0, swelling=0.01, mu=50.0), M=1.0, compression=0.1, p_c=2.0), 1.2)
    with pytest.raises(pm.InputError, match="material = 3"):
        reduced(3, 1.2)


# fields ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["fem", "mpm"])
def test_p_q_and_lode_angle_are_those_of_eigenvalues(kind):
    """Of points and of elements; zero and 30 degrees where they ought to be."""
    problem = block(pm.MohrCoulomb(HENCKY, phi=ANGLE, psi=0.0, c=1.0), 1.8, kind)
    for _ in problem.march(3):
        pass
    found = problem.fields("stress", "p", "q", "lode_angle")
    low, middle, high = np.linalg.eigvalsh(found["stress"]).T
    assert found["p"] == pytest.approx(-(low + middle + high) / 3)
    squares = (high - low) ** 2 + (high - middle) ** 2 + (middle - low) ** 2
    assert found["q"] == pytest.approx(np.sqrt(squares / 2))
    assert found["lode_angle"] == pytest.approx(
        np.arctan2(2 * middle - high - low, math.sqrt(3) * (high - low))
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rest = block(HENCKY, 1.0, kind).fields("q", "lode_angle")
    assert np.abs(rest["q"]).max(initial=0.0) < 1e-9
    assert not np.any(rest["lode_angle"])
