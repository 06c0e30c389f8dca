"""
Bodies fit no grid
==================

A strip is turned through the grid, in which nothing is aligned any more. It deflects by the same,
whatever its angle: points stand for the part of their cell that is inside and integrate over it, and its
support lies on its own end.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)
rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)


def deflection(angle):
    """Of a strip of 4 x 0.5 m at an angle (degrees), across it, and its points."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    axes = np.array([[c, s], [-s, c]])  # along and across
    corner = axes.T @ (0.0, -0.25), axes.T @ (0.0, 0.25)

    def inside(x):
        along, across = axes @ x.T
        return (along >= 0) & (along <= 4) & (abs(across) <= 0.25)

    grid = pm.Grid.box((-2, -2), (5, 5), cell=0.25)
    points = pm.seed(grid, inside, material=rubber)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.Surface.line(corner[1], corner[0], 8), ux=0, uy=0)
    tip = points.farthest(axes[0], tolerance=0.1)
    problem.load(tip, force=-600 * axes[1])
    list(problem.march(6, progress=False))
    return -axes[1] @ points.mean_displacement(tip), points


angles = np.arange(0, 91, 7.5)
found = [deflection(angle) for angle in angles]
fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.8))
plot.plot_points(found[4][1], ax=left)
right.plot(angles, [value for value, _ in found], "o-")
right.set(xlabel="angle (degrees)", ylabel="deflection (m)", ylim=(0, None))
plt.show()
