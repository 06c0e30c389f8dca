"""Restart files: all that a run needs to continue to the same digits, as if it had never been interrupted.

Material points are put back as they are; another number of ranks than wrote the file reads equal shares of it
and distributes them afresh. Elements are made by the script, and their state is put in by the original
numbers of cells and quadrature points.

A file is HDF5 with a checksum, see `container`. It also says what the state was made of, see `identity`. All
is checked before anything of the problem is changed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from ..bodies.lineage import Lineage
from ..bodies.pointfields import MOTION_FIELDS
from ..bodies.reference import Reference
from ..errors import InputError
from ..problems.base import Problem
from ..problems.boxes import BoxRecord
from ..problems.elementdoubts import ElementRecord
from ..problems.elements import QuasiStaticFEM
from ..problems.points import QuasiStatic
from ..problems.state import Progress
from ..solvers.stepping import Restored, Step
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import raise_on_all_ranks
from . import container, meshstate
from .files import reason
from .identity import Facts, check_allowed, check_points, differences, made_of, refuse_differences
from .probes import restore_probes

_FORMAT = 15
_KIND = f"format {_FORMAT}"
_WHOLE = ("terms", "steps", "lineage")  # groups of arrays that every rank has whole
_FINITE = ("points", "reference", "nodes", "cells", "equilibrium")  # that have nothing of a script's


# saving -----------------------------------------------------------------------------------------------
@collective("save_restart", comm=lambda problem, *args, **options: problem.comm)
def save(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write the last converged state of a `QuasiStatic` or `QuasiStaticFEM`. Collective.

    The file is complete, flushed, and then put in place of an old one of this name. Its folder is made if it
    isn't there.

    Raises:
        InputError: not a problem, a closed one, no name of a file, or a state that isn't finite.
        OutputError: the file can't be written, such as on a full disc. The old file stays, and the run can go
            on.
    """
    _check_problem(problem)
    problem.check_open()
    file, comm = checks.path("path", path, "the name of a restart file"), problem.comm
    if file.is_dir():
        raise InputError(f"path = {str(file)!r}: is a folder; the name of a restart file is needed")
    arrays = meshstate.arrays(problem) if isinstance(problem, QuasiStaticFEM) else _arrays(problem)
    about: dict[str, Any] = {
        "made of": made_of(problem, problem.terms),
        "conditions": problem.condition_state(),
    }
    found = problem.equilibrium_state()
    about["sizes"], lineage = problem.step_sizes, dict[str, np.ndarray]()
    about["probes"] = {name: probe.saved() for name, probe in problem.probes.items()}
    if found is not None:
        about["equilibrium"], rows = found
        arrays |= {f"equilibrium/{name}": a for name, a in rows.items()}
    about["trust"] = _record(problem).state()
    if isinstance(problem, QuasiStatic):
        about["grids"], lineage = problem.grid_state()
    whole = {f"terms/{name.replace('/', '.')}": a for name, a in problem.term_state().items()}
    whole |= {f"steps/{name}": a for name, a in _steps(problem.steps).items()}
    whole |= {f"lineage/{name}": a for name, a in lineage.items()}
    whole["about"] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    for name, a in whole.items():  # the same on every rank
        arrays[name] = np.asarray(a) if comm.rank == 0 else np.asarray(a)[:0]
    error = next((_not_finite(name) for name, a in arrays.items() if not _is_finite(name, a)), None)
    raise_on_all_ranks(comm, error)
    attributes: dict[str, Any] = {"format": _FORMAT, "body": _body(problem)}
    attributes |= {f"progress/{name}": value for name, value in asdict(problem.progress).items()}
    if isinstance(problem, QuasiStatic):
        attributes["shares"] = problem.load_shares.state()
    container.write(comm, file, _KIND, container.agree(comm, arrays), attributes)


def _check_problem(problem: Any) -> None:
    checks.instance("problem", problem, (QuasiStatic, QuasiStaticFEM), "a QuasiStatic or QuasiStaticFEM is")


def _record(problem: Any) -> BoxRecord | ElementRecord:
    """What it keeps of how far its answer can be trusted."""
    found: BoxRecord | ElementRecord
    found = problem.box_record if isinstance(problem, QuasiStatic) else problem.element_record
    return found


def _body(problem: Problem) -> str:
    return "finite elements" if isinstance(problem, QuasiStaticFEM) else "material points"


def _arrays(problem: Any) -> dict[str, np.ndarray]:
    """This rank's rows of a problem of material points."""
    between = problem.increments()  # the points may have to know more
    arrays = {f"points/{name}": a for name, a in problem.points.arrays().items()}
    if between is not None:
        reference, lattice, values = between
        arrays |= {f"reference/{f.name}": getattr(reference, f.name) for f in fields(reference)}
        arrays |= {"nodes/lattice": lattice, "nodes/increments": values}
    arrays |= {f"kept/{name}": a for name, a in problem.kept().items()}
    return arrays


def _is_finite(name: str, values: np.ndarray) -> bool:
    return name.split("/")[0] not in _FINITE or bool(np.all(np.isfinite(values)))


def _not_finite(name: str) -> InputError:
    return InputError(f"restart file: {name} isn't finite; such a state can't be continued")


def _steps(steps: list[Step]) -> dict[str, np.ndarray]:
    """Converged steps as arrays; what isn't known of a step is not a number."""
    rows = [[s.number, s.factor, s.cuts, np.nan if s.unresolved is None else s.unresolved] for s in steps]
    history = [measures for s in steps for measures in s.history]
    return {
        "rows": np.array(rows, dtype=float).reshape(-1, 4),
        "lengths": np.array([len(s.history) for s in steps], dtype=np.int64),
        "history": np.array(history, dtype=float).reshape(-1, 2),
    }


# loading ----------------------------------------------------------------------------------------------
@collective("load_restart", comm=lambda problem, *args, **options: problem.comm)
def load(problem: Problem, path: str | os.PathLike[str], *, allow: Collection[str] = ()) -> None:
    """Put a saved state into a problem with the same grid, basis, points and materials, or the same mesh,
    degree, quadrature and materials; `march` goes on from it. Collective.

    Supports and loads aren't in the file: the script that made the problem gives all of them again before it
    calls this, in the same order, those too that were added in mid-run or released. The file knows since when
    they count and which have been released. Those that it doesn't know count from the saved state on.

    Reactions, balance, fields and `problem.steps` are those of the saved state at once, and a `Recorder` or
    `Table` that is used as in the run before goes on with its files.

    Args:
        allow: differences that are meant, a set of: "materials" (other numbers or classes; plastic strain
            that the file doesn't have is zero), "points" (the file's points are taken), "grid" and "basis"
            (the grid is reset), "terms" (they begin anew), "conditions" (some aren't given any more),
            "motion" (another mass, or the state of a quasi-static run, which is at rest).

    Raises:
        InputError: no such file, a damaged one, or one that belongs to another problem; the message says what
            differs. A condition of the saved run is missing. The problem stays as it was.
    """
    _check_problem(problem)
    file = checks.path("path", path, "the name of a restart file")
    allowed = check_allowed(problem, allow)
    container.check(problem.comm, file, _KIND)
    saved, error = None, None
    try:
        saved = _read(file, problem.comm)
    except OSError as e:
        error = InputError(f"restart file {file} can't be read: {reason(e)}")
    except (KeyError, ValueError) as e:
        error = InputError(f"restart file {file} isn't complete: {e}")
    raise_on_all_ranks(problem.comm, error)
    assert saved is not None
    differing = _check(problem, saved, file, allowed)
    _put(problem, saved, file, differing)


@dataclass
class _Saved:
    """What a file holds; of arrays this rank's rows."""

    body: str
    about: dict[str, Any]
    progress: Progress
    rows: dict[str, np.ndarray]
    shares: np.ndarray | None

    @property
    def made_of(self) -> Facts:
        found: Facts = self.about["made of"]
        return found

    def group(self, name: str) -> dict[str, np.ndarray]:
        start = f"{name}/"
        return {key[len(start) :]: a for key, a in self.rows.items() if key.startswith(start)}


def _read(path: Path, comm: MPI.Comm) -> _Saved:
    with h5py.File(path, "r") as file:
        names = [
            f"{group}/{name}" for group in file if group not in ("counts", "about") for name in file[group]
        ]
        rows = {n: file[n][:] if n.split("/")[0] in _WHOLE else _rows(file, n, comm) for n in names}
        progress = {f.name: file.attrs[f"progress/{f.name}"].item() for f in fields(Progress)}
        about = json.loads(file["about"][:].tobytes())
        return _Saved(file.attrs["body"], about, Progress(**progress), rows, _shares(file, comm))


def _shares(file: h5py.File, comm: MPI.Comm) -> np.ndarray | None:
    """How well the points are distributed; None where other ranks wrote the file."""
    same = "counts/points/id" in file and len(file["counts/points/id"]) == comm.size
    return file.attrs["shares"] if same and "shares" in file.attrs else None


def _rows(file: h5py.File, name: str, comm: MPI.Comm) -> np.ndarray:
    """This rank's rows: the rank's own when as many ranks read as wrote, else an equal share."""
    data, counts = file[name], file[f"counts/{name}"][:]
    if len(counts) == comm.size:
        start = int(counts[: comm.rank].sum())
        end = start + int(counts[comm.rank])
    else:
        start, end = len(data) * comm.rank // comm.size, len(data) * (comm.rank + 1) // comm.size
    rows: np.ndarray = data[start:end]
    return rows


def _check(problem: Problem, saved: _Saved, path: Path, allowed: frozenset[str]) -> frozenset[str]:
    """Refuse what doesn't fit, before anything is changed; the groups that may differ, and do. Collective."""
    here = _body(problem)
    if saved.body != here:
        raise InputError(f"restart file {path}: its state is of {saved.body}, this problem's of {here}")
    changed = "grid has been changed" if getattr(problem, "regrids", ()) else ""
    if not changed and isinstance(problem, QuasiStatic) and problem.regridding.split:
        changed = "points have been split"
    if changed:
        raise InputError(f"restart file {path}: this problem's {changed} since it was made; make it anew")
    conditions = saved.about["conditions"]
    try:
        fewer = problem.check_conditions(conditions, "conditions" in allowed)
    except InputError as e:
        raise InputError(f"restart file {path}: {e}") from None
    found = list(differences(saved.made_of, made_of(problem, problem.terms_after(conditions))))
    refuse_differences(path, found, allowed)
    error = next((_not_finite(name) for name, a in saved.rows.items() if not _is_finite(name, a)), None)
    raise_on_all_ranks(problem.comm, error)
    if not isinstance(problem, QuasiStaticFEM):
        lineage = Lineage(**saved.group("lineage")) if saved.group("lineage") else None
        of_points: Any = problem
        inside = of_points.saved_grid(saved.about["grids"]).inside if "grid" not in allowed else None
        check_points(problem, saved.rows, path, allowed, lineage, inside)
    return frozenset([group for group, _ in found] + ["conditions"] * fewer)


def _put(problem: Problem, saved: _Saved, path: Path, differing: frozenset[str]) -> None:
    """Put a state that fits into the problem. Collective."""
    progress = saved.progress
    found = meshstate.find(problem, saved.rows, path) if isinstance(problem, QuasiStaticFEM) else None
    problem.restore_conditions(saved.about["conditions"], progress.factor)
    if "terms" not in differing:
        terms = {name.replace(".", "/"): a for name, a in saved.group("terms").items()}
        problem.restore_terms(terms, len(saved.made_of["terms"]))
    if found is not None and isinstance(problem, QuasiStaticFEM):
        meshstate.put(problem, found)
        problem.restore(progress)
    elif isinstance(problem, QuasiStatic):
        _put_points(problem, saved, differing)
    _record(problem).restore(saved.about["trust"])
    problem.steps = list(_steps_of(saved.group("steps"), getattr(problem, "regridding", None)))
    problem.step_sizes = tuple(saved.about["sizes"]) if saved.about["sizes"] else None
    known = {step.number: step for step in problem.steps}
    problem.restored = Restored(progress.step, known, problem.step_sizes)
    if "equilibrium" in saved.about:
        problem.restore_equilibrium(saved.about["equilibrium"], saved.group("equilibrium"))
    restore_probes(problem, saved.about.get("probes", {}))


def _put_points(problem: QuasiStatic, saved: _Saved, differing: frozenset[str]) -> None:
    """On another grid or in another basis only the points' state holds."""
    between: tuple[Reference, np.ndarray, np.ndarray] | None = None
    rows, kept, points = saved.rows, saved.group("kept"), problem.points
    if "nodes/lattice" in rows and not differing & {"grid", "basis"}:
        reference = Reference(*(rows[f"reference/{f.name}"] for f in fields(Reference)))
        between = reference, rows["nodes/lattice"], rows["nodes/increments"]
    if "terms" in differing:
        kept = {name: a for name, a in kept.items() if not name.startswith("term ")}
    problem.restore_grid({} if "grid" in differing else saved.about["grids"], saved.group("lineage"))
    points.replace({**_unyielded(rows), **saved.group("points")}, same=True)
    problem.restore(saved.progress, between, kept, saved.shares)


def _unyielded(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Plastic state of points that were elastic in the run before, second gradients of those without."""
    n = len(rows["points/id"])
    none = {"plastic_wryness": np.zeros((n, 3, 3)), "hardening": np.zeros(n), "dissipation": np.zeros(n)}
    none["grad_F"], none["body"] = np.zeros((n, 3, 3, 3)), np.zeros(n, dtype=np.int32)
    d = rows["points/X"].shape[1]
    none |= {name: np.zeros((n, d if shape == ("d",) else 3)) for name, (shape, _) in MOTION_FIELDS.items()}
    return {"plastic_F": np.tile(np.eye(3), (n, 1, 1)), **none}


def _steps_of(arrays: dict[str, np.ndarray], grids: Any) -> Iterator[Step]:
    ends = np.cumsum(arrays["lengths"])
    for (number, factor, cuts, unresolved), end, n in zip(
        arrays["rows"].tolist(), ends, arrays["lengths"], strict=True
    ):
        history = tuple((force, energy) for force, energy in arrays["history"][end - n : end].tolist())
        regrids = 0 if grids is None else grids.before(int(number))
        share = None if np.isnan(unresolved) else unresolved
        yield Step(int(number), factor, history, int(cuts), share, regrids=regrids)
