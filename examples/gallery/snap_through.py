"""
An arch snaps through
=====================

Past the greatest load that an arch bears there is equilibrium at smaller loads only. The arc-length
method follows it: the load factor is an unknown of each step.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

RADIUS, THICK, HALF = 5.0, 0.2, np.radians(35)  # m, m, rad


def arch(x):
    radius, angle = np.hypot(x[:, 0], x[:, 1] + RADIUS), np.arctan2(x[:, 0], x[:, 1] + RADIUS)
    return (abs(radius - RADIUS) <= THICK / 2) & (abs(angle) <= HALF)


grid = pm.Grid.box((-3.5, -3.5), (3.5, 0.5), cell=0.125)
points = pm.seed(grid, arch, material=pm.NeoHookean.from_engineering(E=1e8, nu=0.3))
problem = pm.QuasiStatic(grid, points)
foot = -RADIUS * (1 - np.cos(HALF))
problem.fix(lambda x: (x[:, 1] < foot + 0.1) & (abs(x[:, 0]) > 2.5), u=0)
crown = points.nearest((0, 0), count=4)
problem.load(crown, force=(0, -1e5))

path = [(0.0, 0.0)]
for step in problem.march_arc_length(
    0.03, largest=0.06, until=lambda step: path[-1][0] > 1.2, progress=False
):
    path.append((-points.mean_displacement(crown)[1], 100 * step.factor))

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.6), width_ratios=(3, 2))
plot.plot_points(points, ax=left)
right.plot(*zip(*path), "o-")
right.axhline(0.0, color="grey", lw=0.8)
right.set(xlabel="crown moves down by (m)", ylabel="load (kN)")
plt.show()
