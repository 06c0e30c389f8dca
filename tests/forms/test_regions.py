"""A material with several regions of its yield surface, written by a user in one place.

`CutCone` is the recipe: Drucker-Prager's cone with a tension cut-off p <= T, two smooth surfaces and their
edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import ufl
from scipy.linalg import expm

import polarmpm as pm
from tests.conftest import COMM, beam
from tests.forms.test_return_mapping import log_stress, put_stretch, same_returns, scattered, tangent_errors
from tests.helpers.plasticity import (
    BULK,
    ELASTIC,
    HENCKY,
    L_P,
    MU,
    NEO_HOOKEAN,
    Driven,
    K,
    Solution,
    cone,
    dev,
    q_of,
    slope,
    sym,
    trace,
    transposed,
)

A, B = slope(30.0), slope(10.0)
TENSION = 8.0  # Pa; the cone's apex is at K / A = 33 Pa
NUMBERS = {"a": A, "b": B, "yield_strength": K, "tension": TENSION, "bend": L_P}


@dataclass(frozen=True)
class CutCone(pm.Plastic):
    """q + a p <= k and p <= T, both strengths times a factor."""

    elastic: pm.Material
    factor: float = 1.0
    length: float = L_P

    def plastic_parameters(self) -> dict[str, float]:
        return {**NUMBERS, "yield_strength": self.factor * K, "tension": self.factor * TENSION}

    def shear(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _q(tau, nu, p) + p.a * ufl.tr(tau) / 3 - p.yield_strength

    def shear_flow(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return _q(tau, nu, p) + p.b * ufl.tr(tau) / 3

    def cut_off(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        return ufl.tr(tau) / 3 - p.tension

    def first_region(self, tau: Any, nu: Any, chi: Any, p: Any) -> dict[str, Any]:
        return {"tension": self.cut_off(tau, nu, chi, p)}

    @property
    def regions(self) -> tuple[pm.Region, ...]:
        shear = pm.YieldSurface("shear", self.shear, self.shear_flow)
        tension = pm.YieldSurface("tension", self.cut_off)
        return pm.SmoothPart(shear), pm.SmoothPart(tension), pm.Edge(shear, tension)


def _q(tau: Any, nu: Any, p: Any) -> Any:
    s = ufl.dev(ufl.sym(tau))
    bend = 0 if nu is None else ufl.inner(nu, nu) / p.bend**2
    return ufl.sqrt(1.5 * (ufl.inner(s, s) + bend))


SHEAR, CUT, EDGE = 0, 1, 2
MATERIALS = {"micropolar": CutCone(ELASTIC), "classical": CutCone(NEO_HOOKEAN)}


def violations(tau: np.ndarray, nu: np.ndarray | None, factor: float = 1.0) -> np.ndarray:
    """Both yield functions (2, n) of Kirchhoff stresses, in NumPy."""
    p = trace(tau) / 3
    return np.array([q_of(tau, nu) + A * p - factor * K, p - factor * TENSION])


def sample(name: str, dim: int) -> tuple[Driven, np.ndarray]:
    """Points of which many return to each of the regions."""
    return scattered(MATERIALS[name], dim, 400, size=0.004, tension=0.002)


# local problem --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "dim"),
    [("micropolar", 2), ("classical", 2), pytest.param("classical", 3, marks=pytest.mark.slow)],
)
def test_returns_fulfil_the_conditions_of_koiter(name, dim):
    """T (4.57)-(4.60) with the flows of the active surfaces, f = 0 there, f < 0 of the other one, and no
    multiplier below zero; written out with SciPy."""
    driven, z = sample(name, dim)
    x = driven.solve(z)
    y = driven.mapping.yielding
    assert y is not None
    first = driven.form.hardening_column + 1
    multipliers = np.where((y.region == CUT)[:, None], y.X[:, [first + 1, first]], y.X[:, [first, first + 1]])
    active = np.array([y.region != CUT, y.region != SHEAR])
    f = violations(x.tau, x.nu, driven.material.factor)
    for region in (SHEAR, CUT, EDGE):
        assert (y.region == region).sum() >= 25
    assert np.abs(f[active]).max() < 1e-9 * MU
    assert f.max() < 1e-8 * MU
    assert np.all(multipliers >= -1e-8)
    assert np.all(multipliers[~active.T] == 0)
    for equation, value in _residuals(driven, x, multipliers).items():
        assert np.abs(value).max() < 1e-10, equation


def _residuals(driven: Driven, x: Solution, multipliers: np.ndarray) -> dict[str, np.ndarray]:
    m1, m2 = (multipliers[:, k, None, None] for k in (0, 1))
    q = q_of(x.tau, x.nu)[:, None, None]
    flow = m1 * (1.5 * dev(sym(x.tau)) / q + B / 3 * np.eye(3)) + m2 / 3 * np.eye(3)
    trial = x.f @ np.linalg.inv(driven.points.plastic_F[x.rows])
    out = {"U": x.ue - transposed(x.q) @ np.array([expm(-n) for n in flow]) @ trial}
    if x.nu is not None:
        step = 1.5 / L_P**2 * m1 * (transposed(x.q) @ (x.nu / q) @ x.f)
        out["Gamma"] = x.ge + step - (x.gamma - driven.points.plastic_wryness[x.rows])
    return out | {"chi": x.chi - driven.points.hardening[x.rows] - x.multiplier}


@pytest.mark.parametrize(
    ("name", "dim"),
    [("micropolar", 2), ("classical", 2), pytest.param("classical", 3, marks=pytest.mark.slow)],
)
def test_consistent_tangent_on_every_region(name, dim):
    errors = tangent_errors(*sample(name, dim))
    assert list(errors) == ["elastic", "shear", "tension", "shear+tension"]
    for region, error in errors.items():
        assert len(error) >= (3 if region == "elastic" else 25), region
        assert error.max() < 1e-6, region


def test_taylor_remainder_is_of_second_order():
    driven, z = sample("micropolar", 2)
    direction = np.random.default_rng(5).standard_normal(z.shape)
    s, a, y = driven.stress(z)
    steps, remainders, same = [4e-4, 2e-4, 1e-4], [], np.ones(len(y.rows), dtype=bool)
    for h in steps:
        near, _, other = driven.stress(z + h * direction, tangent=False)
        region = np.full(driven.n, -1)
        region[other.rows] = other.region
        same &= region[y.rows] == y.region
        remainders.append(np.abs(near - s - h * np.einsum("nij,nj->ni", a, direction)).max(axis=1)[y.rows])
    order = np.log2(np.array(remainders)[:-1] / np.array(remainders)[1:])
    for region in (SHEAR, EDGE):  # a flat cut-off has next to no remainder
        which = same & (y.region == region)
        assert which.sum() >= 20
        assert np.quantile(np.abs(order[:, which] - 2.0), 0.8) < 0.1


def test_every_state_near_the_edge_has_a_return():
    driven = Driven(CutCone(HENCKY), 4000)
    rng = np.random.default_rng(2)
    shear = (K - A * TENSION) / (2 * MU * np.sqrt(3)) * (1 + rng.normal(0.2, 0.3, 4000))
    even = TENSION / (3 * BULK) * (1 + rng.normal(0.2, 0.3, 4000))
    log = shear[:, None] * np.array([1.0, -1.0, 0.0]) + even[:, None]
    x = driven.solve(put_stretch(driven, log))
    assert min(np.mean(x.region == region) for region in (SHEAR, CUT, EDGE)) > 0.05
    assert violations(x.tau, x.nu).max() < 1e-8 * MU


def test_returns_in_logarithmic_strains():
    """Hencky's energy: the cut-off leaves the deviator and puts p = T; the edge scales it to q = k - a T."""
    driven, turn = Driven(CutCone(HENCKY), 60), 0.4
    log = np.random.default_rng(3).normal(0.003, 0.005, (60, 3))
    x = driven.solve(put_stretch(driven, log, turn))
    s = 2 * MU * (log - log.mean(axis=1)[:, None])[x.rows]
    q = np.sqrt(1.5 * (s**2).sum(axis=1))
    scale = np.where(x.region == EDGE, (K - A * TENSION) / q, 1.0)
    expected = scale[:, None] * s + TENSION
    found = log_stress(x, turn)
    for region in (CUT, EDGE):
        at = x.region == region
        assert at.sum() >= 5
        np.testing.assert_allclose(found[at], expected[at], rtol=0, atol=1e-7 * K)
    assert np.all(q[x.region == CUT] <= K - A * TENSION)


def test_dissipation_is_never_negative():
    driven, rng = Driven(MATERIALS["micropolar"], 60), np.random.default_rng(0)
    at, seen = np.zeros((60, driven.size)), set()
    for _ in range(40):
        move = 0.01 * rng.standard_normal(at.shape) - 0.1 * at
        at += move
        y, loss = driven.advance(move)
        assert loss.min(initial=0.0) >= -1e-9 * K
        seen |= set(y.region)
    assert seen == {SHEAR, CUT, EDGE}
    assert driven.points.dissipation.min() > 0
    assert np.all(driven.points.hardening > 0)


def test_a_surface_out_of_reach_changes_nothing():
    """A cone that is cut off beyond all stresses is the package's."""
    far = {**NUMBERS, "tension": 1e6}
    functions = {"shear": CutCone(ELASTIC).shear, "tension": CutCone(ELASTIC).cut_off}
    user = pm.UserPlasticity(ELASTIC, functions, far, {"shear": CutCone(ELASTIC).shear_flow}, length=L_P)
    (first, z), (second, _) = (scattered(m, tension=-0.02) for m in (user, cone()))
    same_returns(first, second, z)


class EvenReturn(pm.Region):
    """The cut-off by hand: its flow is even, exp(-m I / 3), and leaves the wryness alone."""

    name = "tension"

    def __init__(self, surface: pm.YieldSurface):
        self.surfaces = (surface,)

    def residual(self, s: Any) -> list[Any]:
        m, turn = s.multipliers[0], ufl.Identity(3) if s.Q is None else ufl.transpose(s.Q)
        rows = s.flat(s.Ue - ufl.exp(-m / 3) * ufl.dot(turn, s.Fe_trial))
        rows += [] if s.Ge is None else s.flat_wryness(s.Ge - s.Ge_trial)
        return [*rows, s.chi - s.chi_before - m, self.surfaces[0].at(s)]

    def row_scale(self, scales: Any) -> np.ndarray:
        strains = [1.0] * scales.deformation + [scales.length] * scales.wryness
        return np.array([*strains, 1.0, 1.0 / scales.modulus])

    def flow(self, s: Any) -> list[Any]:
        tau, _ = s.kirchhoff()
        return [s.multipliers[0] * ufl.tr(tau) / 3, s.multipliers[0]]


class ByHand(CutCone):
    @property
    def regions(self) -> tuple[pm.Region, ...]:
        shear, tension, edge = super().regions
        return shear, EvenReturn(tension.surfaces[0]), edge


@pytest.mark.parametrize("elastic", [ELASTIC, NEO_HOOKEAN], ids=MATERIALS)
def test_a_region_of_a_users_own(elastic):
    answers = []
    for kind in (CutCone, ByHand):
        driven, z = scattered(kind(elastic), 2, 400, size=0.004, tension=0.002)
        s, a, y = driven.stress(z)
        answers.append((s, a, driven.mapping.dissipation(), y.region))
    assert (answers[0][3] == CUT).sum() >= 25
    for one, other in zip(*answers, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * np.abs(other).max())


@dataclass(frozen=True)
class Clay(pm.Plastic):
    """Modified Cam-Clay: an ellipse of p and q that grows with the plastic change of volume chi."""

    elastic: pm.Material

    def plastic_parameters(self) -> dict[str, float]:
        return {"M": 1.2, "start": 60.0, "compression": 0.05}

    def ellipse(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        half = p.start / 2 * ufl.exp(-chi / p.compression)
        s, mean = ufl.dev(ufl.sym(tau)), ufl.tr(tau) / 3
        return ufl.sqrt(1.5 * ufl.inner(s, s) / p.M**2 + (mean + half) ** 2) - half

    def growth(self, tau: Any, nu: Any, chi: Any, p: Any) -> Any:
        t = ufl.variable(tau)
        return ufl.tr(ufl.diff(self.ellipse(t, nu, chi, p), t))

    @property
    def regions(self) -> tuple[pm.Region, ...]:
        return (pm.SmoothPart(pm.YieldSurface("ellipse", self.ellipse, hardening=self.growth)),)


def test_chi_may_be_the_plastic_change_of_volume():
    """Compaction hardens, dilation softens; the tangent is consistent."""
    driven, z = scattered(Clay(HENCKY), 2, 400, size=0.004, tension=-0.004)
    driven.points.hardening[:] = 0.0
    errors = tangent_errors(driven, z)
    assert len(errors["ellipse"]) >= 100
    assert errors["ellipse"].max() < 1e-6
    volume, chi = np.linalg.det(driven.points.plastic_F), driven.points.hardening.copy()
    driven.advance(z)
    change = np.log(np.linalg.det(driven.points.plastic_F) / volume)
    np.testing.assert_allclose(driven.points.hardening - chi, change, rtol=0, atol=1e-10)
    assert change.min() < -1e-3
    assert change.max() > 1e-4


# bodies ---------------------------------------------------------------------------------------------
def pulled(material: Any) -> Any:
    """A short beam that is bent and pulled: its upper side is cut off, and it is sheared at the lower one."""
    strict = pm.Controls(force_tolerance=1e-10, energy_tolerance=1e-22)
    problem = beam(2, material, per_cell=4, controls=strict, basis="mpm", reset=None)
    theta = {"theta": -0.05} if material.micropolar else {}
    problem.fix(pm.plane(x=3.0), u=(0.03, -0.1), **theta)
    list(problem.march(6, progress=False))
    return problem


@pytest.mark.parametrize("name", MATERIALS)
def test_a_body_on_all_of_its_regions(name):
    problem = pulled(MATERIALS[name])
    p, fields = problem.points, problem.fields()
    j = np.linalg.det(p.F)[:, None, None]
    tau, nu = j * fields.stress, j * fields.couple_stress if MATERIALS[name].micropolar else None
    assert violations(tau, nu).max(initial=-1.0) < 1e-6 * K
    assert p.dissipation.min(initial=0.0) >= 0
    (mapping,) = problem.system.mappings
    counts = np.bincount(mapping.yielding.region, minlength=3)
    counts = COMM.allreduce(counts)
    assert min(counts) >= 2
    forces = np.array([force for force, _ in problem.steps[-1].history])[1:]
    small = np.flatnonzero(forces < 1e-2)[:2]
    assert forces[small[1]] < 50 * forces[small[0]] ** 2 + 1e-12  # quadratic


def test_a_users_functions_by_name_are_the_same_material():
    """Without a class: two functions, and the potential of the one whose flow isn't associated."""
    own = MATERIALS["classical"]
    functions = {"shear": own.shear, "tension": own.cut_off}
    user = pm.UserPlasticity(NEO_HOOKEAN, functions, NUMBERS, {"shear": own.shear_flow}, length=L_P)
    assert [region.name for region in user.regions] == ["shear", "tension", "shear+tension"]
    one, other = (pulled(m).points for m in (user, own))
    assert other.hardening.max(initial=1.0) > 1e-3
    for field in ("F", "plastic_F", "hardening", "dissipation"):
        np.testing.assert_allclose(getattr(one, field), getattr(other, field), rtol=0, atol=1e-9)


# mistakes -------------------------------------------------------------------------------------------
def f(tau: Any, nu: Any, chi: Any, p: Any) -> Any:
    return ufl.tr(tau) - p.y


@dataclass(frozen=True)
class Odd(pm.Plastic):
    elastic: pm.Material
    given: tuple[Any, ...]

    @property
    def regions(self) -> Any:
        return self.given


ONE, TWIN = pm.YieldSurface("one", f), pm.YieldSurface("one", lambda *arguments: f(*arguments))


@pytest.mark.parametrize(
    ("regions", "message"),
    [
        ((), "Odd has no yield surface"),
        ((ONE,), "has YieldSurface.* among its regions; a Region is needed"),
        ((pm.SmoothPart(ONE), pm.SmoothPart(ONE)), "has the regions one, one; their names must differ"),
        ((pm.SmoothPart(ONE), pm.Edge(ONE, TWIN)), "has two yield surfaces named 'one'"),
        ((pm.SmoothPart(pm.YieldSurface("wrong", lambda *a: a[0])),), r"of Odd \('wrong'\) has the shape"),
    ],
)
def test_mistakes_in_regions_are_named(regions, message):
    """When the problem is made."""
    grid = pm.Grid.box((0, 0), (2, 1), 0.5, COMM)
    points = pm.seed(grid, material=Odd(NEO_HOOKEAN, regions))
    with pytest.raises(pm.InputError, match=message):
        pm.QuasiStatic(grid, points, **pm.PUBLISHED)


@dataclass(frozen=True)
class Lost(CutCone):
    def first_region(self, tau: Any, nu: Any, chi: Any, p: Any) -> dict[str, Any]:
        return {"apex": ufl.tr(tau)}


def test_a_first_region_that_is_not_there():
    with pytest.raises(
        pm.InputError, match=r"first_region of Lost: 'apex' is none .*: tension, shear\+tension"
    ):
        Driven(Lost(NEO_HOOKEAN), 1)


@pytest.mark.parametrize(
    ("function", "flow", "message"),
    [
        ({"one": 3}, None, r"function\['one'\] = 3: a function in UFL is needed"),
        ({}, None, "function: no function is given"),
        ({"one": f}, f, "several functions need flow by the surfaces' names"),
        ({"one": f}, {"two": f}, "flow: 'two' is none of the surfaces one"),
        (f, {"one": f}, "flow: 'one' is none of the surfaces"),
    ],
)
def test_mistakes_in_functions_by_name(function, flow, message):
    with pytest.raises(pm.InputError, match=message):
        pm.UserPlasticity(NEO_HOOKEAN, function, {"y": 1.0}, flow)
