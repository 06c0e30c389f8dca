"""Factor of safety of a slope by strength reduction: example 1 of Griffiths and Lane (1999). Metres, Pa.

A slope of 2:1 and 10 m on firm ground, Mohr-Coulomb with phi = 20 degrees, psi = 0 and c = 0.05 gamma H,
E = 1e5 kPa, nu = 0.3, under its weight. c and tan(phi) are divided by a factor until no equilibrium is found,
or the largest displacement is five times the elastic one. D. V. Griffiths, P. A. Lane: Slope stability
analysis by finite elements, Geotechnique 49 (1999), 387-403, find 1.4; charts by Bishop, Morgenstern 1.380.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

HEIGHT, CREST, BASE = 10.0, 12.0, 32.0  # m: of the slope, and widths at its top and foot
WEIGHT, YOUNG, POISSON = 20e3, 1e8, 0.3  # N/m^3, Pa, -
COHESION, FRICTION = 0.05 * WEIGHT * HEIGHT, math.radians(20.0)
CONTROLS = pm.Controls(max_iterations=15)  # where the slope fails more of them lead nowhere
PUBLISHED = {"Griffiths and Lane": 1.4, "Bishop and Morgenstern": 1.380}
# of Griffiths and Lane: E u_max / (gamma H^2) over the factor
THEIRS = ((0.8, 1.0, 1.2, 1.3, 1.35, 1.4), (0.379, 0.381, 0.422, 0.453, 0.544, 1.476))


def soil(factor=1.0):
    elastic = pm.Hencky.from_engineering(E=YOUNG, nu=POISSON)
    return pm.geotechnics.reduced(pm.MohrCoulomb(elastic, phi=FRICTION, psi=0.0, c=COHESION), factor)


def inside(x):
    return x[:, 1] <= HEIGHT * np.minimum(1.0, (BASE - x[:, 0]) / (BASE - CREST))


def problem_of(factor, args):
    grid = pm.Grid.box((0, 0), (BASE + 1, HEIGHT + 1), args.cell)
    points = pm.seed(
        grid,
        inside,
        material=soil(factor),
        points_per_cell=args.points_per_cell,
        bounds=((0, 0), (BASE, HEIGHT)),
    )
    problem = pm.QuasiStatic(grid, points, basis=args.basis, reset=None, controls=CONTROLS)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    problem.body_load(force=(0, -WEIGHT))
    return problem


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="slope",
        cell=0.5,
        points_per_cell=4,
        steps=5,
        basis="bspline",
        bases=("bspline", "gimpm", "mpm"),
        argv=argv,
        more={
            "--low": {"type": demo.positive, "default": 1.2, "help": "factor with which the slope stands"},
            "--high": {"type": demo.positive, "default": 1.5, "help": "factor with which it fails"},
            "--width": {"type": demo.positive, "default": 0.02, "help": "of the bracket"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    found = pm.geotechnics.strength_reduction(
        lambda factor: problem_of(factor, args),
        low=args.low,
        high=args.high,
        width=args.width,
        steps=args.steps,
        smallest=0.5,
    )
    fields = ("displacement", "hardening", "p", "q", "lode_angle")
    for name, problem in (("stands", found.standing), ("fails", found.failed)):
        with pm.Recorder(folder / f"{name}.pvd", problem, fields=fields) as record:
            record(problem.steps[-1])
    draw(found, folder / "slope.png")
    trials = sorted(found.trials, key=lambda trial: trial.factor)
    result = {
        "factor": list(found.factor),
        "published": PUBLISHED,
        "reference": found.reference,
        "limit": found.limit,
        "trials": {f"{t.factor:.4g}": [t.displacement, t.load, t.iterations] for t in trials},
    }
    ends = {name: getattr(args, name) for name in ("low", "high", "width")}
    return demo.report(args, "slope", found.standing, result, **ends)


@styled()
def draw(found, file):
    """Displacement over the factor, and the plastic strain where the slope fails."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(12, 3.9), width_ratios=(1, 1.7))
    problem = found.failed
    values = problem.points.hardening
    cap = problem.comm.allreduce(float(np.quantile(values, 0.995)) if len(values) else 0.0, op=MPI.MAX)
    plot.plot_points(
        problem.points,
        np.minimum(values, cap),
        axes[1],
        label="plastic strain (-)",
        limits=(0.0, cap),
        undeformed=False,
    )
    if MPI.COMM_WORLD.rank == 0:
        found.plot(axes[0], length=(1e3, "mm"))
        scale = 1e3 * WEIGHT * HEIGHT**2 / YOUNG
        axes[0].plot(THEIRS[0], scale * np.array(THEIRS[1]), "k+", ms=8, mew=1.4, label="Griffiths and Lane")
        axes[0].legend(frameon=False, loc="upper left")
        load = next(t.load for t in found.trials if t.factor == found.factor[1])
        axes[1].set_title(
            f"strength divided by {found.factor[1]:.3f}, under {100 * load:.0f} % of the weight"
        )
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
