"""What the demo scripts share: their command line and their report."""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from .. import __version__
from ..io.files import check_output, not_written, replace_file
from ..plot.movies import Movie, movie
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..solvers.stepping import Step
from ..tools import checks
from ..tools.parallel import raise_on_all_ranks


def arguments(
    description: str,
    *,
    output: str,
    cell: float | None,
    points_per_cell: int,
    steps: int,
    basis: str,
    bases: Sequence[str] = ("gimpm", "mpm"),
    argv: Sequence[str] | None = None,
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> argparse.Namespace:
    """Command line of a demo with its defaults; `more` adds options of its own (flag -> argparse keywords).
    Without a `cell` there is no option for it; `bases` are those to choose from."""
    parser = _parser(description)
    if cell is not None:
        parser.add_argument("--cell", type=positive, default=cell, help="cell size (unit of the scene)")
    parser.add_argument("--points-per-cell", type=count, default=points_per_cell, help="in each direction")
    parser.add_argument("--steps", type=count, default=steps, help="number of load steps")
    parser.add_argument("--basis", choices=bases, default=basis, help="weighting functions")
    return _parse(parser, output, more, argv)


def element_arguments(
    description: str,
    *,
    output: str,
    elements: int,
    degree: int,
    steps: int,
    argv: Sequence[str] | None = None,
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> argparse.Namespace:
    """As `arguments`, of a demo with finite elements."""
    parser = _parser(description)
    parser.add_argument("--elements", type=count, default=elements, help="number along the body")
    parser.add_argument("--degree", type=int, choices=(1, 2), default=degree, help="of the elements")
    parser.add_argument("--steps", type=count, default=steps, help="number of load steps")
    return _parse(parser, output, more, argv)


def scene_arguments(
    description: str,
    *,
    output: str,
    argv: Sequence[str] | None = None,
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> argparse.Namespace:
    """As `arguments`, of a demo of several scenes, which has no options but its own."""
    return _parse(_parser(description), output, more, argv)


# an option of demos that can show how a run goes, see `film`
MOVIE: dict[str, dict[str, Any]] = {"--movie": {"action": "store_true", "help": "write a movie, too (.gif)"}}


class _NoFilm:
    """Records nothing."""

    def __enter__(self) -> _NoFilm:
        return self

    def __exit__(self, *error: object) -> None: ...

    def record(self, step: Step | None = None) -> None: ...


def film(
    args: argparse.Namespace, path: Path, problem: Problem, *shown: Any, **options: Any
) -> Movie | _NoFilm:
    """The movie of a demo, as of `plot.movie`, if `--movie` asks for one; else what records nothing."""
    return movie(path, problem, *shown, **options) if args.movie else _NoFilm()


def count(text: str) -> int:
    """A positive whole number of the command line."""
    try:
        return checks.whole("", int(text), least=1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number") from None


def positive(text: str) -> float:
    """A positive number of the command line."""
    try:
        return checks.number("", float(text), above=0.0)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number") from None


def _parser(description: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )


def _parse(
    parser: argparse.ArgumentParser,
    output: str,
    more: Mapping[str, Mapping[str, Any]] | None,
    argv: Sequence[str] | None,
) -> argparse.Namespace:
    parser.add_argument("--output", type=Path, default=Path("results") / output, metavar="DIR", help="folder")
    parser.add_argument(
        "--json",
        nargs="?",
        const=True,
        default=False,
        type=Path,
        metavar="FILE",
        help="last line of output is one JSON object, which a FILE gets, too",
    )
    for flag, keywords in (more or {}).items():
        parser.add_argument(flag, **keywords)
    return parser.parse_args(argv)


def report(
    args: argparse.Namespace,
    case: str,
    problem: Problem,
    result: Mapping[str, Any],
    more: Mapping[str, Any] | None = None,
    **parameters: Any,
) -> dict[str, Any]:
    """Print what a demo has found, as text or JSON, on one rank; a file that `--json` names gets it, too.
    Collective.

    Returns the object with the keys case, parameters, result, iterations (per step), points, unknowns,
    cpu_s (by phase, summed over ranks, with total), peak_memory_mb (likewise) and version; with finite
    elements also elements, and points are the quadrature points; and the keys of `more`.
    """
    comm = checks.instance("problem", problem, Problem, "a problem is").comm
    seconds = {**problem.timer.seconds, "total": time.process_time()}
    known: tuple[str, ...] = ("cell", "points_per_cell", "steps", "basis")
    elements = {}
    if isinstance(problem, QuasiStaticFEM):
        known = ("elements", "degree", "steps")
        elements = {"elements": comm.allreduce(len(problem.elements.live))}
    summary = {
        "case": case,
        "parameters": {**{k: getattr(args, k) for k in known if k in args}, "ranks": comm.size, **parameters},
        "result": {name: _plain(value) for name, value in result.items()},
        **(more or {}),
        "iterations": [step.iterations for step in problem.steps],
        **elements,
        "points": problem.points.total,
        "unknowns": problem.unknowns,
        "cpu_s": {name: round(comm.allreduce(seconds[name]), 3) for name in sorted(seconds)},
        "peak_memory_mb": round(comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024, 1),
        "version": __version__,
    }
    if isinstance(args.json, Path):
        _write(comm, args.json, json.dumps(summary) + "\n")
    if comm.rank == 0:
        if args.json:
            print(json.dumps(summary))
        else:
            _print_text(summary, args.output)
        sys.stdout.flush()
    return summary


def _write(comm: MPI.Comm, path: Path, text: str) -> None:
    """A file of rank 0. Collective."""
    file = check_output(comm, path)
    error: Exception | None = None
    if comm.rank == 0:
        try:
            replace_file(file, text.encode())
        except OSError as e:
            error = not_written("file", file, e)
    raise_on_all_ranks(comm, error)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(of) for name, of in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


def _print_text(summary: Mapping[str, Any], output: Path) -> None:
    counts = (f"{summary[name]} {name}" for name in ("elements", "points", "unknowns") if name in summary)
    print(f"{summary['case']}: {', '.join(counts)}")
    for name, value in summary["result"].items():
        if isinstance(value, float):
            print(f"  {name}: {value:.6g}")
        elif isinstance(value, list) and all(isinstance(v, int | float) for v in value):
            print(f"  {name}:", "  ".join(f"{v:.6g}" for v in value[:6]) + (" ..." if len(value) > 6 else ""))
        elif isinstance(value, dict):
            _print_rows(name, value)
    seconds = ", ".join(f"{k} {v:.2f}" for k, v in summary["cpu_s"].items())
    print(f"  iterations {sum(summary['iterations'])}; CPU seconds: {seconds}")
    print(f"  files in {output}")


def _print_rows(name: str, rows: Mapping[str, Any]) -> None:
    for key, values in rows.items():
        if isinstance(values, dict):
            _print_rows(f"{name}, {key}", values)
            continue
        numbers = values if isinstance(values, Sequence) else [values]
        print(f"  {name}, {key}:", "  ".join(f"{v:.5g}" for v in numbers))


def output_folder(args: argparse.Namespace, comm: MPI.Comm) -> Path:
    """Make the output folder, before any work is done, and see that the file for JSON can be written. Errors
    are raised on every rank. Collective."""
    if isinstance(args.json, Path):
        check_output(comm, args.json)
    return check_output(comm, args.output / "files").parent
