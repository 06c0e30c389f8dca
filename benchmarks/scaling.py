"""Strong scaling: an elastic block of 216 000 points on 1, 2 and more ranks, phase by phase.

A block of micropolar GIMPM points is bent and pulled in load steps with a reset each; from the second step on
domains cross the grid's planes. It has 30^3 cells of 2^3 points, or 15^3 cells of 4^3 points, once more with
MUMPS instead of multigrid. Each number of ranks has an mpirun of its own, one thread a rank. A phase lasts
until its slowest rank is done; sent bytes are what this package sends (PETSc's and MUMPS' own messages aren't
seen). `python3 benchmarks/scaling.py` does all; results are written after each run.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PHASES = ("assembly", "factor", "solve", "reset", "pattern", "migration", "update", "conditions")
# cells of a side, points in each direction of a cell, solver
BLOCKS = {"fine": (30, 2, "auto"), "coarse": (15, 4, "auto"), "direct": (15, 4, "direct")}
COLUMNS = (
    "block",
    "ranks",
    "phase",
    "wall_s",
    "cpu_s",
    "sent_bytes_most",
    "messages_most",
    "speedup_wall",
    "speedup_cpu",
)


# a rank ---------------------------------------------------------------------------------------------
def clock(comm: Any) -> Any:
    """A timer whose phases begin on all ranks together: seconds on the wall until the slowest rank is done,
    and of this rank CPU seconds, bytes and messages sent."""
    from polarmpm.tools.parallel import traffic

    class Clock:
        def __init__(self) -> None:
            self.phases: dict[str, list[float]] = {}

        @contextmanager
        def __call__(self, phase: str) -> Iterator[None]:
            comm.Barrier()
            begin, cpu = time.perf_counter(), time.process_time()
            sent = traffic.bytes, traffic.messages
            try:
                yield
            finally:
                cpu, sent = time.process_time() - cpu, (traffic.bytes - sent[0], traffic.messages - sent[1])
                comm.Barrier()
                sums = self.phases.setdefault(phase, [0.0] * 4)
                for k, more in enumerate((time.perf_counter() - begin, cpu, *sent)):
                    sums[k] += more

    return Clock()


def run(steps: int, block: str) -> dict[str, Any]:
    """The block's load steps on the ranks of this mpirun; collective."""
    from mpi4py import MPI

    import polarmpm as pm

    comm, (cells, per_cell, solver) = MPI.COMM_WORLD, BLOCKS[block]
    grid = pm.Grid.box((-4, -4, -4), (cells + 4,) * 3, 1.0)
    material = pm.MicropolarElastic.bounded_stiffness(lam=4e6, mu=4e6, kappa=4e5, l_b=0.5)
    bounds = (0,) * 3, (cells,) * 3
    points = pm.seed(grid, material=material, points_per_cell=per_cell, bounds=bounds)
    problem = pm.QuasiStatic(grid, points, solver=solver, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0, 0)), force=(2e5 * cells**2, 1e5 * cells**2, 5e4 * cells**2))
    problem._compile()  # once for all, from the cache
    problem.timer = timer = clock(comm)
    comm.Barrier()
    begin, cpu = time.perf_counter(), time.process_time()
    iterations = sum(step.iterations for step in problem.march(steps, progress=False))
    whole = [time.perf_counter() - begin, time.process_time() - cpu]
    whole += [sum(p[k] for p in timer.phases.values()) for k in (2, 3)]
    timer.phases["whole"] = whole
    nodes = problem.system.nodes
    mine = {"points": len(points), "owned": nodes.owned, "ghosts": len(nodes) - nodes.owned}
    every = {name: comm.gather(value) for name, value in mine.items()}
    most = {
        phase: [comm.allreduce(float(v), op=MPI.MAX) for v in values]
        for phase, values in timer.phases.items()
    }
    shape = (
        {name: {"most": max(v), "mean": sum(v) / comm.size} for name, v in every.items() if v[0] is not None}
        if comm.rank == 0
        else {}
    )
    return {
        "block": block,
        "solver": type(problem.system.solver).__name__,
        "ranks": comm.size,
        "points": comm.allreduce(len(points)),
        "unknowns": problem.unknowns,
        "iterations": iterations,
        "steps": steps,
        "phases": most,
        "shares": shape,
        "seconds_checking": check_seconds(problem),
    }


def check_seconds(problem: Any) -> float:
    """CPU seconds of a step's check of conservation, most of a rank; collective."""
    from mpi4py import MPI

    conservation, interpolation = problem._conservation, problem.system.interpolation
    begin = time.process_time()
    for _ in range(10):
        conservation.check(interpolation, problem.system.x)
    return problem.comm.allreduce((time.process_time() - begin) / 10, op=MPI.MAX)


# all of them ------------------------------------------------------------------------------------------
def on_ranks(ranks: int, steps: int, block: str) -> dict[str, Any]:
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("PMIX_", "OMPI_COMM", "PRTE_"))}
    env = {**keep, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    env.setdefault("OMPI_MCA_rmaps_base_oversubscribe", "1")
    env.setdefault("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe")
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "result.json")
        command = ["mpirun", "-n", str(ranks), sys.executable, __file__, "--worker", str(result)]
        command += [str(steps), block]
        subprocess.run(command, env=env, check=True, stdin=subprocess.DEVNULL)
        return json.loads(result.read_text())


def table(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the CSV file."""
    rows, first = [], runs[0]["phases"]
    for found in runs:
        for phase in (*PHASES, "whole"):
            if phase in found["phases"]:
                wall, cpu, sent, messages = found["phases"][phase]
                before = first.get(phase, [float("nan")] * 4)
                values = (
                    found["solver"],
                    found["ranks"],
                    phase,
                    wall,
                    cpu,
                    sent,
                    messages,
                    before[0] / wall,
                    before[1] / cpu,
                )
                rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def markdown(runs: list[dict[str, Any]], rows: list[dict[str, Any]]) -> str:
    head = runs[0]
    out = [
        f"**{head['block'].capitalize()}** ({head['solver']}): {head['points']} points, {head['unknowns']} "
        f"unknowns, {head['steps']} load steps with a reset each, {head['iterations']} iterations. Seconds "
        "of the slowest rank, on the wall and of CPU; in brackets how many times as fast as on "
        f"{head['ranks']} rank(s).",
        "",
        "| phase | " + " | ".join(f"{r['ranks']} rank(s), wall | CPU | sent (MB)" for r in runs) + " |",
        "|---" * (1 + 3 * len(runs)) + "|",
    ]
    for phase in (*PHASES, "whole"):
        line = [phase]
        for found in runs:
            row = next((r for r in rows if (r["ranks"], r["phase"]) == (found["ranks"], phase)), None)
            if row is None:
                line += [""] * 3
                continue
            line += [f"{row[f'{k}_s']:.2f} ({row[f'speedup_{k}']:.2f})" for k in ("wall", "cpu")]
            line.append(f"{row['sent_bytes_most'] / 1e6:.2f}")
        out.append("| " + " | ".join(line) + " |")
    out += [
        "",
        "| ranks | points, most/mean | own nodes, most/mean | ghosts, most | check of a step (CPU s) |",
    ]
    out.append("|---" * 5 + "|")
    for found in runs:
        shares = found["shares"]
        fair = [f"{shares[k]['most'] / shares[k]['mean']:.3f}" for k in ("points", "owned")]
        check = f"{found['seconds_checking']:.4f}"
        out.append(
            "| " + " | ".join([str(found["ranks"]), *fair, str(shares["ghosts"]["most"]), check]) + " |"
        )
    return "\n".join(out) + "\n"


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        found = run(int(sys.argv[3]), sys.argv[4])
        if found["shares"]:
            Path(sys.argv[2]).write_text(json.dumps(found))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4], metavar="N")
    parser.add_argument("--block", nargs="+", choices=BLOCKS, default=list(BLOCKS))
    parser.add_argument("--steps", type=int, default=2)
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    runs: dict[str, list[dict[str, Any]]] = {}
    for block in args.block:
        for ranks in args.ranks:
            runs.setdefault(block, []).append(on_ranks(ranks, args.steps, block))
            rows = {name: table(found) for name, found in runs.items()}
            with (args.output / "scaling.csv").open("w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                for name in rows:
                    writer.writerows(rows[name])
            text = "\n".join(markdown(runs[name], rows[name]) for name in runs)
            (args.output / "scaling.md").write_text(text)
            print(markdown(runs[block], rows[block]), flush=True)


if __name__ == "__main__":
    main()
