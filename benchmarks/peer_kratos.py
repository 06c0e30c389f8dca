"""A live comparison with Kratos' MPM application: what a point costs in an iteration, and the same answer.

Plane-strain cantilever of 10 x 1 m under a dead end force of 100 kN in 50 load steps, cells of 0.25 m,
equally spaced points, standard weighting functions, a reset after each step; neo-Hookean in both codes, with
the same energy. Each run has a process of its own on one thread, codes take turns. Kratos comes from PyPI
into a virtual environment that the script makes the first time. Writes JSON, a Markdown table and a figure.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
import venv
from pathlib import Path
from statistics import median

import numpy as np

import polarmpm as pm
from polarmpm.plot import styled

HERE = Path(__file__).parent
PACKAGES = ("KratosMPMApplication", "KratosLinearSolversApplication")
SCENE = {
    "length": 10.0,  # m
    "height": 1.0,
    "cell": 0.25,
    "box": ((0.0, -10.0), (11.0, 2.0)),
    "E": 12e6,  # Pa
    "nu": 0.2,
    "force": 100e3,  # N per metre of width
    "steps": 50,
    "tolerance": 1e-9,  # of residuals: Kratos' relative to the step's first one, ours to all forces
    "displacement_tolerance": 1e-6,  # of Kratos' other criterion, on a correction; what is left is its square
    "max_iterations": 25,
}
HARD = 10  # iterations above which a step is called hard
MICROPOLAR = {"n": 0.5, "l_b": 0.1, "l_t": 0.1, "psi": 1.0}  # besides E and nu

# Kratos 10.4's solvers that are in the wheels and go through the scene; pardiso is not in them, sparse_cg and
# Krylov methods with plain preconditioners give up
DIRECT = {
    "skyline_lu": {"linear_solver": "skyline_lu_factorization", "linear_settings": {}},
    "sparse_lu": {"linear_solver": "LinearSolversApplication.sparse_lu", "linear_settings": {}},
    "sparse_qr": {"linear_solver": "LinearSolversApplication.sparse_qr", "linear_settings": {}},
    "amgcl": {
        "linear_solver": "amgcl",
        "linear_settings": {"krylov_type": "cg", "tolerance": 1e-10, "max_iteration": 2000},
    },
}
BEST = DIRECT["skyline_lu"] | {"builder": "elimination"}

# Kratos' displacement criterion spares the residual that follows each correction, so it is the faster one
KRATOS, RESIDUAL = "Kratos", "Kratos, residual criterion"
CLASSICAL, GHOST = "polarmpm, classical", "polarmpm, classical, ghost penalty"
POLAR = "polarmpm, micropolar"
CODES = (KRATOS, RESIDUAL, CLASSICAL, GHOST, POLAR)
CRITERIA = {KRATOS: "displacement", RESIDUAL: "residual"}


# runs ---------------------------------------------------------------------------------------------
class Counting(pm.QuasiStatic):
    """Counts the linear solutions of all attempts, those of steps that are cut, too."""

    taken = 0

    def attempt(self, factor):
        outcome = super().attempt(factor)
        self.taken += outcome.iterations
        return outcome


def build(code, per_cell):
    """Our problem, and the points at the free end."""
    moduli = {"E": SCENE["E"], "nu": SCENE["nu"]}
    if code == POLAR:
        material = pm.MicropolarElastic.from_engineering(**moduli, **MICROPOLAR)
    else:
        material = pm.NeoHookean.from_engineering(**moduli)
    grid = pm.Grid.box(*SCENE["box"], SCENE["cell"])
    body = (0, 0), (SCENE["length"], SCENE["height"])
    points = pm.seed(grid, bounds=body, material=material, points_per_cell=per_cell)
    controls = pm.Controls(force_tolerance=SCENE["tolerance"], max_iterations=SCENE["max_iterations"])
    ghost = "thesis" if code == GHOST else None
    published = {**pm.PUBLISHED, "basis": "mpm"}
    problem = Counting(grid, points, controls=controls, ghost=ghost, **published)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if code == POLAR else {}))
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, -SCENE["force"]))
    return problem, tip


def ours(code, per_cell, trace):
    """One run in this process; the compiled kernels are at hand."""
    problem, tip = build(code, per_cell)
    points, path, begin = problem.points, [], time.process_time()
    for _ in problem.march(SCENE["steps"], adaptive=True, progress=False):
        if trace:
            path.append(points.mean_displacement(tip).tolist())
    loop = time.process_time() - begin
    return {
        "points": points.total,
        "left": points.total,
        "steps": len(problem.steps),
        "iterations": problem.taken,
        "of_steps": [step.iterations for step in problem.steps],
        "unconverged": [step.number for step in problem.steps if step.cuts],
        "tip": points.mean_displacement(tip).tolist(),
        "path": path,
        "loop_s": loop,
        "process_s": time.process_time(),
        "unknowns": problem.unknowns,
        "phases": problem.timer.seconds,
    }


def run(code, per_cell, python, trace=False, solver=BEST):
    """One run in a new process on one thread: what it prints in its last line."""
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    if code in CRITERIA:
        details = {"per_cell": per_cell, "trace": trace, "criterion": CRITERIA[code]}
        details = json.dumps(details | solver)
        command = [str(python), str(HERE / "peer_kratos_run.py"), json.dumps(SCENE), details]
    else:
        details = json.dumps([code, per_cell, trace])
        command = [sys.executable, str(Path(__file__).resolve()), "--one", details]
    done = subprocess.run(command, env=os.environ | one_thread, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{code}, {per_cell}² points a cell:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    found["us"] = 1e6 * found["loop_s"] / found["points"] / found["iterations"]
    return {"code": code, "per_cell": per_cell} | found


def install(folder):
    """Kratos' interpreter, in a virtual environment that is made if it isn't there."""
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"making {folder} with {', '.join(PACKAGES)}", flush=True)
        venv.create(folder, with_pip=True)
    missing = subprocess.run([python, "-c", "import KratosMultiphysics.MPMApplication"], capture_output=True)
    if missing.returncode:
        subprocess.run([python, "-m", "pip", "install", "--quiet", *PACKAGES], check=True)
    return python


# studies ------------------------------------------------------------------------------------------
def compare_paths(per_cell, python):
    """How far tips are apart, relative to the displacement: up to the first step that is hard in one of the
    codes (nodes that points hardly reach may then end elsewhere), and at the end."""
    theirs, mine = (run(code, per_cell, python, trace=True) for code in (RESIDUAL, CLASSICAL))
    hard = [k for found in (theirs, mine) for k, n in enumerate(found["of_steps"]) if n > HARD]
    cut = [k - 1 for k in mine["unconverged"]]
    steps = min([*hard, *cut, SCENE["steps"]])
    a, b = (np.array(found["path"])[[*range(steps), -1]] for found in (theirs, mine))
    apart = np.linalg.norm(a - b, axis=1) / np.linalg.norm(a, axis=1)
    return {
        "per_cell": per_cell,
        "unconverged": [theirs["unconverged"], mine["unconverged"]],
        "steps": steps,
        "apart": float(apart[:steps].max(initial=0.0)),
        "apart_at_end": float(apart[-1]),
    }


def compare_solvers(python, numbers, repeat):
    """CPU time of Kratos with its linear solvers and builders, least of `repeat`."""
    rows = []
    for name, solver in DIRECT.items():
        for builder in ("block", "elimination"):
            row = {"solver": name, "builder": builder}
            for n in numbers:
                found = [run(KRATOS, n, python, solver=solver | {"builder": builder}) for _ in range(repeat)]
                row[str(n)] = min(r["us"] for r in found)
            print(row, flush=True)
            rows.append(row)
    return rows


def describe(python):
    """Versions and the machine's class."""
    code = "import importlib.metadata as m, sys; print(*(m.version(p) for p in sys.argv[1:]))"
    names = ("KratosMultiphysics", *PACKAGES)
    found = subprocess.run([python, "-c", code, *names], capture_output=True, text=True, check=True)
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "versions": dict(zip(names, found.stdout.split(), strict=True)),
        "polarmpm": pm.__version__,
        "machine": f"{model or platform.machine()}, {os.cpu_count()} cores",
    }


def study(args):
    python = install(args.venv)
    results = describe(python) | {"scene": SCENE, "micropolar": MICROPOLAR, "runs": [], "paths": []}
    for code in CODES:
        if code not in CRITERIA:
            run(code, 2, python)  # compiles the kernels
    for n in args.points:
        results["paths"].append(compare_paths(n, python))
        print(results["paths"][-1], flush=True)
    for turn in range(args.repeat):
        for n in args.points:
            for code in CODES:
                row = run(code, n, python) | {"turn": turn}
                del row["path"], row["of_steps"]
                results["runs"].append(row)
                print(f"{code}, {n}²: {row['iterations']} iterations, {row['us']:.2f} us", flush=True)
    if args.solvers:
        results["solvers"] = compare_solvers(python, (args.points[0], args.points[-1]), 3)
    return results


# output -------------------------------------------------------------------------------------------
def summarise(results):
    """One row for each number of points and code: least and median of the turns."""
    rows = []
    for n in sorted({r["per_cell"] for r in results["runs"]}):
        for code in CODES:
            found = [r for r in results["runs"] if r["per_cell"] == n and r["code"] == code]
            row = {key: found[0][key] for key in ("per_cell", "code", "points", "iterations", "tip")}
            row["unconverged"] = len(found[0]["unconverged"])
            for key in ("us", "loop_s", "process_s"):
                values = [r[key] for r in found]
                row[key] = min(values), median(values)
            rows.append(row)
    for row in rows:
        base = next(r for r in rows if r["per_cell"] == row["per_cell"] and r["code"] == KRATOS)
        row["share"] = [a / b for a, b in zip(row["us"], base["us"], strict=True)]
    return rows


def markdown(results):
    """The tables: cost, agreement, and Kratos' solvers where they were compared."""
    lines = [
        "| points a cell | code | points | iterations | steps not converged, or cut | tip (m) "
        "| loop (CPU s) | process (CPU s) | CPU per point and iteration (µs): least, median "
        "| over Kratos': least, median |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in summarise(results):
        lines.append(
            f"| {r['per_cell']}² | {r['code']} | {r['points']} | {r['iterations']} | {r['unconverged']} "
            f"| ({r['tip'][0]:.3f}, {r['tip'][1]:.3f}) | {r['loop_s'][1]:.2f} | {r['process_s'][1]:.2f} "
            f"| {r['us'][0]:.2f}, {r['us'][1]:.2f} | {r['share'][0]:.2f}, {r['share'][1]:.2f} |"
        )
    lines += [
        "",
        f"| points a cell | not converged: Kratos | cut: polarmpm | steps before one of more than {HARD} "
        "iterations | tips apart in these | at the end |",
        "|---|---|---|---|---|---|",
    ]
    for p in results["paths"]:
        failed = " | ".join(", ".join(map(str, steps)) or "none" for steps in p["unconverged"])
        lines.append(
            f"| {p['per_cell']}² | {failed} | {p['steps']} | {p['apart']:.1e} | {p['apart_at_end']:.1e} |"
        )
    if "solvers" in results:
        numbers = [key for key in results["solvers"][0] if key.isdigit()]
        lines += ["", "| Kratos' solver | builder | " + " | ".join(f"{n}² (µs)" for n in numbers) + " |"]
        lines += ["|---" * (2 + len(numbers)) + "|"]
        for row in results["solvers"]:
            cost = " | ".join(f"{row[n]:.2f}" for n in numbers)
            lines.append(f"| {row['solver']} | {row['builder']} | {cost} |")
    return "\n".join(lines) + "\n"


@styled()
def draw(results, path):
    """CPU time per point and iteration over the number of points: least, with a bar up to the median."""
    from polarmpm import plot

    figure, ax = plot.subplots(figsize=(1.3 * plot.COLUMN, 3.2))
    styles = ("o", "#444444"), ("v", "#999999"), ("s", "#0072b2"), ("D", "#56b4e9"), ("^", "#d55e00")
    rows = summarise(results)
    numbers = sorted({r["per_cell"] for r in rows})
    for k, (code, (marker, colour)) in enumerate(zip(CODES, styles, strict=True)):
        least, middle = np.array([r["us"] for r in rows if r["code"] == code]).T
        at = np.array(numbers) + 0.04 * (k - 2)  # side by side, so that bars don't hide each other
        ax.plot(at, least, marker=marker, color=colour, label=code)
        ax.errorbar(at, least, [0 * least, middle - least], fmt="none", color=colour, capsize=3)
        if code == KRATOS:
            ax.plot(at, least / 3, "--", color=colour, label="a third of Kratos")
    ax.set_xticks(numbers, [f"{n}²" for n in numbers])
    ax.set_ylim(bottom=0.0)
    ax.set(xlabel="points per cell", ylabel="CPU time per point and\niteration (µs)")
    ax.grid(alpha=0.3)
    ax.legend(loc="upper center", bbox_to_anchor=(0.45, -0.17), ncols=2, frameon=False)
    plot.save(figure, path)


def main(argv=None):
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "polarmpm" / "peer"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--venv", type=Path, default=cache, metavar="DIR", help="Kratos' environment")
    parser.add_argument("--points", type=int, nargs="+", default=[2, 3, 4, 5, 6], help="a cell and direction")
    parser.add_argument("--repeat", type=int, default=5, help="turns")
    parser.add_argument("--solvers", action="store_true", help="compare Kratos' linear solvers, too")
    parser.add_argument("--redraw", action="store_true", help="table and figure anew from the JSON file")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    parser.add_argument("--figure", type=Path, default=HERE.parent / "docs" / "images" / "peer_kratos.png")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.one:
        print(json.dumps(ours(*json.loads(args.one))))
        return
    file = args.output / "peer_kratos.json"
    if args.redraw:
        results = json.loads(file.read_text())
    else:
        results = study(args)
        args.output.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(results, indent=1) + "\n")
    (args.output / "peer_kratos.md").write_text(markdown(results))
    draw(results, args.figure)
    print(markdown(results))


if __name__ == "__main__":
    main()
