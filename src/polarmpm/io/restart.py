"""Restart files: all that a run needs to continue to the same digits.

Material points are put back as they are; another number of ranks than wrote the file reads equal shares of it
and distributes them afresh. Elements are made by the script, and their state is put in by the original
numbers of cells and quadrature points.

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

from ..bodies.reference import Reference
from ..errors import InputError
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..problems.points import QuasiStatic
from ..problems.state import Progress
from ..tools.meetings import collective
from ..tools.parallel import raise_on_all_ranks
from . import meshstate

_FORMAT = 6


@collective("save_restart", comm=lambda problem, *args, **options: problem.comm)
def save(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write the last converged state of a `QuasiStatic` or `QuasiStaticFEM`. Collective.

    Raises:
        InputError: the file can't be written; the problem has been closed.
    """
    problem.check_open()
    path, comm = Path(path), problem.comm
    temporary = path.with_name(path.name + ".part")
    arrays = meshstate.arrays(problem) if isinstance(problem, QuasiStaticFEM) else _arrays(problem)
    for name, a in problem.term_state().items():  # the same on every rank
        arrays[f"terms/{name.replace('/', '.')}"] = a if comm.rank == 0 else a[:0]
    for rank in range(comm.size):
        error: Exception | None = None
        if rank == comm.rank:
            try:
                _write_rows(temporary, problem, arrays, first=rank == 0)
            except OSError as e:
                error = InputError(f"restart file {path} can't be written: {e}")
        raise_on_all_ranks(comm, error)
    if comm.rank == 0:
        os.replace(temporary, path)
    comm.Barrier()


def _arrays(problem: Any) -> dict[str, np.ndarray]:
    """This rank's rows of a problem of material points."""
    arrays = {f"points/{name}": a for name, a in problem.points.arrays().items()}
    between = problem.increments()
    if between is not None:
        reference, lattice, values = between
        arrays |= {f"reference/{f.name}": getattr(reference, f.name) for f in fields(reference)}
        arrays |= {"nodes/lattice": lattice, "nodes/increments": values}
    arrays |= {f"kept/{name}": a for name, a in problem.kept().items()}
    return arrays


def _write_rows(path: Path, problem: Problem, arrays: dict[str, np.ndarray], first: bool) -> None:
    with h5py.File(path, "w" if first else "r+") as file:
        if first:
            file.attrs.update({"body": _kind(problem), **_header(problem)})
            for name, value in asdict(problem.progress).items():
                file.attrs[f"progress/{name}"] = value
            for name, text in problem.condition_state().items():
                file.create_dataset(f"conditions/{name}", data=np.frombuffer(text.encode(), dtype=np.uint8))
            if isinstance(problem, QuasiStatic):
                file.attrs["shares"] = problem.load_shares.state()
        for name, rows in arrays.items():
            if first:
                file.create_dataset(name, data=rows, maxshape=(None, *rows.shape[1:]), chunks=True)
                file.create_dataset(f"counts/{name}", data=[len(rows)], maxshape=(None,), chunks=True)
            else:
                for key, new in ((name, rows), (f"counts/{name}", np.array([len(rows)]))):
                    data = file[key]
                    data.resize(len(data) + len(new), axis=0)
                    data[len(data) - len(new) :] = new


def _header(problem: Any) -> dict[str, Any]:
    ends = {"block": problem.layout.block, "materials": len(problem.points.materials)}
    if isinstance(problem, QuasiStaticFEM):
        return {"format": _FORMAT, **meshstate.header(problem), **ends}
    known = {**problem.initial_grid.description(), "basis": problem.basis.name}
    return {"format": _FORMAT, **known, **ends}


def _kind(problem: Problem) -> str:
    return "finite elements" if isinstance(problem, QuasiStaticFEM) else "material points"


@collective("load_restart", comm=lambda problem, *args, **options: problem.comm)
def load(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Put a saved state into a problem with the same grid, basis and materials, or the same mesh, degree,
    quadrature and materials; `march` goes on from it. Collective.

    Supports and loads aren't in the file: the script that made the problem gives all of them again before it
    calls this, in the same order, those too that were added in mid-run or released. The file knows since when
    they count and which have been released. Those that it doesn't know count from the saved state on.

    Raises:
        InputError: no such file, or it belongs to another problem; the message says what differs. A condition
            of the saved run is missing.
    """
    error: Exception | None = None
    try:
        with h5py.File(path, "r") as file:
            _check(problem, file, path)
            rows = _read_all(file, problem.comm)
            saved = {f.name: file.attrs[f"progress/{f.name}"].item() for f in fields(Progress)}
            shares = _shares(file, problem.comm)
            conditions = {k: v[:].tobytes().decode() for k, v in file.get("conditions", {}).items()}
    except OSError as e:
        error = InputError(f"restart file {path} can't be read: {e}")
    except InputError as e:
        error = e
    raise_on_all_ranks(problem.comm, error)
    problem.restore_conditions(conditions, saved["factor"])
    terms = {name[6:].replace(".", "/"): a for name, a in rows.items() if name.startswith("terms/")}
    problem.restore_terms(terms)
    if isinstance(problem, QuasiStaticFEM):
        meshstate.put(problem, rows, path)
        problem.restore(Progress(**saved))
    elif isinstance(problem, QuasiStatic):
        _put(problem, rows, Progress(**saved), shares)


def _shares(file: h5py.File, comm: MPI.Comm) -> np.ndarray | None:
    """How well the points are distributed; None where other ranks wrote the file."""
    same = "counts/points/id" in file and len(file["counts/points/id"]) == comm.size
    return file.attrs["shares"] if same and "shares" in file.attrs else None


def _put(
    problem: QuasiStatic, rows: dict[str, np.ndarray], progress: Progress, shares: np.ndarray | None
) -> None:
    between: tuple[Reference, np.ndarray, np.ndarray] | None = None
    if "nodes/lattice" in rows:
        reference = Reference(*(rows[f"reference/{f.name}"] for f in fields(Reference)))
        between = reference, rows["nodes/lattice"], rows["nodes/increments"]
    problem.points.replace({name: rows[f"points/{name}"] for name in problem.points.fields})
    kept = {name[5:]: a for name, a in rows.items() if name.startswith("kept/")}
    problem.restore(progress, between, kept, shares)


def _check(problem: Problem, file: h5py.File, path: Any) -> None:
    saved, here = file.attrs.get("body", "material points"), _kind(problem)
    if "format" in file.attrs and saved != here:
        raise InputError(f"restart file {path}: its state is of {saved}, this problem's of {here}")
    for name, value in _header(problem).items():
        found = file.attrs.get(name)
        if found is None or np.any(np.asarray(found) != np.asarray(value)):
            raise InputError(f"restart file {path}: {name} is {found}, this problem has {value}")


def _read_all(file: h5py.File, comm: MPI.Comm) -> dict[str, np.ndarray]:
    groups = [group for group in file if group not in ("counts", "conditions")]
    names = [f"{group}/{name}" for group in groups for name in file[group]]
    whole = [name for name in names if name.startswith("terms/")]
    return {name: file[name][:] if name in whole else _read(file, name, comm) for name in names}


def _read(file: h5py.File, name: str, comm: MPI.Comm) -> np.ndarray:
    """This rank's rows: the rank's own when as many ranks read as wrote, else an equal share."""
    data, counts = file[name], file[f"counts/{name}"][:]
    if len(counts) == comm.size:
        start = int(counts[: comm.rank].sum())
        end = start + int(counts[comm.rank])
    else:
        start, end = len(data) * comm.rank // comm.size, len(data) * (comm.rank + 1) // comm.size
    rows: np.ndarray = data[start:end]
    return rows
