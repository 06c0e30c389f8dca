"""One experiment at one set of parameters: values and derivatives; here or in another process."""

from __future__ import annotations

import contextlib
import inspect
import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import ErrorOnAnotherRank, InputError, PolarMPMError, RanksApart
from ..sensitivity.runs import Sensitivity
from ..tools import checks
from ..tools.parallel import errors_on_all_ranks
from .doubts import Doubts, doubts_kept
from .experiment import Experiment, Task

# changes of an unknown for differences: closed forms are smooth, runs as smooth as tolerances and resets
_CLOSED, _RUN = 1e-5, 1e-3
_NUMERIC = (PolarMPMError, ArithmeticError, np.linalg.LinAlgError)  # of a run at parameters that don't do


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What an experiment gives.

    Attributes:
        values: by observable, (n, ...) with a row for each state.
        rates: their derivatives by the unknowns, (n, ..., unknowns).
        failure: why there are none; empty if there are.
        doubts: texts of `TrustWarning`s, which aren't shown yet.
    """

    values: dict[str, np.ndarray]
    rates: dict[str, np.ndarray]
    failure: str = ""
    doubts: tuple[str, ...] = ()


class _Named(dict[str, float]):
    """Parameters by name, which say so if one isn't there."""

    def __missing__(self, name: str) -> float:
        raise checks.refuse("start", dict(self), f"the experiment's function asks for {name!r}")


def probe(test: Experiment, p: Mapping[str, float], comm: MPI.Intracomm) -> Task:
    """The task of an experiment, for which its function is called once. Collective.

    Raises:
        InputError: it returns something else than it should; an observable is missing.
    """
    task = test.task()
    with errors_on_all_ranks(comm), doubts_kept():  # the first evaluation has them, too
        returned = task.build(_Named(p), **_given(task))
    name = getattr(test.build, "__name__", "build")
    if isinstance(returned, Mapping):
        task = replace(task, closed=True)
        known: Any = returned
    else:
        good = isinstance(returned, tuple | list) and len(returned) == 2 and isinstance(returned[1], Mapping)
        if not good:
            raise InputError(
                f"{name}: returned {checks.shown(returned)}; (problem, observables), functions by name, or "
                "values by name of a closed form are needed"
            )
        known = returned[1]
        for key, function in known.items():
            checks.function(f"{name}: observable {key}", function)
    for key in task.names:
        if key not in known:
            raise checks.refuse("data", key, f"the observables of {name} are {', '.join(map(str, known))}")
    return task


def _given(task: Task) -> dict[str, Any]:
    """Arguments of a task's function besides the parameters."""
    with contextlib.suppress(TypeError, ValueError):
        if "at" in inspect.signature(task.build).parameters and "at" not in task.arguments:
            return {**task.arguments, "at": task.at.copy()}
    return task.arguments


def evaluate(
    task: Task,
    p: Mapping[str, float],
    slopes: Mapping[str, float],
    first: bool = False,
    comm: MPI.Intracomm | None = None,
) -> Evaluated:
    """Values and derivatives. Collective, but for closed forms.

    Args:
        slopes: by free parameter, its change (in its unit) for a change of 1 of its unknown; none: values
            only.
        first: the parameters are those of the start: what goes wrong is raised.
        comm: ranks that compute it together; None: this one alone.
    """
    with doubts_kept() as doubts:
        found = _evaluated(task, p, slopes, first, comm or MPI.COMM_SELF)
    return replace(found, doubts=tuple(doubts))


def _evaluated(
    task: Task, p: Mapping[str, float], slopes: Mapping[str, float], first: bool, comm: MPI.Intracomm
) -> Evaluated:
    try:
        with errors_on_all_ranks(comm), np.errstate(over="ignore"):
            if task.closed or task.method == "differences" or not slopes:
                values, rates = _by_differences(task, p, slopes)
            else:
                values, rates = _by_run(task, p, slopes)
    except (ErrorOnAnotherRank, RanksApart):
        raise
    except _NUMERIC as e:
        if first:
            raise
        return Evaluated({}, {}, f"{type(e).__name__}: {str(e).splitlines()[0] if str(e) else ''}")
    if not all(np.isfinite(a).all() for a in (*values.values(), *rates.values())):
        failure = "not all values and derivatives are finite numbers"
        if first:
            raise InputError(f"{getattr(task.build, '__name__', 'build')}: at the start {failure}")
        return Evaluated({}, {}, failure)
    return Evaluated(values, rates)


def _by_differences(
    task: Task, p: Mapping[str, float], slopes: Mapping[str, float]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    compute = _closed if task.closed else _run_once
    values = compute(task, p)
    step = _CLOSED if task.closed else _RUN
    columns: dict[str, list[np.ndarray]] = {name: [] for name in values}
    for name, slope in slopes.items():
        up, down = ({**p, name: p[name] + sign * step * slope} for sign in (1, -1))
        high, low = compute(task, up), compute(task, down)
        for key in values:
            columns[key].append((high[key] - low[key]) / (2 * step))
    return values, {key: _columns(of, values[key].shape) for key, of in columns.items()}


def _columns(of: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.stack(of, axis=-1) if of else np.zeros((*shape, 0))


def _closed(task: Task, p: Mapping[str, float]) -> dict[str, np.ndarray]:
    returned = task.build(dict(p), **_given(task))
    out = {}
    for name in task.names:
        value = checks.numeric(f"the closed form's {name}", returned[name])
        if len(task.at) == 1 and (value.ndim == 0 or len(value) != 1):
            value = value[None]
        if value.ndim == 0 or len(value) != len(task.at):
            raise InputError(
                f"the closed form's {name} has the shape {value.shape}; a row for each of the {len(task.at)} "
                "abscissae is needed"
            )
        out[name] = value
    return out


def _run_once(task: Task, p: Mapping[str, float]) -> dict[str, np.ndarray]:
    problem, observables = task.build(dict(p), **_given(task))
    rows: dict[str, list[np.ndarray]] = {name: [] for name in task.names}

    def note() -> None:
        for name in task.names:
            rows[name].append(np.array(observables[name](), dtype=float))

    _march(problem, task, note)
    problem.close()
    return {name: _filled(task, of) for name, of in rows.items()}


def _by_run(
    task: Task, p: Mapping[str, float], slopes: Mapping[str, float]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    build = partial(task.build, **_given(task))  # whose names may be those of the run's own arguments
    sides = {"sides": 1} if task.method == "twins" else {}  # digits enough for steps towards a minimum
    run = Sensitivity(build, dict(p), list(slopes), task.method, **sides)
    values: dict[str, list[np.ndarray]] = {name: [] for name in task.names}
    rates: dict[str, list[np.ndarray]] = {name: [] for name in task.names}

    def note() -> None:
        for name in task.names:
            value = np.array(run.values[name], dtype=float)
            values[name].append(value)
            of = [slope * np.asarray(run.rates[name][m]) for m, slope in slopes.items()]
            rates[name].append(_columns(of, value.shape))

    _march(run, task, note)
    run.close()
    return {k: _filled(task, a) for k, a in values.items()}, {k: _filled(task, a) for k, a in rates.items()}


def _filled(task: Task, rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of all states; those of the undeformed body are zero, and not compared."""
    skipped = len(task.at) - len(rows)
    return np.stack([np.zeros_like(rows[0])] * skipped + list(rows))


def _march(run: Any, task: Task, note: Callable[[], None]) -> None:
    """Bring the load on, from one state to the next, which are noted."""
    options = {"adaptive": True, **task.march}
    steps, whole = options.pop("steps", None), float(np.abs(np.diff(task.at, prepend=0.0)).sum())
    before = 0.0
    for factor in task.at:
        if factor == before == 0.0:
            continue
        number = 1 if steps is None else max(1, round(steps * abs(factor - before) / whole))
        for _ in run.march(steps=number, to=float(factor), progress=False, **options):
            pass
        note()
        before = factor


# processes ------------------------------------------------------------------------------------------------
Answers = list[Evaluated]


class Evaluator:
    """Computes all experiments at one set of parameters, in turn or in a pool of processes.

    Args:
        tasks: see `probe`.
        workers: number of processes; 1: here, on all ranks together.
    """

    def __init__(self, tasks: Sequence[Task], workers: int, comm: MPI.Intracomm):
        self.tasks, self.comm = list(tasks), comm
        self.workers, self._doubts = workers, Doubts(comm)
        self._pool: ProcessPoolExecutor | None = None
        if workers > 1:
            for task in self.tasks:
                _check_sendable(task)
            # spawned rather than forked: MPI doesn't survive a fork
            self._pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))

    def __call__(self, p: Mapping[str, float], slopes: Mapping[str, float], first: bool = False) -> Answers:
        if self._pool is None:
            found = [evaluate(task, p, slopes, first, self.comm) for task in self.tasks]
        else:
            found = self._in_pool(self._pool, p, slopes, first)
        self._doubts.tell(text for one in found for text in one.doubts)
        return found

    def _in_pool(
        self, pool: ProcessPoolExecutor, p: Mapping[str, float], slopes: Mapping[str, float], first: bool
    ) -> Answers:
        # more processes than experiments share the parameters of each, whose run they all make
        shares = max(1, min(self.workers // len(self.tasks), len(slopes)))
        parts = [{name: slopes[name] for name in list(slopes)[k::shares]} for k in range(shares)]
        waiting = [_submit(pool, task, dict(p), part, first) for task in self.tasks for part in parts]
        try:
            found = [one.result() for one in waiting]
            return [_joined(found[k : k + shares], parts, slopes) for k in range(0, len(found), shares)]
        except BrokenProcessPool:
            raise InputError(
                "workers: a process of the pool has ended; a script that starts some begins its work under "
                'if __name__ == "__main__":, and there must be enough memory for all of them'
            ) from None
        finally:
            for one in waiting:
                one.cancel()

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _submit(pool: ProcessPoolExecutor, *args: Any) -> Future[Evaluated]:
    with _alone():
        return pool.submit(evaluate, *args)


def _joined(
    found: Sequence[Evaluated], parts: Sequence[Mapping[str, float]], slopes: Mapping[str, float]
) -> Evaluated:
    """One experiment, of processes that have differentiated by a part of the parameters each."""
    failed = next((one for one in found if one.failure), None)
    doubts = tuple(text for one in found for text in one.doubts)
    if failed is not None or len(found) == 1:
        return replace(failed or found[0], doubts=doubts)
    names = [name for part in parts for name in part]
    order = [names.index(name) for name in slopes]
    joined = {key: np.concatenate([one.rates[key] for one in found], axis=-1) for key in found[0].rates}
    rates = {key: of[..., order] for key, of in joined.items()}
    return Evaluated(found[0].values, rates, doubts=doubts)


def _check_sendable(task: Task) -> None:
    try:
        pickle.dumps((task.build, task.arguments))
    except Exception as e:
        name = getattr(task.build, "__name__", "build")
        raise InputError(
            f"workers: {name} and its arguments can't be sent to another process ({e}); a function of a "
            "module or at the top of the script is needed, or workers=1"
        ) from None


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Processes that begin here know nothing of an mpirun: they are ranks of their own."""
    kept = {
        k: v
        for k, v in os.environ.items()
        if k.startswith(("OMPI_COMM", "OMPI_UNIVERSE", "PMIX_", "PRTE_", "PMI_"))
    }
    try:
        for name in kept:
            del os.environ[name]
        yield
    finally:
        os.environ.update(kept)
