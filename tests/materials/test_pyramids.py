"""Mohr-Coulomb's pyramid and the cones that stand for it: closed forms of strength and plane flow."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.materials.cones import CONES, cone_slopes
from polarmpm.materials.pyramids import edge_numbers, lode_function
from tests.forms.test_return_mapping import tangent_errors
from tests.helpers.plasticity import ELASTIC, HENCKY, L_P, NEO_HOOKEAN, Driven, sym

C = 20.0  # Pa


def pyramid(elastic: Any = HENCKY, phi: float = 30.0, psi: float = 10.0, **options: Any) -> pm.MohrCoulomb:
    """With angles in degrees."""
    options = {"c": C, **({"l_p": L_P} if elastic.micropolar else {}), **options}
    return pm.MohrCoulomb(elastic, phi=math.radians(phi), psi=math.radians(psi), **options)


def excess(tau: np.ndarray, phi: float, c: float = C) -> np.ndarray:
    """(s1 - s3)/2 + (s1 + s3)/2 sin(phi) - c cos(phi) of the sharp pyramid, from eigenvalues."""
    value = np.linalg.eigvalsh(sym(tau))
    low, high = value[:, 0], value[:, 2]
    angle = math.radians(phi)
    return (high - low) / 2 + (high + low) / 2 * math.sin(angle) - c * math.cos(angle)


def lode_angle(tau: np.ndarray) -> np.ndarray:
    """Lode's angle (n,) in degrees, from eigenvalues: tan(theta) = (2 s2 - s1 - s3)/(sqrt(3) (s1 - s3))."""
    low, middle, high = np.linalg.eigvalsh(sym(tau)).T
    return np.degrees(np.arctan2(2 * middle - high - low, math.sqrt(3) * (high - low)))


def random_steps(driven: Driven, seed: int) -> np.ndarray:
    """Increments of 1e-3 to 0.1 in all directions; couples of a tenth."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 1, (driven.n, driven.size)) * 10 ** rng.uniform(-3, -1, (driven.n, 1))
    z[:, driven.dim**2 :] *= 0.1
    return z


# the functions --------------------------------------------------------------------------------------
@pytest.mark.parametrize("friction", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("sign", [-1, 1])
def test_rounded_edges_are_smooth_and_inside(friction, sign):
    """K, K' and K'' agree where the edge begins; a larger K is a smaller strength."""
    corner = math.radians(25)
    a, b, c = edge_numbers(friction, corner, sign)

    def rounded(t: float) -> float:
        x = math.sin(3 * t)
        return a + b * x + c * x * x

    t, h = sign * corner, 5e-5
    for weights in ((0, 1, 0), (-0.5 / h, 0, 0.5 / h), (1 / h**2, -2 / h**2, 1 / h**2)):
        at = [(w, t + k * h) for k, w in zip((-1, 0, 1), weights, strict=True)]
        sharp = sum(w * lode_function(x, friction) for w, x in at)
        assert sum(w * rounded(x) for w, x in at) == pytest.approx(sharp, rel=1e-5, abs=1e-5)
    for beyond in np.linspace(corner, math.pi / 6, 9)[1:]:
        assert rounded(sign * beyond) > lode_function(sign * beyond, friction) - 1e-6


def test_no_cone_is_chosen_without_a_word():
    angle = math.radians(30)
    with pytest.warns(
        UserWarning, match=r'cone = None: "compression", the outer cone.*30 degrees act as 43.9 degrees'
    ):
        silent = pm.DruckerPrager(HENCKY, phi=angle, c=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        named = pm.DruckerPrager(HENCKY, phi=angle, c=1.0, cone="compression")
        pm.DruckerPrager(HENCKY, c=1.0)  # a cylinder is no cone
    assert silent.plastic_parameters() == named.plastic_parameters()
    with pytest.raises(pm.InputError, match="cone = 'outer': one of 'compression', 'extension'"):
        pm.DruckerPrager(HENCKY, phi=angle, c=1.0, cone="outer")


@pytest.mark.parametrize("cone", CONES)
def test_cones_meet_the_pyramid_where_they_say(cone):
    """On the edges in triaxial compression and extension; "inscribed" touches it from inside."""
    phi, psi = math.radians(28), math.radians(12)
    a, _, k = cone_slopes(cone, phi, psi)
    p = -3.0  # in units of c
    q = k - a * p  # the cone's
    angles = np.linspace(-math.pi / 6, math.pi / 6, 2001)
    shear = math.sqrt(3) * (math.cos(phi) - p * math.sin(phi))
    pyramid_q = np.array([shear / lode_function(t, math.sin(phi)) for t in angles])
    if cone == "compression":
        assert q == pytest.approx(pyramid_q[-1], rel=1e-12)
        assert np.all(q >= pyramid_q - 1e-12)
    elif cone == "extension":
        assert q == pytest.approx(pyramid_q[0], rel=1e-12)
    elif cone == "inscribed":
        assert q == pytest.approx(pyramid_q.min(), rel=1e-6)
        same = cone_slopes("plane strain", phi, phi)
        assert (a, k) == pytest.approx((same[0], same[2]), rel=1e-12)
        # Drucker and Prager 1952: alpha = tan(phi)/sqrt(9 + 12 tan(phi)^2), k = 3 c/sqrt(9 + 12 tan(phi)^2)
        root = math.sqrt(9 + 12 * math.tan(phi) ** 2)
        assert a == pytest.approx(3 * math.sqrt(3) * math.tan(phi) / root, rel=1e-12)
        assert k == pytest.approx(3 * math.sqrt(3) / root, rel=1e-12)


# plane flow -----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("phi", "psi"), [(30.0, 0.0), (30.0, 12.0), (20.0, 20.0)])
@pytest.mark.parametrize("kind", ["cone", "pyramid"])
def test_plane_flow_has_the_strength_of_mohr_and_coulomb(kind, phi, psi):
    """Plane strain that dilates by sin(psi): in the limit (s1 - s3)/2 = c cos(phi) - (s1 + s3)/2 sin(phi)."""
    angles = {"phi": math.radians(phi), "psi": math.radians(psi)}
    material = pyramid(phi=phi, psi=psi)
    if kind == "cone":
        material = pm.DruckerPrager(HENCKY, c=C, cone="plane strain", **angles)
    driven, rate = Driven(material, 1), 2e-3
    grow = 1 + math.sin(angles["psi"])
    factors = np.exp(rate * np.array([grow, grow - 2]))  # of the stretches in a step
    for _ in range(60):
        z = (np.diag(factors) - np.eye(2)) @ driven.points.F[0, :2, :2]
        x = driven.solve(z.reshape(1, 4))
        driven.advance(z.reshape(1, 4))
    plane = np.linalg.eigvalsh(sym(x.tau[0])[:2, :2])
    carried = C * math.cos(angles["phi"]) - plane.mean() * math.sin(angles["phi"])
    assert (plane[1] - plane[0]) / 2 == pytest.approx(carried, rel=1e-6)


@pytest.mark.parametrize("cone", ["compression", "extension", "inscribed"])
def test_other_cones_have_another_strength_in_plane_flow(cone):
    """By as much as their formula says, so that the choice matters: psi = 0, sin(phi_plane) = a/sqrt(3)."""
    phi = math.radians(30)
    material = pm.DruckerPrager(HENCKY, phi=phi, c=C, cone=cone)
    driven, a, _, k = Driven(material, 1), *cone_slopes(cone, phi, 0.0)
    factors = np.exp(2e-3 * np.array([1.0, -1.0]))
    for _ in range(60):
        z = (np.diag(factors) - np.eye(2)) @ driven.points.F[0, :2, :2]
        x = driven.solve(z.reshape(1, 4))
        driven.advance(z.reshape(1, 4))
    plane = np.linalg.eigvalsh(sym(x.tau[0])[:2, :2])
    assert (plane[1] - plane[0]) / 2 == pytest.approx((k * C - a * plane.mean()) / math.sqrt(3), rel=1e-6)


# returns --------------------------------------------------------------------------------------------
CASES = {
    "sharp": (HENCKY, {"edges": "sharp"}),
    "sharp, associated": (HENCKY, {"psi": 30.0, "edges": "sharp"}),
    "sharp, isochoric": (NEO_HOOKEAN, {"phi": 20.0, "psi": 0.0, "edges": "sharp"}),
    "sharp prism": (HENCKY, {"phi": 0.0, "psi": 0.0, "edges": "sharp"}),
    "classical": (HENCKY, {}),
    "isochoric": (NEO_HOOKEAN, {"phi": 20.0, "psi": 0.0}),
    "cut": (NEO_HOOKEAN, {"cut": 8.0}),
    "prism": (NEO_HOOKEAN, {"phi": 0.0, "psi": 0.0, "cut": 30.0}),
    "micropolar": (ELASTIC, {"cut": 12.0}),
    "rounded": (HENCKY, {"tip": 3.0}),
}


@pytest.mark.parametrize("name", CASES)
def test_no_return_is_lost_and_all_are_admissible(name):
    """20 000 states with strains up to 10 %: each finds a region, inside of the pyramid and of the cut-off,
    on the pyramid within 25 degrees of plane shear (sharp: everywhere), and with dissipation."""
    elastic, options = CASES[name]
    material = pyramid(elastic, **options)
    phi = options.get("phi", 30.0)
    driven = Driven(material, 20_000)
    z = random_steps(driven, seed=5)
    x = driven.solve(z)
    f = excess(x.tau, phi)
    assert len(x.rows) > 8000
    assert f.max() < 1e-6 * C
    shear = (x.region == 0) & (np.abs(lode_angle(x.tau)) < 24.9)
    assert shear.sum() > 1000
    if material.tip == 0 and not elastic.micropolar:
        assert np.abs(f[shear]).max() < 1e-6 * C
    if material.sharp:
        assert np.abs(f).max() < 1e-8 * C
        for region, angle in ((1, -30.0), (2, 30.0)):
            assert (x.region == region).sum() > 30
            assert lode_angle(x.tau[x.region == region]) == pytest.approx(angle, abs=1e-6)
    largest = np.linalg.eigvalsh(sym(x.tau))[:, 2]
    if material.cut is not None:
        assert largest.max() < material.cut * (1 + 1e-5)
        assert [(x.region == k).sum() > 50 for k in (0, 1, 2)] == [True] * 3
    _, loss = driven.advance(z)
    assert loss.min() > -1e-9 * C


@pytest.mark.parametrize("name", CASES)
def test_consistent_tangent(name):
    """Against differences, on every region. The tangent is continuous, with kinks where the rounded edges
    begin (K is C2): a central difference across one is off by the step, those on one side aren't."""
    elastic, options = CASES[name]
    driven = Driven(pyramid(elastic, **options), 300)
    z = 0.3 * random_steps(driven, seed=6)
    errors = tangent_errors(driven, z, step=2e-6, kinks=not driven.material.sharp)
    for region in ("surface", "tension", "surface+tension") if "cut" in options else ("surface",):
        assert len(errors[region]) >= 5
    for kind, error in errors.items():
        assert error.max(initial=0.0) < 1e-6, kind


@pytest.mark.parametrize(("phi", "stretch"), [(10.0, -0.0178), (0.0, -0.0102), (0.0, 0.0102)])
def test_moduli_near_sharp_edges_are_bounded(phi, stretch):
    """States that begin 1e-12 to 1e-3 away from an edge, and end on it or beside it: moduli stay below a few
    elastic ones, and stresses change by no more than they say."""
    driven = Driven(pyramid(phi=phi, psi=phi, edges="sharp"), 240)
    small = np.logspace(-12, -3, 120)
    z = np.zeros((240, 4))
    z[:, 0], z[:, 3] = np.concatenate([small, -small]), stretch
    stress, moduli, y = driven.stress(z)
    assert len(y.rows) == len(z)
    assert {0, 2 if stretch < 0 else 1} == set(y.region)
    largest = 2 * HENCKY.mu + HENCKY.lam
    assert np.abs(moduli).max() < 10 * largest
    step = 1e-10 * np.random.default_rng(1).uniform(-1, 1, z.shape)
    change = driven.stress(z + step)[0] - stress
    assert np.abs(change).max() < 40 * largest * np.abs(step).max()


@pytest.mark.parametrize("phi", [10.0, 40.0])
def test_stretch_that_is_the_same_in_the_plane_ends_on_the_sharp_tip(phi):
    """Two stresses are the same, and neither is the one apart: its axis would be any, and the edge about it
    has a solution far away. From the tip nothing leads away but another stretch."""
    driven = Driven(pyramid(phi=phi, psi=phi, edges="sharp"), 40)
    turned = np.linspace(0.0, 0.1, 40)
    z = np.stack([0.055 + 0.01 * turned, -turned, turned, 0.055 + 0.01 * turned], axis=1)
    x = driven.solve(z)
    assert np.all(x.region == 3)
    assert x.tau == pytest.approx(C / math.tan(math.radians(phi)) * np.tile(np.eye(3), (40, 1, 1)))
    driven.advance(z)
    before = driven.points.hardening.copy()
    again = driven.solve(0 * z)
    assert np.all(again.region == 3)
    assert np.abs(again.chi - before[again.rows]).max() < 1e-12


@pytest.mark.parametrize("edges", ["sharp", "rounded"])
def test_edges_are_weaker_by_what_is_said(edges):
    """Triaxial states, at p = 0: the strength is the sharp one less `edge_deficit`, if any."""
    for phi in (0.0, 20.0, 40.0):
        material = pyramid(phi=phi, psi=0.0, edges=edges)
        assert (material.edge_deficit == (0.0, 0.0)) == (edges == "sharp")
        for sign, deficit in zip((-1, 1), material.edge_deficit, strict=True):
            value = -sign * np.array([2.0, -1.0, -1.0]) * 0.02
            driven = Driven(material, 1, 3)
            x = driven.solve(np.diag(np.exp(value) - 1).reshape(1, 9))
            p = np.trace(x.tau[0]) / 3
            s = x.tau[0] - p * np.eye(3)
            angle = math.radians(phi)
            sharp = C * math.cos(angle) - p * math.sin(angle)
            sharp /= lode_function(sign * math.pi / 6, math.sin(angle))
            assert math.sqrt(np.sum(s * s) / 2) == pytest.approx((1 - deficit) * sharp, rel=1e-9)


def test_the_cohesion_hardens_and_softens():
    """In plane shear sqrt(3) chi is the plastic shear strain: the slope is mu h/(mu + h), h = H/sqrt(3)."""
    mu = HENCKY.mu
    for H in (200.0, -10.0):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            material = pyramid(phi=0.0, psi=0.0, H=H)
        shear = []
        for gamma in (0.02, 0.0201):
            driven = Driven(material, 1)
            x = driven.solve(np.array([[gamma / 2, 0.0, 0.0, -gamma / 2 / (1 + gamma / 2)]]))
            plane = np.linalg.eigvalsh(x.tau[0])
            shear.append((plane[2] - plane[0]) / 2)
            assert shear[-1] == pytest.approx(C + H * x.chi[0], rel=1e-9)
        h = H / math.sqrt(3)
        assert (shear[1] - shear[0]) / 1e-4 == pytest.approx(mu * h / (mu + h), rel=0.02)


BAD = [
    ({"c": 0.0}, "c = 0"),
    ({"phi": 95.0}, "phi = 1.658"),
    ({"psi": 40.0}, "psi = 0.698"),
    ({"corner": 1.0}, "corner = 1 is out of range"),
    ({"cut": 100.0}, r"cut = 100 is out of range: cut < c/tan\(phi\) = 34.641 Pa"),
    ({"cut": 0.0}, "cut = 0 is out of range: cut > 0"),
    ({"edges": "round"}, "edges = 'round': one of 'rounded', 'sharp'"),
    ({"edges": "sharp", "cut": 8.0}, r"edges = 'sharp': \"rounded\" with cut = 8"),
    ({"edges": "sharp", "tip": 3.0}, r"edges = 'sharp': \"rounded\" with tip = 3"),
    ({"tip": 40.0}, r"tip = 40 is out of range: 0 <= tip < sqrt\(3\) c cos\(phi\) = 30 Pa"),
    ({"l_p": 1.0}, "a classical material has no plastic length"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_bad_pyramids(change, message):
    with pytest.raises(pm.InputError, match=message):
        pyramid(**change)
