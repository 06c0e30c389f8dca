"""Waves in a micropolar solid: frequencies over wave numbers, against the dispersion relation. SI units.

Half a standing transverse wave in a strip between two walls, on which nothing turns; displacements across
the strip and microrotations swing together. Below the cut-off frequency sqrt(4 kappa / (rho j)) there is one
such wave for each wave number, above it another one. Points on splines, and elements of degree 2; for each
the frequency is that of the motion's mode, step by step, freed from the shift of the method in time.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo
from polarmpm.study.exact import micropolar_waves

MU, KAPPA, LENGTH = 4e9, 4e8, 5e-3  # Pa, Pa, m
DENSITY, MICROINERTIA = 2000.0, LENGTH**2  # kg/m^3, m^2
MATERIAL = pm.MicropolarElastic.bounded_stiffness(lam=4e9, mu=MU, kappa=KAPPA, l_b=LENGTH)
BRANCHES = ("acoustic", "optical")


def exact(k):
    """Frequencies (rad/s), and microrotations over displacements (1/m), of both waves."""
    stiffness = MATERIAL.gamma + MATERIAL.beta
    return micropolar_waves(k, mu=MU, kappa=KAPPA, stiffness=stiffness, rho=DENSITY, j=MICROINERTIA)


def build(k, method, args):
    """Half a wave, at rest."""
    length, n = math.pi / k, args.cells
    inertia = {"density": DENSITY, "microinertia": MICROINERTIA, "rho_inf": args.rho_inf}
    if method == "elements":
        from dolfinx import mesh

        corners = [np.zeros(2), np.array([length, length / n])]
        body = mesh.create_rectangle(MPI.COMM_WORLD, corners, [n, 1], mesh.CellType.quadrilateral)
        elements = pm.Elements(body, material=MATERIAL, degree=2)
        problem = pm.DynamicFEM(elements, **inertia)
    else:
        grid = pm.Grid.box((0, 0), (length, length / n), length / n)
        # Gauss points, which integrate the modes exactly, stand for themselves, without boxes
        seeding = {"points_per_cell": args.points_per_cell, "layout": "gauss"}
        points = pm.seed(grid, material=MATERIAL, **seeding)
        options = {"basis": args.basis, "reset": args.reset or None, "boxes": False}
        problem = pm.Dynamic(grid, points, **options, **inertia)
    for x in (0.0, length):
        problem.fix(pm.plane(x=x), ux=0, theta=0)
    for y in (0.0, length / n):
        problem.fix(pm.plane(y=y), ux=0)
    return problem


def swing(k, branch, method, args):
    """A wave's frequency (rad/s), free from the method's shift, the change of its energy, and the problem."""
    omega, ratio = (values[branch] for values in exact(k))
    problem = build(k, method, args)
    points = problem.points
    size = 1e-7 / k  # small, as the closed form is that of small motions

    def v(x):
        return np.column_stack([0 * x[:, 0], size * omega * np.cos(k * x[:, 0])])

    problem.velocity(v=v, spin=lambda x: size * omega * ratio * np.sin(k * x[:, 0]))
    begin, period, mode, wave = problem.energies()["kinetic"], 2 * math.pi / omega, [0.0], []

    def measure():
        share = points.volume0 * np.cos(k * points.X[:, 0])
        return problem.comm.allreduce(float(share @ points.displacement[:, 1]))

    for _ in problem.march(args.periods * period, steps=round(args.periods * args.steps), progress=False):
        mode.append(measure())
        wave.append(problem.energies())
    q = np.array(mode)
    # q[i + 1] + q[i - 1] = 2 cos(w dt) q[i] of a motion of one frequency
    cosine = 0.5 * (q[1:-1] @ (q[2:] + q[:-2])) / (q[1:-1] @ q[1:-1])
    dt = period / args.steps
    found = 2.0 / dt * math.tan(0.5 * math.acos(cosine))
    energy = (wave[-1]["kinetic"] + wave[-1]["stored"]) / begin - 1.0
    return found, energy, problem


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="waves",
        cell=None,
        points_per_cell=3,
        steps=60,
        basis="bspline",
        argv=argv,
        more={
            "--cells": {"type": int, "default": 12, "help": "in half a wave"},
            "--numbers": {"type": float, "nargs": "+", "default": [50, 100, 200, 400], "help": "k (1/m)"},
            "--periods": {"type": float, "default": 2, "help": "of each wave; --steps are those of one"},
            "--reset": {"type": int, "default": 0, "help": "of the grid, after so many steps; 0: never"},
            "--rho-inf": {"type": float, "default": 1.0, "help": "1: the midpoint rule"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    rows, problem = [], None
    for method in ("points", "elements"):
        for k in args.numbers:
            for branch, name in enumerate(BRANCHES):
                found, energy, problem = swing(k, branch, method, args)
                omega = float(exact(k)[0][branch])
                rows.append(
                    {
                        "method": method,
                        "wave": name,
                        "k": k,
                        "omega": found,
                        "exact": omega,
                        "error": found / omega - 1.0,
                        "energy": energy,
                    }
                )
    fields = ("displacement", "rotation", "velocity")
    with pm.Recorder(folder / "wave.pvd", problem, fields=fields) as record:
        record(problem.steps[-1])
    draw(rows, folder / "waves.png")
    result = {
        "waves": rows,
        "error": max(abs(row["error"]) for row in rows),
        "energy_error": max(abs(row["energy"]) for row in rows),
    }
    return demo.report(args, "waves", problem, result)


@styled()
def draw(rows, file):
    """Frequencies over wave numbers."""
    from polarmpm.plot import figures as plot

    figure, ax = plot.subplots(1, 1, figsize=plot.fitted(6, 4.2))
    if ax is not None:
        k = np.linspace(1.0, 1.05 * max(row["k"] for row in rows), 200)
        branches = np.array([exact(one)[0] for one in k])
        for branch, name in enumerate(BRANCHES):
            ax.plot(k, branches[:, branch] / 1e3, color=f"C{branch}", label=f"{name}, closed form")
        for method, marker in (("points", "o"), ("elements", "x")):
            some = [row for row in rows if row["method"] == method]
            ax.plot(
                [row["k"] for row in some],
                [row["omega"] / 1e3 for row in some],
                "k" + marker,
                label=method,
                mfc="none",
            )
        cut_off = math.sqrt(4 * KAPPA / (DENSITY * MICROINERTIA))
        ax.axhline(cut_off / 1e3, color="0.4", lw=1, ls=":", label="cut-off")
        ax.set_xlabel("wave number (1/m)")
        ax.set_ylabel("frequency (krad/s)")
        ax.legend()
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
