"""What graded grids buy: the same scenes on equal cells, on graded lines, and on lines from a pilot run.

Footing and hole are compared by force and by the error of the strain, the shear layer by force and width of
its band. `bodies` are cantilevers at random heights on lines of 1:4. Rows have unknowns, error and CPU
seconds.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import scenes
from mpm_versus_fem import demo

import polarmpm as pm

HERE = Path(__file__).parent
GROWTHS = (1.15, 1.2, 1.3)


def timed(work):
    """What it returns, and CPU seconds."""
    begin = time.process_time()
    found = work()
    return found, time.process_time() - begin


def unknowns(problem):
    return int(problem.system.nodes.total * problem.layout.block)


# footing ----------------------------------------------------------------------------------------------
def footing(cells, lines=None, steps=20, length=None, size=(5, 5), **options):
    """A rough strip footing on soil of 5 x 5: the load over c and the effective half width. `length`: of a
    micropolar soil."""
    soil = demo("strip_footing").soil()
    if length:
        elastic = pm.MicropolarElastic.bounded_stiffness(
            lam=soil.elastic.lam, mu=soil.elastic.mu, kappa=soil.elastic.mu / 10, l_b=length
        )
        soil = pm.VonMises(elastic, k=soil.k, l_p=length)
    grid = pm.Grid.box((0, 0), size, 1 / cells) if lines is None else pm.Grid.graded(**lines)
    points = pm.seed(grid, material=soil, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, **{"reset": None, **options})
    width, depth = grid.upper
    for x in (0.0, width):
        problem.fix(pm.plane(x=x), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    held = problem.fix(lambda x: (x[:, 0] < 1 + 1e-6) & (x[:, 1] > depth - 1e-6), ux=0, uy=-0.02)
    list(problem.march(steps, adaptive=True, progress=False))
    x = problem.system.nodes.position
    top = x[np.abs(x[:, 1] - depth) < 1e-6, 0]
    width = 0.5 * (top[top < 1 + 1e-6].max() + top[top > 1 + 1e-6].min())
    return problem, -float(problem.reaction(held).force[1]) / width


def footings(cells):
    rows = {}
    rows["equal"] = of_footing(lambda: footing(cells))
    for growth in GROWTHS:
        x = pm.lines(0, 5, fine=1 / cells, where=(0, 1.25), growth=growth, keep=[1.0])
        y = pm.lines(0, 5, fine=1 / cells, where=(4.5, 5), growth=growth)
        rows[f"growth {growth}"] = of_footing(lambda x=x, y=y: footing(cells, {"x": x, "y": y}))

    def by_pilot():
        pilot, _ = footing(cells // 4)
        number = round(15 * cells / 8)
        return footing(cells, pm.lines_from(pilot, cells=number, fine=1 / cells, keep={"x": [1.0]}))

    rows["pilot"] = of_footing(by_pilot)
    return compared("footing, load over c", rows)


def of_footing(work):
    (problem, load), seconds = timed(work)
    return unknowns(problem), load, seconds


# hole -------------------------------------------------------------------------------------------------
def holes(cells):
    """A hole of radius a in 10 a: the error of the strain."""
    size, rows = 10.0, {}

    def solved(lines):
        def work():
            problem, read = scenes.plate(1 / cells, 2, size=size, lines=lines)
            list(problem.march(1, progress=False))
            return unknowns(problem), read()

        (number, error), seconds = timed(work)
        return number, error, seconds

    rows["equal"] = solved(None)
    for growth in GROWTHS:
        rows[f"growth {growth}"] = solved(pm.lines(0, size, fine=1 / cells, where=(0, 1.25), growth=growth))
    return compared("hole, error of the strain", rows)


# shear layer ------------------------------------------------------------------------------------------
def layers(cells):
    """Shear layer of 100 mm, l = 2 mm, cells of l / `cells`, to a shift of 10 mm: force and width."""
    scene, h = demo("shear_layer"), 2e-3 / cells
    args = argparse.Namespace(
        model="micropolar", mode="mpm", weakness=0.1, zone=4e-3, points_per_cell=2, basis="bspline", regrid=h
    )
    rows, width = {}, {}
    for name, lines in (
        ("equal", np.linspace(0, 0.1, round(0.1 / h) + 1)),
        ("growth 1.25", pm.lines(0, 0.1, fine=h, where=(0.045, 0.055), growth=1.25)),
    ):

        def work(lines=lines):
            problem, base = scene.build(25, 1, 2e-3, args, lines)
            list(problem.march(20, to=0.5, progress=False))
            return problem, -problem.reaction(base)[0][0]

        (problem, force), seconds = timed(work)
        rows[name], width[name] = (unknowns(problem), force, seconds), scene.widths(problem.points)[0]
    found = compared("shear layer, force (N/m)", rows)
    for row in found:
        row["width"] = width[row["grid"]] / width["equal"] - 1
    return found


# bodies -----------------------------------------------------------------------------------------------
def bodies(number):
    """Cantilevers of 1 x 4 m at random heights, lines of 1:4 and equal ones: spreads of the deflection."""
    steps = np.tile([1.0, 2.0, 4.0, 2.0], 4)
    kinds = {
        "equal": (np.ones(14), np.ones(10)),
        "smooth": (4.0 ** (np.arange(14) / 13), 4.0 ** (np.arange(10) / 9)),
        "smooth, coarse clamp": (4.0 ** (np.arange(14)[::-1] / 13), 4.0 ** (np.arange(10) / 9)),
        "1 2 4 2 1": (steps[:14], steps[:10]),
    }
    found = []
    for basis in ("bspline", "mpm", "gimpm"):
        for name, sizes in kinds.items():
            x, y = (
                np.concatenate([[0.0], np.cumsum(h)]) * length / h.sum()
                for h, length in zip(sizes, (5.2, 2.5), strict=True)
            )
            rng, answers = np.random.default_rng(7), []
            for low in rng.uniform(0.1, 1.4, number):
                grid = pm.Grid.graded(x, y)
                points = pm.seed(grid, material=scenes.classical(0.3), bounds=((0, low), (4, low + 1)))
                problem = pm.QuasiStatic(grid, points, basis=basis)
                problem.fix(pm.plane(x=0.0), u=0)
                problem.body_load(force=(0, -5e-5 * scenes.YOUNG))
                list(problem.march(1, progress=False))
                v = points.volume0
                answers.append(float(v @ points.displacement[:, 1] / v.sum()))
            spread = np.ptp(answers) / abs(np.median(answers))
            found.append({"scene": f"{number} bodies, {basis}", "grid": name, "spread": float(spread)})
            show(found[-1])
    return found


# re-gridding ------------------------------------------------------------------------------------------
def regridded():
    """Footings on soil of 4 x 2 whose grid changes, against the last grid from the start, reset as often."""
    found = []
    fine = pm.Grid.box((0, 0), (4, 2), 1 / 8)

    def once(problem, trial):
        return fine if problem.comm.allreduce(int(trial.flowed.any())) else None

    def late(problem):
        return fine if problem.progress.step == 3 else None

    for name, cells, options in (
        ("micropolar, along bands", 4, {"length": 0.2, "regrid": pm.AlongBands(h=1 / 8)}),
        ("von Mises, function of trials", 4, {"regrid": once}),
        ("von Mises, function after step 3", 4, {"regrid": late, "reset": 1}),
    ):
        scene = {"size": (4, 2), **options}
        problem, load = footing(cells, **scene)
        lines = dict(zip("xy", problem.grid.lines, strict=True))
        reset = scene.pop("reset", None) or AfterSteps(one.step for one in problem.regrids)
        del scene["regrid"]
        _, expected = footing(cells, lines, **scene, reset=reset)
        changes = [one.step for one in problem.regrids]
        found.append({"scene": "footing", "grid": name, "unknowns": unknowns(problem), "changes": changes})
        found[-1] |= {"value": load, "error": load / expected - 1}
        show(found[-1])
    return found


class AfterSteps:
    """Resets after some steps."""

    def __init__(self, steps):
        self.steps, self.number = set(steps), 0

    def due(self, steps, gradient, comm):
        self.number += 1
        return self.number in self.steps


# --------------------------------------------------------------------------------------------------------
def compared(scene, rows):
    """Rows beside the one on equal cells."""
    equal, found = rows["equal"], []
    for name, (number, value, seconds) in rows.items():
        found.append(
            {
                "scene": scene,
                "grid": name,
                "unknowns": number,
                "share": number / equal[0],
                "value": value,
                "error": value / equal[1] - 1,
                "cpu_s": seconds,
                "cpu_share": seconds / equal[2],
            }
        )
        show(found[-1])
    return found


def show(row):
    text = {k: f"{v:.5g}" if isinstance(v, float) and math.isfinite(v) else str(v) for k, v in row.items()}
    print(", ".join(f"{k} {v}" if k not in ("scene", "grid") else v for k, v in text.items()), flush=True)


PARTS = {
    "footing": lambda args: footings(8 if args.quick else 16),
    "hole": lambda args: holes(8 if args.quick else 16),
    "layer": lambda args: layers(4),
    "regrid": lambda args: regridded(),
    "bodies": lambda args: bodies(10 if args.quick else 60),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts")
    parser.add_argument("--quick", action="store_true", help="coarser cells, fewer bodies")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    file = args.output / "grids.json"
    known = json.loads(file.read_text()) if file.exists() else {}
    for name in args.only:
        known[name] = PARTS[name](args)
        file.write_text(json.dumps(known, indent=1) + "\n")


if __name__ == "__main__":
    main()
