"""Closed forms with which the scenes of generalised continua are compared: a beam under a pressure that
follows it, a ring of a material with second gradients under outer pressure, and of micropolar materials a
hole under tension, a round bar in torsion, and plane waves."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..materials.moduli import lame
from ..tools import checks


def pressed_cantilever(load: float, steps: int = 4000) -> np.ndarray:
    """The elastica of a cantilever under a constant normal load p per current length.

    From the free end on, where there are no forces and no moment, the equations are an initial value problem
    (phi' = k, k' = -V, N' = V k, V' = -N k + c); the line is then turned until its root is horizontal.

    Args:
        load: c = p L^3 / EI, of a beam along x that the load pushes towards -y.
        steps: of the Runge-Kutta method; as many segments has the line.

    Returns:
        Positions (steps + 1, 2) over L, the root first, at (0, 0).

    Raises:
        InputError: an argument is out of range.
    """
    c, n = checks.number("load", load), checks.whole("steps", steps, least=1)

    def rate(y: np.ndarray) -> np.ndarray:
        phi, k, axial, shear = y[2:]
        return np.array([np.cos(phi), np.sin(phi), k, -shear, shear * k, -axial * k + c])

    line, h = np.zeros((n + 1, 6)), 1.0 / n
    for i in range(n):
        y = line[i]
        a = rate(y)
        b = rate(y + h / 2 * a)
        d = rate(y + h / 2 * b)
        line[i + 1] = y + h / 6 * (a + 2 * b + 2 * d + rate(y + h * d))
    # the line runs from the free end to the root: seen from the root it begins with the opposite tangent
    turn, offset = line[-1, 2], line[-1, :2] - line[::-1, :2]
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([offset @ (cos, sin), -(offset @ (-sin, cos))], axis=1)


def micropolar_waves(
    k: float, *, mu: float, kappa: float, stiffness: float, rho: float, j: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies of plane transverse waves in an endless micropolar body, and the microrotations in them.

    A displacement U cos(k x) across x and a microrotation Theta sin(k x) about the third axis swing together:

        (rho w^2 - (mu + kappa) k^2) U = 2 kappa k Theta,
        (rho j w^2 - c k^2 - 4 kappa) Theta = 2 kappa k U.

    Args:
        k: wave number (1/m).
        mu, kappa: moduli (Pa), see `MicropolarElastic`.
        stiffness: c = gamma + beta (N).
        rho, j: density (kg/m^3) and microinertia (m^2).

    Returns:
        Of the acoustic and of the optical wave: w (rad/s), (2,), and Theta / U (1/m), (2,).

    Raises:
        InputError: an argument is out of range.
    """
    given = {"k": k, "mu": mu, "kappa": kappa, "rho": rho, "j": j}
    k, mu, kappa, rho, j = (checks.number(name, value, above=0.0) for name, value in given.items())
    stiffness = checks.number("stiffness", stiffness, least=0.0)
    # symmetric in the unknowns sqrt(rho) U and sqrt(rho j) Theta
    coupling = 2.0 * kappa * k / (rho * np.sqrt(j))
    matrix = np.array(
        [
            [(mu + kappa) * k**2 / rho, coupling],
            [coupling, (stiffness * k**2 + 4.0 * kappa) / (rho * j)],
        ]
    )
    squares, modes = np.linalg.eigh(matrix)
    return np.sqrt(squares), modes[1] / modes[0] / np.sqrt(j)


def hole_in_tension(*, radius: float, nu: float, N: float, l_b: float) -> float:
    """Stress concentration of a round hole in an endless micropolar body under tension.

    Kaloni & Ariman 1967. Small strains, plane strain. Classically it is 3, whatever the hole's radius.

    Args:
        radius: of the hole (m).
        nu: Poisson's ratio.
        N: coupling number, N^2 = kappa / (mu + kappa), from 0 (classical) to 1 (couple stresses).
        l_b: characteristic length of bending (m), l_b^2 = (gamma + beta) / (4 mu).

    Returns:
        The largest hoop stress over the tension.

    Raises:
        InputError: an argument is out of range.
    """
    a = checks.number("radius", radius, above=0.0)
    nu = checks.number("nu", nu, above=-1.0, most=0.5)
    N, l_b = checks.number("N", N, least=0.0, most=1.0), checks.number("l_b", l_b, least=0.0)
    if N <= 1e-9 or l_b <= 1e-9 * a:  # nothing but rounding
        return 3.0
    z = a * N / l_b
    F = 8 * (1 - nu) * N**2 / (4 + z**2 + 2 * z * _ratio(z, -1))
    return (3 + F) / (1 + F)


def twisted_bar(*, radius: float, mu: float, kappa: float, alpha: float, gamma: float) -> float:
    """Torsional stiffness of a round micropolar bar over the classical one (Gauthier & Jahsman 1975).

    Small strains; the moduli are those of `MicropolarElastic`, of which lambda and beta don't matter.

    Args:
        radius: of the bar (m).
        mu, kappa: moduli (Pa).
        alpha, gamma: moduli of the wryness (N), alpha >= -2/3 gamma.

    Returns:
        1 + 6 (l_t / R)^2 (1 - 4/3 Psi chi) / (1 - Psi chi), l_t^2 = gamma / mu,
        Psi = 2 gamma / (alpha + 2 gamma), chi = I1(p R) / (p R I0(p R)), p^2 = 4 kappa / (alpha + 2 gamma).

    Raises:
        InputError: an argument is out of range.
    """
    R, mu = checks.number("radius", radius, above=0.0), checks.number("mu", mu, above=0.0)
    kappa, gamma = checks.number("kappa", kappa, above=0.0), checks.number("gamma", gamma, least=0.0)
    alpha = checks.number("alpha", alpha, least=-2 / 3 * gamma)
    if gamma == 0:
        return 1.0
    z = R * np.sqrt(4 * kappa / (alpha + 2 * gamma))
    held = 2 * gamma / (alpha + 2 * gamma) * _ratio(z, 1) / z
    return float(1 + 6 * gamma / (mu * R**2) * (1 - 4 / 3 * held) / (1 - held))


class GradientRing:
    """A ring under outer pressure, of the material with W = psi(E) + sum l^2/12 psi(E,a) (two equal lengths).

    Small strains, plane strain. The radial displacement is A r + B / r + C I1(r / g) + D K1(r / g) with
    g = l / sqrt(12); the constants make the potential stationary, so that no condition of the boundary is
    put in by hand (Gao & Park 2007; Aravas 2011). With l = 0 it is Lame's solution.

    Args:
        inner, outer: radii (m).
        pressure: at the outer wall (Pa).
        E, nu: Young's modulus (Pa) and Poisson's ratio.
        l: internal length (m).

    Raises:
        InputError: an argument is out of range.
    """

    def __init__(self, *, inner: float, outer: float, pressure: float, E: float, nu: float, l: float):
        self.inner = checks.number("inner", inner, above=0.0)
        self.outer = checks.number("outer", outer, above=self.inner)
        self.pressure = checks.number("pressure", pressure)
        self.lam, self.mu = lame(E, nu)
        self.g = checks.number("l", l, least=0.0) / np.sqrt(12)
        self._constants = self._stationary()

    def _functions(self, r: np.ndarray) -> np.ndarray:
        """u, u' and u'' (3, functions, n) of the general solution's functions, each at most about 1."""
        one, a, b = np.ones_like(r), self.inner, self.outer
        found = [(r / b, one / b, 0 * r), (a / r, -a / r**2, 2 * a / r**3)]
        if self.g > 1e-4 * (b - a):  # thinner layers at the walls are not to be seen
            found += [_bessel(r / self.g, b / self.g, 1), _bessel(r / self.g, a / self.g, -1)]
            for k in (2, 3):
                u, first, second = found[k]
                found[k] = (u, first / self.g, second / self.g**2)
        return np.moveaxis(np.array(found), 0, 1)

    def _stationary(self) -> np.ndarray:
        # points crowd at both walls, where there are layers as thick as g
        x, w = np.polynomial.legendre.leggauss(12)
        panels = 200
        t = (np.arange(panels)[:, None] + (x + 1) / 2).ravel() / panels * np.pi
        half = (self.outer - self.inner) / 2
        r = self.inner + half * (1 - np.cos(t))
        weight = np.tile(w / 2, panels) / panels * np.pi * half * np.sin(t) * r
        u, first, second = self._functions(r)
        dilation, gradient = first + u / r, second + first / r - u / r**2
        shear = first / r - u / r**2

        def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
            found: np.ndarray = (p * weight) @ q.T
            return found

        energy = self.lam * product(dilation, dilation) + 2 * self.mu * product(first, first)
        energy += 2 * self.mu * product(u / r, u / r) + self.g**2 * self.lam * product(gradient, gradient)
        energy += 2 * self.g**2 * self.mu * (product(second, second) + 3 * product(shear, shear))
        wall = self._functions(np.array([self.outer]))[0, :, 0]
        return np.linalg.solve(energy, -self.pressure * self.outer * wall)

    def displacement(self, r: Any) -> np.ndarray:
        """Radial displacement (n,) (m) at radii (n,) (m); inwards is negative."""
        found: np.ndarray = self._constants @ self._functions(self._radii(r))[0]
        return found

    def stress(self, r: Any) -> np.ndarray:
        """Radial and hoop stress (2, n) (Pa) at radii (n,) (m): those of the strain, not of its gradient."""
        r = self._radii(r)
        u, first, _ = np.einsum("k,dkn->dn", self._constants, self._functions(r))
        trace = self.lam * (first + u / r)
        return np.stack([trace + 2 * self.mu * first, trace + 2 * self.mu * u / r])

    def _radii(self, r: Any) -> np.ndarray:
        found = np.atleast_1d(checks.numeric("r", r, "radii"))
        slack = 1e-9 * self.outer
        if np.any(found < self.inner - slack) or np.any(found > self.outer + slack):
            raise checks.refuse("r", r, f"radii from {self.inner:g} to {self.outer:g} m are allowed")
        return found


def _bessel(z: np.ndarray, at: float, sign: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """I1 (sign 1) or K1 (sign -1) times exp(-sign at), and its first two derivatives.

    By their integrals, I_n = 1/pi int_0^pi exp(z cos t) cos(n t) dt and K_n = int_0^oo exp(-z cosh t)
    cosh(n t) dt, of which the trapezoidal rule leaves out nothing but rounding.
    """
    n = 2000
    if sign > 0:
        t = (np.arange(n) + 0.5) / n * np.pi
        weight, argument, order = np.exp(np.multiply.outer(z, np.cos(t)) - at) / n, np.cos(t), np.cos(t)
    else:
        t = (np.arange(n) + 0.5) / n * np.arccosh(1 + 750.0 / z.min())
        argument, order = -np.cosh(t), np.cosh(t)
        weight = np.exp(np.multiply.outer(z, argument) + at) * (t[1] - t[0])
    value, first, second = (weight @ (order * argument**k) for k in range(3))
    return value, first, second


def _ratio(z: float, sign: int) -> float:
    """I1(z) / I0(z) (sign 1) or K0(z) / K1(z) (sign -1), by the integrals of `_bessel`, z > 0."""
    n = 2000
    if sign > 0:
        if z > 1e4:  # narrower than the rule's steps; the next term is less than rounding
            return 1 - 1 / (2 * z) - 1 / (8 * z**2) - 1 / (8 * z**3)
        if z < 1e-2:  # where the sum loses digits
            return z / 2 * (1 - z**2 / 8 + z**4 / 48)
        t = (np.arange(n) + 0.5) / n * np.pi
        weight = np.exp(-2 * z * np.sin(t / 2) ** 2)
        return float(weight @ np.cos(t) / weight.sum())
    t = (np.arange(n) + 0.5) / n * np.arccosh(1 + 750.0 / z)
    weight = np.exp(-2 * z * np.sinh(t / 2) ** 2)
    return float(weight.sum() / (weight @ np.cosh(t)))
