"""Restart files: all that a run needs to continue to the same digits.

A file is HDF5; ranks write their rows one after the other. It is written under a temporary name and put in
place at the end, so the file on disc is always complete.
"""

from __future__ import annotations

import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from ..errors import InputError
from ..interpolation import Reference
from ..parallel import collectively
from ..pointproblem import QuasiStatic
from ..points import FIELDS
from ..problem import Progress

_FORMAT = 1


def save(problem: QuasiStatic, path: str | os.PathLike[str]) -> None:
    """Write the last converged state. Collective.

    Raises:
        InputError: the file can't be written.
    """
    path, comm = Path(path), problem.comm
    temporary = path.with_name(path.name + ".part")
    arrays = {f"points/{name}": a for name, a in problem.points.arrays().items()}
    between = problem.increments()
    if between is not None:
        reference, lattice, values = between
        arrays |= {f"reference/{f.name}": getattr(reference, f.name) for f in fields(reference)}
        arrays |= {"nodes/lattice": lattice, "nodes/increments": values}
    for rank in range(comm.size):
        error: Exception | None = None
        if rank == comm.rank:
            try:
                _write_rows(temporary, problem, arrays, first=rank == 0)
            except OSError as e:
                error = InputError(f"restart file {path} can't be written: {e}")
        collectively(comm, error)
    if comm.rank == 0:
        os.replace(temporary, path)
    comm.Barrier()


def _write_rows(path: Path, problem: QuasiStatic, arrays: dict[str, np.ndarray], first: bool) -> None:
    with h5py.File(path, "w" if first else "r+") as file:
        if first:
            file.attrs.update(_header(problem))
            for name, value in asdict(problem.progress).items():
                file.attrs[f"progress/{name}"] = value
        for name, rows in arrays.items():
            if first:
                file.create_dataset(name, data=rows, maxshape=(None, *rows.shape[1:]), chunks=True)
                file.create_dataset(f"counts/{name}", data=[len(rows)], maxshape=(None,), chunks=True)
            else:
                for key, new in ((name, rows), (f"counts/{name}", np.array([len(rows)]))):
                    data = file[key]
                    data.resize(len(data) + len(new), axis=0)
                    data[len(data) - len(new) :] = new


def _header(problem: QuasiStatic) -> dict[str, Any]:
    grid = problem.grid
    return {
        "format": _FORMAT,
        "origin": grid.origin,
        "cell": grid.cell,
        "shape": grid.shape,
        "basis": problem.basis,
        "block": problem.layout.block,
        "materials": len(problem.points.materials),
    }


def load(problem: QuasiStatic, path: str | os.PathLike[str]) -> None:
    """Put a saved state into a problem with the same grid, basis and materials; `march` goes on from it.
    Collective.

    Supports and loads aren't in the file: the script that made the problem gives them again.

    Raises:
        InputError: no such file, or it belongs to another problem; the message says what differs.
    """
    error: Exception | None = None
    try:
        with h5py.File(path, "r") as file:
            _check(problem, file, path)
            rows = {name: _read(file, f"points/{name}", problem.comm) for name in FIELDS}
            between: tuple[Reference, np.ndarray, np.ndarray] | None = None
            if "nodes" in file:
                reference = Reference(
                    *(_read(file, f"reference/{f.name}", problem.comm) for f in fields(Reference))
                )
                lattice, values = (_read(file, f"nodes/{n}", problem.comm) for n in ("lattice", "increments"))
                between = (reference, lattice, values)
            saved = {f.name: file.attrs[f"progress/{f.name}"].item() for f in fields(Progress)}
    except OSError as e:
        error = InputError(f"restart file {path} can't be read: {e}")
    except InputError as e:
        error = e
    collectively(problem.comm, error)
    problem.points.replace(rows)
    problem.restore(Progress(**saved), between)


def _check(problem: QuasiStatic, file: h5py.File, path: Any) -> None:
    for name, value in _header(problem).items():
        found = file.attrs.get(name)
        if found is None or np.any(np.asarray(found) != np.asarray(value)):
            raise InputError(f"restart file {path}: {name} is {found}, this problem has {value}")


def _read(file: h5py.File, name: str, comm: MPI.Comm) -> np.ndarray:
    """This rank's rows: the rank's own when as many ranks read as wrote, else an equal share."""
    data, counts = file[name], file[f"counts/{name}"][:]
    if len(counts) == comm.size:
        start = int(counts[: comm.rank].sum())
        return data[start : start + int(counts[comm.rank])]
    return data[len(data) * comm.rank // comm.size : len(data) * (comm.rank + 1) // comm.size]
