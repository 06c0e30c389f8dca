"""A cylinder pressed on a rigid plane: half width and pressure of the contact (Hertz). Metres, Pa.

The lower half of a disc of radius R in plane strain, its right half by symmetry, which is held at its middle
plane and pressed down, on a grid that doesn't know of its outline. The sites of contact are on the arc. With
the
load P per length that the plane bears, Hertz has the half width a = sqrt(4 P R / (pi E*)) and the pressure
p0 = sqrt(P E* / (pi R)). The half width is measured by the second moment of the contact forces, a^2 = 4
<x^2>, the pressure by the forces near the middle over the present lengths of their parts.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

RADIUS, YOUNG, POISSON = 0.1, 1e6, 0.3  # m, Pa
APPROACH = 9.5e-4  # m: of the middle plane
PART = math.radians(15.0)  # of the arc that may touch
STIFF = YOUNG / (1 - POISSON**2)  # E*


def inside(x):
    return np.hypot(x[:, 0], x[:, 1] - RADIUS) < RADIUS


def scene(args):
    """The problem and its plane."""
    h = args.cell
    grid = pm.Grid.box((0, 0), (RADIUS + 2 * h, RADIUS), h)
    material = pm.NeoHookean.from_engineering(E=YOUNG, nu=POISSON)
    points = pm.seed(grid, inside, material=material, points_per_cell=args.points_per_cell)
    problem = pm.QuasiStatic(grid, points, basis=args.basis)
    problem.symmetry(pm.plane(x=0.0))
    problem.fix(pm.plane(y=RADIUS), ux=0, uy=-APPROACH)
    sites = math.ceil(args.sites * RADIUS * PART / h)
    arc = pm.Surface.arc((0.0, RADIUS), RADIUS, sites, start=-math.pi / 2, end=-math.pi / 2 + PART)
    plane = problem.obstacle(pm.HalfSpace((0, 0), (0, 1)), on=arc, gap=args.gap * h if args.gap else None)
    return problem, plane


def measured(plane):
    """Load of both halves (N/m), half width (m), pressure in the middle (Pa), and the pressures at places."""
    force, x = plane.area * plane.traction[:, 1], plane.x[:, 0]
    length = np.gradient(x)  # of the present parts of the arc
    length[0] = x[0] + 0.5 * (x[1] - x[0])
    pressure = force / length
    width = 2.0 * math.sqrt(np.sum(force * x**2) / np.sum(force))
    few = max(2, int(np.sum(x < 0.15 * width)))
    # p0 sqrt(1 - (x/a)^2) in the middle of the parts
    shape = np.sqrt(1 - (x[:few] / width) ** 2)
    return 2 * force.sum(), width, float(np.sum(pressure[:few]) / np.sum(shape)), x, pressure


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="hertz",
        cell=1e-3,
        points_per_cell=2,
        steps=3,
        basis="bspline",
        bases=("bspline", "gimpm", "mpm"),
        argv=argv,
        more={
            "--sites": {"type": demo.count, "default": 2, "help": "of contact in a cell"},
            "--gap": {"type": float, "default": 0.0, "help": "largest gap, in cells; 0: springs alone"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    problem, plane = scene(args)
    with pm.Recorder(folder / "hertz.pvd", problem) as record:
        for step in problem.march(args.steps, progress=False):
            record(step)
    load, width, p0, x, pressure = measured(plane)
    hertz_a, hertz_p = (
        math.sqrt(4 * load * RADIUS / (math.pi * STIFF)),
        math.sqrt(load * STIFF / (math.pi * RADIUS)),
    )
    balance = problem.balance()
    touching = plane.touching
    result = {
        "half_width_error": width / hertz_a - 1,
        "pressure_error": p0 / hertz_p - 1,
        "load": load,
        "half_width": width,
        "pressure": p0,
        "hertz": {"half_width": hertz_a, "pressure": hertz_p},
        "penetration_cells": plane.penetration / args.cell,
        "out_of_balance": balance.residue[0],
        "profile": {"x": x[touching].tolist(), "pressure": pressure[touching].tolist()},
    }
    draw(result, problem, args, folder / "hertz.png")
    return demo.report(args, "hertz", problem, result, sites=args.sites, gap=args.gap)


@styled()
def draw(result, problem, args, file):
    """The pressure over the contact, and the stress beneath it."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.2), width_ratios=(1, 1.15))
    stress = problem.fields("stress").stress
    radius = 4 * result["half_width"]
    s = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    shear = np.sqrt(np.sum(s**2, axis=(1, 2)) / 2) / result["hertz"]["pressure"]
    look = {"label": r"$\sqrt{J_2}\,/\,p_0$ (Hertz)", "length": (1e3, "mm"), "undeformed": False}
    plot.plot_points(problem.points, shear, axes[1], **look)
    if MPI.COMM_WORLD.rank == 0:
        axes[1].set_xlim(0, 1e3 * radius)
        axes[1].set_ylim(-0.2, 1e3 * radius)
        draw_pressure(axes[0], result)
    plot.save(figure, file, comm=MPI.COMM_WORLD)


def draw_pressure(ax, result):
    a, p = result["hertz"]["half_width"], result["hertz"]["pressure"]
    s = np.linspace(0, 1, 200)
    ax.plot(1e3 * a * s, 1e-3 * p * np.sqrt(1 - s**2), color="0.35", lw=1.4, label="Hertz")
    x, pressure = (np.array(result["profile"][name]) for name in ("x", "pressure"))
    ax.plot(1e3 * x, 1e-3 * pressure, "o", ms=4, color="#0072b2", label="sites of contact")
    ax.set_xlabel("distance from the middle (mm)")
    ax.set_ylabel("pressure (kPa)")
    ax.set_xlim(left=0)
    ax.set_ylim(bottom=0)
    finish_curves(ax)


if __name__ == "__main__":
    main()
