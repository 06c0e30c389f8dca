"""
A block between rolls
=====================

A rigid cylinder is pushed into a soft block and drawn along it, with friction. Obstacles are level sets:
the grid knows nothing of them.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)
grid = pm.Grid.box((-3, 0), (3, 1.5), cell=0.0625)
points = pm.seed(grid, bounds=((-2, 0), (2, 1)), material=pm.NeoHookean.from_engineering(E=1e6, nu=0.3))
problem = pm.QuasiStatic(grid, points)
problem.fix(pm.plane(y=0.0), u=0)
roll = problem.obstacle(
    pm.Sphere((-0.8, 1.5), 0.5), friction=0.3, motion=lambda t: (1.6 * max(t - 1, 0), -0.15 * min(t, 1))
)

ways, forces = [], []
for step in problem.march(30, to=2.0, adaptive=True, progress=False):
    ways.append(step.factor)
    forces.append(roll.force / 1e3)

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.4), width_ratios=(3, 2))
plot.plot_points(points, points.displacement[:, 0], label="$u_x$ (m)", undeformed=False, ax=left)
left.add_patch(plt.Circle((0.8, 1.35), 0.5, color="0.8"))
right.plot(ways, [-f[1] for f in forces], "o-", label="across")
right.plot(ways, [-f[0] for f in forces], "o-", label="along")
right.set(xlabel="load factor", ylabel="force of the roll (kN)")
right.legend()
plt.show()
