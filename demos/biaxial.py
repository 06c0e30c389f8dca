"""Plane-strain compression of a sand column to 20 %: a shear band of the material's own width. SI units.

Thesis 4.5.1. A quarter of a 100 x 50 mm column between rough platens; the grid stretches so that its upper
plane follows the platen. Micropolar Drucker-Prager plasticity without hardening and without any imperfection:
the band comes from the platens. Cells of two sizes and three dilatancies.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

WIDTH, HEIGHT, SHORTENING = 0.025, 0.05, 0.01  # m, of a quarter
MODULUS, LENGTH = 8e6, 2e-3  # Pa, m
COHESION, FRICTION = 100e3, 30.0  # Pa, degrees


def material(dilatancy):
    """The sand with an angle of dilatancy in degrees."""
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=MODULUS, mu=MODULUS, kappa=MODULUS / 10, l_b=LENGTH)
    phi, psi = math.radians(FRICTION), math.radians(dilatancy)
    return pm.DruckerPrager(elastic, phi=phi, psi=psi, c=COHESION, cone="compression", l_p=LENGTH)


def build(cell, dilatancy, args):
    """The problem of a quarter with cells of a size (m), and the support of the platen."""
    grid = pm.Grid.box((0, 0), (0.05, HEIGHT), cell)
    points = pm.seed(
        grid,
        bounds=((0, 0), (WIDTH, HEIGHT)),
        material=material(dilatancy),
        points_per_cell=args.points_per_cell,
    )
    if args.basis == "bspline":  # converges faster, and resets lose nothing
        options = {"reset": pm.WhenDistorted(0.2), "balanced_reset": True}
    else:  # the thesis' way
        options = {"ghost": "thesis", "reset": 1, "balanced_reset": False}
    # as in the thesis, without a cure of locking: it would turn the bands by half a degree
    problem = pm.QuasiStatic(grid, points, basis=args.basis, locking=None, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    platen = problem.fix(pm.plane(y=HEIGHT, moving=True), ux=0, uy=-SHORTENING)
    return problem, platen


def solve(cell, dilatancy, args, folder):
    """One column: its problem and its curve of axial strain and stress (Pa)."""
    problem, platen = build(cell, dilatancy, args)
    name = f"biaxial_{cell * 1e3:g}mm_{dilatancy:g}deg"
    curve = [(0.0, 0.0)]
    fields = ("displacement", "rotation", "wryness", "stress", "hardening")
    with (
        pm.Recorder(folder / f"{name}.pvd", problem, fields=fields) as record,
        pm.Table(
            folder / f"{name}.csv",
            reaction=lambda: problem.reaction(platen)[0],
            work=problem.energies,
        ) as table,
    ):
        for step in problem.march(args.steps, adaptive=True):
            table.record(step)
            if step.number % 10 == 0 or step.factor == 1.0:
                record(step)
            force = problem.reaction(platen)[0][1]
            curve.append((step.factor * SHORTENING / HEIGHT, -force / WIDTH))
    return problem, np.array(curve).T


def band(points):
    """Inclination (degrees) and width (m) of the shear band, from the hardening variable chi.

    The inclination is that of the principal axis of the volume weighted with chi^2. The width is measured
    across the middle of the band, where the mean of chi exceeds a quarter of its maximum there.
    """
    everything = points.comm.allgather((points.x, points.hardening, points.volume))
    x, chi, volume = (np.concatenate(parts) for parts in zip(*everything, strict=True))
    weight = volume * chi**2
    centre = weight @ x / weight.sum()
    along = np.linalg.eigh((x - centre).T @ (weight[:, None] * (x - centre)))[1][:, -1]
    along = along * np.sign(along[0])
    across = np.array([-along[1], along[0]])
    middle = np.abs((x - centre) @ along) < WIDTH / 10
    s, step = (x[middle] - centre) @ across, WIDTH / 25
    cell = np.floor(s / step).astype(int)
    places = np.unique(cell)
    profile = np.array([chi[middle][cell == k].mean() for k in places])
    width = step * np.count_nonzero(profile > 0.25 * profile.max())
    return math.degrees(math.atan2(along[1], along[0])), width


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="biaxial",
        cell=None,
        points_per_cell=3,
        steps=50,
        basis="bspline",
        bases=("bspline", "gimpm", "mpm"),
        argv=argv,
        more={
            "--cells": {"type": float, "nargs": "+", "default": [2.5e-3, 1.25e-3], "help": "cell sizes (m)"},
            "--dilatancies": {"type": float, "nargs": "+", "default": [0.0, 10.0, 20.0], "help": "degrees"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    cases = [(args.cells[0], psi) for psi in args.dilatancies]
    refined = 10.0 if 10.0 in args.dilatancies else args.dilatancies[0]
    cases += [(cell, refined) for cell in args.cells[1:]]
    solved = {case: solve(*case, args, folder) for case in cases}
    draw(solved, folder / "biaxial.png")
    result = {"cell": [cell for cell, _ in cases], "dilatancy": [psi for _, psi in cases]}
    result |= measure(solved.values())
    return demo.report(args, "biaxial", solved[cases[-1]][0], result)


def measure(columns):
    """What is compared with the thesis, a list of each over the columns."""
    names = ("peak", "residual", "rotation", "hardening", "inclination", "width", "iterations")
    rows = []
    for problem, (_, stress) in columns:
        points = problem.points
        most = [np.abs(points.rotation_vector[:, 2]).max(initial=0.0), points.hardening.max(initial=0.0)]
        rotation, hardening = (problem.comm.allreduce(v, op=MPI.MAX) for v in most)
        iterations = sum(step.iterations for step in problem.steps)
        rows.append((stress.max(), stress[-1], rotation, hardening, *band(points), iterations))
    return {name: [float(row[k]) for row in rows] for k, name in enumerate(names)}


@styled()
def draw(solved, file):
    """The band of each column, coloured by chi, and the curves of stress over strain."""
    from polarmpm.plot import figures as plot

    figure, (axes, below) = plot.subplots(2, len(solved), figsize=(plot.PAGE, 4.6), squeeze=False)
    below[0].set_subplotspec(below[0].get_gridspec()[1, :])
    for ax in below[1:]:
        ax.remove()
    curves, last = {}, list(solved)[-1]
    chi = [float(problem.points.hardening.max(initial=0.0)) for problem, _ in solved.values()]
    limits = 0.0, MPI.COMM_WORLD.allreduce(max(chi), op=MPI.MAX)  # one scale for all
    for ax, (case, (problem, curve)) in zip(axes, solved.items(), strict=True):
        cell, psi = case
        name = f"h = {cell * 1e3:g} mm, $\\psi$ = {psi:g}°"
        plot.plot_points(
            problem.points,
            problem.points.hardening,
            ax,
            label="hardening variable $\\chi$ (-)" if case == last else None,
            limits=limits,
            length=(1e3, "mm"),
            undeformed=False,
        )
        ax.set_title(name)
        curves[name] = (100 * curve[0], curve[1] / 1e3)
    plot.load_displacement(curves, below[0], xlabel="axial strain (%)", ylabel="axial stress (kPa)")
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
