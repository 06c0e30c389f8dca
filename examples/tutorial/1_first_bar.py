"""
1. A first bar
==============

A soft bar is clamped at its left end and bends under a force at its free end. SI units throughout.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

# %%
# A *grid* of square cells covers all places that the body will reach. Material points, here two a cell and
# direction, fill the bar. It need not fit the grid: points at its faces stand for the part of their cell
# that is inside.

grid = pm.Grid.box((0, -2.5), (5, 1.5), cell=0.25)
rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
points = pm.seed(grid, bounds=((0, 0), (4, 0.6)), material=rubber, points_per_cell=2)

# %%
# Supports hold the nodes of a plane of the grid; loads act on points. Both grow with the load factor, from
# 0 to 1.

problem = pm.QuasiStatic(grid, points)
clamp = problem.fix(pm.plane(x=0.0), u=0)
tip = points.farthest((1, 0))
problem.load(tip, force=(0, -3e3))

# %%
# `march` takes the steps. Each one is in equilibrium when it comes back; the curve is recorded on the way.

curve = [(0.0, 0.0)]
for step in problem.march(10, progress=False):
    curve.append((-points.mean_displacement(tip)[1], 3e3 * step.factor))

# %%
# The last line tells how far the answer can be trusted; the reaction of the clamp balances the load.

print(problem.trust())
print("reaction (N):", problem.reaction(clamp).force)

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.6), width_ratios=(2, 1))
plot.plot_points(points, points.displacement[:, 1], label="$u_y$ (m)", ax=left)
right.plot(*zip(*curve), "o-")
right.set(xlabel="deflection (m)", ylabel="force (N)")
plt.show()
