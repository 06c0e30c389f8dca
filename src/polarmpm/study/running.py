"""Runs discretisations, each in a process of its own."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, NotConverged, PointsOutsideGrid
from ..kernels import native
from ..problems.base import Problem
from ..problems.elements import QuasiStaticFEM
from ..tools import checks
from ..tools.timing import Phase, Timer
from .discretisations import Case, Discretisation, Row

# phases of `Problem.timer` that aren't part of a method's cost
NOT_COUNTED = ("compile", "output")
Reference = Sequence[float] | np.ndarray | Callable[[np.ndarray], float]


def run(
    discretisations: Sequence[Discretisation],
    references: Mapping[str, Reference],
    *,
    record: Callable[[Row], Any] | None = None,
) -> list[Row]:
    """Run every discretisation in a process of its own, one after the other.

    Args:
        references: by name, vectors to which the distance is the error; or functions that give the error of
            a result.
        record: called with every row as soon as it is there.

    Returns:
        One row for each discretisation. A discretisation that finds no equilibrium, loses points or whose
        process dies (of too little memory, say) is a row with `failed_at` and `failure`.

    Raises:
        InputError: no discretisations; two of one name; a reference that doesn't fit the result; several
            ranks.
    """
    if MPI.COMM_WORLD.size > 1:
        raise InputError("run: a study starts processes of its own; run the script on one rank")
    try:
        discretisations = list(discretisations)
    except Exception:  # a script's class may do anything
        allowed = "a list of Discretisation is needed"
        raise checks.refuse("discretisations", discretisations, allowed) from None
    for one in discretisations:
        checks.instance("discretisations", one, Discretisation, "objects of study.Discretisation are")
    references = _checked(references)
    if record is not None:
        checks.function("record", record, takes=("row",))
    if not discretisations:
        raise InputError("discretisations: none is given")
    names = [(d.method, d.label) for d in discretisations]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"discretisations: two are named {name[0]!r}, {name[1]!r}")
    rows = []
    for d in discretisations:
        rows.append(compare(_in_new_process(d), references))
        if record is not None:
            record(rows[-1])
    return rows


def compare(row: Row, references: Mapping[str, Reference]) -> Row:
    """The row with its errors; see `run`.

    Raises:
        InputError: a reference that doesn't fit the result.
    """
    checks.instance("row", row, Row, "a study.Row is")
    references = _checked(references)
    if row.failed_at is not None:
        return row
    found, errors = np.array(row.result), {}
    for name, reference in references.items():
        if callable(reference):
            errors[name] = checks.number(f"references: {name}, of the result,", reference(found), least=0.0)
            continue
        exact = np.atleast_1d(reference)
        if exact.shape != found.shape:
            raise InputError(f"references: {name!r} has the shape {exact.shape}, the result {found.shape}")
        errors[name] = float(np.linalg.norm(found - exact))
    return replace(row, errors=errors)


def _checked(references: Any) -> dict[str, Any]:
    """Functions or vectors by name."""
    if not isinstance(references, Mapping):
        raise checks.refuse("references", references, 'vectors or functions by name, {"exact": (0.0, -1.0)}')
    found: dict[str, Any] = {}
    for name, reference in references.items():
        checks.text("references: a name", name)
        of = f"references: {name}"
        if callable(reference):
            found[name] = checks.function(of, reference, takes=("result",))
        else:
            found[name] = checks.numeric(of, reference, "a vector, or a function of the result")
            if not np.all(np.isfinite(found[name])):
                raise checks.refuse(of, reference, "finite numbers are needed")
    return found


def _in_new_process(d: Discretisation) -> Row:
    # spawned rather than forked: a fork shares the parent's memory, and MPI doesn't survive it
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, d).result()
        except BrokenProcessPool:
            failure = "the process ended; was there enough memory?"
            return Row(d.method, d.label, d.h, failed_at=0.0, failure=failure)


def _measure(d: Discretisation) -> Row:
    """Build and march; runs in a process of its own."""
    row = Row(d.method, d.label, d.h)
    try:
        case = d.build(**d.arguments)
        if not isinstance(case, Case):
            raise InputError(f"build = {d.build!r}: returned {checks.shown(case)} and not a study.Case")
        problem = case.problem
    except PointsOutsideGrid as e:
        return replace(row, failed_at=0.0, failure=str(e))
    _load_code(problem)
    problem.timer = timer = _Counter()
    begin, failed, failure = time.process_time(), None, ""
    try:
        for _ in problem.march(d.steps, adaptive=d.adaptive, progress=False):
            pass
    except (NotConverged, PointsOutsideGrid) as e:
        failed = e.factor if isinstance(e, NotConverged) else problem.progress.factor
        failure = str(e)
    spent = time.process_time() - begin
    cpu = spent - sum(timer.seconds.get(name, 0.0) for name in NOT_COUNTED)
    everything = sum(os.times()[:4])  # compilers included
    phases = {name: s for name, s in timer.seconds.items() if name not in NOT_COUNTED}
    phases["rest"] = max(0.0, cpu - sum(phases.values()))
    memory = _peak_memory()
    result: tuple[float, ...] = ()
    kernel = None
    if failed is None:
        found = checks.numeric("result, of the case,", case.result(), "a number or a vector")
        result = tuple(float(v) for v in np.atleast_1d(found).ravel())
        if case.kernel is not None:
            tangents = timer.calls.get("factor", 0)
            others = timer.calls.get("assembly", 0) - tangents
            kernel = tangents * case.kernel(True) + others * case.kernel(False)
    return replace(
        row,
        result=result,
        unknowns=problem.unknowns,
        points=problem.points.total,
        steps=len(problem.steps),
        iterations=sum(step.iterations for step in problem.steps),
        cuts=sum(step.cuts for step in problem.steps),
        cpu_s=cpu,
        phases=phases,
        kernel_s=kernel,
        startup_s=everything - cpu,
        peak_memory_mb=memory,
        failed_at=failed,
        failure=failure,
    )


class _Counter(Timer):
    """Counts how often each phase was entered, too."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, int] = {}

    def __call__(self, phase: str) -> Phase:
        self.calls[phase] = self.calls.get(phase, 0) + 1
        return super().__call__(phase)


def _load_code(problem: Problem) -> None:
    """Load compiled code that would be loaded within phases other than "compile" otherwise."""
    native.library()
    if isinstance(problem, QuasiStaticFEM):
        problem.forms.load_code()


def _peak_memory() -> float:
    """MB of this process. The usual ru_maxrss begins with what the parent had when it started this one."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
