"""What is kept of a benchmark's runs, in tables and in JSON files that can be laid side by side."""

from __future__ import annotations

import json
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import polarmpm as pm


@dataclass
class Run:
    """What came out of a scene.

    Attributes:
        value: what the scene reads, None if it has failed.
        failure: why it found no equilibrium.
        steps, iterations, cuts: of all load steps.
        cpu_s: CPU seconds, but for compiling.
        warned: warnings of what not to trust; other: all others.
        unresolved: the largest share of a step's work inside the points' boxes; None if it isn't known.
    """

    value: object = None
    failure: str = ""
    steps: int = 0
    iterations: int = 0
    cuts: int = 0
    points: int = 0
    cpu_s: float = 0.0
    warned: list[str] = field(default_factory=list)
    other: list[str] = field(default_factory=list)
    unresolved: float | None = None
    problem: object = None


def run(build, steps=None, keep=False, **options):
    """Build, march adaptively, read. `build()` gives a problem and a function that reads the result."""
    out, problem = Run(), None
    options.setdefault("adaptive", True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.process_time()
        try:
            problem, read = build()
            for _ in problem.march(steps, progress=False, **options):
                pass
            out.value = read()
        except pm.PolarMPMError as e:
            out.failure = str(e).splitlines()[0]
        out.cpu_s = time.process_time() - begin
    kind = getattr(pm, "TrustWarning", ())
    for w in caught:
        list_ = out.warned if kind and issubclass(w.category, kind) else out.other
        list_.append(str(w.message))
    if problem is not None:
        out.cpu_s -= problem.timer.seconds.get("compile", 0.0)
        out.steps, out.points = len(problem.steps), len(problem.points)
        out.iterations = sum(s.iterations for s in problem.steps)
        out.cuts = sum(s.cuts for s in problem.steps)
        shares = [getattr(s, "unresolved", None) for s in problem.steps]
        shares = [s for s in shares if s is not None and np.isfinite(s)]
        out.unresolved = max(shares) if shares else None
        if keep:
            out.problem = problem
    return out


# records and tables -------------------------------------------------------------------------------
def record(scene, made, reference=None, error=None):
    """What is kept of a run: a row of the tables and of the JSON file.

    The error is relative; given, or the distance of the value to the reference over the reference's size.
    """
    value = made.value
    if error is None and reference is not None and value is not None:
        error = np.linalg.norm(np.subtract(value, reference)) / np.linalg.norm(reference)
        if np.ndim(value) == 0:
            error = float(value / reference - 1)
    return {
        "scene": scene,
        "value": plain(value),
        "reference": plain(reference),
        "error": None if made.failure or error is None else float(error),
        "failure": made.failure,
        "iterations": made.iterations,
        "steps": made.steps,
        "cuts": made.cuts,
        "points": made.points,
        "cpu_s": round(made.cpu_s, 3),
        "unresolved": made.unresolved,
        "warned": made.warned,
        "other_warnings": made.other,
    }


def plain(value):
    """Numbers as JSON knows them."""
    if value is None or isinstance(value, str):
        return value
    return np.asarray(value, float).tolist()


def digits(value, number=4):
    """A cell of a table."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, list | tuple):
        return ", ".join(digits(v, number) for v in value)
    return f"{value:.{number}g}"


def percent(row):
    """The error of a row (%), or that there is none."""
    if row["failure"]:
        return "fails"
    return "" if row["error"] is None else f"{100 * row['error']:+.3g}"


def table(head, rows):
    """Print a Markdown table."""
    print("| " + " | ".join(head) + " |\n" + "|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(str(c) for c in row) + " |")
    print(flush=True)


def report(name, rows):
    """Print the rows of a group."""
    print(f"\n### {name}\n")
    head = ["scene", "value", "reference", "error (%)", "iterations", "CPU (s)", "unresolved", "warned"]
    lines = []
    for r in rows:
        warned = "yes" if r["warned"] else ""
        cells = [digits(r["value"]), digits(r["reference"]), percent(r), r["iterations"], f"{r['cpu_s']:.2f}"]
        lines.append([r["scene"], *cells, digits(r["unresolved"], 2), warned])
    table(head, lines)


def add_to_json(file, name, rows):
    """Put a group of rows into a file, beside those of other groups that are there."""
    if file is None:
        return
    file = Path(file)
    found = json.loads(file.read_text()) if file.exists() else {}
    found["version"] = pm.__version__
    found[name] = rows
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(found, indent=1) + "\n")


def compare(old, new, out=print):
    """Print two files side by side; an entry is worse when its error has grown by more than a tenth."""
    old, new = (json.loads(Path(f).read_text()) for f in (old, new))
    worse = []
    for name in new:
        if name == "version" or name not in old:
            continue
        before = {r["scene"]: r for r in old[name]}
        lines, cpu = [], [0.0, 0.0]
        for r in new[name]:
            b = before.get(r["scene"])
            if b is None:
                continue
            mark = "worse" if is_worse(b, r) else ""
            if mark:
                worse.append(f"{name}: {r['scene']}: {percent(b)} -> {percent(r)} %")
            cpu = [cpu[0] + b["cpu_s"], cpu[1] + r["cpu_s"]]
            its = f"{b['iterations']} / {r['iterations']}"
            seconds = f"{b['cpu_s']:.2f} / {r['cpu_s']:.2f}"
            cells = [digits(b["value"]), digits(r["value"]), percent(b), percent(r)]
            lines.append([r["scene"], *cells, its, seconds, digits(r["unresolved"], 2), mark])
        out(f"\n### {name}\n")
        head = ["scene", "old", "new", "old error (%)", "new error (%)", "iterations", "CPU (s)"]
        table([*head, "unresolved", ""], lines)
        out(f"CPU {cpu[0]:.1f} s / {cpu[1]:.1f} s")
    out(f"\n{len(worse)} entries are worse by more than a tenth of their error:")
    for line in worse:
        out(f"- {line}")


def is_worse(old, new):
    """Whether an error has grown by more than a tenth of itself, and by 0.001 %."""
    if new["failure"] or old["failure"]:
        return bool(new["failure"]) and not old["failure"]
    if new["error"] is None or old["error"] is None:
        return False
    return abs(new["error"]) > 1.1 * abs(old["error"]) + 1e-5
