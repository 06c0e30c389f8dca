"""What experiments would tell of parameters, before they are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..tools import checks
from ..tools.meetings import collective
from .evaluating import Evaluated, Evaluator, probe
from .experiment import Dataset, Experiment, Task, experiments
from .judging import LIMIT, Judgement, direction_in_words, intervals, judge, percent, unidentifiable
from .transforms import Free, free_parameters
from .wording import identified, table


@dataclass(frozen=True, eq=False)
class Plan:
    """Intervals that experiments would give, by the derivatives of what they measure.

    Attributes:
        names: of the free parameters.
        values: at which it was predicted.
        without: for each experiment, and each observable of several, the plan with it left out.
        limit: see `identify`.
    """

    free: Free
    judgement: Judgement
    limit: float
    without: dict[str, Plan]

    @property
    def names(self) -> list[str]:
        return self.free.names

    @property
    def values(self) -> dict[str, float]:
        return {name: self.free.start[name] for name in self.names}

    @property
    def relative_sd(self) -> dict[str, float]:
        """Standard deviations of the unknowns, relative ones for "log"; inf where nothing would be known."""
        return dict(zip(self.names, self.judgement.spread.tolist(), strict=True))

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations in the parameters' units."""
        slopes = np.abs(self.free.slopes(self.free.start))
        return dict(zip(self.names, (slopes * self.judgement.spread).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Lower and upper end by name, in the parameters' units."""
        return intervals(self.free, np.zeros(len(self.names)), self.judgement.spread, level)

    @property
    def unidentifiable(self) -> list[str]:
        """Parameters that the experiments wouldn't show to within `limit`."""
        return [self.names[k] for k in unidentifiable(self.judgement, self.limit)]

    @property
    def weakest(self) -> str:
        """The direction of which they would say least, in words."""
        return direction_in_words(self.judgement, self.free, np.zeros(len(self.names)))

    def __str__(self) -> str:
        rows = [["sd", *self.names], ["all", *(percent(sd) for sd in self.judgement.spread)]]
        rows += [
            [f"without {k}", *(percent(sd) for sd in p.judgement.spread)] for k, p in self.without.items()
        ]
        lines = table(rows)
        return "\n".join(lines + identified(self.judgement, self.free, np.zeros(len(self.names)), self.limit))


@collective("plan", comm=lambda *args, comm=MPI.COMM_WORLD, **options: comm)
def plan(
    tests: Experiment | Sequence[Experiment],
    *,
    values: Mapping[str, float],
    free: Mapping[str, Any] | Sequence[str],
    limit: float = LIMIT,
    workers: int = 1,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
) -> Plan:
    """Predict the intervals that experiments would give, were the parameters so. Collective.

    Each experiment is computed once, with derivatives. Of the data only the standard deviations matter;
    `data={"torque": (None, sigma)}` plans what isn't measured yet.

    Args:
        values: all parameters, as `start` of `identify`.
        tests, free, limit, workers, comm: see `identify`.

    Raises:
        InputError: an argument that isn't allowed.
        NotConverged: (or another error of a run) at these values.
    """
    checks.communicator("comm", comm)
    found = experiments(tests, measured=False)
    unknown = free_parameters(values, free)
    limit, workers = checks.number("limit", limit, above=0.0), checks.whole("workers", workers, least=1)
    if workers > 1 and comm.size > 1:
        raise checks.refuse("workers", workers, f"1 where {comm.size} ranks compute each experiment together")
    tasks = [probe(test, unknown.start, comm) for test in found]
    slopes = dict(zip(unknown.names, unknown.slopes(unknown.start), strict=True))
    with Evaluator(tasks, workers, comm) as evaluator:
        answers = evaluator(unknown.start, slopes, True)
    rows: dict[str, np.ndarray] = {}
    for k, (test, answer) in enumerate(zip(found, answers, strict=True)):
        for d in test.datasets:
            whole = test.label or str(k + 1)
            name = whole if len(test.datasets) == 1 else f"{whole}, {d.name}"
            name = name if name not in rows else f"{name} ({k + 1})"
            rows[name] = comm.bcast(_weighted(tasks[k], d, answer))
    nothing = np.full(len(unknown.names), np.inf)

    def of(names: Sequence[str], without: dict[str, Plan]) -> Plan:
        empty = [np.zeros((0, len(nothing)))]
        return Plan(unknown, judge(np.concatenate(empty + [rows[n] for n in names]), nothing), limit, without)

    without = {name: of([n for n in rows if n != name], {}) for name in rows} if len(rows) > 1 else {}
    return of(list(rows), without)


def _weighted(task: Task, d: Dataset, answer: Evaluated) -> np.ndarray:
    """Derivatives (N, n) of one observable over its standard deviation."""
    rates = answer.rates[d.name][d.rows]
    seen = (d.rows >= task.skipped).reshape(-1, *[1] * (rates.ndim - 2))
    there = np.broadcast_to(seen, rates.shape[:-1]) if d.measured is None else task.compared(d)
    sigma = np.broadcast_to(d.sigma, rates.shape[:-1])
    weighted: np.ndarray = (rates / sigma[..., None])[there]
    return weighted
