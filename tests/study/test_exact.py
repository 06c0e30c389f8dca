"""Closed forms of the scenes, against numbers of other methods."""

import numpy as np
import pytest
from scipy import integrate, special

from polarmpm.errors import InputError
from polarmpm.study.exact import GradientRing, _ratio, hole_in_tension, pressed_cantilever, twisted_bar

# tip displacement over L, by load
TIPS = {2: (-0.0352, -0.2456), 8: (-0.4607, -0.7635), 20: (-1.2915, -0.6526), 60: (-1.2392, -0.0251)}

# radial and hoop stress (MPa, compression positive) at radii of 2, 2.5, 3 and 5 m; by internal length (m)
RINGS = {
    0.0: ((0, 128.62), (23.15, 105.47), (35.73, 92.89), (54.02, 74.60)),
    1.0: ((18.55, 123.57), (26.95, 103.24), (36.91, 91.40), (52.92, 73.79)),
    4.0: ((49.99, 94.91), (50.38, 85.96), (51.23, 80.09), (53.85, 69.20)),
}
WALLS = {0.0: (12.8616, 18.6494), 1.0: (12.3572, 18.4476), 4.0: (9.4913, 17.3012)}  # mm, inwards


def ring(l, nu=0.0):
    return GradientRing(inner=2.0, outer=5.0, pressure=54.0189e6, E=20e9, nu=nu, l=l)


@pytest.mark.parametrize("load", TIPS)
def test_pressed_cantilever(load):
    line = pressed_cantilever(load)
    np.testing.assert_allclose(line[-1] - (1, 0), TIPS[load], atol=6e-5)
    np.testing.assert_allclose(line[1] - line[0], (1 / (len(line) - 1), 0), atol=3 * load / len(line) ** 2)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert length == pytest.approx(1, abs=1e-4)


def test_pressed_cantilever_is_a_beam_at_first_and_its_mirror_image_turned_round():
    line = pressed_cantilever(1e-3)
    x = line[:, 0]
    np.testing.assert_allclose(line[:, 1], -1e-3 / 24 * (x**4 - 4 * x**3 + 6 * x**2), atol=1e-9)
    np.testing.assert_allclose(pressed_cantilever(-5.0), pressed_cantilever(5.0) * (1, -1), atol=1e-12)


@pytest.mark.parametrize("l", RINGS)
def test_ring(l):
    r = np.array([2.0, 2.5, 3.0, 5.0])
    np.testing.assert_allclose(-ring(l).stress(r).T / 1e6, RINGS[l], atol=6e-3)
    np.testing.assert_allclose(-ring(l).displacement([2.0, 5.0]) * 1e3, WALLS[l], atol=6e-5)


def test_ring_with_a_short_length_is_that_of_lame():
    np.testing.assert_allclose(ring(0.01).displacement(2.0), ring(0.0).displacement(2.0), rtol=5e-6)
    np.testing.assert_allclose(ring(1e-5).displacement(2.0), ring(0.0).displacement(2.0), rtol=1e-9)


def test_ring_is_in_equilibrium():
    """The potential of neighbours, by quadrature with SciPy's functions, isn't lower."""
    made = ring(1.5, nu=0.3)
    g, lam, mu = made.g, made.lam, made.mu
    A, B, C, D = made._constants

    def potential(change):
        def u(r):
            layers = C * special.iv(1, r / g) * np.exp(-5 / g) + D * special.kv(1, r / g) * np.exp(2 / g)
            return A * r / 5 + B * 2 / r + layers + change(r)

        def density(r, h=1e-4):
            first, second = (u(r + h) - u(r - h)) / (2 * h), (u(r + h) - 2 * u(r) + u(r - h)) / h**2
            hoop = u(r) / r
            e, de, slope = first + hoop, second + (first - hoop) / r, (first - hoop) / r
            local = lam / 2 * e**2 + mu * (first**2 + hoop**2)
            return r * (local + g**2 * (lam / 2 * de**2 + mu * (second**2 + 3 * slope**2)))

        inside = integrate.quad(density, 2 + 2e-4, 5 - 2e-4, epsabs=0, epsrel=1e-9)[0]
        return inside + 5 * made.pressure * u(5.0)

    least = potential(lambda r: 0 * r)
    for shape in (lambda r: r, lambda r: r**2, np.cos):
        up, down = (potential(lambda r, s=s, f=shape: s * 1e-4 * f(r)) for s in (1, -1))
        assert up > least
        assert down > least
        assert up + down - 2 * least > 20 * abs(up - down)


@pytest.mark.parametrize("z", [1e-9, 1e-3, 0.02, 1.0, 30.0, 9e3, 1.1e4, 1e7])
def test_ratios_of_bessel_functions(z):
    assert _ratio(z, 1) == pytest.approx(special.ive(1, z) / special.ive(0, z), rel=1e-12)
    assert _ratio(z, -1) == pytest.approx(special.kve(0, z) / special.kve(1, z), rel=1e-12)


def test_hole_in_tension():
    for N, l_b, factor in ((0.5**0.5, 0.02, 2.9958), (0.5**0.5, 0.25, 2.7151), (0.5**0.5, 1, 2.3164)):
        assert hole_in_tension(radius=1, nu=0.3, N=N, l_b=l_b) == pytest.approx(factor, abs=6e-5)
    assert hole_in_tension(radius=2, nu=0.3, N=0.9, l_b=1) == pytest.approx(2.3809, abs=6e-5)
    # classical if there is no length or no coupling; with couple stresses, 8 (1 - nu) / 4 of a small hole
    assert hole_in_tension(radius=1, nu=0.3, N=0.5, l_b=0) == 3
    assert hole_in_tension(radius=1, nu=0.3, N=0, l_b=1) == 3
    assert hole_in_tension(radius=1, nu=0.3, N=0.5, l_b=1e-6) == pytest.approx(3, abs=1e-10)
    assert hole_in_tension(radius=1, nu=0.3, N=1, l_b=1e6) == pytest.approx(4.4 / 2.4, rel=1e-9)


def ritz_of_a_twisted_bar(mu, kappa, alpha, gamma, terms=14):
    """Of radius 1, by odd polynomials f of r for the microrotation f e_r + z e_z (twist 1)."""
    x, w = np.polynomial.legendre.leggauss(60)
    r, w = (x + 1) / 2, w / 2 * (x + 1) / 2
    power = 2 * np.arange(terms)[:, None] + 1
    f, df = r**power, power * r ** (power - 1)
    dilation, one = df + f / r, np.ones_like(r)
    # 1/2 c A c + b c + constant, the energy over 2 pi, shear r / 2 and spin -r / 2 of the displacement
    A = 4 * kappa * (f * w) @ f.T + alpha * (dilation * w) @ dilation.T
    A += 2 * gamma * ((df * w) @ df.T + (f / r * w) @ (f / r).T)
    b = 2 * kappa * (f * w) @ r + alpha * (dilation * w) @ one
    constant = (mu + kappa) * (r**2 * w).sum() / 2 + (alpha / 2 + gamma) * w.sum()
    c = np.linalg.solve(A, -b)
    return 2 * (constant + b @ c / 2) / (mu / 4)


@pytest.mark.parametrize(
    "moduli", [(1.0, 1.0, 0.1, 0.1), (2.0, 0.3, 0.0, 0.4), (1.0, 5.0, -0.02, 0.05), (1.0, 0.01, 3.0, 1.0)]
)
def test_twisted_bar_is_that_of_ritz(moduli):
    names = ("mu", "kappa", "alpha", "gamma")
    found = twisted_bar(radius=1, **dict(zip(names, moduli, strict=True)))
    assert found == pytest.approx(ritz_of_a_twisted_bar(*moduli), rel=1e-8)


def test_twisted_bar_without_length_is_classical():
    assert twisted_bar(radius=1, mu=1, kappa=1, alpha=0.2, gamma=0) == 1
    thick = twisted_bar(radius=1e5, mu=1, kappa=1, alpha=0.2, gamma=0.1)
    assert thick == pytest.approx(1 + 0.6e-10, rel=1e-12)
    with_units = twisted_bar(radius=1e-3, mu=1e9, kappa=1e9, alpha=1e2, gamma=1e2)
    assert with_units == pytest.approx(twisted_bar(radius=1, mu=1, kappa=1, alpha=0.1, gamma=0.1), rel=1e-12)


def test_arguments_of_closed_forms_are_checked():
    with pytest.raises(InputError, match=r"N = 1\.5"):
        hole_in_tension(radius=1, nu=0.3, N=1.5, l_b=1)
    with pytest.raises(InputError, match=r"nu = 0\.6"):
        hole_in_tension(radius=1, nu=0.6, N=0.5, l_b=1)
    with pytest.raises(InputError, match="kappa = 0"):
        twisted_bar(radius=1, mu=1, kappa=0, alpha=0, gamma=1)
    with pytest.raises(InputError, match="alpha = -1"):
        twisted_bar(radius=1, mu=1, kappa=1, alpha=-1, gamma=1)
    with pytest.raises(InputError, match="load"):
        pressed_cantilever("2")
    with pytest.raises(InputError, match="outer"):
        GradientRing(inner=2, outer=2, pressure=1, E=1, nu=0, l=0)
    with pytest.raises(InputError, match="l ="):
        GradientRing(inner=2, outer=5, pressure=1, E=1, nu=0, l=-1)
    with pytest.raises(InputError, match="r ="):
        ring(1.0).stress([1.0])
