"""
2. A plate with a hole, and a length
====================================

A hole concentrates stress: three times the mean in a classical plate, however small the hole is. A
micropolar material has a length of its own, and small holes weaken it less. A quarter of the plate is
computed.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)

RADIUS, WIDTH, STRESS = 1.0, 8.0, 1e3  # m, m, Pa


def concentration(length):
    """The largest stress over the mean one, for a bending length (m), and the problem."""
    material = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.7, l_b=length, l_t=length, psi=1.0)
    grid = pm.Grid.box((0, 0), (WIDTH + 1, WIDTH + 1), cell=0.25)
    points = pm.seed(
        grid,
        lambda x: np.linalg.norm(x, axis=1) >= RADIUS,
        bounds=((0, 0), (WIDTH, WIDTH)),
        material=material,
    )
    problem = pm.QuasiStatic(grid, points, basis="bspline")
    problem.symmetry(pm.plane(x=0.0))
    problem.symmetry(pm.plane(y=0.0))
    problem.traction(pm.Surface.line((0, WIDTH), (WIDTH, WIDTH), 64), force=(0, STRESS))
    list(problem.march(1, progress=False))
    stress = problem.fields("stress").stress[:, 1, 1]
    return stress.max() / STRESS, problem


# %%
# `fields` evaluates stresses at the points. The factor falls as the length approaches the hole's radius.

lengths = np.array((0.02, 0.1, 0.2, 0.5, 1.0))
factors = [concentration(length)[0] for length in lengths]
_, problem = concentration(0.1)

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 3))
plot.plot_points(
    problem.points, problem.fields("stress").stress[:, 1, 1] / STRESS, label="stress / mean", ax=left
)
right.semilogx(lengths / RADIUS, factors, "o-")
right.set(xlabel="bending length / radius", ylabel="largest stress / mean")
plt.show()
