"""
An energy of one's own
======================

Write the energy in UFL. Stresses and the tangent are derived from it and compiled, once: changing a
number compiles nothing. Here fibres along x stiffen a soft solid.
"""

import matplotlib.pyplot as plt
import ufl

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)


def fibred(F, p):
    """Neo-Hookean, with fibres along x that bear tension and pressure (J/m^3)."""
    C, J = F.T * F, ufl.det(F)
    matrix = p.mu / 2 * (ufl.tr(C) - 3) - p.mu * ufl.ln(J) + p.lam / 2 * ufl.ln(J) ** 2
    return matrix + p.fibre / 8 * (C[0, 0] - 1) ** 2


def bend(fibre):
    solid = pm.UserEnergy(fibred, {"lam": 6e5, "mu": 4e5, "fibre": fibre}, micropolar=False)
    grid = pm.Grid.box((0, -3), (5, 1.5), cell=0.25)
    points = pm.seed(grid, bounds=((0, 0), (4, 0.5)), material=solid)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.load(points.farthest((1, 0)), force=(0, -1.5e3))
    list(problem.march(10, progress=False))
    return points


fig, axes = plt.subplots(1, 3, figsize=(plot.PAGE, 2.3), sharey=True)
for ax, fibre in zip(axes, (0.0, 2e6, 8e6)):
    plot.plot_points(bend(fibre), ax=ax)
    ax.set_title(f"fibres {fibre / 1e6:g} MPa")
    ax.label_outer()
plt.show()
