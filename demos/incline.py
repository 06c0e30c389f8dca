"""A disc rolls and slips down an incline, and a block slides: friction against closed forms. Metres, Pa.

The incline is the line y = 0, gravity is turned instead. A disc (R = 0.5, E = 200 MPa, rho = 7800, 60
degrees) rolls for friction 0.9, g sin(a) t^2 / 3; slips and rolls for 0.3; and slides without turning for 0.
A block (1 x
0.5, E = 1 MPa, rho = 1000, 30 degrees, friction 0.3) slides. All settle first under the part of gravity along
the normal, with the drag that stops their slowest waves soonest, and begin at rest.
"""

import math

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled
from polarmpm.plot.drawing import finish_curves
from polarmpm.study import commandline as demo

GRAVITY = 9.81  # m/s^2
RADIUS, LENGTH, HEIGHT = 0.5, 1.0, 0.5  # m
# friction, angle (degrees)
CASES = {"rolling": (0.9, 60.0), "slipping": (0.3, 60.0), "smooth": (0.0, 60.0), "block": (0.3, 30.0)}
SETTLING = 24.0  # for how long bodies settle, in times that a wave takes through them


def exact(name, time):
    """Way (m) and turn (rad) of the middle after a time (s)."""
    friction, angle = CASES[name]
    down, across = (GRAVITY * f(math.radians(angle)) for f in (math.sin, math.cos))
    if name == "rolling":
        way = down * time**2 / 3.0
        return way, way / RADIUS
    turn = 0.0 if name == "block" else friction * across / RADIUS * time**2
    return 0.5 * (down - friction * across) * time**2, turn


def settling(name, args):
    """Steps in which a body settles, and drag (1/s): critical for waves of four times its height."""
    disc = name != "block"
    crossing = 2 * RADIUS * math.sqrt(7800.0 / 200e6) if disc else HEIGHT * math.sqrt(1000.0 / 1e6)
    return math.ceil(SETTLING * crossing / args.dt), math.pi / crossing


def scene(name, args):
    """The problem and its incline."""
    disc, (friction, angle) = name != "block", CASES[name]
    steps, drag = settling(name, args)
    h = args.cell if disc else 0.125 * args.cell / 0.1
    size = 2 * RADIUS if disc else LENGTH
    high = 2 * RADIUS if disc else HEIGHT
    way = math.ceil((exact(name, args.time)[0] + size) / h + 4) * h
    grid = pm.Grid.box((-4 * h, -4 * h), (way, math.ceil(high / h + 4) * h), h)
    young, density = (200e6, 7800.0) if disc else (1e6, 1000.0)
    material = pm.NeoHookean.from_engineering(E=young, nu=0.3)

    def inside(x):
        return np.hypot(x[:, 0] - RADIUS, x[:, 1] - RADIUS) < RADIUS

    if disc:
        points = pm.seed(grid, inside, material=material, points_per_cell=args.points_per_cell)
        sites = pm.Surface.arc((RADIUS, RADIUS), RADIUS, math.ceil(20 * math.pi * RADIUS / h))
    else:
        box = ((0.0, 0.0), (LENGTH, HEIGHT))
        points = pm.seed(grid, bounds=box, material=material, points_per_cell=args.points_per_cell)
        sites = None
    problem = pm.Dynamic(
        grid, points, density=density, rho_inf=args.rho_inf, reset=10, basis=args.basis, drag=drag
    )
    incline = problem.obstacle(
        pm.HalfSpace((0, 0), (0, 1)), on=sites, friction=friction, stiffness=10 * young / h
    )
    start = steps * args.dt
    down, across = (density * GRAVITY * f(math.radians(angle)) for f in (math.sin, math.cos))

    held = 0.0 if disc else friction * across

    def weight(time):
        """Grows along the normal, and along the incline as far as friction holds the body; all of it is there
        from the start of the motion on."""
        share = min(1.0, 2.0 * time / start)
        return down if time > start else share * held, -share * across

    problem.body_load(force=weight)
    return problem, incline


def place(problem, X):
    """Middle (m), and turn (rad) about it, of the body whose points were at X."""
    points = problem.points
    volume = points.volume0[:, None]
    total = problem.comm.allreduce(float(volume.sum()))
    middle, before = (problem.comm.allreduce((volume * y).sum(axis=0)) / total for y in (points.x, X))
    now, then = points.x - middle, X - before
    across = np.sum(volume[:, 0] * (then[:, 0] * now[:, 1] - then[:, 1] * now[:, 0]))
    along = np.sum(volume[:, 0] * np.sum(then * now, axis=1))
    return middle, math.atan2(problem.comm.allreduce(across), problem.comm.allreduce(along))


def solve(name, args, folder):
    """Times (s), ways (m), turns (rad) and forces (N) from the start of the motion on."""
    problem, incline = scene(name, args)
    settled, _ = settling(name, args)
    for _ in problem.march(steps=settled, duration=settled * args.dt, progress=False):
        pass
    problem.drag = 0.0
    problem.velocity(v=(0.0, 0.0))
    problem.rows["X"] = problem.points.x.copy()
    first, start = place(problem, problem.rows["X"])[0], problem.time
    steps = max(1, round(args.time / args.dt))
    times, ways, turns, forces = [0.0], [0.0], [0.0], [incline.force.tolist()]
    with pm.Recorder(folder / f"{name}.pvd", problem) as record:
        for number, step in enumerate(problem.march(steps=steps, duration=args.time, progress=False)):
            middle, turn = place(problem, problem.rows["X"])
            times.append(step.time - start)
            ways.append(float(middle[0] - first[0]))
            turns.append(-turn)
            forces.append(incline.force.tolist())
            if number % 10 == 9:
                record(step)
    turns = np.unwrap(turns).tolist()
    return problem, {"time": times, "way": ways, "turn": turns, "force": forces}


def main(argv=None):
    args = demo.scene_arguments(
        __doc__.splitlines()[0],
        output="incline",
        argv=argv,
        more={
            "--cases": {"nargs": "+", "choices": tuple(CASES), "default": list(CASES)},
            "--cell": {"type": demo.positive, "default": 0.1, "help": "of the disc's grid (m)"},
            "--points-per-cell": {"type": demo.count, "default": 3, "help": "in each direction"},
            "--basis": {"choices": ("bspline", "gimpm", "mpm"), "default": "bspline", "help": "functions"},
            "--dt": {"type": demo.positive, "default": 2e-3, "help": "step (s)"},
            "--time": {"type": demo.positive, "default": 1.0, "help": "of the motion (s)"},
            "--rho-inf": {"type": float, "default": 0.8, "help": "of the method in time"},
        },
    )
    folder = demo.output_folder(args, MPI.COMM_WORLD)
    result, curves = {}, {}
    for name in args.cases:
        problem, curve = solve(name, args, folder)
        way, turn = exact(name, curve["time"][-1])
        result[name] = curve["way"][-1] / way - 1
        if turn:
            result[f"{name}_turn"] = curve["turn"][-1] / turn - 1
        later = np.array(curve["force"])[len(curve["force"]) // 2 :].sum(axis=0)
        result[f"{name}_ratio"] = -float(later[0] / later[1])  # of friction and pressure
        result[f"{name}_iterations"] = float(
            np.mean([step.iterations for step in problem.steps[settling(name, args)[0] :]])
        )
        curves[name] = curve
    for name, curve in curves.items():
        result |= {f"{name}_{key}s": curve[key] for key in ("time", "way", "turn")}
    draw(curves, folder / "incline.png")
    names = ("cases", "cell", "points_per_cell", "basis", "dt", "time", "rho_inf")
    return demo.report(args, "incline", problem, result, **{key: getattr(args, key) for key in names})


@styled()
def draw(curves, file):
    """Ways and turns over the time, and closed forms."""
    from polarmpm.plot import figures as plot

    figure, axes = plot.subplots(1, 2, figsize=plot.fitted(10.5, 4.2))
    if MPI.COMM_WORLD.rank == 0:
        colours = dict(zip(CASES, ("#0072b2", "#d55e00", "#009e73", "#cc79a7"), strict=True))
        for name, curve in curves.items():
            time = np.array(curve["time"])
            some = slice(None, None, max(1, len(time) // 20))
            closed = np.array([exact(name, t) for t in time])
            label = f"{name}, friction {CASES[name][0]:g}, {CASES[name][1]:g}°"
            for ax, key, column in ((axes[0], "way", 0), (axes[1], "turn", 1)):
                if key == "turn" and name == "block":
                    continue
                ax.plot(time, closed[:, column], color=colours[name], lw=1.2)
                ax.plot(time[some], np.array(curve[key])[some], "o", ms=4, color=colours[name], label=label)
        for ax, what in zip(axes, ("way (m)", "turn (rad)"), strict=True):
            ax.set_xlabel("time (s)")
            ax.set_ylabel(what)
            ax.set_xlim(left=0)
            finish_curves(ax)
        axes[0].set_title("lines: closed forms")
    plot.save(figure, file, comm=MPI.COMM_WORLD)


if __name__ == "__main__":
    main()
