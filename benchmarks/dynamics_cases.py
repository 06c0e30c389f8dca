"""The scenes of `dynamics.py`, case by case: what is measured, and the bars that it is held against."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import tempfile
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

import polarmpm as pm
from polarmpm.kinematics import rotations

DEMOS = Path(__file__).parents[1] / "demos"
SOFT = pm.NeoHookean.from_engineering(E=1e6, nu=0.3)
LENGTH, SPEED = 25.0, 10.0  # of the bar (m), of waves in it (m/s)
ROD = pm.SaintVenantKirchhoff(lam=0.0, mu=50.0)


TENTS = {"basis": "gimpm", "ghost": pm.GhostPenalty(1e4)}


class Row(NamedTuple):
    """A number, and whether it holds its bar; None where there is no bar."""

    what: str
    bar: str
    found: str
    holds: bool | None


def within(what, value, bar, form=".0e", unit=1.0, said=""):
    """Of a value whose size is bounded; `unit` 100 for percent."""
    sign = "%" if unit == 100 else ""
    shown = f"{unit * value:{form}} {sign}".strip()
    return Row(what, said or f"{unit * bar:g} {sign}".strip(), shown, bool(abs(value) <= bar))


def percent(value):
    return f"{100 * value:+.2f} %"


def few(iterations, most=4):
    return within("iterations a step", iterations, most, ".1f")


def go(problem, time, **steps):
    """March, and the mean number of iterations."""
    for _ in problem.march(time, progress=False, **steps):
        pass
    return float(np.mean([step.iterations for step in problem.steps]))


def demo(name, *options):
    """Result of a demo."""
    spec = importlib.util.spec_from_file_location(name, DEMOS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        with contextlib.redirect_stdout(io.StringIO()):
            module.main([*options, "--json", str(file), "--output", folder])
        return json.loads(file.read_text())["result"]


# free bodies ----------------------------------------------------------------------------------------
def fall():
    """D3: 98 cells deep, with a reset at each of 100 steps."""
    rate, strain, most = 0.0, 0.0, 0.0
    for basis in ("bspline", "gimpm", "mpm"):
        for rho in (1.0, 0.8):
            grid = pm.Grid.box((0, 0), (3, 102), 1.0)
            points = pm.seed(grid, bounds=((0.7, 99.2), (2.3, 100.4)), material=SOFT, points_per_cell=3)
            problem = pm.Dynamic(grid, points, density=1e3, basis=basis, rho_inf=rho, reset=1, boxes=False)
            problem.body_load(force=lambda t: (0.0, -9.81e3))
            end = np.sqrt(2 * 98 / 9.81)
            most = max(most, go(problem, end, steps=100))
            rate = max(rate, np.abs(points.velocity[:, 1] / (-9.81 * end) - 1).max())
            strain = max(strain, np.abs(points.F - np.eye(3)).max())
    return [
        within("D3, 100 resets, three bases, r = 1, 0.8: v/(g t) − 1", rate, 1e-10),
        within("F − I", strain, 1e-11),
        few(most),
    ]


def spinning(per_cell, **options):
    """D2: once in a second, not fitted to the grid."""
    grid, middle = pm.Grid.box((0, 0), (2.5, 2.5), 0.25), np.array([1.21, 1.27])
    points = pm.seed(grid, bounds=(middle - 0.5, middle + 0.5), points_per_cell=per_cell, material=SOFT)
    problem = pm.Dynamic(grid, points, density=1e3, **options)
    problem.velocity(v=lambda x: 2 * np.pi * np.column_stack([middle[1] - x[:, 1], x[:, 0] - middle[0]]))
    return problem, middle


def spin(per_cell, turns, **options):
    """Relative changes of energy, kinetic energy and angular momentum, momentum, iterations."""
    problem, middle = spinning(per_cell, **options)
    energy, momentum = problem.energies()["kinetic"], problem.angular_momentum(middle)[0]
    size = np.sqrt(2 * energy * problem.inertia()["mass"])
    iterations = go(problem, turns, dt=1 / 40)
    found = problem.energies()
    return (
        (found["kinetic"] + found["stored"]) / energy - 1,
        problem.angular_momentum(middle)[0] / momentum - 1,
        np.abs(problem.momentum()).max() / size,
        iterations,
    )


def spins():
    rows = []
    for name, per_cell, turns, least, options in (
        ("splines, 3 x 3 points, 100 turns", 3, 100, -0.015, {}),
        (
            "gimpm, 2 x 2 points, ghost 1e-2 E, 25 turns",
            2,
            25,
            -0.03,
            {"basis": "gimpm", "ghost": pm.GhostPenalty(1e4)},
        ),
    ):
        e, spin_, momentum, iterations = spin(per_cell, turns, rho_inf=1.0, reset=1, **options)
        rows += [
            Row(
                f"D2, r = 1, reset each step, {name}: energy",
                f"> {100 * least:g} %",
                f"{100 * e:+.2f} %",
                e > least,
            ),
            within("its angular momentum", abs(spin_), 1e-8),
            within("its momentum", momentum, 1e-12),
            few(iterations),
        ]
    return rows


def spin_alone():
    rows = []
    for name, per_cell, options in (
        ("splines", 3, {}),
        ("gimpm, ghost 1e-2 E", 2, TENTS),
    ):
        e, spin_, _, iterations = spin(per_cell, 100, rho_inf=0.9, **options)
        rows += [
            Row(
                f"D2, r = 0.9, no reset, {name}, 100 turns: energy", "1 %", f"{100 * e:+.2f} %", abs(e) < 0.01
            ),
            within("its angular momentum", spin_, 1e-3, "+.1e"),
            few(iterations),
        ]
    return rows


def travelling():
    rows = []
    ghost = pm.GhostPenalty(1e-3 * 100.0)
    for name, options in (("no boxes, ghost 1e-3 E", {"boxes": False, "ghost": ghost}), ("boxes", {})):
        rows += travel(name, **options)
    return rows


def travel(name, **options):
    """D1: a free bar in its first mode, which travels over 20 cells in 10 periods of 40 steps."""
    h, period, v0, drift = 2.5, 2 * LENGTH / SPEED, 0.1, 1.0
    grid = pm.Grid.box((0, 0), (30 * h + 2.5, 3 * h), h)
    points = pm.seed(grid, bounds=((0.8, 1.1), (0.8 + LENGTH, 1.1 + h)), material=ROD, points_per_cell=3)
    problem = pm.Dynamic(grid, points, density=1.0, rho_inf=1.0, reset=1, **options)
    shape = lambda: np.cos(np.pi * (points.X[:, 0] - 0.8) / LENGTH)  # noqa: E731
    problem.velocity(
        v=lambda x: np.column_stack([drift + v0 * np.cos(np.pi * (x[:, 0] - 0.8) / LENGTH), 0 * x[:, 0]])
    )
    energy = problem.energies()["kinetic"]
    momentum, mass = problem.momentum()[0], problem.inertia()["mass"]
    amplitude, times = [0.0], [0.0]
    for step in problem.march(10 * period, steps=400, progress=False):
        weight = points.volume0 * shape()
        amplitude.append(float(weight @ points.displacement[:, 0] / (weight @ shape())))
        times.append(step.time)
    found = problem.energies()
    of_mode = energy - 0.5 * momentum**2 / mass
    kept = (found["kinetic"] + found["stored"] - 0.5 * problem.momentum()[0] ** 2 / mass) / of_mode
    q, dt = np.array(amplitude), period / 40
    cosine = 0.5 * (q[1:-1] @ (q[2:] + q[:-2])) / (q[1:-1] @ q[1:-1])
    rule = 2 / dt * np.arctan(np.pi * SPEED / LENGTH * dt / 2)
    omega = np.arccos(cosine) / dt / rule - 1
    last = np.abs(q[-41:]).max() / np.abs(q[:41]).max()
    iterations = float(np.mean([step.iterations for step in problem.steps]))
    return [
        Row(
            f"D1, {name}, over 20 cells, 400 resets: energy of the mode",
            "> 0.997",
            f"{kept:.4f}",
            kept > 0.997,
        ),
        within("its frequency, to the method's", omega, 5e-4, "+.1e"),
        Row("its amplitude", "> 0.997", f"{last:.4f}", last > 0.997),
        few(iterations),
    ]


# orders and waves -------------------------------------------------------------------------------------
def bar(kind, **options):
    """Fixed at x = 0, in its first mode."""
    if kind == "points":
        grid = pm.Grid.box((0, 0), (30, 5), 2.5)
        points = pm.seed(grid, bounds=((0, 0), (LENGTH, 2.5)), material=ROD, points_per_cell=3)
        problem = pm.Dynamic(grid, points, density=1.0, **options)
    else:
        from mpi4py import MPI

        from dolfinx import mesh

        corners = [np.zeros(2), np.array([LENGTH, 2.5])]
        body = mesh.create_rectangle(MPI.COMM_WORLD, corners, [10, 1], mesh.CellType.quadrilateral)
        problem = pm.DynamicFEM(pm.Elements(body, material=ROD, degree=2), density=1.0, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    problem.velocity(
        v=lambda x: np.column_stack([1e-3 * np.sin(0.5 * np.pi * x[:, 0] / LENGTH), 0 * x[:, 0]])
    )
    return problem


def orders():
    rows, period = [], 4 * LENGTH / SPEED
    for kind in ("points", "elements of degree 2"):
        for rho in (1.0, 0.8):
            ends = []
            for steps in (40, 80, 640):
                problem = bar(kind, rho_inf=rho)
                go(problem, period, steps=steps)
                ends.append(problem.points.displacement[np.argsort(problem.points.id)])
            order = np.log2(np.linalg.norm(ends[0] - ends[2]) / np.linalg.norm(ends[1] - ends[2]))
            rows.append(
                Row(
                    f"order in time, bar, {kind}, r = {rho:g}",
                    "2 ± 0.15",
                    f"{order:.2f}",
                    abs(order - 2) < 0.15,
                )
            )
    return rows


def estimate():
    """The estimate against (exact) dt^3 / 12 of the third derivative, at T/20 to T/80."""
    ratios, period = [], 4 * LENGTH / SPEED
    for steps, reset in ((20, None), (40, None), (80, None), (80, 1)):
        problem = bar("points", rho_inf=1.0, reset=reset)
        w, dt = 2 * np.pi / period, period / steps
        for step in problem.march(4 * dt, steps=4, progress=False):
            if step.number > 1:
                true = np.sqrt(0.5) * 1e-3 * w**2 * dt**3 / 12 * abs(np.cos((step.time - dt) * w))
                ratios.append(problem.error / true)
    low, high = min(ratios), max(ratios)
    return [
        Row(
            "estimate over the true error of a step",
            "1 to 6",
            f"{low:.2f} to {high:.2f}",
            low > 0.95 and high < 6,
        )
    ]


def waves():
    rows = []
    for name, options in (("no reset", ()), ("reset each step", ("--reset", "1"))):
        found = demo("waves", "--numbers", "50", "200", *options)
        for method in ("points", "elements"):
            errors = [abs(row["error"]) for row in found["waves"] if row["method"] == method]
            if method == "elements" and options:
                continue
            said = "elements of degree 2" if method == "elements" else f"points, {name}"
            rows.append(
                Row(f"D4, 12 in half a wave, {said}", "1e-5", f"{max(errors):.1e}", max(errors) < 1e-5)
            )
        energy = found["energy_error"]
        rows.append(Row("energy", "1e-8", f"{energy:.0e}", energy < 1e-8))
    for axis in range(3):
        error = wave_in_space(axis)
        rows.append(
            Row(f"D4 in space along {'xyz'[axis]}, 8 cells", "3e-5", f"{abs(error):.1e}", abs(error) < 3e-5)
        )
    return rows


def wave_in_space(axis, k=200.0, cells=8, steps=40):
    """Error of the frequency of half a standing optical wave, freed from the method's shift."""
    from polarmpm.study.exact import micropolar_waves

    length, lb = np.pi / k, 5e-3
    material = pm.MicropolarElastic.bounded_stiffness(lam=4e9, mu=4e9, kappa=4e8, l_b=lb)
    stiffness = material.gamma + material.beta
    found = micropolar_waves(k, mu=4e9, kappa=4e8, stiffness=stiffness, rho=2000.0, j=lb**2)
    omega, ratio = (values[1] for values in found)
    u, w = (axis + 1) % 3, (axis + 2) % 3  # the displacement is along u, the microrotation about w
    h = length / cells
    upper = np.full(3, h)
    upper[axis] = length
    grid = pm.Grid.box((0, 0, 0), tuple(upper), h)
    points = pm.seed(grid, material=material, points_per_cell=3, layout="gauss")
    problem = pm.Dynamic(grid, points, density=2000.0, microinertia=lb**2, rho_inf=1.0, boxes=False)
    names = "xyz"
    for x in (0.0, length):
        problem.fix(pm.plane(**{names[axis]: x}), **{f"u{names[axis]}": 0, f"u{names[w]}": 0, "theta": 0})
    others = {f"u{names[axis]}": 0, f"u{names[w]}": 0, f"theta_{names[axis]}": 0, f"theta_{names[u]}": 0}
    everywhere = lambda X: np.ones(len(X), dtype=bool)  # noqa: E731
    problem.fix(everywhere, **others)
    size, period = 1e-7 / k, 2 * np.pi / omega

    def v(x):
        out = np.zeros((len(x), 3))
        out[:, u] = size * omega * np.cos(k * x[:, axis])
        return out

    def turning(x):
        out = np.zeros((len(x), 3))
        out[:, w] = size * omega * ratio * np.sin(k * x[:, axis])
        return out

    problem.velocity(v=v, spin=turning)
    mode = [0.0]
    for _ in problem.march(period, steps=steps, progress=False):
        mode.append(float(points.volume0 * np.cos(k * points.X[:, axis]) @ points.displacement[:, u]))
    q, dt = np.array(mode), period / steps
    cosine = 0.5 * (q[1:-1] @ (q[2:] + q[:-2])) / (q[1:-1] @ q[1:-1])
    return 2 / dt * np.tan(0.5 * np.arccos(cosine)) / omega - 1


# microrotations in space --------------------------------------------------------------------------------
MICRO = {"lam": 1e5, "mu": 1e5, "kappa": 1e3, "alpha": 0.0, "beta": 10.0, "gamma": 10.0}
SPRINGS = {**MICRO, "lam": 1e3, "mu": 1e3}
STIFF = {**MICRO, "lam": 1e6, "mu": 5e5, "kappa": 1e5, "beta": 1e3, "gamma": 1e3}


def turning(steps):
    """Quaternions of points that turn on their couple springs, from 1 rad on."""
    axis = np.array([0.6, -0.5, 0.62])
    start = rotations.from_vector(axis[None] / np.linalg.norm(axis))
    grid = pm.Grid.box((0, 0, 0), (1, 1, 1), 1.0)
    points = pm.seed(grid, material=pm.MicropolarElastic(**SPRINGS))
    points.q = np.tile(start, (len(points), 1))
    problem = pm.Dynamic(grid, points, density=1e3, microinertia=1.0, rho_inf=1.0)
    problem.fix(lambda X: np.ones(len(X), dtype=bool), u=0.0)
    problem.velocity(spin=(0.3, -2.0, 3.0))
    go(problem, 1.0, steps=steps)
    return points.q[np.argsort(points.id)]


def gyro():
    fine = turning(640)
    errors = [2 * np.linalg.norm(turning(n) - fine, axis=1).max() for n in (10, 20, 40, 80)]
    order = np.log2(errors[2] / errors[3])
    return [
        Row("microrotation in space: order in Q", "2 ± 0.05", f"{order:.2f}", abs(order - 2) < 0.05),
        Row(
            "its error with 80 steps",
            "1.65 % of that with 10",
            f"{errors[3]:.1e}",
            errors[3] < 0.0165 * errors[0],
        ),
    ]


def block_in_space(turns=3.0, steps=40):
    """A free micropolar block about a tilted axis, reset at each step."""
    grid = pm.Grid.box((-0.7, -0.7, -0.7), (2.3, 2.3, 2.3), 0.25)
    low, size = np.array([0.07, 0.31, 0.55]), np.array([1.5, 1.0, 0.5])
    points = pm.seed(
        grid, bounds=(low, low + size), material=pm.MicropolarElastic(**STIFF), points_per_cell=3
    )
    problem = pm.Dynamic(grid, points, density=1e3, microinertia=1e-2, rho_inf=1.0, reset=1)
    axis = 2 * np.pi * np.array([0.2, 0.3, 1.0]) / np.linalg.norm([0.2, 0.3, 1.0])
    middle = low + size / 2
    problem.velocity(v=lambda x: np.cross(axis, x - middle), spin=tuple(axis))
    momentum, energy = problem.angular_momentum(middle), problem.energies()["kinetic"]
    iterations = go(problem, turns, dt=1.0 / steps)
    error = np.linalg.norm(problem.angular_momentum(middle) - momentum) / np.linalg.norm(momentum)
    found = problem.energies()
    change = (found["kinetic"] + found["stored"]) / energy - 1
    return [
        Row(
            "micropolar block in space, 3 turns, reset each step: angular momentum",
            "5e-6",
            f"{error:.0e}",
            error < 5e-6,
        ),
        Row("its energy", "", f"{100 * change:+.2f} %", None),
        few(iterations),
    ]


# impacts ------------------------------------------------------------------------------------------------
def discs_by_nodes():
    found = demo("discs", "--contact", "nodes", "--reset", "1")
    e, v, p = found["energy_error"], found["restitution"], found["momentum"]
    iterations = found["iterations"] / 400
    return [
        within("D6, one body, reset each step, cells of 0.05 m: momentum", p, 1e-12),
        within("its energy", e, 0.01, ".2f", 100),
        Row("its restitution", "0.97 ± 0.01", f"{v:.3f}", abs(v - 0.97) <= 0.01),
        few(iterations),
    ]


def discs():
    rows = []
    for name, options in (("never reset", ()), ("reset each step", ("--reset", "1"))):
        found = demo("discs", "--cells", "0.05", "0.025", *options)
        for run in found["runs"]:
            said, felt = f"D6, two bodies, {name}, cells of {run['cell']:g} m", run["gap_cells"]
            v, e = run["restitution"], run["energy_error"]
            rows += [
                within(f"{said}: felt before they touch (cells)", felt, 0.5, "+.2f"),
                Row("restitution", "0.97", f"{v:.3f}", v >= 0.97),
                within("energy", e, 0.01, ".2f", 100),
            ]
    return rows


# friction and contact ------------------------------------------------------------------------------------
def inclines():
    rows = []
    found = demo("incline")
    for name in ("rolling", "slipping", "smooth"):
        error, iterations = found[name], found[f"{name}_iterations"]
        rows.append(within(f"C1, {name}: way", error, 2e-3, "+.1e"))
        if f"{name}_turn" in found:
            rows.append(within("its turn", found[f"{name}_turn"], 1.5e-2, "+.1e"))
        rows.append(few(iterations))
    for rho, most, result in ((0.8, 0.02, found), (0.0, 0.01, None)):
        one = result or demo("incline", "--cases", "block", "--rho-inf", "0")
        error, ratio, iterations = one["block"], one["block_ratio"], one["block_iterations"]
        rows += [
            Row(
                f"C2, 30°, r = {rho:g}: way", f"{100 * most:g} %", f"{100 * error:+.2f} %", abs(error) <= most
            ),
            Row("its T/N", "0.3 ± 1e-3", f"{ratio:.4f}", abs(ratio - 0.3) <= 1e-3),
            few(iterations, 5),
        ]
    return rows


def hertz():
    found = demo("hertz")
    width, pressure = found["half_width_error"], found["pressure_error"]
    return [
        within("C3, h = a/7: half width", width, 0.025, "+.1f", 100),
        within("its pressure", pressure, 0.02, "+.1f", 100),
    ]


# statics, the column, the cost ----------------------------------------------------------------------------
def slow():
    """B4 on elements and by points, pulled slowly and damped, against the static answer on the same nodes."""
    spec = importlib.util.spec_from_file_location("arch", DEMOS / "curved_cantilever_fem.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    rows = []
    for kind in ("elements", "points"):
        tips = []
        for dynamic in (False, True):
            problem, mean = _arch(module, kind, dynamic)
            if dynamic:
                go(problem, 22.0, dt=0.5)
            else:
                go(problem, 10)
            tips.append(mean())
        error = float(np.linalg.norm(tips[1] - tips[0]) / np.linalg.norm(tips[0]))
        rows.append(within(f"B4, slowly, {kind}, to the static answer", error, 1e-4))
    return rows


def _arch(module, kind, dynamic):
    inertia = {"density": 0.05, "microinertia": 0.05, "rho_inf": 0.6, "drag": 3.0} if dynamic else {}
    body = module.arch(64)
    if kind == "elements":
        elements = pm.Elements(body, material=module.MATERIAL, degree=1)
        problem = (pm.DynamicFEM if dynamic else pm.QuasiStaticFEM)(elements, **inertia)
        tip = elements.farthest((1, -1, 0))
        read = lambda: elements.mean_displacement(tip)  # noqa: E731
    else:
        grid = pm.Grid.box((0, -40, -8), (80, 40, 64), 1.0)
        points = pm.seed_mesh(grid, body, material=module.MATERIAL, degree=3)
        problem = (pm.Dynamic if dynamic else pm.QuasiStatic)(grid, points, reset=None, **inertia)
        tip = points.farthest((1, -1, 0))
        read = lambda: points.mean_displacement(tip)  # noqa: E731
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    if dynamic:
        problem.load(tip, force=lambda t: (0.0, 0.0, module.FORCE * min(1.0, t / 10.0)))
    else:
        problem.load(tip, force=(0, 0, module.FORCE))
    return problem, read


def ledger():
    """D8 with a cohesion of 100 Pa: what the energies' sum is off by, and the ghost penalty's work."""
    rows = []
    splines = ("--basis", "bspline", "--points-per-cell", "3", "--ghost", "0")
    runs = (("splines, 3 x 3 points, no ghost", splines, 350), ("gimpm", (), 350), ("gimpm", (), 1400))
    for name, chosen, steps in runs:
        options = ("--cells", "0.01", "--cohesion", "100", "--steps", f"{steps}", *chosen)
        found = demo("granular_column", *options)["runs"][0]
        off, both = abs(found["ledger"]), abs(found["ledger"]) + abs(found["ghost"])
        said = f"column, c = 100 Pa, cells of 10 mm, {name}, steps of {0.7 / steps:g} s: ledger"
        rows += [
            within(said, off, 3e-3),
            within("with the ghost penalty's work", both, 0.02, ".1f", 100),
            within("cuts", found["cuts"], 0, ".0f"),
        ]
    return rows


COSTS = (
    ("plane", 2, False, 16),
    ("plane", 2, False, 32),
    ("plane", 2, False, 64),
    ("plane, micropolar", 2, True, 32),
    ("space", 3, False, 8),
    ("space, micropolar", 3, True, 8),
)


def loaded(static, dim, micro, cells):
    """A cantilever under a weight that grows."""
    h = 1.0 / cells
    upper = np.array([1.0, 0.5, 0.5][:dim])
    lower = np.array([0.0, -4 * h, -4 * h][:dim])
    grid = pm.Grid.box(tuple(lower), tuple(upper + 4 * h), h)
    lam, mu = SOFT.lam, SOFT.mu
    material = (
        pm.MicropolarElastic.bounded_stiffness(lam=lam, mu=mu, kappa=mu / 2, l_b=0.1) if micro else SOFT
    )
    points = pm.seed(grid, bounds=((0.0,) * dim, tuple(upper)), material=material)
    if static:
        problem = pm.QuasiStatic(grid, points)
    else:
        problem = pm.Dynamic(grid, points, density=1e3, microinertia=1e-3 if micro else None)
    problem.fix(pm.plane(x=0.0), u=0)
    force = np.zeros(dim)
    force[1] = -4e3
    problem.body_load(force=lambda t: tuple(t * force))
    return problem


def cost(steps=40):
    """CPU time of steps in turn, static and dynamic, of those with as many iterations."""
    rows = []
    for name, dim, micro, cells in COSTS:
        problems = loaded(True, dim, micro, cells), loaded(False, dim, micro, cells)
        runs = problems[0].march(steps, progress=False), problems[1].march(1.0, steps=steps, progress=False)
        spent, iterations = np.zeros((steps, 2)), np.zeros((steps, 2))
        for number in range(steps):
            for k, run in enumerate(runs):
                begin = time.process_time()
                iterations[number, k] = next(run).iterations
                spent[number, k] = time.process_time() - begin
        same = (iterations[:, 0] == iterations[:, 1]) & (np.arange(steps) > 3)
        ratio = float(np.median(spent[same, 1] / spent[same, 0]))
        said = f"a dynamic step over a static one, {name}, {len(problems[0].points)} points"
        bar = 1.15 if len(problems[0].points) > 1000 else None
        rows.append(Row(said, f"{bar}" if bar else "", f"{ratio:.2f}", ratio <= bar if bar else None))
    return rows


CASES = {
    "fall": fall,
    "spin": spins,
    "spin-alone": spin_alone,
    "travelling": travelling,
    "orders": orders,
    "estimate": estimate,
    "waves": waves,
    "gyro": gyro,
    "block": block_in_space,
    "discs-by-nodes": discs_by_nodes,
    "discs": discs,
    "incline": inclines,
    "hertz": hertz,
    "slow": slow,
    "ledger": ledger,
    "cost": cost,
}


def quietly(case):
    """Rows of a case; a run that ends early is a row, too."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pm.TrustWarning)
        try:
            return CASES[case]()
        except pm.PolarMPMError as e:
            return [Row(case, "", str(e).splitlines()[0], False)]
