"""
4. Points against elements
==========================

The same bar by material points and by finite elements: two lines differ. Both converge to one answer;
which is cheaper depends on the scene.
"""

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np
from dolfinx import mesh

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

material = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.5, l_b=0.1, l_t=0.1, psi=1.0)


def by_points(cell):
    grid = pm.Grid.box((0, -3), (5, 2), cell)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=material)
    return pm.QuasiStatic(grid, points), points


def by_elements(cell):
    box = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (4, 1)], [round(4 / cell), round(1 / cell)], mesh.CellType.quadrilateral
    )
    elements = pm.Elements(box, material=material, degree=2)
    return pm.QuasiStaticFEM(elements), elements.points


def deflection(make, cell):
    problem, body = make(cell)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    end = body.where(lambda x: x[:, 0] > 3.5)
    problem.body_load(force=(0, -1e3))
    list(problem.march(5, progress=False))
    return -body.mean_displacement(end)[1]


# %%
# What is compared is the mean of the last eighth of the bar. Elements have points, too: their places of
# quadrature.

cells = np.array((0.5, 0.25, 0.125))
fig, ax = plt.subplots(figsize=(plot.COLUMN, 2.6))
for make in (by_points, by_elements):
    ax.plot(cells, [deflection(make, cell) for cell in cells], "o-", label=make.__name__.replace("_", " "))
ax.set(xlabel="cell (m)", ylabel="deflection of the end (m)", xlim=(0, None))
ax.legend()
plt.show()
