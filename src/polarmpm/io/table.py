"""Tables of a run: one row for each load step, as comma-separated values."""

from __future__ import annotations

import csv
import errno
import io
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..problems.base import Problem
from ..solvers.stepping import Restored, Step
from ..tools import checks
from ..tools.caller import warn
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, raise_on_all_ranks
from .files import (
    begin_writing,
    bring_to_disc,
    check_output,
    check_writer,
    not_written,
    reason,
    replace_file,
)
from .naming import named_components

_STEP_COLUMNS = ("step", "factor", "iterations", "newton_force", "newton_energy")


class Table:
    """Load-displacement table; all methods are collective, rank 0 writes. Every row is on disk at once.

    Columns: step, factor (load factor), iterations, newton_force and newton_energy (Newton's final measures,
    T (2.53)-(2.54)), then those of the problem's probes, if it is given, then the user's.

        with pm.Table("arch.csv", problem, tip=lambda: points.mean_displacement(tip)) as table:
            for step in problem.march(10):
                table.record(step)

    `energies=problem.energies` adds the energy balance, `wall=lambda: problem.reaction(wall)` a reaction
    (force, couple and moment), `balance=problem.balance` what loads and reactions add up to,
    `p=lambda: points.mean(field_values(problem, "mean_pressure"), tip)` the mean of a field of `Recorder`'s.

    A run that goes on from a restart file, with a table of the same path and columns, goes on with the file:
    rows up to the saved state stay, later ones are written again. (Record a step before you save it.) A file
    of another run is overwritten; what tells them apart is the first five columns.

    Args:
        path: of the file; missing folders are made, an old file is overwritten by the first row.
        problem: whose probes (`problem.probe`) have columns, also those that are made later, before the
            first row.
        comm: of the ranks that record, where no problem is given; rank 0 writes.
        **columns: functions without arguments, called on all ranks, that return a number, a vector or a
            dictionary of them; a vector `tip` becomes the columns tip_x, tip_y and tip_z (tip_0, tip_1, ...
            beyond three), a tensor (3, 3) `s` s_xx, s_xy and so on, a dictionary `energies` the columns
            energies_stored and so on.

    Raises:
        InputError: a column's name is taken, or the file can't be written; on every rank alike.
    """

    @collective(
        "Table",
        comm=lambda self, path, problem=None, *, comm=MPI.COMM_WORLD, **columns: _comm_of(problem, comm),
        compare=True,
    )
    def __init__(
        self,
        path: str | os.PathLike[str],
        problem: Problem | None = None,
        *,
        comm: MPI.Comm = MPI.COMM_WORLD,
        **columns: Callable[[], Any],
    ):
        if problem is not None:
            checks.instance("problem", problem, Problem, "a problem, or None, is")
        for name, function in columns.items():
            if name in _STEP_COLUMNS:
                raise InputError(f"column {name!r} is taken; there is one already in every table")
            if not callable(function):
                raise InputError(f"column {name!r} = {function!r}: a function without arguments is needed")
        self.comm, self.columns = checks.communicator("comm", _comm_of(problem, comm)), columns
        self.problem = problem
        self.path = check_output(self.comm, path)
        self._header: list[str] = []
        self._open = False
        self._size: int | None = None  # bytes of the file; None: this table has no row yet
        self._run: Restored | None = None

    @collective("Table")
    def __enter__(self) -> Table:
        if self._open:
            raise InputError(f"table {self.path}: its with statement has been entered already")
        self._writer = begin_writing(self.path)
        self._open, self._header, self._size, self._run = True, [], None, None
        return self

    def __exit__(self, *error: object) -> None:
        self._open = False

    def record(self, step: Step) -> None:
        """Add the row of a converged step.

        Raises:
            InputError: outside of the `with` statement; a column that is neither number nor vector, or
                whose length has changed; columns of the same name, or others than before a restart.
            OutputError: the file can't be written, such as on a full disc; it has the rows of before, and
                this one can be recorded again.
        """
        if not self._open:
            raise InputError("a table records inside of its with statement only")
        checks.instance("step", step, Step, "a step of march is")
        check_writer(self.path, self._writer)
        row: dict[str, Any] = dict(zip(_STEP_COLUMNS, _of_step(step), strict=True))
        with errors_on_all_ranks(self.comm, f"the columns of the table {self.path}"):
            for name, function in {**self._of_probes(), **self.columns}.items():
                for key, number in _expand(name, function()).items():
                    if key in row:
                        what = f"there are two of this name, one of them from {name!r}"
                        raise InputError(f"column {key!r}: {what}")
                    row[key] = number
            header = self._header or list(row)
            if list(row) != header:
                raise InputError(f"columns: were {', '.join(header)} and are now {', '.join(row)}")
        error: Exception | None = None
        if self.comm.rank == 0:
            try:
                self._write(step.restored, header, list(row.values()))
            except OSError as e:
                error = not_written("table", self.path, e)
            except InputError as e:
                error = e
        raise_on_all_ranks(self.comm, error)
        self._header = header

    __call__ = record

    def _of_probes(self) -> dict[str, Callable[[], Any]]:
        probes = {} if self.problem is None else self.problem.probes
        both = sorted(set(probes) & {*self.columns, *_STEP_COLUMNS})
        if both:
            raise InputError(f"column {both[0]!r}: there is a probe of this name; give one of them another")
        return probes

    # the file, on rank 0 ----------------------------------------------------------------------------
    def _write(self, run: Restored | None, header: list[str], values: list[Any]) -> None:
        if self._size is not None and run is self._run:
            self._append(_line(values))
            return
        kept = b""
        if run is not None and (self._size is not None or self.path not in run.continued):
            kept = self._kept(run, header)
        content = (kept or _line(header)) + _line(values)
        if self.path.exists() and not self.path.is_file():  # a pipe or a terminal
            with self.path.open("wb") as file:
                file.write(content)
        else:
            replace_file(self.path, content)
        self._size, self._run = len(content), run
        if run is not None:
            run.continued.add(self.path)

    def _append(self, line: bytes) -> None:
        handle, done = os.open(self.path, os.O_WRONLY | os.O_APPEND), 0
        try:
            ordinary = stat.S_ISREG(os.fstat(handle).st_mode)
            if ordinary and os.fstat(handle).st_size != self._size:
                raise OSError(errno.EBUSY, "it has been changed since the last row")
            try:
                while done < len(line):
                    done += os.write(handle, line[done:])
                bring_to_disc(handle)
            except OSError:
                if ordinary:  # no half rows
                    os.ftruncate(handle, self._size or 0)
                raise
        finally:
            os.close(handle)
        self._size = (self._size or 0) + len(line)

    def _kept(self, run: Restored, header: list[str]) -> bytes:
        """The beginning of the file that the run has left, as far as the saved state; nothing of another
        run's."""
        try:
            lines = self.path.read_bytes().splitlines(keepends=True)
        except OSError:
            return b""
        first, *rows = [next(csv.reader([line.decode("utf-8", "replace")]), []) for line in lines] or [[]]
        size, numbers = len(lines[0]) if lines else 0, []
        for line, row in zip(lines[1:], rows, strict=True):
            number = int(row[0]) if row and row[0].isdigit() else None
            whole = len(row) == len(first) and line.endswith(b"\n")
            if number is None or number > run.number or not whole:
                break
            if number in run.steps:
                if row[: len(_STEP_COLUMNS)] != _texts(_of_step(run.steps[number])):
                    return b""
                numbers.append(number)
            size += len(line)
        if not numbers:
            return b""
        if first != header:
            raise InputError(
                f"columns: the table {self.path} has {', '.join(first)} from before the restart, now there "
                f"are {', '.join(header)}; give the same ones, or another path"
            )
        if len(numbers) > 1 and numbers == list(range(numbers[0], run.number)):
            warn(
                f"table {self.path}: has no row of step {run.number}, which was saved before it was recorded"
            )
        return b"".join(lines)[:size]


def _comm_of(problem: Any, comm: MPI.Comm) -> MPI.Comm:
    of_problem: MPI.Comm = getattr(problem, "comm", comm)
    return of_problem


def _of_step(step: Step) -> tuple[Any, ...]:
    force, energy = step.history[-1]
    return int(step.number), float(step.factor), step.iterations, float(force), float(energy)


def _line(values: list[Any]) -> bytes:
    text = io.StringIO()
    csv.writer(text).writerow(values)
    return text.getvalue().encode()


def _texts(values: Iterable[Any]) -> list[str]:
    return next(csv.reader([_line(list(values)).decode()]))


def _expand(name: str, value: Any) -> dict[str, float]:
    if hasattr(value, "as_dict"):  # a reaction or a balance
        value = value.as_dict()
    if isinstance(value, Mapping):
        if not value:
            raise InputError(f"column {name!r}: an empty dictionary is neither a number nor a vector")
        parts = [_expand(f"{name}_{key}", part) for key, part in value.items()]
        return {key: number for part in parts for key, number in part.items()}
    try:
        numbers = np.asarray(value)
        good = numbers.dtype.kind in "biuf" and numbers.size > 0
    except ValueError:
        good = False
    if not good:
        raise InputError(f"column {name!r}: {checks.shown(value)} is neither a number nor a vector")
    if numbers.ndim in (2, 3) and len(set(numbers.shape)) == 1 and len(numbers) in (2, 3):
        return {f"{name}_{end}": v for end, v in named_components(name, numbers).items()}
    if numbers.ndim > 1:
        raise InputError(f"column {name!r}: the shape {numbers.shape} is neither a number nor a vector")
    if numbers.ndim == 0:
        return {name: float(numbers)}
    if len(numbers) == 1:  # a couple in plane strain: needs no letter
        return {name: float(numbers[0])}
    ends = "xyz" if len(numbers) <= 3 else range(len(numbers))
    return {f"{name}_{end}": float(v) for end, v in zip(ends, numbers, strict=False)}


def read_table(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Columns (rows,) of a table by name.

    Raises:
        InputError: the file can't be read, or isn't a table; the message names it.
    """
    found = checks.path("path", path, "the name of a table")
    try:
        with found.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise InputError(f"table {found} can't be read: {reason(e) if isinstance(e, OSError) else e}") from e
    if not header:
        raise InputError(f"table {found} is empty; it has no header")
    for k, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise InputError(f"table {found}: row {k} has {len(row)} of {len(header)} columns")
    try:
        return {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(header)}
    except ValueError as e:
        raise InputError(f"table {found} has something else than numbers: {e}") from e
