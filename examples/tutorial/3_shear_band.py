"""
3. A shear band
===============

Sand between rough platens fails along a band. Its width is the material's: half the cells, the same band.
One quarter of a column of 50 x 100 mm is compressed by a tenth.
"""

import math

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

elastic = pm.MicropolarElastic.bounded_stiffness(lam=8e6, mu=8e6, kappa=0.8e6, l_b=2e-3)  # Pa, m
sand = pm.DruckerPrager(
    elastic, phi=math.radians(30), psi=math.radians(10), c=100e3, cone="compression", l_p=2e-3
)

# %%
# A plane of the grid that is `moving` follows the platen, so that the body fills whole cells. Steps are
# `adaptive`: one that doesn't converge is halved.


def compress(cell):
    grid = pm.Grid.box((0, 0), (0.05, 0.05), cell)
    points = pm.seed(grid, bounds=((0, 0), (0.025, 0.05)), material=sand)
    problem = pm.QuasiStatic(grid, points)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    platen = problem.fix(pm.plane(y=0.05, moving=True), ux=0, uy=-0.005)
    curve = [(0.0, 0.0)]
    for step in problem.march(20, adaptive=True, progress=False):
        curve.append((10 * step.factor, -problem.reaction(platen).force[1] / 0.025 / 1e3))
    return points, curve


# %%
# The plastic strain is drawn for the finer grid. The curves of both agree: nothing depends on the mesh.

fig, axes = plt.subplots(1, 2, figsize=(plot.PAGE, 3.2))
for cell in (2.5e-3, 1.25e-3):
    points, curve = compress(cell)
    axes[1].plot(*zip(*curve), label=f"cells of {1e3 * cell:g} mm")
plot.plot_points(
    points, points.hardening, label="plastic strain", length=(1e3, "mm"), undeformed=False, ax=axes[0]
)
axes[1].set(xlabel="shortening (%)", ylabel="mean stress (kPa)")
axes[1].legend()
plt.show()
