"""
Probes, and stress along a line
===============================

A *probe* follows a place of the body through the run. Stresses live at material points; `recover` gives them
at any place, here across a bending bar, beside the straight line of beam theory.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

grid = pm.Grid.box((0, -1), (5, 2), cell=0.25)
rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
points = pm.seed(grid, bounds=((0, 0), (4, 0.6)), material=rubber, points_per_cell=3)
problem = pm.QuasiStatic(grid, points)
problem.fix(pm.plane(x=0.0), u=0)
problem.load(points.farthest((1, 0)), force=(0, -400))

tip = problem.probe("tip", at=(4.0, 0.3), fields=("displacement", "von_mises"))
root = problem.probe("root", at=(0.5, 0.55), fields="von_mises")
for step in problem.march(8, progress=False):
    pass

# %%
# Histories are at hand, and go into tables with `pm.Table("bar.csv", problem)`.

print("last step:", tip.now())

y = np.linspace(0.0, 0.6, 31)
stress = problem.recover("stress", np.column_stack([np.full_like(y, 2.0), y]))[:, 0, 0]
beam = 400 * (4.0 - 2.0) * (y - 0.3) / (0.6**3 / 12)

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.6))
left.plot(tip.factor, -tip["displacement"][:, 1], "o-", label="deflection of the tip (m)")
left.plot(root.factor, root["von_mises"] / 1e5, "s-", label="von Mises at the root (100 kPa)")
left.set_xlabel("load factor (-)")
left.legend()
right.plot(stress / 1e3, y, label="recovered")
right.plot(beam / 1e3, y, "k--", lw=0.8, label="beam theory")
right.set(xlabel="$\\sigma_{xx}$ at x = 2 m (kPa)", ylabel="y (m)")
right.legend()
plt.show()
