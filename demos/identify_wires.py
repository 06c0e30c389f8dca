"""Parameters from torques of wires: what elastic wires show, and what plastic ones do. SI units.

Thesis 4.5.2, the other way round: synthetic torques of wires of several diameters, with noise, from which the
parameters are to be found again. Elastic wires are the closed form of Gauthier & Jahsman: however many
diameters there are, they say little of the coupling number n and the polar ratio psi. Plastic ones are
material points between rollers, as in `wire_torsion.py`: strength k, hardening H and plastic length l_p.
"""

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import figures as plot
from polarmpm.study import commandline as demo
from polarmpm.study.exact import twisted_bar

ELASTIC = {"E": 120e9, "n": 0.5, "l_t": 3.7e-6, "psi": 1.2}  # Pa, -, m, -
ELASTIC_START = {"E": 90e9, "n": 0.3, "l_t": 1.9e-6, "psi": 1.0}
RADII = np.array((3.7e-6, 6e-6, 11e-6, 20e-6, 37e-6))  # m
PLASTIC = {"k": 150e6, "H": 75e6, "l_p": 3.7e-6, "l": 3.7e-6, "kappa": 3e9}  # Pa, Pa, m, m, Pa
TIMES = {"k": 1.3, "H": 2.0, "l_p": 0.6, "l": 1.2, "kappa": 0.5}  # of the truth, where the search starts
DIAMETERS = (12.0, 20.0, 40.0)  # micrometres
TWISTS = np.array((0.005, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3, 0.5))  # rad, over a length of one diameter


def bars(p, at):
    """Torsional rigidity over the polar moment of area (Pa) of elastic bars of radii `at`."""
    m = pm.MicropolarElastic.from_engineering(
        E=p["E"], nu=0.3, n=p["n"], l_b=p["l_t"], l_t=p["l_t"], psi=p["psi"]
    )
    ratios = [twisted_bar(radius=r, mu=m.mu, kappa=m.kappa, alpha=m.alpha, gamma=m.gamma) for r in at]
    return {"rigidity": m.mu * np.array(ratios)}


def wire(p, diameter, cells):
    """The problem of a plastic wire between rollers, and its torque over a^3 (Pa). The load factor is the
    twist of the top's microrotation (rad)."""
    share, a = (p["l"] / 3.7e-6) ** 2, diameter / 2
    elastic = pm.MicropolarElastic(
        lam=69e9, mu=46e9, kappa=p["kappa"], alpha=-0.41938 * share, beta=0.0, gamma=0.62974 * share
    )
    cell = diameter / cells
    half = (cells // 2 + 1) * cell
    grid = pm.Grid.box((-half, -half, 0), (half, half, (cells + 2) * cell), cell)
    points = pm.seed(
        grid,
        inside=lambda x: (np.hypot(x[:, 0], x[:, 1]) <= a) & (x[:, 2] <= diameter),
        material=pm.VonMises(elastic, k=p["k"], H=p["H"], l_p=p["l_p"]),
    )
    problem = pm.QuasiStatic(grid, points, basis="mpm", controls=pm.Controls(energy_tolerance=1e-20))
    problem.fix(pm.plane(z=0.0), uz=0, theta_z=0)
    top = problem.fix(pm.plane(z=diameter), uz=0, theta_z=1.0)
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 1e-3 * cell, ux=0, uy=0, theta_x=0, theta_y=0)
    return problem, {"torque": lambda: problem.reaction(top)[1][2] / a**3}


def measured(values, noise, rng):
    """Values with noise, and its standard deviation: a share of each."""
    sigma = noise * np.abs(values)
    return values + sigma * rng.standard_normal(np.shape(values)), sigma


def elastic_fit(args, rng):
    data = measured(bars(ELASTIC, RADII)["rigidity"], args.noise, rng)
    test = pm.Experiment(bars, at=RADII, data={"rigidity": data}, label="elastic wires")
    free = {"E": "log", "n": pm.Bounds(0, 1), "l_t": "log", "psi": pm.Bounds(0, 1.5)}
    return pm.identify(test, start=ELASTIC_START, free=free)


def plastic_fit(args, rng):
    tests = []
    for diameter in 1e-6 * np.array(args.diameters):
        torque = []
        problem, observables = wire(PLASTIC, diameter, args.cells)
        for twist in TWISTS:
            list(problem.march(1, to=twist, adaptive=True, progress=False))
            torque.append(observables["torque"]())
        problem.close()
        data = {"torque": measured(np.array(torque), args.noise, rng)}
        label = f"2a = {1e6 * diameter:g} µm"
        tests.append(
            pm.Experiment(wire, at=TWISTS, data=data, label=label, diameter=diameter, cells=args.cells)
        )
    start = {name: value * (TIMES[name] if name in args.free else 1.0) for name, value in PLASTIC.items()}
    return pm.identify(tests, start=start, free=args.free, workers=args.workers)


def compared(fit, true):
    """Value, truth and standard deviation by name; None where there is none."""
    sd = {name: value if np.isfinite(value) else None for name, value in fit.sd.items()}
    return {n: {"value": v, "true": true[n], "sd": sd[n]} for n, v in fit.values.items()}


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="identify_wires",
        argv=argv,
        more={
            "--noise": {"type": demo.positive, "default": 0.01, "help": "share of each measured value"},
            "--seed": {"type": int, "default": 7, "help": "of the noise"},
            "--cells": {"type": demo.count, "default": 4, "help": "across a wire, an even number"},
            "--diameters": {"type": float, "nargs": "+", "default": DIAMETERS, "help": "micrometres"},
            "--free": {"nargs": "+", "choices": tuple(PLASTIC), "default": ["k", "H", "l_p"]},
            "--workers": {"type": demo.count, "default": 2, "help": "processes, on one rank"},
        },
    )
    # processes have to find this script's functions
    args.workers = args.workers if wire.__module__ == "__main__" and MPI.COMM_WORLD.size == 1 else 1
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    rng = np.random.default_rng(args.seed)
    elastic, plastic = elastic_fit(args, rng), plastic_fit(args, rng)
    if MPI.COMM_WORLD.rank == 0 and not args.json:
        print(f"elastic wires\n{elastic}\n\nplastic wires\n{plastic}\n")
    elastic.save(folder / "elastic.json")
    plastic.save(folder / "plastic.json")
    draw(elastic, plastic, folder / "identify_wires.png")
    problem, _ = wire(plastic.parameters, 1e-6 * args.diameters[0], args.cells)
    with pm.Recorder(folder / "wire.pvd", problem, fields=("displacement", "hardening")) as record:
        for step in problem.march(6, to=TWISTS[-1], adaptive=True, progress=False):
            record(step)
    result = {**compared(elastic, ELASTIC), **compared(plastic, PLASTIC)}
    more = {"result_curve_alone": elastic.unidentifiable}
    return demo.report(
        args, "identify_wires", problem, result, more=more, noise=args.noise, seed=args.seed, cells=args.cells
    )


def draw(elastic, plastic, file):
    """Torques of the plastic wires and of the fit; what goes together in the elastic fit."""
    if MPI.COMM_WORLD.rank:
        plot.save(None, file, comm=MPI.COMM_WORLD)
        return
    axes = plastic.plot_data()
    axes[0].set_xscale("log")
    axes[0].set_xlabel("twist (rad)")
    axes[0].set_ylabel("torque / $a^3$ (Pa)")
    plot.save(axes[0], file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
