"""
Clay in an oedometer
====================

Modified Cam-Clay is compressed, unloaded and compressed again between smooth walls. One cell does, since
the strain is the same everywhere.
"""

import math

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot
from polarmpm.materials.clay import critical_slope

plt.style.use(plot.STYLE)

skeleton = pm.Houlsby(p_0=50e3, swelling=0.01, mu=3e6)
clay = pm.CamClay(skeleton, M=critical_slope(math.radians(24)), compression=0.08, p_c=100e3)
grid = pm.Grid.box((0, 0), (1, 1), cell=1.0)
points = pm.seed(grid, material=clay)
problem = pm.QuasiStatic(grid, points, reset=None)
for x in (0.0, 1.0):
    problem.fix(pm.plane(x=x), ux=0)
problem.fix(pm.plane(y=0.0), uy=0)
piston = problem.fix(pm.plane(y=1.0), uy=lambda t: -0.1 * np.interp(t, [0, 1, 1.5, 3], [0, 0.5, 0.42, 1]))

stress, strain = [], []
for step in problem.march(60, to=3.0, adaptive=True, progress=False):
    stress.append(-problem.reaction(piston).force[1] / 1e3)
    strain.append(100 * abs(points.displacement[:, 1] / points.X[:, 1]).mean())

fig, ax = plt.subplots(figsize=(plot.COLUMN, 2.8))
ax.plot(stress, strain)
ax.invert_yaxis()
ax.set(xlabel="vertical stress (kPa)", ylabel="shortening (%)")
plt.show()
