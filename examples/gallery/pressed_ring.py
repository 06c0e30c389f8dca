"""
Pressure on a curved surface
============================

A ring is inflated. Pressure acts on a surface that doesn't follow the grid, and stays normal to it as the
ring grows.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

INNER, OUTER, CELL = 1.0, 1.4, 0.1  # m
angle = (np.arange(200) + 0.5) / 200 * np.pi / 2
inside = np.stack([np.cos(angle), np.sin(angle)], axis=1)
wall = pm.Surface(INNER * inside, np.full(200, INNER * np.pi / 2 / 200), -inside)

grid = pm.Grid.box((0, 0), (3, 3), CELL)
points = pm.seed(
    grid,
    lambda x: abs(np.linalg.norm(x, axis=1) - 1.2) <= 0.2,
    bounds=((0, 0), (OUTER, OUTER)),
    material=pm.NeoHookean.from_engineering(E=1e6, nu=0.4),
)
problem = pm.QuasiStatic(grid, points)
problem.symmetry(pm.plane(x=0.0))
problem.symmetry(pm.plane(y=0.0))
problem.pressure(wall, 0.8e5)
bottom, curve = points.nearest((INNER, 0.0)), [(0.0, 0.0)]
for step in problem.march(10, progress=False):
    curve.append((points.mean_displacement(bottom)[0], 80 * step.factor))

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 3))
stretch = np.linalg.norm(points.x, axis=1) / np.linalg.norm(points.X, axis=1)
plot.plot_points(points, stretch, label="hoop stretch", ax=left)
right.plot(*zip(*curve), "o-")
right.set(xlabel="inner radius grows by (m)", ylabel="pressure (kPa)")
plt.show()
