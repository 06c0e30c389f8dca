"""
A wave in a bar
===============

A bar flies against a wall at 1 m/s, without a rotation or a spring anywhere: a front of pressure runs to
its free end, is thrown back as tension, and the bar rebounds.
"""

import matplotlib.pyplot as plt
import numpy as np

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)
E, DENSITY, LENGTH = 1e9, 1000.0, 1.0  # Pa, kg/m^3, m: waves run at 1000 m/s
grid = pm.Grid.box((0, 0), (1.5, 0.05), cell=(0.0125, 0.05))
points = pm.seed(grid, bounds=((0, 0), (LENGTH, 0.05)), material=pm.Hencky.from_engineering(E=E, nu=0.0))
problem = pm.Dynamic(grid, points, density=DENSITY)
wall = problem.fix(pm.plane(x=0.0), ux=0)
for y in (0.0, 0.05):
    problem.fix(pm.plane(y=y), uy=0)
problem.velocity(points.where(lambda x: x[:, 0] > -1), v=(-1.0, 0.0))

times, forces, profiles = [], [], {}
for step in problem.march(2e-3, steps=200, progress=False):
    times.append(1e3 * step.time)
    forces.append(problem.reaction(wall).force[0] / 0.05 / 1e6)
    if step.number in (50, 150):
        profiles[1e3 * step.time] = points.velocity[:, 0].copy()

fig, (left, right) = plt.subplots(1, 2, figsize=(plot.PAGE, 2.4))
order = np.argsort(points.X[:, 0])
for time, velocity in profiles.items():
    left.plot(points.X[order, 0], velocity[order], label=f"{time:.2g} ms")
left.set(xlabel="X (m)", ylabel="velocity (m/s)")
left.legend()
right.plot(times, forces)
right.axhline(1.0, color="grey", lw=0.8, ls="--")  # rho c v
right.set(xlabel="time (ms)", ylabel="pressure on the wall (MPa)")
plt.show()
