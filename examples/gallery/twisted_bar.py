"""
A bar twisted by more than a turn
=================================

The far end of a rubber bar turns by one and a quarter turns; its length stays free. Positions in `fix`
are those of the nodes, so that the support turns rigidly about the bar's axis.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

grid = pm.Grid.box((0, -1, -1), (4, 1, 1), cell=0.5)
rubber = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
points = pm.seed(grid, bounds=((0, -0.5, -0.5), (4, 0.5, 0.5)), material=rubber)
problem = pm.QuasiStatic(grid, points, reset=None)
problem.fix(pm.plane(x=0.0), u=0)


def turned(component):
    def displacement(t, x):
        angle = 2.5 * np.pi * t
        c, s = np.cos(angle) - 1, np.sin(angle)
        return c * x[:, 1] - s * x[:, 2] if component == "y" else s * x[:, 1] + c * x[:, 2]

    return displacement


end = problem.fix(pm.plane(x=4.0), uy=turned("y"), uz=turned("z"))
list(problem.march(20, progress=False))
print("torque (N m):", problem.reaction(end, about=(4, 0, 0)).moment)

fig, ax = plt.subplots(figsize=(5, 3), subplot_kw={"projection": "3d"})
plot.plot_points(points, points.displacement[:, 0], label="$u_x$ (m)", undeformed=False, ax=ax)
plt.show()
