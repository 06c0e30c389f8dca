"""Values at places of a body: once, or through a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ..bodies.recovery import Around, stencil
from ..bodies.selection import Selection
from ..errors import InputError
from ..problems.elements import QuasiStaticFEM
from ..problems.observer import Observer
from ..tools import checks
from ..tools.parallel import errors_on_all_ranks
from .fields import AnyField, choose, field_arrays
from .naming import named_components


class Probe(Observer):
    """Values at a material place, a row for each converged step; made by `problem.probe`.

    `probe["stress"]` is a field's history (rows, ...), vectors with d components. Called without arguments it
    gives the values of the present state, such as columns of a `Table` want them.

    Attributes:
        name: of the probe.
        at: place (m), (d,), or selection.
        fields: names of its fields.
    """

    def __init__(self, problem: Any, name: str, at: Any, fields: str | AnyField | Iterable[str | AnyField]):
        self.name, self._chosen = name, choose(fields, problem.points)
        self.fields = tuple(field.name for field in self._chosen)
        if not self.fields:
            raise InputError("fields = (): one field is needed at least")
        self.at = at
        self._mean = _mean_at(problem, at)
        self._rows: list[tuple[float, dict[str, np.ndarray]]] = []
        # the problem, once it is watched, holds the probe: no circle
        self._now = self._values(problem)
        self._rows.append((float(problem.progress.factor), self._now))
        problem._probes[name] = self
        problem.observers.append(self)

    def _values(self, problem: Any) -> dict[str, np.ndarray]:
        arrays = field_arrays(problem, self._chosen, pad=False)
        return {name: self._mean(problem.points, values) for name, values in arrays.items()}

    def after_commit(self, problem: Any, rebased: bool) -> None:
        self._now = self._values(problem)
        self._rows.append((float(problem.progress.factor), self._now))

    # what it has found ----------------------------------------------------------------------------
    @property
    def factor(self) -> np.ndarray:
        """Load factors of the rows, in dynamic problems times (s)."""
        return np.array([factor for factor, _ in self._rows])

    time = factor

    def __getitem__(self, field: str) -> np.ndarray:
        if field not in self.fields:
            raise KeyError(f"{field}: probe {self.name!r} has {', '.join(self.fields)}")
        return np.array([values[field] for _, values in self._rows])

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Any:
        return iter(self.fields)

    def now(self) -> dict[str, np.ndarray]:
        """Values of the last converged state by field."""
        return dict(self._now)

    def __call__(self) -> dict[str, Any]:
        """Columns of a table."""
        return {name: named_components(name, value) for name, value in self._now.items()}

    def __repr__(self) -> str:
        at = f"{len(self.at)} points" if isinstance(self.at, Selection) else f"{_shown(self.at)} m"
        return f"<Probe {self.name!r} at {at}: {', '.join(self.fields)}; {len(self)} rows>"

    # restart --------------------------------------------------------------------------------------
    def saved(self) -> list[Any]:
        """Its rows, for a file."""
        return [[factor, {n: v.tolist() for n, v in values.items()}] for factor, values in self._rows]

    def restore(self, problem: Any, rows: list[Any] | None) -> None:
        """Go on with saved rows; without any it begins anew with the present state. Collective."""
        good = rows and all(set(values) == set(self.fields) for _, values in rows)
        self._now = self._values(problem)
        self._rows = [(float(problem.progress.factor), self._now)]
        if good and rows:
            shapes = {name: value.shape for name, value in self._now.items()}
            self._rows = [
                (f, {n: np.array(v, dtype=float).reshape(shapes[n]) for n, v in values.items()})
                for f, values in rows
            ]


def _shown(at: Any) -> str:
    return "(" + ", ".join(f"{float(c):g}" for c in at) + ")"


def _mean_at(problem: Any, at: Any) -> Callable[[Any, np.ndarray], np.ndarray]:
    """What makes one value of those at the local points. Collective."""
    if isinstance(at, Selection):
        problem.points.check(at)
        if not len(at):
            raise InputError("at: a selection without points has no mean")
        return lambda points, values: _mean(points, values, at)
    place = checks.vector(
        "at", at, problem.points.dim, f"{problem.points.dim} coordinates (m), or a selection"
    )
    around = Around(problem.points, place[None], of_nearest=True)
    return lambda points, values: around(points, values)[0]


def _mean(points: Any, values: np.ndarray, selection: Selection) -> np.ndarray:
    """Mean over those of a selection that are still there, weighted by reference volume; nan without any.
    Collective."""
    rows = points.rows(selection)
    volume = points.volume0[rows]
    whole = points.comm.allreduce(float(volume.sum()))
    total = points.comm.allreduce(np.tensordot(volume, values[rows].astype(float), axes=1))
    return np.asarray(total / whole if whole else np.full(np.shape(total), np.nan))


def restore_probes(problem: Any, saved: Mapping[str, list[Any]]) -> None:
    """Put the histories of a restart file into a problem's probes. Collective."""
    for name, probe in problem.probes.items():
        probe.restore(problem, saved.get(name))


def recover(problem: Any, field: str | AnyField, at: Any) -> np.ndarray:
    """See `Problem.recover`."""
    points = problem.points
    (chosen,) = choose(field, points)
    single = False
    with errors_on_all_ranks(problem.comm):
        if at is None:
            places = _nodes(problem)
        else:
            found = checks.numeric("at", at, "places (m)")
            single = found.ndim == 1
            places = checks.array("at", found[None] if single else found, (None, points.dim), "places (m)")
    around = stencil(points, places)
    values = around.apply(points, field_arrays(problem, (chosen,), pad=False)[chosen.name])
    return values[0] if single else values


def _nodes(problem: Any) -> np.ndarray:
    """Where the nodes of a mesh were (n, d)."""
    if not isinstance(problem, QuasiStaticFEM):
        raise InputError(
            "at = None: material points have no nodes of their own; places (m, d) in the undeformed body are "
            "needed, such as points.X"
        )
    found: np.ndarray = problem.elements.nodes.position
    return found
