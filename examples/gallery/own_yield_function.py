"""
A yield function of one's own
=============================

Return mapping and consistent tangent follow from a function in UFL of the Kirchhoff stress: here von
Mises' with different strengths along x and y. A plate with a hole is pulled along either.
"""

import matplotlib.pyplot as plt
import numpy as np
import ufl

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)


def rolled(tau, nu, chi, p):
    """Hill's quadratic, in the plane: r is the strength along y over that along x."""
    s = ufl.dev(tau)
    q = ufl.sqrt(1.5 * (ufl.inner(s, s) + (1 / p.r**2 - 1) * s[1, 1] ** 2))
    return q - p.k - p.H * chi


metal = pm.UserPlasticity(
    pm.Hencky.from_engineering(E=70e9, nu=0.3), rolled, {"r": 0.5, "k": 100e6, "H": 1e9}
)


def pull(axis):
    grid = pm.Grid.box((0, 0), (2.5, 2.5), cell=0.125)
    points = pm.seed(grid, lambda x: np.linalg.norm(x, axis=1) > 0.5, bounds=((0, 0), (2, 2)), material=metal)
    problem = pm.QuasiStatic(grid, points, reset=None)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    moved = problem.fix(lambda x: x[:, "xy".index(axis)] > 1.99, **{f"u{axis}": 0.01})
    curve = [(0.0, 0.0)]
    for step in problem.march(10, adaptive=True, progress=False):
        curve.append((0.5 * step.factor, abs(problem.reaction(moved).force["xy".index(axis)]) / 2 / 1e6))
    return curve


fig, ax = plt.subplots(figsize=(plot.COLUMN, 2.6))
for axis in "xy":
    ax.plot(*zip(*pull(axis)), "o-", label=f"pulled along {axis}")
ax.set(xlabel="extension (%)", ylabel="mean stress (MPa)")
ax.legend()
plt.show()
