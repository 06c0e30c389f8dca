"""Stress tests of the solver's numerical stability, at and beyond the ends of what it is made for.

Blocks cut by the grid at random; load steps too large and too small; moduli, lengths, compression, rotations
and units at the ends of their ranges; locking over Poisson's ratio. Each case prints a line and goes to
`results/stress.csv` and `.md`. `--quick` runs a few of each.
"""

import argparse
import csv
import itertools
import time
from dataclasses import asdict, fields
from io import StringIO
from pathlib import Path

import stress_cuts as cuts
import stress_extremes as extremes
import stress_locking as locking
import stress_steps as steps
from stress_cases import BASES, MICROPOLAR, NEO_HOOKEAN, Record, head, line

from polarmpm import study

HERE = Path(__file__).parent
BODIES = (MICROPOLAR, NEO_HOOKEAN)


def cut_cases(quick):
    """Positions in the grid: 200 in the plane, fewer of classical blocks and in space."""
    for material in BODIES:
        number = 10 if quick else 200 if material.micropolar else 100
        for basis in BASES:
            yield cuts.run(range(number), 2, basis, material)
            if basis != "bspline":
                yield cuts.run(range(number), 2, basis, material, ghost="light")
    for basis in BASES:
        yield cuts.run(range(5 if quick else 30), 3, basis, MICROPOLAR)
    for material in BODIES:
        for basis, ghost in [(b, None) for b in BASES] + [(b, "thesis") for b in BASES[:2]]:
            number = 10 if quick else 100 if material.micropolar else 50
            yield cuts.run(range(number), 2, basis, material, single=True, ghost=ghost)


def step_cases(quick):
    """Load steps too large and too small."""
    for basis, resets in itertools.product(BASES[2:] if quick else BASES, steps.RESETS):
        yield steps.too_large(basis, resets)
    yield steps.too_large("bspline", steps.HALF_WAY, load=0.05)
    for basis in BASES[2:] if quick else BASES:
        every = steps.RESETS if basis == "bspline" else ("no resets",)
        for resets in every:
            yield steps.too_small(basis, resets, factor=50 if quick else 1000)
    if not quick:
        yield steps.too_small("FEM", "no resets")


def moduli_cases(quick):
    """kappa / mu, l / h."""
    ends = [(c, 0.1) for c in (1e-6, 1e-3, 1.0, 1e3, 1e6)] + [(0.35, l) for l in (1e-4, 1e-2, 1.0, 1e2, 1e4)]
    ends += list(itertools.product((1e-6, 1e6), (1e-4, 1e4)))
    for basis in BASES[2:] if quick else locking.METHODS:
        for coupling, length in ends[::3] if quick else ends:
            yield extremes.moduli(basis, coupling, length)


def compression_cases(quick):
    """To a tenth of the volume."""
    for basis, dim in itertools.product(BASES, (2,) if quick else (2, 3)):
        yield extremes.compression(basis, MICROPOLAR, dim, reset=None)
        yield extremes.compression(basis, MICROPOLAR, dim, J=0.35)
        yield extremes.compression(basis, MICROPOLAR, dim)  # past where this state is stable
        for material in (NEO_HOOKEAN, extremes.HENCKY):
            yield extremes.compression(basis, material, dim)


def rotation_cases(quick):
    """A hundred turns."""
    turns = 3 if quick else 100
    for basis in BASES:
        yield extremes.turning(basis, NEO_HOOKEAN, 2, turns, reset=1)
        for reset in (1, None):
            yield extremes.turning(basis, MICROPOLAR, 2, turns, reset=reset)
    for reset in (1, None):
        yield extremes.turning("mpm", MICROPOLAR, 3, turns, reset=reset)
    yield extremes.turning("bspline", MICROPOLAR, 3, 1 if quick else 10, reset=1)


def unit_cases(quick):
    """From nanometres to kilometres."""
    for dim, basis, material in itertools.product((2,) if quick else (2, 3), BASES, BODIES):
        yield extremes.units(dim, basis, material)


def locking_cases(quick):
    """Over Poisson's ratio; at its end over cells and points."""
    for scene, micropolar in itertools.product(locking.SCENES, (False, True)):
        for nu in (0.0, 0.4999):
            yield locking.reference_error(scene, nu, micropolar)
        for method, nu in itertools.product(locking.METHODS, locking.RATIOS):
            yield locking.locking(scene, method, nu, micropolar)
    if quick:
        return
    for method, cells in itertools.product(locking.METHODS, (4, 16)):
        yield locking.locking("footing", method, 0.4999, False, cells, tangents=False)
    for method, number in itertools.product(BASES, (2, 3, 6)):
        yield locking.locking("footing", method, 0.4999, False, per_cell=number)


GROUPS = {
    "cuts": cut_cases,
    "steps": step_cases,
    "moduli": moduli_cases,
    "compression": compression_cases,
    "rotation": rotation_cases,
    "units": unit_cases,
    "locking": locking_cases,
}


def write_csv(records, file):
    """All records."""
    text = StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(Record)], lineterminator="\n")
    writer.writeheader()
    for record in records:
        short = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(record).items()}
        writer.writerow({k: "" if v is None else v for k, v in short.items()})
    study.write_text(file, text.getvalue())


def read_csv(file):
    """Records of an earlier run; none if there is no such file."""
    if not file.exists():
        return []
    kinds = {f.name: f.type.split(" ")[0] for f in fields(Record)}
    make = {"str": str, "int": int, "float": float, "bool": lambda text: text == "True"}
    with file.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    return [Record(**{k: make[kinds[k]](v) for k, v in row.items() if v != ""}) for row in rows]


def write(records, folder):
    """Tables and figure of records, in the order of the groups."""
    names = list(GROUPS)
    records = sorted(records, key=lambda record: names.index(record.group))
    write_csv(records, folder / "stress.csv")
    study.write_text(folder / "stress.md", "\n".join([head(), *map(line, records)]) + "\n")
    if any(record.group == "locking" for record in records):
        locking.draw(records, folder / "stress_locking.png")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few cases of each kind")
    parser.add_argument("--only", choices=GROUPS, help="one group; rows of others stay as they are")
    parser.add_argument("--output", type=Path, default=HERE / "results", metavar="DIR")
    args = parser.parse_args()
    records, begin = [], time.process_time()
    print(head())
    for name in [args.only] if args.only else GROUPS:
        for record in GROUPS[name](args.quick):
            records.append(record)
            print(line(record), flush=True)
        print(f"<!-- {name}: {time.process_time() - begin:.0f} s of CPU so far -->", flush=True)
    kept = read_csv(args.output / "stress.csv") if args.only else []
    write(records + [r for r in kept if r.group != args.only], args.output)
    failed = [r for r in records if not r.passed]
    print(f"{len(records)} cases, {len(failed)} not passed, {time.process_time() - begin:.0f} s of CPU")


if __name__ == "__main__":
    main()
