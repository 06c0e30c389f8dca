"""Shaft in torsion past a full turn: rotations larger than 2 pi without singularity. SI units.

Thesis 3.5.3, paper 4.3. A shaft of 5 x 1 x 1 m, its root fixed, an end couple in 50 equal steps on the 64
points of the last layer. Both sources print a moment of 8e9 N m, which doesn't fit their moduli: see
`docs/benchmarks.md`.
"""

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

LENGTH, SIDE = 5.0, 1.0  # m
MATERIAL = pm.MicropolarElastic(
    lam=10e6 / 3, mu=5e6, kappa=5e6 / 3, alpha=0.0, gamma=10e6, beta=10e6
)  # Pa, N


def build(args):
    """The problem, and the points of the last layer."""
    grid = pm.Grid.box((0, -1, -1), (8, 1, 1), args.cell)
    bounds = ((0, -SIDE / 2, -SIDE / 2), (LENGTH, SIDE / 2, SIDE / 2))
    points = pm.seed(grid, bounds=bounds, material=MATERIAL, points_per_cell=args.points_per_cell)
    problem = pm.QuasiStatic(grid, points, basis=args.basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest((1, 0, 0))
    problem.load(tip, couple=(args.moment, 0, 0))
    return problem, tip


class Twist:
    """Angle about the axis of every local point, followed step by step so that it doesn't wrap."""

    def __init__(self, problem):
        self.problem = problem
        problem.rows["angle"] = np.zeros(len(problem.points))  # goes with points that move between ranks

    @property
    def angle(self):
        return self.problem.rows["angle"]

    def update(self):
        q = self.problem.points.q
        change = 2 * np.arctan2(q[:, 1], q[:, 0]) - self.angle
        self.problem.rows["angle"] += change - 4 * np.pi * np.round(change / (4 * np.pi))


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="torsion",
        cell=0.25,
        points_per_cell=2,
        steps=50,
        basis="gimpm",
        argv=argv,
        more={"--moment": {"type": float, "default": 3.2e7, "help": "end moment (N m)"}},
    )
    problem, tip = build(args)
    points, twist = problem.points, Twist(problem)
    folder = demo.output_folder(args, problem.comm)
    turns, lengths = [0.0], [LENGTH]
    with (
        pm.Recorder(folder / "shaft.pvd", problem, fields=("displacement", "rotation")) as record,
        pm.Table(
            folder / "shaft.csv",
            turns=lambda: points.mean(twist.angle, tip) / (2 * np.pi),
            tip=lambda: points.mean_displacement(tip),
        ) as table,
    ):
        for step in problem.march(args.steps):
            twist.update()
            table.record(step)
            if step.number % 10 == 0 or step.factor == 1.0:
                record(step)
            turns.append(float(points.mean(twist.angle, tip)) / (2 * np.pi))
            lengths.append(LENGTH + float(points.mean_displacement(tip)[0]))
    draw(problem, twist.angle, turns, args.moment, folder / "shaft.png")
    result = {"turns": turns[-1], "length": lengths[-1], "history": turns}
    return demo.report(args, "torsion", problem, result, moment=args.moment)


@styled()
def draw(problem, angle, turns, moment, file):
    """The twisted shaft, the angle along it, and turns over the moment."""
    from polarmpm.plot import figures as plot

    comm = problem.comm
    figure, grid = plot.subplots(2, 2, figsize=(plot.PAGE, 3.8), solid=[0], width_ratios=(1.3, 1))
    axes = grid[0, 0], grid[0, 1], grid[1, 1]
    axes[0].set_subplotspec(axes[0].get_gridspec()[:, 0])  # the shaft takes both rows
    grid[1, 0].remove()
    along, turned = (plot.gather(comm, a) for a in (problem.points.x[:, 0], angle / (2 * np.pi)))
    if comm.rank == 0:
        axes[1].plot(along, turned, ".", ms=2)
        axes[1].axhline(1.0, color="0.6", lw=1)
        axes[1].set_xlabel("x of the deformed shaft (m)")
        axes[1].set_ylabel("microrotation (turns)")
    plot.plot_points(
        problem.points, angle / (2 * np.pi), axes[0], label="microrotation about the axis (turns)"
    )
    load = np.linspace(0, moment / 1e6, len(turns))
    plot.load_displacement(
        {"_shaft": (turns, load)}, axes[2], xlabel="rotation of the end (turns)", ylabel="moment (MN m)"
    )
    plot.save(figure, file, comm=comm)


if __name__ == "__main__":
    main()
