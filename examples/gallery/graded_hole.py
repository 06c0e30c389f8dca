"""
Cells where they matter
=======================

Around a hole strains change fast, far away hardly. Lines of the grid that grow from the hole save most of
the unknowns.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)
SIZE = 10.0  # of the plate over the hole's radius
rock = pm.Hencky.from_engineering(E=1e9, nu=0.25)


def pulled(grid):
    points = pm.seed(
        grid, lambda x: np.linalg.norm(x, axis=1) >= 1, bounds=((0, 0), (SIZE, SIZE)), material=rock
    )
    problem = pm.QuasiStatic(grid, points, reset=None)
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    problem.traction(pm.Surface.line((0, SIZE), (SIZE, SIZE), 200), force=(0, 1e3))
    list(problem.march(1, progress=False))
    near = np.linalg.norm(points.X, axis=1) < 3
    return problem, problem.fields("stress").stress[:, 1, 1] / 1e3, near


lines = pm.lines(0, SIZE, fine=0.1, where=(0, 1.5), growth=1.2)
graded, stress, near = pulled(pm.Grid.graded(x=lines, y=lines))
equal, expected, _ = pulled(pm.Grid.box((0, 0), (SIZE, SIZE), cell=0.1))
print(f"unknowns {graded.unknowns} and {equal.unknowns}")

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 3))
plot.plot_grid(graded.grid, ax=left)
for problem, values, label, line in ((equal, expected, "equal cells", "-"), (graded, stress, "graded", "--")):
    X = problem.points.X
    row = (X[:, 1] < 0.06) & (X[:, 0] < 5)
    order = np.argsort(X[row, 0])
    right.plot(X[row, 0][order], values[row][order], line, label=label)
right.set(xlabel="distance from the centre / radius", ylabel="stress / far stress")
right.legend()
plt.show()
