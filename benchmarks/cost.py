"""What a load step costs over the number of material points: CPU time, memory, and their exponents.

A block of a micropolar material under its own weight, held below, one load step from rest: in space 2³ points
a cell, in the plane 2², standard weighting functions. Each size has a process of its own, one thread, and
is run twice where it's small; the second run counts. Sizes that aren't asked for stay as they were in the
file, so that a quiet machine can add the large ones: `--points 1e6 2e6`. Writes JSON, a Markdown table, the
line of the README, and a figure. `--without-avx512` runs the sizes in turns with a copy of the package that
is built without these instructions (two minutes), and writes `avx512.json`.
"""

import argparse
import itertools
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from pages import quote

import polarmpm as pm
from polarmpm.plot import styled

HERE = Path(__file__).parent
SIZES = (1e3, 1e4, 1e5, 1e6, 2e6)  # points; the number of cells that comes closest is taken
SMALL = 3e5  # points up to which a size is run twice
PHASES = ("assembly", "factor", "solve", "pattern", "conditions", "update")
BODIES = {"block": 3, "sheet": 2}  # space dimension


def build(body, cells):
    d = BODIES[body]
    grid = pm.Grid.box((0,) * d, (1,) * d, 1 / cells)
    material = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=1e5, alpha=0.0, beta=1e3, gamma=1e3)
    points = pm.seed(grid, material=material, points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=1, balanced_reset=False)
    problem.fix(pm.plane(**{"xyz"[d - 1]: 0.0}), u=0, theta=0)
    problem.body_load(force=(0,) * (d - 1) + (-1e5,))
    return problem


def megabytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(body, cells):
    """A step in this process."""
    empty, begin = megabytes(), time.process_time()
    problem = build(body, cells)
    built = time.process_time() - begin
    points, begin = len(problem.points), time.process_time()
    (step,) = problem.march(1, progress=False)
    spent, solver = time.process_time() - begin, problem.system.solver
    seconds = problem.timer.seconds
    return {
        "body": body,
        "cells": cells,
        "points": points,
        "unknowns": problem.unknowns,
        "solver": type(solver).__name__,
        "newton": step.iterations,
        "krylov": getattr(solver, "iterations", 0),
        "failures": getattr(solver, "failures", 0),
        "build_s": built,
        "step_s": spent,
        **{f"{phase}_s": seconds.get(phase, 0.0) for phase in PHASES},
        "memory_mb": megabytes(),
        "bytes_a_point": (megabytes() - empty) * 2**20 / points,
    }


def in_a_process(body, cells, **environment):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    command = [sys.executable, __file__, "--measure", body, str(cells)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def older(folder):
    """A copy of the package as a processor without AVX-512 would have it; the folder to import it from."""
    package = Path(shutil.copytree(Path(pm.__file__).parent, folder / "polarmpm"))
    kernels = package / "kernels"
    for name, line, without in (
        ("_points.h", '"arch=x86-64-v4", ', ""),
        ("jit.py", "-march=native", "-march=x86-64-v3"),
    ):
        text = (kernels / name).read_text()
        if text.count(line) != 1:
            raise SystemExit(f"{name} has {line!r} {text.count(line)} times, not once")
        (kernels / name).write_text(text.replace(line, without))
    (library,) = kernels.glob("_native*.so")
    flags = ["-O3", "-std=gnu11", "-fno-math-errno", "-fno-wrapv", "-fPIC", "-shared"]  # as in setup.py
    subprocess.run(["gcc", *flags, "_native.c", "-o", library.name, "-lm"], cwd=kernels, check=True)
    return folder


def without_avx512(bodies, sizes, output):
    """Each size with and without AVX-512 in turns, least of two."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = {"PYTHONPATH": str(older(Path(folder)))}
        for body, points in itertools.product(bodies, sizes):
            cells, runs = cells_of(body, points), []
            for environment in ({}, path) * 2:
                runs.append(in_a_process(body, cells, **environment))
            having, lacking = (min(runs[k::2], key=lambda row: row["step_s"]) for k in range(2))
            rows.append({"with": having, "without": lacking})
            ratio = lacking["step_s"] / having["step_s"]
            print(f"{body}, {having['points']} points: with AVX-512 {having['step_s']:.3g} s,", end=" ")
            print(f"without {lacking['step_s']:.3g} s, {ratio:.2f} times", flush=True)
            output.mkdir(parents=True, exist_ok=True)
            (output / "avx512.json").write_text(json.dumps(rows, indent=1) + "\n")


def cells_of(body, points):
    d = BODIES[body]
    return round((points / 2**d) ** (1 / d))


# tables ---------------------------------------------------------------------------------------------
def exponents(rows, what):
    """Of a quantity between each size and the one before; None for the first one."""
    pairs = itertools.pairwise(rows)
    grows = [
        math.log(b[what] / a[what]) / math.log(b["points"] / a["points"]) if a[what] and b[what] else None
        for a, b in pairs
    ]
    return [None, *grows] if rows else []


def of_body(rows, body):
    return sorted((row for row in rows if row["body"] == body), key=lambda row: row["points"])


def table(rows):
    head = ["body", "points", "unknowns", "Newton", "CG", "step (CPU s)", "exponent"]
    head += ["assembly", "set-up or factor", "solve", "µs a point", "memory (MB)", "kB a point", "exponent"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for body in BODIES:
        mine = of_body(rows, body)
        grows = zip(mine, exponents(mine, "step_s"), exponents(mine, "bytes_a_point"), strict=True)
        for row, of_time, of_bytes in grows:
            cells = [body, row["points"], row["unknowns"], row["newton"], row["krylov"] or ""]
            cells += [f"{row['step_s']:.3g}", "" if of_time is None else f"{of_time:.2f}"]
            cells += [f"{row[name]:.2g}" for name in ("assembly_s", "factor_s", "solve_s")]
            cells += [f"{1e6 * row['step_s'] / row['points']:.1f}", f"{row['memory_mb']:.0f}"]
            cells += [f"{row['bytes_a_point'] / 1e3:.2f}", "" if of_bytes is None else f"{1 + of_bytes:.2f}"]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def readme(rows):
    """What the README says of the largest block."""
    row = of_body(rows, "block")[-1]
    points, unknowns = (f"{row[name]:,}".replace(",", " ") for name in ("points", "unknowns"))
    return (
        f"a load step of {points} points ({unknowns} unknowns, {row['newton']} iterations of Newton's "
        f"method) takes {row['step_s']:.2g} s of CPU and {row['memory_mb'] / 1e3:.2g} GB"
    )


@styled()
def draw(rows, file):
    """CPU time and memory over points."""
    from polarmpm import plot

    figure, axes = plot.subplots(1, 2, figsize=(plot.PAGE, 3.0))
    for colour, body in enumerate(BODIES):
        mine = of_body(rows, body)
        if not mine:
            continue
        points = np.array([row["points"] for row in mine])
        for name, style in (("step", "o-"), ("assembly", "^:"), ("factor", "v:"), ("solve", "s:")):
            values = [row[f"{name}_s"] or np.nan for row in mine]
            axes[0].plot(points, values, style, color=f"C{colour}", label=f"{body}, {name}")
        axes[1].plot(points, [row["memory_mb"] for row in mine], "o-", color=f"C{colour}", label=body)
        proportional = {} if colour else {"label": "proportional to the points"}
        axes[0].plot(points, mine[-1]["step_s"] * points / points[-1], "k--", linewidth=0.6, **proportional)
    for axis, name in zip(axes, ("CPU time of a step (s)", "memory of the process (MB)"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel="material points", ylabel=name)
    plot.legend_below(figure, axes[:1])
    plot.save(figure, file)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=float, nargs="+", default=SIZES, metavar="N", help="sizes to run")
    parser.add_argument("--bodies", nargs="+", choices=BODIES, default=list(BODIES), metavar="NAME")
    parser.add_argument("--redraw", action="store_true", help="table and figure from the JSON file")
    parser.add_argument(
        "--without-avx512", action="store_true", help="these sizes, beside the package without it"
    )
    parser.add_argument(
        "--measure", nargs=2, metavar=("BODY", "CELLS"), help="one size, in this process; JSON"
    )
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(args.measure[0], int(args.measure[1])), default=float))
        return
    if args.without_avx512:
        without_avx512(args.bodies, args.points, args.output)
        return
    kept = args.output / "cost.json"
    rows = json.loads(kept.read_text()) if kept.exists() else []
    for body in () if args.redraw else args.bodies:
        for points in args.points:
            cells = cells_of(body, points)
            for _ in range(2 if points <= SMALL else 1):
                row = in_a_process(body, cells)
            rows = [r for r in rows if (r["body"], r["cells"]) != (body, cells)] + [row]
            print(json.dumps(row), flush=True)
            args.output.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(rows, indent=1) + "\n")
    (args.output / "cost.md").write_text(table(rows))
    if args.output == HERE / "results":
        quote(HERE.parent / "docs" / "cost.md", "cost", f"\n{table(rows)}")
        quote(HERE.parent / "README.md", "cost", readme(rows))
    print(table(rows), readme(rows), sep="\n")
    draw(rows, args.output / "cost.png")


if __name__ == "__main__":
    main()
