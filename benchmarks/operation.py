"""Ordinary accidents of a run and what comes of them: bad calls, full discs, damaged files, interrupts,
kills, errors on one rank, compilers, memory, meshes.

Each group is a module `operation_NAME` with a function `cases(quick, seed)` that yields `Case`s. They go to
`results/operation.csv` one by one, their counts to `results/operation.md`, the table of docs/stability.md, in
brackets those of an earlier run, `--before`. `--seed` draws other random cases.
"""

import argparse
import collections
import csv
import importlib
import re
import time
from pathlib import Path

from operation_cases import GOOD, VERDICTS, Case
from pages import quote

from polarmpm import study

HERE = Path(__file__).parent
GROUPS = (
    "calls",
    "properties",
    "meshes",
    "ranks",
    "disc",
    "restart",
    "kills",
    "interrupts",
    "compiling",
    "memory",
    "diagnosis",
)


def table(cases, before=()):
    """Counts by group in Markdown; with earlier ones in brackets."""
    groups = list(dict.fromkeys(case.group for case in [*before, *cases]))
    now, then = (collections.Counter((c.group, c.verdict) for c in all_) for all_ in (cases, before))
    rows = ["| accident | cases | " + " | ".join(VERDICTS) + " |", "|---" * (len(VERDICTS) + 2) + "|"]
    for group in groups:
        number = sum(now[group, v] for v in VERDICTS)
        counts = [(now[group, v], then[group, v]) for v in VERDICTS]
        cells = [f"{n} ({b})" if b else str(n or "") for n, b in counts]
        rows.append(f"| {group} | {number} | " + " | ".join(cells) + " |")
    return "\n".join(rows) + "\n"


def read(file):
    """Cases of an earlier run."""
    if file is None or not file.exists():
        return []
    with file.open(newline="") as lines:
        return [Case(**row) for row in csv.DictReader(lines)]


def short(case):
    """Its row in a file: without the folders of this machine, and with a note where it isn't good."""
    note = "" if case.verdict in GOOD else re.sub(r"(/[^\s'\"/:]+)+/", "", case.note)[:120]
    return [case.group, case.name, case.verdict, note]


def write(cases, file):
    """Cases, one a row."""
    with file.open("w", newline="") as lines:
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(["group", "name", "verdict", "note"])
        writer.writerows(map(short, cases))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few cases of each group")
    parser.add_argument("--only", nargs="+", choices=GROUPS, help="some groups; the others' rows stay")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn at random")
    parser.add_argument("--before", type=Path, default=HERE / "results" / "operation_before.csv")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    chosen, found = args.only or GROUPS, []
    for name in chosen:
        begin = time.perf_counter()
        for case in importlib.import_module(f"operation_{name}").cases(args.quick, args.seed):
            found.append(case)
            if case.verdict not in GOOD:
                print(f"{case.verdict}: {case.group}, {case.name}: {case.note}", flush=True)
        print(f"{name}: {time.perf_counter() - begin:.0f} s", flush=True)
    touched = {c.group for c in found}
    kept = [c for c in read(args.output / "operation.csv") if c.group not in touched] if args.only else []
    cases = kept + found
    write(cases, args.output / "operation.csv")
    text = table(cases, read(args.before))
    study.write_text(args.output / "operation.md", text)
    if args.output == HERE / "results":
        quote(HERE.parent / "docs" / "stability.md", "operation", f"\n\n{text}\n")
    print(text)


if __name__ == "__main__":
    main()
