"""Torsion of copper wires of 12 to 170 micrometres: the thinner, the stiffer and stronger. SI units.

Thesis 4.5.2. Cylinders as high as they are wide between rollers; the axial microrotation of the top face is
prescribed, that of the bottom is held, and the wire turns with it as far as the coupling of rotation and
displacement makes it. Micropolar elastoplasticity with the yield function of von Mises. Torques are divided
by a^3, with a the radius: without the length scale (`--length 1e-9`) those of all wires are the same.
"""

from dataclasses import replace

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

DIAMETERS = (12.0, 15.0, 20.0, 30.0, 170.0)  # micrometres
LENGTH = 3.7e-6  # m, characteristic length of torsion, and the plastic length
COPPER = pm.MicropolarElastic(lam=69e9, mu=46e9, kappa=3e9, alpha=-0.41938, beta=0.0, gamma=0.62974)  # Pa, N
STRENGTH, HARDENING = 150e6, 75e6  # Pa
ROTATION = 2.0  # rad, of the top face


def elastic(length):
    """The elastic part with another characteristic length (m)."""
    share = (length / LENGTH) ** 2
    return replace(COPPER, alpha=share * COPPER.alpha, gamma=share * COPPER.gamma)


def material(length=LENGTH):
    return pm.VonMises(elastic(length), k=STRENGTH, H=HARDENING, l_p=length)


def build(diameter, args, solid=None):
    """The problem of a wire (diameter in m), and the support of its top face."""
    solid, radius = solid or material(args.length), diameter / 2
    cell = diameter / args.cells
    half = (args.cells // 2 + 2) * cell
    grid = pm.Grid.box((-half, -half, 0), (half, half, (args.cells + 2) * cell), cell)
    points = pm.seed(
        grid,
        inside=lambda x: (np.hypot(x[:, 0], x[:, 1]) <= radius) & (x[:, 2] <= diameter),
        material=solid,
        points_per_cell=args.points_per_cell,
        cut=False,  # as published
    )
    # forces of 1e-9 relative to those of the step are reached first, whatever the unit of energy
    controls = pm.Controls(energy_tolerance=1e-20)
    # with beta = 0 nothing but kappa stiffens the skew part of the wryness
    ghost = pm.GhostPenalty(0.0, args.ghost * elastic(args.length).gamma) if args.ghost else None
    # as published: resets that let go, and nothing projected
    problem = pm.QuasiStatic(
        grid,
        points,
        basis=args.basis,
        ghost=ghost,
        controls=controls,
        reset=1,
        balanced_reset=False,
        locking=None,
    )
    problem.fix(pm.plane(z=0.0), uz=0, theta_z=0)
    top = problem.fix(pm.plane(z=diameter), uz=0, theta_z=ROTATION)
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 1e-3 * cell, ux=0, uy=0, theta_x=0, theta_y=0)
    return problem, top


def solve(diameter, args, folder):
    """One wire: its problem, and curvature times a, torque over a^3 (Pa) and the largest hardening variable
    of each step."""
    problem, top = build(diameter, args)
    points, name = problem.points, f"wire_{diameter * 1e6:g}"
    rows = [(0.0, 0.0, 0.0)]
    fields = ("displacement", "rotation", "hardening")
    with (
        pm.Recorder(folder / f"{name}.pvd", problem, fields=fields) as record,
        pm.Table(folder / f"{name}.csv", couple=lambda: problem.reaction(top)[1][2]) as table,
    ):
        for step in problem.march(args.steps, adaptive=True, largest=4 / args.steps):
            table.record(step)
            torque = problem.reaction(top)[1][2] / (diameter / 2) ** 3
            hardening = problem.comm.allreduce(points.hardening.max(initial=0.0), op=MPI.MAX)
            # the wire is 2 a long: its curvature is the rotation by 2 a
            rows.append((ROTATION * step.factor / 2, torque, hardening))
            if step.number % 10 == 0 or step.factor == 1.0:
                record(step)
    return problem, dict(zip(("curvature", "torque", "hardening"), np.array(rows).T, strict=True))


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="wire_torsion",
        cell=None,
        points_per_cell=2,
        steps=100,
        basis="mpm",
        argv=argv,
        more={
            "--cells": {"type": int, "default": 4, "help": "across the diameter, an even number"},
            "--ghost": {
                "type": float,
                "default": 0.0,
                "help": "ghost penalty of microrotations, a share of gamma",
            },
            "--length": {"type": float, "default": LENGTH, "help": "characteristic length (m)"},
            "--diameters": {"type": float, "nargs": "+", "default": DIAMETERS, "help": "micrometres"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    solved = {d: solve(d * 1e-6, args, folder) for d in args.diameters}
    draw(solved, folder / "wires.png")
    result = {
        "diameters": list(map(float, args.diameters)),
        "torque": [float(path["torque"][-1]) for _, path in solved.values()],
        "hardening": [float(path["hardening"][-1]) for _, path in solved.values()],
        "steps": [len(problem.steps) for problem, _ in solved.values()],
        "most_iterations": [max(s.iterations for s in problem.steps) for problem, _ in solved.values()],
    }
    last = solved[args.diameters[-1]][0]
    return demo.report(args, "wire_torsion", last, result, cells=args.cells, length=args.length)


@styled()
def draw(solved, file):
    """Normalised torque over normalised curvature of all wires; the thinnest one with its microrotation and
    its hardening variable."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 3, figsize=(plot.PAGE, 2.8), solid=[1, 2])
    curves = {f"2a = {d:g} µm": (path["curvature"], path["torque"] / 1e6) for d, (_, path) in solved.items()}
    plot.load_displacement(
        curves, axes[0], xlabel="twist per length times a (-)", ylabel="torque / $a^3$ (MPa)"
    )
    if MPI.COMM_WORLD.rank == 0:
        plot.legend_below(figure, axes[:1], columns=len(curves))
    thin = min(solved)
    points = solved[thin][0].points
    angle = 2 * np.arctan2(points.q[:, 3], points.q[:, 0])
    views = {"axial microrotation (rad)": angle, "hardening variable $\\chi$ (-)": points.hardening}
    for (label, values), ax in zip(views.items(), axes[1:], strict=True):
        plot.plot_points(points, values, ax, label=label, length=(1e6, "µm"), undeformed=False)
        ax.set_title(f"2a = {thin:g} µm")
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
