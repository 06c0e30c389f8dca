"""What was measured: where, what, how well, and the function that computes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

METHODS = ("twins", "exact", "differences")
_SAME = 1e-9  # relative to the largest abscissa
_ALLOWED = "measured values and their standard deviation, (measured, sigma), or (measured, sigma, at)"


@dataclass(frozen=True, eq=False)
class Dataset:
    """One measured thing of an experiment.

    Attributes:
        name: of the observable.
        rows: of the experiment's abscissae at which it was measured (n,).
        measured: values (n, ...), NaN where there is none; None: only planned.
        sigma: standard deviations, of the same shape, or one number of what is planned.
    """

    name: str
    rows: np.ndarray
    measured: np.ndarray | None
    sigma: np.ndarray


class Experiment:
    """One test of a body: a function that computes it, and what was measured.

    Args:
        build: called as `build(p, **arguments)` with all parameters by name, returns `(problem, observables)`
            as for `Sensitivity`; observables are functions without arguments, by name, that return a number
            or an array which is the same on all ranks. Or a closed form: it returns values by name, an array
            with one row for each entry of `at` (which it's given, if it has an argument of that name). It
            must be deterministic; to run in several processes it must be a function of a module or of the
            script.
        at: load factors at which there are data, in the order in which they are passed (a load path may turn
            back); of a closed form, abscissae of whatever kind. None: one state, at load factor 1. States at
            load factor 0 at the beginning aren't compared: nothing has been solved there.
        data: `(measured, sigma)` by observable: values with one row for each of `at`, NaN where there is
            none, and their standard deviation, one number or an array. `(measured, sigma, at)`: measured at
            these of the load factors only, which are added to `at` if that goes one way. `(None, sigma)`: not
            yet measured, for `plan`.
        march: how the load is brought on: options of `problem.march`, `steps` being those to the last load
            factor. Default: a step to each of `at`, cut where it fails.
        method: of derivatives: "twins", "exact" (see `Sensitivity`), or "differences" of whole runs, which
            need twice as many runs as there are parameters and are as rough as a run is.
        label: for messages and figures.
        **arguments: of `build`.

    Raises:
        InputError: an argument that isn't allowed; data that don't fit `at`.
    """

    def __init__(
        self,
        build: Callable[..., Any],
        *,
        at: Any = None,
        data: Mapping[str, Any],
        march: Mapping[str, Any] | None = None,
        method: str = "twins",
        label: str = "",
        **arguments: Any,
    ):
        self.build = checks.function("build", build)
        self.method = checks.choice("method", method, METHODS)
        self.label = checks.instance("label", label, str, "a text is")
        self.single = at is None
        self.march = _march_options(march)
        self.arguments = arguments
        path = (
            np.ones(1) if at is None else checks.array("at", np.atleast_1d(checks.numeric("at", at)), (None,))
        )
        if not len(path):
            raise InputError("at: at least one abscissa is needed")
        if not isinstance(data, Mapping) or not data:
            raise checks.refuse("data", data, f"by observable: {_ALLOWED}")
        parts = {checks.text("data: a name", name): _parts(name, given) for name, given in data.items()}
        self.at = _with_others(path, {name: at for name, (_, _, at) in parts.items() if at is not None})
        self.datasets = [self._dataset(name, path, *part) for name, part in parts.items()]

    def _dataset(self, name: str, path: np.ndarray, measured: Any, sigma: Any, at: Any) -> Dataset:
        own = path if at is None else at
        rows = np.array([_row(self.at, x) for x in own]) if at is not None else _rows(self.at, path)
        of = f"data: {name}"
        spread = checks.numeric(f"{of}: sigma", sigma, "standard deviations of the measured values")
        if measured is None:
            if spread.ndim:
                raise checks.refuse(
                    f"{of}: sigma", sigma, "one number is needed where nothing is measured yet"
                )
            if not 0 < spread < np.inf:
                raise checks.refuse(f"{of}: sigma", sigma, "a positive finite number is needed")
            return Dataset(name, rows, None, spread)
        values = checks.numeric(of, measured, "measured values")
        if self.single and at is None:
            values = values[None]
        if values.ndim == 0 or len(values) != len(own):
            raise InputError(
                f"{of}: {len(own)} rows are needed, one for each of at; the shape is {values.shape}"
            )
        if np.isinf(values).any():
            raise checks.refuse(of, measured, "finite values are needed, or NaN where there is none")
        try:
            if spread.ndim == 1 and values.ndim > 1 and len(spread) == len(values) != values.shape[-1]:
                spread = spread.reshape(-1, *[1] * (values.ndim - 1))
            spread = np.broadcast_to(spread, values.shape).copy()
        except ValueError:
            raise InputError(
                f"{of}: sigma has the shape {spread.shape}, the values have {values.shape}"
            ) from None
        there = np.isfinite(values)
        if not there.any():
            raise InputError(f"{of}: no value is a number")
        if not (np.isfinite(spread[there]).all() and (spread[there] > 0).all()):
            raise checks.refuse(f"{of}: sigma", sigma, "positive finite numbers are needed")
        return Dataset(name, rows, values, spread)

    def __repr__(self) -> str:
        names = ", ".join(d.name for d in self.datasets)
        what = self.label or getattr(self.build, "__name__", "build")
        return f"Experiment({what}: {names}; {len(self.at)} states)"

    def task(self) -> Task:
        """What is needed to compute it, without the data."""
        names = tuple(d.name for d in self.datasets)
        return Task(self.build, self.arguments, self.at, self.march, self.method, names)


@dataclass(frozen=True, eq=False)
class Task:
    """What computes an experiment; it can be sent to another process if `build` can.

    Attributes:
        closed: it is a closed form, without a run.
    """

    build: Callable[..., Any]
    arguments: dict[str, Any]
    at: np.ndarray
    march: dict[str, Any]
    method: str
    names: tuple[str, ...]
    closed: bool = False

    @property
    def skipped(self) -> int:
        """How many states at the beginning are the undeformed body's."""
        away = np.flatnonzero(self.at != 0)
        return 0 if self.closed else int(away[0]) if len(away) else len(self.at)

    def compared(self, d: Dataset) -> np.ndarray:
        """Which values (n, ...) of measured data are there, and computed."""
        assert d.measured is not None
        found: np.ndarray = np.isfinite(d.measured)
        return found & (d.rows >= self.skipped).reshape(-1, *[1] * (d.measured.ndim - 1))


def _march_options(march: Any) -> dict[str, Any]:
    if march is None:
        return {}
    if not isinstance(march, Mapping):
        raise checks.refuse("march", march, 'options of problem.march by name, such as {"steps": 20}')
    allowed = ("steps", "adaptive", "smallest", "largest", "easy")
    for name in march:
        if name not in allowed:
            raise checks.refuse("march", name, f"its options are {', '.join(allowed)}")
    found = dict(march)
    if found.get("steps") is not None:
        found["steps"] = checks.whole("march: steps", found["steps"], least=1)
    return found


def _parts(name: str, given: Any) -> tuple[Any, Any, np.ndarray | None]:
    if not isinstance(given, tuple | list) or len(given) not in (2, 3):
        raise checks.refuse(f"data: {name}", given, f"{_ALLOWED}, is needed")
    measured, sigma, *rest = given
    if not rest or rest[0] is None:
        return measured, sigma, None
    own = checks.array(
        f"data: {name}: at", np.atleast_1d(checks.numeric(f"data: {name}: at", rest[0])), (None,)
    )
    return measured, sigma, own


def _with_others(path: np.ndarray, others: dict[str, np.ndarray]) -> np.ndarray:
    """All abscissae, in the order of the path."""
    steps = np.diff(path)
    way = -1.0 if len(path) and path[-1] < 0 else 1.0
    one_way = (way * steps >= 0).all()
    for name, own in others.items():
        missing = [x for x in own if _find(path, x) is None]
        if missing and not one_way:
            raise checks.refuse(
                f"data: {name}: at", missing[0], "the load goes back and forth: one of at is needed"
            )
        path = np.sort(way * np.concatenate([path, missing])) * way if missing else path
    keep = np.concatenate([[True], np.diff(path) != 0])
    return np.array(path[keep])


def _find(path: np.ndarray, x: float) -> int | None:
    near = np.flatnonzero(np.abs(path - x) <= _SAME * max(1e-300, float(np.abs(path).max())))
    return int(near[0]) if len(near) else None


def _row(path: np.ndarray, x: float) -> int:
    row = _find(path, x)
    assert row is not None
    return row


def _rows(whole: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Row of each entry of the path among all, equal neighbours being one."""
    out, k = [], -1
    for i, x in enumerate(path):
        if i == 0 or x != path[i - 1]:
            k = k + 1 + int(np.flatnonzero(whole[k + 1 :] == x)[0])
        out.append(k)
    return np.array(out)


def experiments(tests: Any, measured: bool = True) -> list[Experiment]:
    """A list of experiments, or one.

    Raises:
        InputError: something else; no data, where they are needed.
    """
    found = [tests] if isinstance(tests, Experiment) else tests
    try:
        found = list(found)
    except Exception:
        raise checks.refuse("tests", tests, "a list of polarmpm.Experiment is needed") from None
    if not found:
        raise InputError("tests: at least one polarmpm.Experiment is needed")
    for k, test in enumerate(found):
        checks.instance(f"tests[{k}]", test, Experiment, "a polarmpm.Experiment is")
        for d in test.datasets:
            if measured and d.measured is None:
                raise InputError(f"tests[{k}]: {d.name} isn't measured yet; plan takes such experiments")
    return found
