"""Curved cantilever: how the answer depends on the position of the arch in the grid, and what it costs.

Runs the demo's problem over cell sizes, weighting functions and positions, adaptively (some coarse positions
need cuts), and writes a CSV file and a Markdown table. `--quick` leaves out the finest cells.
"""

import argparse
import csv
import importlib.util
import time
from pathlib import Path

import numpy as np

import polarmpm as pm

HERE = Path(__file__).parent
POSITIONS = [(-100.0, 0.0), (-99.5, 0.0), (-99.75, 0.25), (-100.0, -0.5)]  # y of the centre, lowest z (m)
PUBLISHED = {2.0: (6.03, 90.1), 1.0: (1.31, 792.7), 0.5: (0.40, 23736.5)}  # error (m), CPU seconds


def load_demo():
    """The demo's module: its geometry and problem."""
    path = HERE.parent / "demos" / "curved_cantilever.py"
    spec = importlib.util.spec_from_file_location("curved_cantilever", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(demo, cell, basis, centre, bottom):
    """One row of the table."""
    begin = time.process_time()
    args = argparse.Namespace(cell=cell, points_per_cell=4, basis=basis, centre=centre, bottom=bottom)
    problem, tip = demo.build(args)
    row = {"cell": cell, "basis": basis, "centre": centre, "bottom": bottom, "points": problem.points.total}
    try:
        for _ in problem.march(15, adaptive=True, progress=False):
            pass
    except pm.NotConverged as failure:
        return row | {"failed_at": round(failure.factor, 4), "cpu_s": time.process_time() - begin}
    found = problem.points.mean_displacement(tip)
    return row | {
        "unknowns": problem.unknowns,
        "steps": len(problem.steps),
        "cuts": sum(step.cuts for step in problem.steps),
        "iterations": sum(step.iterations for step in problem.steps),
        "u_x": found[0],
        "u_y": found[1],
        "u_z": found[2],
        "error": float(np.linalg.norm(found - demo.BEAM)),
        "cpu_s": time.process_time() - begin,
    }


COLUMNS = [
    "cell", "basis", "centre", "bottom", "points", "unknowns", "steps", "cuts", "iterations",
    "u_x", "u_y", "u_z", "error", "cpu_s", "failed_at",
]  # fmt: skip


def markdown(rows):
    """The table, with the published error and CPU time of each cell size."""
    lines = [
        "| cell (m) | basis | centre y, lowest z (m) | steps (cuts) | iterations "
        "| u_x | u_y | u_z (m) | error (m) | CPU (s) | published error, CPU |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        published = "{:g} m, {:g} s".format(*PUBLISHED[r["cell"]])
        head = f"| {r['cell']:g} | {r['basis']} | {r['centre']:g}, {r['bottom']:g} |"
        if "failed_at" in r:
            lines.append(f"{head} no equilibrium at load factor {r['failed_at']} | | | | | | | {published} |")
            continue
        u = " | ".join(f"{r[c]:.2f}" for c in ("u_x", "u_y", "u_z"))
        lines.append(
            f"{head} {r['steps']} ({r['cuts']}) | {r['iterations']} | {u} | {r['error']:.2f} "
            f"| {r['cpu_s']:.1f} | {published} |"
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="leave out the cells of 0.5 m")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    demo, rows = load_demo(), []
    for cell in (2.0, 1.0) if args.quick else (2.0, 1.0, 0.5):
        for basis in ("mpm", "gimpm"):
            for centre, bottom in POSITIONS:
                rows.append(run(demo, cell, basis, centre, bottom))
                print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    with (args.output / "curved_cantilever.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        writer.writerows(
            {k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )
    (args.output / "curved_cantilever.md").write_text(markdown(rows))


if __name__ == "__main__":
    main()
