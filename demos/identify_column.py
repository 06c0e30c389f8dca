"""All parameters of a micropolar soil from one column, compressed until it softens. SI units.

A column of a micropolar Drucker-Prager material between rough platens, plane strain; synthetic data with
noise.
Its load curve alone shows nothing but the shear modulus: a length, a strength and its softening trade places
freely. The displacements of its side at two load factors, as digital image correlation sees them, show all
the
eight: moduli mu and kappa, lengths l_b and l_p, friction phi, dilatancy psi, cohesion c and softening H.
"""

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import figures as plot
from polarmpm.study import commandline as demo

TRUE = {
    **{"mu": 8e6, "kappa": 8e5, "l_b": 2e-3},  # Pa, Pa, m
    **{"phi": 0.5236, "psi": 0.1745, "c": 100e3, "H": -1e5, "l_p": 2e-3},  # rad, rad, Pa, Pa, m
}
TIMES = dict(zip(TRUE, (1.3, 2.0, 0.6, 0.85, 1.3, 1.3, 2.0, 0.6), strict=True))  # where the search starts
WIDTH, HEIGHT, SHORTENING = 0.025, 0.05, 0.005  # m; half of the column
AT = np.array((0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0))
SEEN = (0.5, 1.0)  # load factors at which the side is photographed
STRESS, CAMERA = 8e3, 1e-5  # Pa, m: standard deviations


def column(p, cell, places):
    """The problem of a column, its mean stress (Pa), and displacements (m) at `places` of its side."""
    elastic = pm.MicropolarElastic.bounded_stiffness(lam=8e6, mu=p["mu"], kappa=p["kappa"], l_b=p["l_b"])
    soil = pm.DruckerPrager(
        elastic, phi=p["phi"], psi=p["psi"], c=p["c"], H=p["H"], l_p=p["l_p"], cone="compression"
    )
    grid = pm.Grid.box((0, 0), (2 * WIDTH, HEIGHT), cell)
    points = pm.seed(grid, bounds=((0, 0), (WIDTH, HEIGHT)), material=soil)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    top = problem.fix(pm.plane(y=HEIGHT, moving=True), ux=0, uy=-SHORTENING)
    seen = pm.Places(points, places)
    return problem, {
        "stress": lambda: -problem.reaction(top).force[1] / WIDTH,
        "field": seen.displacement,
    }


def side():
    """Places (n, 2) of the side, as of an image."""
    x, y = np.meshgrid(np.linspace(0.06, 0.94, 7) * WIDTH, np.linspace(0.03, 0.97, 14) * HEIGHT)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def synthetic(args):
    """Stresses and fields of the true parameters, with noise; None instead of fields where there are none."""
    problem, see = column(TRUE, args.cell, side())
    stress, fields = [], []
    for factor in AT:
        list(problem.march(1, to=factor, adaptive=True, progress=False))
        stress.append(see["stress"]())
        if factor in SEEN:
            fields.append(see["field"]())
    problem.close()
    rng = np.random.default_rng(args.seed)
    stress = np.array(stress) + STRESS * args.noise * rng.standard_normal(len(stress))
    fields = np.array(fields) + CAMERA * args.noise * rng.standard_normal(np.shape(fields))
    return stress, fields


def fits(args):
    """From the curve alone, and from curve and fields."""
    stress, fields = synthetic(args)
    curve = {"stress": (stress, STRESS * args.noise)}
    camera = {"field": (fields, CAMERA * args.noise, SEEN)}
    given = {"at": AT, "cell": args.cell, "places": side()}
    start = {name: TIMES[name] * value for name, value in TRUE.items()}
    options = {"start": start, "free": list(TRUE), "workers": args.workers}
    alone = pm.identify(pm.Experiment(column, data=curve, **given), most=args.most, **options)
    both = pm.identify(pm.Experiment(column, data=curve | camera, **given), **options)
    return alone, both


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="identify_column",
        argv=argv,
        more={
            "--cell": {"type": demo.positive, "default": 2.5e-3, "help": "m"},
            "--noise": {"type": demo.positive, "default": 1.0, "help": f"1: {STRESS:g} Pa and {CAMERA:g} m"},
            "--seed": {"type": int, "default": 11, "help": "of the noise"},
            "--most": {"type": demo.count, "default": 6, "help": "evaluations for the curve alone"},
            "--workers": {"type": demo.count, "default": 2, "help": "processes, on one rank"},
        },
    )
    # processes have to find this script's functions
    args.workers = args.workers if column.__module__ == "__main__" and MPI.COMM_WORLD.size == 1 else 1
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    alone, both = fits(args)
    if MPI.COMM_WORLD.rank == 0 and not args.json:
        print(f"curve alone\n{alone}\n\ncurve and fields\n{both}\n")
    alone.save(folder / "curve_alone.json")
    both.save(folder / "curve_and_fields.json")
    draw(both, folder / "identify_column.png")
    problem, _ = column(both.parameters, args.cell, side())
    with pm.Recorder(folder / "column.pvd", problem, fields=("displacement", "hardening")) as record:
        for step in problem.march(10, adaptive=True, progress=False):
            record(step)
    sd = {name: value if np.isfinite(value) else None for name, value in both.sd.items()}
    result = {n: {"value": v, "true": TRUE[n], "sd": sd[n]} for n, v in both.values.items()}
    more = {"result_curve_alone": alone.unidentifiable}
    return demo.report(
        args, "identify_column", problem, result, more=more, cell=args.cell, noise=args.noise, seed=args.seed
    )


def draw(fit, file):
    """Data and fit, and what goes together."""
    if MPI.COMM_WORLD.rank:
        plot.save(None, file, comm=MPI.COMM_WORLD)
        return
    axes = fit.plot_data()
    axes[0].set_xlabel("load factor (-)")
    axes[0].set_ylabel("mean stress (Pa)")
    axes[1].set_xlabel("displacement (m), measured")
    plot.save(axes[0], file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
