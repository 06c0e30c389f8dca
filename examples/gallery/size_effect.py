"""
Thin beams are stiffer
======================

Micropolar beams of one shape and different size bend under the same nominal stress. Far above the
material's length they are classical; near it they are several times stiffer.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

LENGTH = 1e-3  # of the material (m)
material = pm.MicropolarElastic.from_engineering(E=1e9, nu=0.3, n=0.7, l_b=LENGTH, l_t=LENGTH, psi=1.0)


def stiffness(height):
    """Curvature of a classical beam over that of a cantilever of 8 heights."""
    grid = pm.Grid.box((0, -height), (9 * height, 2 * height), height / 4)
    points = pm.seed(grid, bounds=((0, 0), (8 * height, height)), material=material)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip, force = points.farthest((1, 0)), 1e2 * height
    problem.load(tip, force=(0, -force))
    list(problem.march(1, progress=False))
    beam = force * (8 * height) ** 3 / (3 * 1e9 / (1 - 0.3**2) * height**3 / 12)
    return -beam / points.mean_displacement(tip)[1]


heights = np.geomspace(1, 100, 7) * LENGTH
fig, ax = plt.subplots(figsize=(plot.COLUMN, 2.6))
ax.loglog(heights / LENGTH, [stiffness(height) for height in heights], "o-")
ax.axhline(1.0, color="grey", lw=0.8, ls="--")
ax.set(xlabel="height / bending length", ylabel="stiffness / classical beam")
plt.show()
