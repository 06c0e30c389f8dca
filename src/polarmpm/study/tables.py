"""Tables of studies: comma-separated values, Markdown, orders of convergence, time for an error."""

from __future__ import annotations

import csv
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from io import StringIO
from typing import Any

from mpi4py import MPI

from ..errors import InputError
from ..io.files import check_output, not_written, replace_file
from ..tools import checks
from .discretisations import PHASES, Row


def write_csv(rows: Sequence[Row], path: str | os.PathLike[str]) -> None:
    """Write all rows; what isn't known stays empty.

    Columns: those of `Row`; result_0, ...; error_<name>; <phase>_s.
    """
    rows = check_rows("rows", rows)
    lines = [_flat(row) for row in rows]
    text = StringIO()
    writer = csv.DictWriter(text, _columns(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write_text(path, text.getvalue())


_PLAIN = ("method", "label", "h", "unknowns", "points", "steps", "iterations", "cuts")
_COST = ("cpu_s", "kernel_s", "startup_s", "peak_memory_mb", "failed_at", "failure")


def _columns(rows: Sequence[Row]) -> list[str]:
    size = max((len(r.result) for r in rows), default=0)
    phases = _phases(rows)
    return [
        *_PLAIN,
        *(f"result_{k}" for k in range(size)),
        *(f"error_{name}" for name in error_names(rows)),
        "cpu_s",
        *(f"{name}_s" for name in phases),
        *_COST[1:],
    ]


def _flat(row: Row) -> dict[str, Any]:
    values: dict[str, Any] = {name: getattr(row, name) for name in (*_PLAIN, *_COST)}
    values |= {f"result_{k}": v for k, v in enumerate(row.result)}
    values |= {f"error_{name}": v for name, v in row.errors.items()}
    values |= {f"{name}_s": v for name, v in row.phases.items()}
    short = {k: f"{v:.9g}" if isinstance(v, float) else v for k, v in values.items() if v is not None}
    return short | {k: f"{float(v):.4g}" for k, v in short.items() if k.endswith(("_s", "_mb"))}


def read_csv(path: str | os.PathLike[str]) -> list[Row]:
    """The rows of `write_csv`, for figures without another run.

    Raises:
        InputError: the file isn't there, or isn't one of these.
    """
    path = checks.path("path", path)
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [_row(line) for line in csv.DictReader(file)]
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as e:
        raise InputError(f"path = {str(path)!r} is no table of a study: {e}") from None


def _row(line: Mapping[str, str]) -> Row:
    whole = {f.name for f in fields(Row) if f.type == "int"}
    texts = ("method", "label", "failure")
    values: dict[str, Any] = {name: line[name] for name in texts}
    for name in (*_PLAIN, *_COST):
        if name not in texts and line[name] != "":
            values[name] = int(line[name]) if name in whole else float(line[name])
    numbers = {k: float(v) for k, v in line.items() if v != "" and k not in texts}
    values["result"] = tuple(v for k, v in numbers.items() if k.startswith("result_"))
    values["errors"] = {k.removeprefix("error_"): v for k, v in numbers.items() if k.startswith("error_")}
    values["phases"] = {name: numbers[f"{name}_s"] for name in PHASES if f"{name}_s" in numbers}
    return Row(**values)


def error_names(rows: Sequence[Row]) -> list[str]:
    """Names of the references, in the order given."""
    return list(dict.fromkeys(name for row in check_rows("rows", rows) for name in row.errors))


def methods(rows: Sequence[Row]) -> list[str]:
    """Names of the methods, in the order of their first rows."""
    return list(dict.fromkeys(row.method for row in check_rows("rows", rows)))


def _phases(rows: Sequence[Row]) -> list[str]:
    found = dict.fromkeys(name for row in rows for name in row.phases)
    return [p for p in PHASES if p in found] + sorted(set(found) - set(PHASES))


def markdown(rows: Sequence[Row], *, unit: str = "") -> str:
    """Results, errors and costs as a Markdown table. `unit` is the unit of result and errors."""
    rows = check_rows("rows", rows)
    checks.instance("unit", unit, str, "a text is")
    names, of = error_names(rows), f" ({unit})" if unit else ""
    has_result = any(row.result for row in rows)
    head = ["method", "cells", "h (m)", "points", "unknowns", "steps (cuts)", "iterations"]
    head += [f"result{of}"] * has_result + [f"error, {name}{of}" for name in names]
    head += ["CPU (s)", "start-up (s)", "memory (MB)"]
    lines = []
    for r in rows:
        cells = [r.method, r.label, digits(r.h, 3), r.points or "", r.unknowns or ""]
        cells += [f"{r.steps} ({r.cuts})" if r.steps else "", r.iterations or ""]
        if r.failed_at is not None:
            cells += [f"no equilibrium at load factor {r.failed_at:.4g}"] + [""] * (len(names) - 1)
            cells += [""] * has_result
        else:
            cells += [", ".join(digits(v, 4) for v in r.result)] * has_result
            cells += [digits(r.errors.get(name), 3) for name in names]
        memory = "" if r.peak_memory_mb is None else f"{r.peak_memory_mb:.0f}"
        lines.append([*cells, digits(r.cpu_s, 3), digits(r.startup_s, 2), memory])
    return _table(head, lines)


def markdown_phases(rows: Sequence[Row]) -> str:
    """CPU seconds by phase as a Markdown table."""
    rows = [r for r in check_rows("rows", rows) if r.phases]
    phases, kernels = _phases(rows), any(r.kernel_s is not None for r in rows)
    head = ["method", "cells", "CPU (s)", *phases] + ["of the assembly: kernel"] * kernels
    lines = []
    for r in rows:
        cells = [r.method, r.label, digits(r.cpu_s, 3), *(digits(r.phases.get(p), 2) for p in phases)]
        lines.append(cells + [digits(r.kernel_s, 2)] * kernels)
    return _table(head, lines)


def orders(rows: Sequence[Row], name: str) -> dict[str, list[float]]:
    """Observed orders of convergence of an error between successive discretisations of each method.

    Raises:
        InputError: no row has an error of this name.
    """
    check_name(rows, name)
    found = {}
    for method in methods(rows):
        line = [(r.h, r.errors[name]) for r in rows if r.method == method and name in r.errors]
        found[method] = [math.log(a[1] / b[1]) / math.log(a[0] / b[0]) for a, b in itertools.pairwise(line)]
    return found


def markdown_orders(rows: Sequence[Row]) -> str:
    """Observed orders of all errors as a Markdown table."""
    names = error_names(rows)
    every = {name: orders(rows, name) for name in names}
    lines = []
    for method in methods(rows):
        steps = [r.label for r in rows if r.method == method and r.errors]
        for k, (a, b) in enumerate(itertools.pairwise(steps)):
            lines.append([method, f"{a} to {b}", *(f"{every[name][method][k]:.2f}" for name in names)])
    return _table(["method", "cells", *names], lines)


def digits(value: float | None, number: int) -> str:
    """So many significant digits, without an exponent unless the value is tiny; "" for None."""
    if value is None:
        return ""
    if not math.isfinite(value) or abs(value) >= 10**number:
        return f"{value:.0f}"
    return f"{value:#.{number}g}".rstrip(".")


def _table(head: Sequence[Any], lines: Sequence[Sequence[Any]]) -> str:
    every = [head, ["---"] * len(head), *lines]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in every)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Replace a file.

    Raises:
        InputError: it can't be written.
        OutputError: the disc is full; an old file stays.
    """
    content = checks.instance("text", text, str, "a text is").encode()
    file = check_output(MPI.COMM_SELF, path)
    try:
        replace_file(file, content)
    except OSError as e:
        raise not_written("file", file, e) from e


def time_for_error(rows: Sequence[Row], name: str, level: float) -> dict[str, float]:
    """CPU seconds with which each method reaches an error; methods that don't are left out.

    Between two discretisations of a method it is interpolated on logarithmic axes; where already the first
    discretisation is better than asked, it is that discretisation's time.

    Raises:
        InputError: no row has an error of this name; `level` is not positive.
    """
    check_name(rows, name)
    level = checks.number("level", level, above=0.0, allowed="a positive error")
    found: dict[str, float] = {}
    for method in methods(rows):
        mine = [r for r in rows if r.method == method and name in r.errors and r.cpu_s]
        line = sorted((r.cpu_s or 0.0, r.errors[name]) for r in mine)
        if line and line[0][1] <= level:
            found[method] = line[0][0]
            continue
        for (t0, e0), (t1, e1) in itertools.pairwise(line):
            if e0 > level >= e1:
                share = math.log(e0 / level) / math.log(e0 / e1) if e1 > 0 else 1.0
                found[method] = math.exp(math.log(t0) + share * math.log(t1 / t0))
                break
    return found


def markdown_times(rows: Sequence[Row], name: str, levels: Sequence[float], *, unit: str = "") -> str:
    """`time_for_error` as a Markdown table: lines are errors, columns methods; the least time is bold."""
    lines, every = [], methods(rows)
    levels = checks.numeric("levels", levels, "errors").ravel().tolist()
    for level in levels:
        times = time_for_error(rows, name, level)
        least = min(times.values(), default=math.inf)
        cells = [digits(times[m], 2) if m in times else "" for m in every]
        bold = [f"**{c}**" if times.get(m) == least else c for m, c in zip(every, cells, strict=True)]
        lines.append([digits(level, 2), *bold])
    return _table(
        [f"error, {name}" + (f" ({unit})" if unit else ""), *(f"{m} (CPU s)" for m in every)], lines
    )


def check_name(rows: Sequence[Row], name: str) -> None:
    """Raise InputError unless rows have an error of this name."""
    known = error_names(rows)
    if not isinstance(name, str) or name not in known:
        raise checks.refuse("name", name, f"errors are {', '.join(known) or 'not known'}")


def check_rows(name: str, rows: Any) -> list[Row]:
    """Rows of a study.

    Raises:
        InputError: something else.
    """
    if not isinstance(rows, Sequence) or not all(isinstance(row, Row) for row in rows):
        raise checks.refuse(name, rows, "a list of study.Row, as study.run returns it, is needed")
    return list(rows)
