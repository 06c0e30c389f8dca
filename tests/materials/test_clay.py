"""Cam-Clay and the elastic energy of clays: closed forms of compression and shear, no lost return."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.materials.clay import critical_slope
from tests.forms.test_return_mapping import tangent_errors
from tests.helpers.plasticity import ELASTIC, L_P, Driven, dev, square, trace, transposed

P_0, P_C, SWELLING, COMPRESSION, M = 1e5, 1.5e5, 0.02, 0.1, 1.2
STIFF = pm.Houlsby(p_0=P_0, swelling=SWELLING, mu=4e6)
COUPLED = pm.Houlsby(p_0=P_0, swelling=SWELLING, mu=1e6, alpha=100.0)


def clay(elastic: Any = STIFF, **options: Any) -> pm.CamClay:
    return pm.CamClay(elastic, **{"M": M, "compression": COMPRESSION, "p_c": P_C, **options})


def driven_to(driven: Driven, stretch: np.ndarray) -> tuple[float, float]:
    """p and q of one point after a step to diag(stretch) F."""
    z = ((np.diag(stretch) - np.eye(3)) @ driven.points.F).reshape(1, 9)
    tau = driven.stress(z, tangent=False)[0].reshape(-1, 3, 3) @ transposed(driven.motion(z)[0])
    driven.advance(z)
    return -float(trace(tau)[0]) / 3, math.sqrt(1.5 * float(square(dev(tau))[0]))


def test_first_loading_and_swelling_are_straight_lines():
    """ln J = -swelling ln p up to p_c, then -compression ln p; back along swelling."""
    driven, m = Driven(clay(COUPLED), 1, 3), clay(COUPLED)
    volume, step = 0.0, 0.01
    yields = -SWELLING * math.log(P_C / P_0)
    for k in range(40):
        step = 0.01 if k < 30 else -0.002
        p, q = driven_to(driven, np.full(3, math.exp(-step / 3)))
        volume -= step
        most = min(volume, -0.3)
        expected = P_0 * math.exp(-volume / SWELLING)
        if volume < yields or k >= 30:
            consolidated = P_C * math.exp((yields - (volume if k < 30 else most)) / COMPRESSION)
            expected = consolidated * math.exp((-volume + (volume if k < 30 else -0.3)) / SWELLING)
        assert p == pytest.approx(expected, rel=1e-7)
        assert q < 1e-6 * p
    assert m.consolidation(driven.points.hardening)[0] == pytest.approx(
        P_C * math.exp((yields + 0.3) / COMPRESSION), rel=1e-7
    )


@pytest.mark.parametrize("p_c", [1.1 * P_0, 1.5 * P_0, 6.0 * P_0])
def test_undrained_shear_ends_in_the_critical_state(p_c):
    """J = 1: p_c (p/p_0)^(swelling/(compression - swelling)) stays as it was at any strain, and the end is
    q = M p at p = p_0 (p_c/(2 p_0))^((compression - swelling)/compression), wet and dry of critical."""
    driven = Driven(clay(p_c=p_c), 1, 3)
    for _ in range(150):
        p, q = driven_to(driven, np.exp([0.002, 0.002, -0.004]))
        now = driven.material.consolidation(driven.points.hardening)[0]
        assert now == pytest.approx(p_c * (p / P_0) ** (-SWELLING / (COMPRESSION - SWELLING)), rel=1e-7)
        if now != p_c:
            assert (p - now / 2) ** 2 + (q / M) ** 2 == pytest.approx(now**2 / 4, rel=1e-7)
    share = (COMPRESSION - SWELLING) / COMPRESSION
    assert p == pytest.approx(P_0 * (p_c / (2 * P_0)) ** share, rel=1e-4)
    assert q == pytest.approx(M * p, rel=1e-4)


def test_the_energy_gives_pressure_and_shear_of_closed_form():
    """p = p_0 exp(Omega) (1 + alpha/swelling |e|^2), q = 2 (mu + alpha p_0 exp(Omega)) sqrt(3/2) |e|."""
    driven = Driven(clay(COUPLED, p_c=100 * P_0), 1, 3)
    logs = np.array([0.004, -0.003, -0.006])
    p, q = driven_to(driven, np.exp(logs))
    volume, e = logs.sum(), logs - logs.mean()
    pressure, size = P_0 * math.exp(-volume / SWELLING), float(e @ e)
    assert p == pytest.approx(pressure * (1 + 100.0 / SWELLING * size), rel=1e-9)
    assert q == pytest.approx(2 * (1e6 + 100.0 * pressure) * math.sqrt(1.5 * size), rel=1e-9)


MATERIALS = {
    "classical": (clay(COUPLED), 3),
    "plane": (clay(), 2),
    "over-consolidated": (clay(p_c=8 * P_0, cohesion=2e4), 3),
    "micropolar": (
        pm.CamClay(
            ELASTIC, M=M, compression=COMPRESSION, swelling=SWELLING, p_c=40.0, cohesion=10.0, l_p=L_P
        ),
        2,
    ),
}


def random_steps(driven: Driven, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 1, (driven.n, driven.size)) * 10 ** rng.uniform(-3, -1, (driven.n, 1))
    z[:, driven.dim**2 :] *= 0.1
    return z


@pytest.mark.parametrize("name", MATERIALS)
def test_no_return_is_lost_and_dissipation_is_never_negative(name):
    """Strains of up to 10 %, from rest and once more from where the first step has led."""
    material, dim = MATERIALS[name]
    driven = Driven(material, 1500, dim)
    for seed in (1, 2):
        z = random_steps(driven, seed) * (1.0 if seed == 1 else 0.3)
        y, loss = driven.advance(z)
        assert len(y.rows) > 300
        assert loss.min() >= -1e-9 * material.modulus
    f = driven.material.consolidation(driven.points.hardening)
    assert np.all((f > 0) & np.isfinite(f))


@pytest.mark.parametrize("name", MATERIALS)
def test_consistent_tangent(name):
    material, dim = MATERIALS[name]
    driven = Driven(material, 120, dim)
    driven.advance(random_steps(driven, 3) * 0.2)
    errors = tangent_errors(driven, random_steps(driven, 4))
    yielding = np.concatenate([e for region, e in errors.items() if region != "elastic"])
    assert len(yielding) > 30
    assert yielding.max() < 1e-6


def test_it_carries_its_pressure_in_a_scene():
    """A block between rollers is in equilibrium at p_0, and follows the line of first loading."""
    grid = pm.Grid.box((0, 0), (1, 1), cell=0.5)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=clay())
    problem = pm.QuasiStatic(grid, points, basis="mpm")
    for axis in "xy":
        problem.fix(pm.plane(**{axis: 0.0}), **{f"u{axis}": 0})
    for axis in "xy":
        problem.fix(pm.plane(**{axis: 1.0}), **{f"u{axis}": -0.02})
    *_, last = problem.march(4)
    assert last.factor == 1.0
    J = float(np.linalg.det(points.F)[0])
    assert pytest.approx(0.98**2, rel=1e-9) == J


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pm.Houlsby(p_0=0, swelling=0.02, mu=1), "p_0 = 0.*: p_0 > 0"),
        (lambda: pm.Houlsby(p_0=1, swelling=-1, mu=1), "swelling = -1.*: swelling > 0"),
        (lambda: pm.Houlsby(p_0=1, swelling=0.02), "mu = 0, alpha = 0"),
        (lambda: clay(compression=0.01), "compression = 0.01.*: compression > swelling = 0.02"),
        (lambda: clay(p_c=5e4), "p_c = 50000.*: p_c >= p_0 = 100000"),
        (lambda: clay(M=-1), "M = -1.*: M > 0"),
        (lambda: clay(swelling=0.03), "swelling = 0.03: the elastic part's is 0.02"),
        (lambda: clay(l_p=1.0), "l_p = 1.*: a classical material has no plastic length"),
        (lambda: clay(ELASTIC, swelling=0.01), "l_p = None: a micropolar material needs"),
        (lambda: clay(ELASTIC, l_p=1.0), "swelling = None: MicropolarElastic has no index"),
        (lambda: clay(pm.Houlsby(p_0=P_0, swelling=0.02, alpha=40.0)), "no q/p beyond 1.095"),
    ],
)
def test_bad_clays(make, message):
    with pytest.raises(pm.InputError, match=message):
        make()


def test_slope_of_the_critical_state():
    assert critical_slope(math.radians(30)) == pytest.approx(1.2, rel=1e-12)
