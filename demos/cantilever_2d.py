"""Plane-strain cantilever under an end force for two bending lengths: the size effect. SI units.

Thesis 3.5.2, paper 4.2. 10 x 1 m, 50 kN shared by the last plane of points, initially perpendicular.
Case (a), l_b = 0.1 m, bends until it carries the load in tension and stiffens; case (b), l_b = 1 m, is much
stiffer and nearly linear.
"""

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

LENGTH, HEIGHT, FORCE = 10.0, 1.0, 50e3  # m, m, N per metre of width
COUPLES = {"a": 100e3, "b": 10e6}  # gamma = beta in N


def material(case):
    return pm.MicropolarElastic(
        lam=10e6 / 3, mu=5e6, kappa=5e6 / 3, alpha=0.0, gamma=COUPLES[case], beta=COUPLES[case]
    )


def build(case, args):
    """The problem, and the points at the free end."""
    grid = pm.Grid.box((0, -12), (16, 4), args.cell)
    points = pm.seed(
        grid,
        bounds=((0, 0), (LENGTH, HEIGHT)),
        material=material(case),
        points_per_cell=args.points_per_cell,
    )
    problem = pm.QuasiStatic(grid, points, basis=args.basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), ux=0, theta=0)  # the root slides vertically ...
    problem.fix(lambda x: np.hypot(x[:, 0], x[:, 1] - HEIGHT / 2) < 1e-6, uy=0)  # ... but for its middle
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, -FORCE))
    return problem, tip


def solve(case, args, folder):
    """One case: the problem, and the path of the tip's mean displacement (steps + 1, 2)."""
    problem, tip = build(case, args)
    points, path = problem.points, [np.zeros(2)]
    with (
        pm.Recorder(
            folder / f"cantilever_{case}.pvd", problem, fields=("displacement", "rotation", "stress")
        ) as record,
        pm.Table(folder / f"cantilever_{case}.csv", tip=lambda: points.mean_displacement(tip)) as table,
    ):
        for step in problem.march(args.steps):
            table.record(step)
            if step.number % 10 == 0 or step.factor == 1.0:
                record(step)
            path.append(points.mean_displacement(tip))
    return problem, np.array(path)


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="cantilever_2d",
        cell=0.5,
        points_per_cell=4,
        steps=50,
        basis="gimpm",
        argv=argv,
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    solved = {case: solve(case, args, folder) for case in COUPLES}
    draw(solved, folder / "cantilever.png")
    result = {"bending_length": [0.1, 1.0]}
    for case, (problem, path) in solved.items():
        result[f"tip_{case}"] = path[-1]
        result[f"iterations_{case}"] = [step.iterations for step in problem.steps]
    return demo.report(args, "cantilever_2d", solved["b"][0], result)


@styled()
def draw(solved, file):
    """Both bent beams coloured by the bending stress, and the load over the tip's deflection."""
    from polarmpm.plot import figures as plot

    comm, curves = solved["a"][0].comm, {}
    figure, axes = plot.subplots(1, 3, figsize=plot.fitted(15, 4.6))
    stresses = {case: problem.fields().stress[:, 0, 0] / 1e6 for case, (problem, _) in solved.items()}
    most = comm.allreduce(max(np.abs(s).max(initial=0.0) for s in stresses.values()), MPI.MAX)
    look = {"limits": (-most, most), "cmap": "coolwarm"}  # one scale for both
    for (case, (problem, path)), ax in zip(solved.items(), axes[:2], strict=True):
        label = "normal stress $\\sigma_{xx}$ (MPa)" if case == "a" else None
        plot.plot_points(problem.points, stresses[case], ax, label=label, **look)
        ax.set_title(f"({case}) bending length {material(case).engineering()['l_b']:g} m")
        ax.set(xlim=(-0.5, 10.5), ylim=(-7.2, 1.5))
        curves[f"({case})"] = (-path[:, 1], np.linspace(0, FORCE / 1e3, len(path)))
    plot.load_displacement(curves, axes[2], xlabel="deflection of the tip (m)", ylabel="end force (kN)")
    plot.save(figure, file, comm=comm)


if __name__ == "__main__":
    main()
