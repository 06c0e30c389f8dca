"""
A footing on weak ground
========================

Half of a rough strip footing is pressed into cohesive soil. Plastic flow keeps the volume, at which
coarse cells would lock; points see the mean volume of a patch of cells instead. The load levels off near
Prandtl's 5.14 c.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

soil = pm.Tresca(pm.Hencky.from_engineering(E=1e4, nu=0.3), c=1.0)
grid = pm.Grid.box((0, 0), (5, 2.5), cell=0.25)
points = pm.seed(grid, material=soil, points_per_cell=3)
problem = pm.QuasiStatic(grid, points, reset=None)
for x in (0.0, 5.0):
    problem.fix(pm.plane(x=x), ux=0)
problem.fix(pm.plane(y=0.0), u=0)
footing = problem.fix(lambda x: (x[:, 0] < 1.01) & (x[:, 1] > 2.49), ux=0, uy=-0.02)

curve = [(0.0, 0.0)]
for step in problem.march(20, adaptive=True, progress=False):
    curve.append((2 * step.factor, -problem.reaction(footing).force[1]))

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.6), width_ratios=(3, 2))
plot.plot_points(points, 100 * points.hardening, label="plastic strain (%)", undeformed=False, ax=left)
right.plot(*zip(*curve), "o-")
right.axhline(5.14, color="grey", lw=0.8, ls="--")
right.set(xlabel="settlement / half width (%)", ylabel="load / (c half width)")
plt.show()
