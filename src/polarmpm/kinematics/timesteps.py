"""Steps in time: the generalised-alpha method, collocated at a time within the step (docs/dynamics.md).

Unknowns are the increments at the time n + theta, theta = 1 - alpha_f; there forces are in balance, and the
accelerations are affine functions of what the points have moved since n,

    (1 - alpha_m) a_n+1 + alpha_m a_n = c (x - x_n) - h,

with h of v_n and a_n. What is at n + 1 follows from x_n+1 = x_n + (x - x_n) / theta.
(J. Chung, G. M. Hulbert: A time integration algorithm for structural dynamics with improved numerical
dissipation: the generalized-alpha method, J. Appl. Mech. 60 (1993), 371-375.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..tools import checks


@dataclass(frozen=True)
class TimeStep:
    """Coefficients of a step.

    Args:
        dt: its length (s).
        rho_inf: by what the step multiplies motions whose period is much shorter than it: 1 keeps them (the
            implicit midpoint rule), 0 ends them at once.

    Raises:
        InputError: dt isn't positive, or rho_inf isn't between 0 and 1.
    """

    dt: float
    rho_inf: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", checks.number("dt", self.dt, above=0.0))
        object.__setattr__(self, "rho_inf", check_rho(self.rho_inf))

    @property
    def alpha_m(self) -> float:
        return (2.0 * self.rho_inf - 1.0) / (self.rho_inf + 1.0)

    @property
    def alpha_f(self) -> float:
        return self.rho_inf / (self.rho_inf + 1.0)

    @property
    def theta(self) -> float:
        """Where in the step forces are in balance, 1/2 to 1."""
        return 1.0 - self.alpha_f

    @property
    def gamma(self) -> float:
        return 0.5 - self.alpha_m + self.alpha_f

    @property
    def beta(self) -> float:
        return 0.25 * (1.0 - self.alpha_m + self.alpha_f) ** 2

    @property
    def acceleration(self) -> float:
        """c (1/s^2)."""
        return (1.0 - self.alpha_m) / (self.beta * self.dt**2 * self.theta)

    @property
    def rate(self) -> float:
        """Derivative (1/s) of the velocity at n + theta by what has been moved until then."""
        return self.gamma / (self.beta * self.dt)

    def history(self, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """h (m/s^2), of velocities and accelerations at n."""
        m, b = self.alpha_m, self.beta
        found: np.ndarray = (1.0 - m) * (v / (b * self.dt) + (0.5 / b - 1.0) * a) - m * a
        return found

    def rate_history(self, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The velocity at n + theta where nothing moves (m/s)."""
        t, g, b = self.theta, self.gamma, self.beta
        found: np.ndarray = (1.0 - t * g / b) * v + t * self.dt * (1.0 - 0.5 * g / b) * a
        return found

    def end(self, moved: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocities and accelerations at n + 1, of what has moved in the whole step (m)."""
        dt, b, g = self.dt, self.beta, self.gamma
        new = (moved - dt * v - dt**2 * (0.5 - b) * a) / (b * dt**2)
        return v + dt * ((1.0 - g) * a + g * new), new


def check_rho(rho_inf: float) -> float:
    """Raise InputError unless it is a number from 0 to 1."""
    return checks.number("rho_inf", rho_inf, least=0.0, most=1.0)
