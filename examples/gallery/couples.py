"""
A couple at a point
===================

Micropolar bodies take couples: there is a rotation at each point besides the displacement. A block is
turned from within; the rotation spreads as far as the length lets it.
"""

import matplotlib.pyplot as plt

import polarmpm as pm
from polarmpm import plot

plt.style.use(plot.STYLE)


def turn(length):
    solid = pm.MicropolarElastic.from_engineering(E=1e6, nu=0.3, n=0.8, l_b=length, l_t=length, psi=1.0)
    grid = pm.Grid.box((-1.5, -1.5), (1.5, 1.5), cell=0.1)
    points = pm.seed(grid, material=solid)
    problem = pm.QuasiStatic(grid, points)
    for axis in "xy":
        for end in (-1.5, 1.5):
            problem.fix(pm.plane(**{axis: end}), u=0, theta=0)
    problem.body_load(couple=1e5, on=points.where(lambda x: (abs(x) < 0.2).all(axis=1)))
    list(problem.march(5, progress=False))
    return points


fig, axes = plt.subplots(1, 3, figsize=(plot.PAGE, 2.4), sharey=True)
for ax, length in zip(axes, (0.05, 0.2, 0.8)):
    points = turn(length)
    plot.plot_points(points, points.rotation_vector[:, 2], label="rotation (rad)", undeformed=False, ax=ax)
    ax.set_title(f"length {length:g} m")
    ax.label_outer()
plt.show()
