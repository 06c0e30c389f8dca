"""
A tube, by its section
======================

A body of revolution needs its section alone: x is the radius, and points stand for rings. A rubber tube
is inflated until it bulges, held at both ends.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)
grid = pm.Grid.box((0, 0), (3, 4), cell=0.1)
rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.4)
points = pm.seed(grid, bounds=((0.8, 0), (1.0, 4)), material=rubber, axisymmetric=True)
problem = pm.QuasiStatic(grid, points)
problem.symmetry(pm.plane(y=0.0))
problem.fix(pm.plane(y=4.0), u=0)
problem.pressure(pm.Surface.line((0.8, 4), (0.8, 0), 80), 0.6e5)

middle, curve = points.nearest((0.8, 0)), [(0.0, 0.0)]
for step in problem.march(10, adaptive=True, progress=False):
    curve.append((points.mean_displacement(middle)[0], 60 * step.factor))

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 3))
plot.plot_points(points, points.F[:, 2, 2], label="hoop stretch", ax=left)
left.set(xlabel="r (m)", ylabel="z (m)", xlim=(0, 2))
right.plot(*zip(*curve), "o-")
right.set(xlabel="radius grows by (m)", ylabel="pressure (kPa)")
plt.show()
