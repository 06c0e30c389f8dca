"""What fits are held to: synthetic data of wires, beams and a column, and whether their parameters are found.

    python benchmarks/identification.py [beams] [wires] [plastic] [column] [coverage] [other] [--workers 2]

`beams`: five elastic wires and four beams without noise; `wires`: the wires alone, with noise of 1 %;
`plastic`: five parameters of three plastic wires, from far away; `column`: eight parameters of a softening
column, its curve alone, then with two displacement fields, from two starts; `coverage`: how often intervals
hold the truth; `other`: the same of a beam whose data come from fine elements of degree 2, and whose runs are
of material points of several cells. Each scene prints a line for each of its claims, and goes into
identification.json.
"""

import argparse
import importlib.util
import json
import sys
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

import polarmpm as pm

DEMOS = Path(__file__).parents[1] / "demos"


def _demo(name):
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


wires, columns = _demo("identify_wires"), _demo("identify_column")

TRUE = {"E": 2.6, "n": 0.5, "l_b": 0.3, "l_t": 0.3, "psi": 1.2}  # GPa, -, mm, mm, -
START = {"E": 2.0, "n": 0.3, "l_b": 0.6, "l_t": 0.15, "psi": 1.0}
FREE = {"E": "log", "n": pm.Bounds(0, 1), "l_b": "log", "l_t": "log", "psi": pm.Bounds(0, 1.5)}
RADII, HEIGHTS = (0.3, 0.5, 0.9, 1.6, 3.0), (0.4, 0.8, 1.6, 3.2)  # mm


def elastic(p):
    return pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.3, n=p["n"], l_b=p["l_b"], l_t=p["l_t"], psi=p["psi"]
    )


def wire(p, R, cells=4):
    """An elastic wire as long as its radius, its ends turned; torsional rigidity over the polar moment."""
    turn, cell = 1e-4, 2 * R / cells
    half = (cells // 2 + 1) * cell
    grid = pm.Grid.box((-half, -half, 0), (half, half, R), cell)
    points = pm.seed(grid, inside=lambda x: np.hypot(x[:, 0], x[:, 1]) <= R, material=elastic(p))
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(z=0.0), u=0, theta_z=0)
    top = problem.fix(
        pm.plane(z=R),
        ux=lambda f, X: -turn * f * X[:, 1],
        uy=lambda f, X: turn * f * X[:, 0],
        uz=0,
        theta_z=lambda f, X: turn * f + 0 * X[:, 0],
    )
    return problem, {"rigidity": lambda: problem.reaction(top).moment[2] * R / turn / (np.pi * R**4 / 2)}


def beam(p, h):
    """A cantilever, eight times as long as high; deflection over force."""
    force = 1e-5 * h
    grid = pm.Grid.box((0, -2 * h), (10 * h, 3 * h), h / 2)
    points = pm.seed(grid, bounds=((0, 0), (8 * h, h)), material=elastic(p), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, -force))
    return problem, {"compliance": lambda: -points.mean_displacement(tip)[1] / force}


def once(build, name, **arguments):
    """One observable of the true parameters."""
    problem, observables = build(TRUE, **arguments)
    list(problem.march(1, progress=False))
    return observables[name]()


def elastic_tests(noise, sigma, rng, with_beams):
    scenes = [(wire, "rigidity", {"R": R}) for R in RADII]
    scenes += [(beam, "compliance", {"h": h}) for h in HEIGHTS] if with_beams else []
    tests = []
    for build, name, arguments in scenes:
        y = once(build, name, **arguments)
        data = {name: (y * (1 + noise * rng.standard_normal()), sigma * y)}
        tests.append(pm.Experiment(build, data=data, **arguments))
    return tests


def beams(args):
    fit = pm.identify(
        elastic_tests(0.0, 1e-3, np.random.default_rng(3), True), start=START, free=FREE, workers=args.workers
    )
    error = max(abs(fit.values[n] / TRUE[n] - 1) for n in TRUE)
    print(fit)
    return {"error (1e-4)": error, "evaluations (15)": fit.evaluations}


def wires_alone(args):
    free = {name: kind for name, kind in FREE.items() if name != "l_b"}
    tests = elastic_tests(0.01, 0.01, np.random.default_rng(args.seed), False)
    fit = pm.identify(tests, start=START | {"l_b": 0.3}, free=free, workers=args.workers)
    print(fit)
    return {"not identifiable (n, psi)": fit.unidentifiable, "evaluations": fit.evaluations}


def plastic(args):
    given = argparse.Namespace(
        noise=0.01, cells=4, free=list(wires.PLASTIC), diameters=wires.DIAMETERS, workers=args.workers
    )
    fit = wires.plastic_fit(given, np.random.default_rng(args.seed))
    print(fit)
    z = {n: (fit.values[n] - wires.PLASTIC[n]) / fit.sd[n] for n in fit.names}
    return {"z (3)": z, "evaluations": fit.evaluations, "chi2/dof": fit.chi2 / fit.dof}


def column(args):
    given = argparse.Namespace(cell=args.cell, noise=1.0, seed=11, most=6, workers=args.workers)
    alone, both = columns.fits(given)
    print(alone, both, sep="\n")
    stress, fields = columns.synthetic(given)
    data = {"stress": (stress, columns.STRESS), "field": (fields, columns.CAMERA, columns.SEEN)}
    test = pm.Experiment(columns.column, at=columns.AT, data=data, cell=args.cell, places=columns.side())
    times = dict(zip(columns.TRUE, (0.8, 0.6, 1.5, 1.1, 0.8, 0.8, 0.6, 1.5), strict=True))
    start = {n: times[n] * v for n, v in columns.TRUE.items()}
    other = pm.identify(test, start=start, free=list(columns.TRUE), workers=args.workers)
    apart = max(abs(other.values[n] - both.values[n]) / both.sd[n] for n in both.names)
    return {
        "curve alone, not identifiable (all but mu)": alone.unidentifiable,
        "evaluations of two starts (10)": [both.evaluations, other.evaluations],
        "minima apart (0.1 sd)": apart,
        "z": {n: (both.values[n] - columns.TRUE[n]) / both.sd[n] for n in both.names},
    }


def coverage(args):
    """Curve and fields of a column, from the truth, with new noise each time."""
    given = argparse.Namespace(cell=args.cell, noise=args.noise, seed=0)
    clean = columns.synthetic(argparse.Namespace(**{**vars(given), "noise": 0.0}))
    sigmas = columns.STRESS * given.noise, columns.CAMERA * given.noise
    inside, z = [], []
    for seed in range(args.realisations):
        rng = np.random.default_rng(seed)
        noisy = [y + s * rng.standard_normal(y.shape) for y, s in zip(clean, sigmas, strict=True)]
        data = {"stress": (noisy[0], sigmas[0]), "field": (noisy[1], sigmas[1], columns.SEEN)}
        test = pm.Experiment(columns.column, at=columns.AT, data=data, cell=args.cell, places=columns.side())
        fit = pm.identify(test, start=columns.TRUE, free=list(columns.TRUE), workers=args.workers)
        ends = fit.intervals()
        inside += [ends[n][0] < columns.TRUE[n] < ends[n][1] for n in fit.names]
        z += [(fit.values[n] - columns.TRUE[n]) / fit.sd[n] for n in fit.names]
        print(seed, np.mean(inside), np.sqrt(np.mean(np.square(z))), fit.evaluations, flush=True)
    return {"coverage (.90-.99)": np.mean(inside), "rms z (.85-1.15)": np.sqrt(np.mean(np.square(z)))}


STRIP = {"mu": 2e3, "kappa": 700.0, "l": 0.15}  # Pa, Pa, m
SEEN = np.stack(np.meshgrid(np.linspace(0.4, 3.6, 9), np.linspace(0.2, 0.8, 4)), axis=-1).reshape(-1, 2)


def strip_material(p):
    return pm.MicropolarElastic(
        lam=3e3, mu=p["mu"], kappa=p["kappa"], alpha=0.0, beta=0.0, gamma=4 * STRIP["mu"] * p["l"] ** 2
    )


def strip(p, cell):
    """A micropolar cantilever of 4 m x 1 m under its weight, of material points, as a camera sees it."""
    grid = pm.Grid.box((0, -3), (6, 3), cell)
    points = pm.seed(grid, bounds=((0, 0), (4, 1)), material=strip_material(p))
    problem = pm.QuasiStatic(grid, points)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0, -20.0))
    return problem, {"field": pm.Places(points, SEEN).displacement}


def fine_strip(p, cells=(64, 16)):
    """The same of elements of degree 2."""
    corners = [(0.0, 0.0), (4.0, 1.0)]
    body = mesh.create_rectangle(MPI.COMM_SELF, corners, list(cells), mesh.CellType.quadrilateral)
    problem = pm.QuasiStaticFEM(pm.Elements(body, material=strip_material(p), degree=2))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.body_load(force=(0, -20.0))
    return problem, {"field": pm.Places(problem.elements, SEEN).displacement}


def other(args):
    """Data of fine elements; a camera's noise of 1e-3 of the deflection."""
    problem, see = fine_strip(STRIP)
    list(problem.march(2, progress=False))
    clean = see["field"]()
    sigma = 1e-3 * np.abs(clean).max()
    found = {}
    for cell in (0.5, 0.25, 0.125):
        inside, z, chi2 = [], [], []
        for seed in range(args.realisations):
            noisy = clean + sigma * np.random.default_rng(seed).standard_normal(clean.shape)
            test = pm.Experiment(strip, data={"field": (noisy, sigma)}, cell=cell, march={"steps": 2})
            fit = pm.identify(test, start=STRIP, free=list(STRIP))
            ends = fit.intervals()
            inside += [ends[n][0] < STRIP[n] < ends[n][1] for n in fit.names]
            z.append([(fit.values[n] - STRIP[n]) / fit.sd[n] for n in fit.names])
            chi2.append(fit.chi2 / fit.dof)
        found[cell] = {
            "coverage": np.mean(inside),
            "mean z": dict(zip(fit.names, np.mean(z, axis=0), strict=True)),
            "sd": fit.relative_sd,
            "chi2/dof": np.mean(chi2),
        }
        print(cell, found[cell], flush=True)
    return found


SCENES = {
    "beams": beams,
    "wires": wires_alone,
    "plastic": plastic,
    "column": column,
    "coverage": coverage,
    "other": other,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=3, help="of the noise")
    parser.add_argument("--cell", type=float, default=2.5e-3, help="of the column (m)")
    parser.add_argument("--noise", type=float, default=0.3, help="of the realisations, as of the demo")
    parser.add_argument("--realisations", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args()
    file = args.output / "identification.json"
    found = json.loads(file.read_text()) if file.exists() else {}
    for name in args.scenes:
        begin = time.perf_counter()
        found[name] = SCENES[name](args)
        print(name, found[name], f"{time.perf_counter() - begin:.0f} s", flush=True)
        file.write_text(json.dumps(found, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()
