"""Curved cantilever: an arch of 45 degrees bends out of its plane under an end force. SI units.

Thesis 3.5.4, paper 4.4. The grid is seeded with standard material points and those outside the arch are
discarded;
the force goes to the plane of points farthest along (1, -1, 0), and their mean displacement is compared with
the classical beam solution. The arch's centre of curvature lies at (0, `--centre`), its section in the
plane z starts at `--bottom`; the published position in the grid isn't known, and it matters on coarse grids.
"""

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.study import commandline as demo

RADIUS, SIDE, ANGLE = 100.0, 1.0, np.pi / 4  # m, m, rad
FORCE = 600.0  # N
BEAM = np.array((-23.30, 13.64, 53.21))  # m, classical beam theory

MATERIAL = pm.MicropolarElastic(lam=0.0, mu=5e6, kappa=50505.1, alpha=0.0, gamma=12.5e3, beta=37.5e3)  # Pa, N


class Arch:
    """Predicate of the arch, for `pm.seed`."""

    def __init__(self, centre, bottom):
        self.centre, self.bottom = centre, bottom
        top = centre + RADIUS + SIDE / 2
        low = centre + (RADIUS - SIDE / 2) * np.cos(ANGLE)
        self.bounds = ((0, low, bottom), ((RADIUS + SIDE / 2) * np.sin(ANGLE), top, bottom + SIDE))

    def __call__(self, x):
        across, along = x[:, 0], x[:, 1] - self.centre
        radius, angle = np.hypot(across, along), np.arctan2(across, along)
        in_section = (np.abs(radius - RADIUS) <= SIDE / 2) & (
            np.abs(x[:, 2] - self.bottom - SIDE / 2) <= SIDE / 2
        )
        return in_section & (angle >= 0) & (angle <= ANGLE)


def build(args):
    """The problem, and the points at the free end."""
    grid = pm.Grid.box((0, -40, -8), (80, 40, 64), args.cell)
    points = pm.seed(
        grid,
        Arch(args.centre, args.bottom),
        material=MATERIAL,
        points_per_cell=args.points_per_cell,
        cut=False,  # as published
    )
    problem = pm.QuasiStatic(grid, points, basis=args.basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    tip = points.farthest((1, -1, 0))
    problem.load(tip, force=(0, 0, FORCE))
    return problem, tip


def main(argv=None):
    args = demo.arguments(
        __doc__.splitlines()[0],
        output="curved_cantilever",
        cell=1.0,
        points_per_cell=4,
        steps=15,
        basis="mpm",
        argv=argv,
        more={
            "--centre": {"type": float, "default": -100.0, "help": "y of the centre of curvature (m)"},
            "--bottom": {"type": float, "default": 0.0, "help": "lowest z of the section (m)"},
            **demo.MOVIE,
        },
    )
    problem, tip = build(args)
    points = problem.points
    folder = demo.output_folder(args, problem.comm)
    path = [np.zeros(3)]
    with (
        pm.Recorder(folder / "arch.pvd", problem, fields=("displacement", "rotation"), grid=True) as record,
        pm.Table(folder / "arch.csv", tip=lambda: points.mean_displacement(tip)) as table,
        demo.film(args, folder / "arch.gif", problem, "displacement", "z") as film,
    ):
        for step in problem.march(args.steps):
            record(step)
            film.record(step)
            table.record(step)
            path.append(points.mean_displacement(tip))
    draw(problem, np.array(path), folder / "arch.png")
    found = path[-1]
    result = {"displacement": found, "reference": BEAM, "error": float(np.linalg.norm(found - BEAM))}
    return demo.report(args, "curved_cantilever", problem, result, centre=args.centre, bottom=args.bottom)


@styled()
def draw(problem, path, file):
    """The bent arch coloured by u_z, and the end's path with the beam solution."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(11, 4.6), solid=[0])
    plot.plot_points(problem.points, problem.points.displacement[:, 2], axes[0], label="$u_z$ (m)")
    force = np.linspace(0, FORCE, len(path))
    curves = {f"$u_{c}$": (path[:, i], force) for i, c in enumerate("xyz")}
    beam = {"classical beam": (BEAM, np.full(3, FORCE))}
    plot.load_displacement(curves, axes[1], reference=beam, xlabel="end displacement (m)", ylabel="force (N)")
    plot.save(figure, file, comm=problem.comm)


if __name__ == "__main__":
    main()
