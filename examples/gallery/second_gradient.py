"""
A film that is stiff because it is thin
=======================================

A second-gradient material knows how strain changes from place to place, with no rotation unknowns. A
strip as thin as its length bends several times less than a classical one.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

solid = pm.SaintVenantKirchhoff.from_engineering(E=1e6, nu=0.3)


def bend(length):
    grid = pm.Grid.box((0, -2.5), (5, 1.0), cell=0.25)
    film = pm.GradientElastic(solid, length) if length else solid
    points = pm.seed(grid, bounds=((0, 0), (4, 0.25)), material=film)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, slope=0)
    problem.load(points.farthest((1, 0)), force=(0, -100.0))
    list(problem.march(10, progress=False))
    return points


fig, axes = plt.subplots(3, 1, figsize=(plot.COLUMN, 4.6), sharex=True)
for ax, length in zip(axes, (0.0, 0.25, 0.5)):
    plot.plot_points(bend(length), ax=ax)
    ax.set_title(f"length {length:g} m, height 0.25 m")
    ax.label_outer()
plt.show()
