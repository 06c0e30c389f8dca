"""Where the time and the memory of a run go, phase by phase.

Every scene runs in a process of its own: CPU seconds by phase, microseconds a point and iteration, the whole
against what factor and solve alone take, the start of a step against one assembly, and bytes a point apart
from the solver. `--quick` leaves out the expensive scenes, `--scene` picks some. Writes CSV and Markdown.
"""

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from assembly import _START, kernel_seconds, least
from mpm_versus_fem import demo, finite_elements

import polarmpm as pm

HERE = Path(__file__).parent


# scenes: each returns the problem and the options of its march --------------------------------------
def arch(cell, basis):
    args = argparse.Namespace(cell=cell, points_per_cell=4, basis=basis, centre=-100.0, bottom=0.0)
    return demo("curved_cantilever").build(args)[0], {"steps": 15}


def block(cells, basis="mpm"):
    """A cube of 8 points a cell under its own weight, held below; one load step."""
    grid = pm.Grid.box((0, 0, 0), (1, 1, 1), 1 / cells)
    material = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=1e5, alpha=0.0, beta=1e3, gamma=1e3)
    points = pm.seed(grid, material=material, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, basis=basis, reset=1, balanced_reset=False)
    problem.fix(pm.plane(z=0.0), u=0, theta=0)
    problem.body_load(force=(0, 0, -1e5))
    return problem, {"steps": 1}


def plastic():
    args = argparse.Namespace(points_per_cell=2, basis="bspline")
    return demo("biaxial").build(1.25e-3, 10.0, args)[0], {"steps": 40, "to": 0.25, "adaptive": True}


def elements():
    return finite_elements(128, 2, 1).problem, {"steps": 15}


SCENES = {
    "arch, 1 m, MPM": lambda: arch(1.0, "mpm"),
    "arch, 1 m, GIMPM": lambda: arch(1.0, "gimpm"),
    "arch, 0.5 m, MPM": lambda: arch(0.5, "mpm"),
    "arch, 0.5 m, GIMPM": lambda: arch(0.5, "gimpm"),
    "block, 1e5 points": lambda: block(23),
    "block, 1e6 points": lambda: block(50),
    "plane-strain plastic column": plastic,
    "FEM, degree 1, 128 x 2 x 2": elements,
}
EXPENSIVE = ("arch, 0.5 m, GIMPM", "block, 1e6 points")
SOLVER = ("factor", "solve")
START = ("reset", "pattern", "conditions")  # of a step


# one scene, in its own process ----------------------------------------------------------------------
def megabytes():
    """Most memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(name):
    empty, begin = megabytes(), time.process_time()
    problem, options = SCENES[name]()
    seeded, built = megabytes(), time.process_time()
    points = len(problem.points)
    system = problem.system_at(0.0)
    system.evaluate(True)
    row = {"scene": name, "points": points, "build_s": built - begin}
    row |= {"seeded_bytes": (seeded - empty) * 2**20 / points}
    row["bytes_without_solver"] = (megabytes() - empty) * 2**20 / points
    assembly = least(lambda: system.evaluate(True), 5, time.process_time)
    if hasattr(problem, "_compiled"):
        row["kernel_us"] = 1e6 / points * kernel_seconds(problem, 5)
    problem.timer.seconds.clear()
    begin = time.process_time()
    iterations = sum(step.iterations for step in problem.march(progress=False, **options))
    whole, seconds = time.process_time() - begin, problem.timer.seconds
    if getattr(problem, "policy", None) == pm.EverySteps(1):
        start = sum(seconds.get(phase, 0.0) for phase in START) / len(problem.steps)
        row["start_to_assembly"] = (
            start * iterations / seconds["assembly"]
        )  # an iteration's, at the same points
    return row | {
        "unknowns": problem.unknowns,
        "steps": len(problem.steps),
        "iterations": iterations,
        "whole_s": whole,
        "per_point_and_iteration_us": 1e6 * whole / points / iterations,
        **{f"{phase}_s": s for phase, s in sorted(seconds.items())},
        "rest_s": whole - sum(s for phase, s in seconds.items() if phase != "return mapping"),  # in assembly
        "whole_to_solver": whole / sum(seconds[phase] for phase in SOLVER),
        "assembly_us": 1e6 / points * assembly,
        "most_memory_mb": megabytes(),
    }


def in_new_process(name):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--measure", name]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def warm_start():
    """Seconds on the wall from the shell to the first converged step, least of five."""
    return least(lambda: subprocess.run([sys.executable, "-c", _START], check=True), 5)


# tables ---------------------------------------------------------------------------------------------
def table(rows):
    phases = ["assembly", *SOLVER, *START, "update"]
    head = ["scene", "points", "unknowns", "iterations", "whole (s)", *phases, "rest"]
    head += ["whole / (factor + solve)"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        rest = row["whole_s"] - sum(row.get(f"{p}_s", 0.0) for p in phases)
        cells = [row["scene"], row["points"], row["unknowns"], row["iterations"], f"{row['whole_s']:.3g}"]
        cells += [f"{row.get(f'{p}_s', 0.0):.2g}" for p in phases] + [f"{rest:.2g}"]
        lines.append("| " + " | ".join(map(str, [*cells, f"{row['whole_to_solver']:.2f}"])) + " |")
    head = [
        "scene",
        "kernel",
        "assembly",
        "whole",
        "start of a step / assembly",
        "bytes a point",
        "memory (MB)",
    ]
    lines += ["", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        kernel = f"{row['kernel_us']:.2f}" if "kernel_us" in row else ""
        cells = [
            row["scene"],
            kernel,
            f"{row['assembly_us']:.2f}",
            f"{row['per_point_and_iteration_us']:.2f}",
        ]
        cells += [f"{row['start_to_assembly']:.2f}" if "start_to_assembly" in row else ""]
        cells += [f"{row['bytes_without_solver']:.0f}"]
        lines.append("| " + " | ".join([*cells, f"{row['most_memory_mb']:.0f}"]) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="leave out the expensive scenes")
    parser.add_argument("--scene", nargs="+", choices=SCENES, metavar="NAME", help="only these")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    parser.add_argument("--measure", choices=SCENES, metavar="NAME", help="one scene, in this process; JSON")
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(args.measure), default=float))
        return
    names = args.scene or [name for name in SCENES if not (args.quick and name in EXPENSIVE)]
    rows = []
    for name in names:
        in_new_process(name) if "points" not in name else None  # compiles what is missing
        rows.append(in_new_process(name))
        print(json.dumps(rows[-1], indent=2), flush=True)
    start = warm_start()
    text = table(rows) + f"\nFrom the shell to the first converged step, kernels compiled: {start:.2f} s.\n"
    print(text)
    args.output.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with open(args.output / "phases.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})
    (args.output / "phases.md").write_text(text)


if __name__ == "__main__":
    main()
