"""Tables of a run: one row for each load step, as comma-separated values."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping
from typing import Any, TextIO

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..solvers.stepping import Step
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, raise_on_all_ranks
from .files import check_output

_STEP_COLUMNS = ("step", "factor", "iterations", "force", "energy")


class Table:
    """Load-displacement table; all methods are collective, rank 0 writes. Every row is on disk at once.

    Columns: step, factor (load factor), iterations, force and energy (Newton's final measures, T
    (2.53)-(2.54)), then the user's.

        with pm.Table("arch.csv", tip=lambda: points.mean_displacement(tip)) as table:
            for step in problem.march(10):
                table.record(step)

    `energies=problem.energies` adds the energy balance, `wall=lambda: problem.reaction(wall)` a reaction
    (force, couple and moment), `balance=problem.balance` what loads and reactions add up to,
    `p=lambda: points.mean(field_values(problem, "mean_pressure"), tip)` the mean of a field of `Recorder`'s.

    Args:
        path: of the file; missing folders are made, an old file is overwritten on entering.
        comm: of the ranks that record; rank 0 writes.
        **columns: functions without arguments, called on all ranks, that return a number, a vector or a
            dictionary of them; a vector `tip` becomes the columns tip_x, tip_y and tip_z (tip_0, tip_1, ...
            beyond three), a dictionary `energies` the columns energies_stored and so on.

    Raises:
        InputError: a column's name is taken, or the file can't be written; on every rank alike.
    """

    @collective("Table", comm=lambda self, path, *, comm=MPI.COMM_WORLD, **columns: comm, compare=True)
    def __init__(
        self, path: str | os.PathLike[str], *, comm: MPI.Comm = MPI.COMM_WORLD, **columns: Callable[[], Any]
    ):
        for name, function in columns.items():
            if name in _STEP_COLUMNS:
                raise InputError(f"column {name!r} is taken; there is one already in every table")
            if not callable(function):
                raise InputError(f"column {name!r} = {function!r}: a function without arguments is needed")
        self.comm, self.columns = comm, columns
        self.path = check_output(comm, path)
        self._file: TextIO | None = None
        self._header: list[str] = []
        self._open = False

    @collective("Table")
    def __enter__(self) -> Table:
        error = None
        if self.comm.rank == 0:
            try:
                self._file = self.path.open("w", newline="", encoding="utf-8")
            except OSError as e:
                error = InputError(f"path = {str(self.path)!r} can't be written: {e.strerror}")
        raise_on_all_ranks(self.comm, error)
        self._open, self._header = True, []
        return self

    def __exit__(self, *error: object) -> None:
        self._open = False
        if self._file is not None:
            self._file.close()
            self._file = None

    def record(self, step: Step) -> None:
        """Add the row of a converged step.

        Raises:
            InputError: outside of the `with` statement; a column that is neither number nor vector, or
                whose length has changed.
        """
        if not self._open:
            raise InputError("a table records inside of its with statement only")
        force, energy = step.history[-1]
        row: dict[str, Any] = dict(
            zip(_STEP_COLUMNS, (step.number, step.factor, step.iterations, force, energy), strict=True)
        )
        with errors_on_all_ranks(self.comm, f"the columns of the table {self.path}"):
            for name, function in self.columns.items():
                row.update(_expand(name, function()))
            if list(row) != (self._header or list(row)):
                raise InputError(f"columns: were {', '.join(self._header)} and are now {', '.join(row)}")
        first, self._header = not self._header, list(row)
        error = None
        if self._file is not None:
            try:
                writer = csv.writer(self._file)
                if first:
                    writer.writerow(self._header)
                writer.writerow(row.values())
                self._file.flush()
            except OSError as e:
                error = e
        raise_on_all_ranks(self.comm, error)

    __call__ = record


def _expand(name: str, value: Any) -> dict[str, float]:
    if hasattr(value, "as_dict"):  # a reaction or a balance
        value = value.as_dict()
    if isinstance(value, Mapping):
        parts = [_expand(f"{name}_{key}", part) for key, part in value.items()]
        return {key: number for part in parts for key, number in part.items()}
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"column {name!r}: {value!r} is neither a number nor a vector") from None
    if numbers.ndim > 1:
        raise InputError(f"column {name!r}: the shape {numbers.shape} is neither a number nor a vector")
    if numbers.ndim == 0:
        return {name: float(numbers)}
    if len(numbers) == 1:  # a couple in plane strain: needs no letter
        return {name: float(numbers[0])}
    ends = "xyz" if len(numbers) <= 3 else range(len(numbers))
    return {f"{name}_{end}": float(v) for end, v in zip(ends, numbers, strict=False)}


def read_table(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Columns (rows,) of a table by name."""
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(header)}
