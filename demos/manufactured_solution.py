"""Manufactured solution in the unit cube: orders of convergence of all fields. SI units.

All components of displacement and rotation are sin(2 pi X) sin(2 pi Y) sin(2 pi Z) / 30; UFL derives the body
force and couple that belong to them. Points at the Gauss positions, standard basis, one load step: without
crossings and resets the method is a finite element method, whose orders are known. Thesis 3.5.1, paper 4.1.
"""

import itertools
import math

import numpy as np
import ufl

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo
from polarmpm.study import manufactured

MATERIAL = pm.MicropolarElastic(lam=15e9, mu=10e9, kappa=10e9 / 3, alpha=0.0, gamma=50.0, beta=50.0)  # Pa, N


def field(X):
    """The three equal components of displacement (m) or rotation vector (rad)."""
    wave = ufl.sin(2 * math.pi * X[0]) * ufl.sin(2 * math.pi * X[1]) * ufl.sin(2 * math.pi * X[2]) / 30
    return ufl.as_vector((wave, wave, wave))


def build(cells, args):
    """The problem of one grid, and the exact solution."""
    grid = pm.Grid.box((0, 0, 0), (1, 1, 1), 1 / cells)
    points = pm.seed(grid, material=MATERIAL, points_per_cell=args.points_per_cell, layout="gauss")
    problem = pm.QuasiStatic(grid, points, basis=args.basis, reset=1, balanced_reset=False)
    return problem, impose(problem)


def impose(problem):
    """Hold all walls, put the body force and couple on; returns the exact solution."""
    exact = manufactured.Solution(MATERIAL, field, field, problem.comm)
    for axis in "xyz":
        for wall in (0.0, 1.0):
            problem.fix(pm.plane(**{axis: wall}), u=0, theta=0)
    problem.body_load(
        force=lambda t, X: t * exact.sources(X)[:, :3], couple=lambda t, X: t * exact.sources(X)[:, 3:]
    )
    return exact


def solve(cells, args):
    """One grid: the problem after its load steps, and its errors T (3.187)-(3.188)."""
    problem, exact = build(cells, args)
    for _ in problem.march(args.steps):
        pass
    return problem, exact.errors(problem)


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="manufactured_solution",
        cell=1 / 8,
        points_per_cell=2,
        steps=1,
        basis="mpm",
        argv=argv,
        more={
            "--coarsest": {"type": float, "default": 1 / 4, "help": "first cell size, halved down to --cell"}
        },
    )
    sizes = [round(1 / args.coarsest)]
    while sizes[-1] < round(1 / args.cell):
        sizes.append(2 * sizes[-1])
    errors, histories = [], []
    for cells in sizes:
        problem, found = solve(cells, args)
        errors.append(found)
        histories.append([list(measures) for measures in problem.steps[-1].history])
    orders = {
        name: [math.log2(a[name] / b[name]) for a, b in itertools.pairwise(errors)] for name in errors[0]
    }
    folder = demo.output_folder(args, problem.comm)
    with pm.Recorder(
        folder / "manufactured.pvd", problem, fields=("displacement", "rotation", "stress"), initial=False
    ) as record:
        record(problem.steps[-1])
    draw(sizes, errors, histories, folder / "convergence.png", problem.comm)
    result = {"cells": sizes, "errors": errors, "orders": orders, "history": histories}
    return demo.report(args, "manufactured_solution", problem, result, coarsest=args.coarsest)


@styled()
def draw(sizes, errors, histories, path, comm):
    """Errors over cell size, and the Newton residuals of every grid."""
    from polarmpm.plot import figures as plot

    figure, (left, right) = plot.subplots(1, 2, figsize=plot.fitted(10, 4.2))
    h = 1 / np.array(sizes)
    for name, marker in zip(errors[0], "os^d", strict=True):
        left.loglog(h, [e[name] for e in errors], marker + "-", label=name.replace("_", " "))
    for order, style in ((1, ":"), (2, "--")):
        left.loglog(
            h,
            0.5 * errors[0]["displacement"] * (h / h[0]) ** order,
            "k" + style,
            lw=1,
            label=f"order {order}",
        )
    left.set_xlabel("cell size (m)")
    left.set_ylabel("L1 error (m, rad; stresses relative)")
    left.set_xticks(h, [f"1/{cells}" for cells in sizes])
    left.minorticks_off()
    for cells, history in zip(sizes, histories, strict=True):
        right.semilogy([max(f, 1e-17) for f, _ in history], "o-", label=f"{cells}³ cells")
    right.set_xlabel("iteration")
    right.set_ylabel("normalised out-of-balance force")
    plot.legend_below(figure, columns=5)
    plot.save(figure, path, comm=comm)


if __name__ == "__main__":
    main()
