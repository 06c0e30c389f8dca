"""Parameters from measurements: nonlinear least squares over several experiments, from several starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks
from ..tools.meetings import collective
from .evaluating import Evaluator, probe
from .experiment import Experiment, experiments
from .judging import LIMIT, TRUSTED
from .minimising import Objective, Priors, judged, make_priors, minimised
from .result import Fit, Start, make_fit
from .transforms import Free, free_parameters

WEAK = 1.0  # standard deviation of the weak prior of an unknown
_SPREAD = 0.5  # of unknowns at further starts


@collective("identify", comm=lambda *args, comm=MPI.COMM_WORLD, **options: comm)
def identify(
    tests: Experiment | Sequence[Experiment],
    *,
    start: Mapping[str, float],
    free: Mapping[str, Any] | Sequence[str],
    priors: Mapping[str, tuple[float, float]] | None = None,
    weak: float | None = WEAK,
    starts: int | Sequence[Mapping[str, float]] = 1,
    limit: float = LIMIT,
    workers: int = 1,
    most: int = 40,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
) -> Fit:
    """Find the parameters with which experiments are computed as they were measured. Collective.

    The sum of squares of all residuals over their standard deviations is made least by steps in a trust
    region, of Gauss and Newton but for what earlier derivatives tell of a curved valley. Parameters at which
    a run fails are not stepped to. While the data don't show all parameters, a weak prior about the start
    keeps them finite; once they do it is dropped, so that it doesn't bias the answer.

    Args:
        tests: one experiment or several, each with its own function, arguments and data.
        start: all parameters of the functions, by name, in whatever units these take.
        free: those to be found: names, or by name "log" (the sign stays), `Bounds(lower, upper)` or
            `Linear(scale)`. Names alone are "log".
        priors: what is known of free parameters beforehand: (value, standard deviation) by name, in their
            units.
        weak: standard deviation of the weak prior of the unknowns (1: a factor of e); None: none.
        starts: a number of starts, of which all but the first are drawn about `start` (the same ones each
            time); or further starts, values by name.
        limit: standard deviation of an unknown (for "log" the relative one) from which on the data don't
            identify its parameter.
        workers: number of processes, each of which computes one experiment at a time; 1: they are computed
            here, one after the other, on all ranks. Only on one rank; the script must guard its work by
            `if __name__ == "__main__":`. The answer is the same to the last digit.
        most: evaluations for each start.
        comm: the ranks, which all take part in each run.

    Raises:
        InputError: an argument that isn't allowed; data that don't fit what is computed.
        NotConverged: (or another error of a run) at the start; later on, such parameters are avoided.
    """
    checks.communicator("comm", comm)
    found = experiments(tests)
    unknown = free_parameters(start, free)
    known = make_priors(unknown, priors, None if weak is None else checks.number("weak", weak, above=0.0))
    limit = checks.number("limit", limit, above=0.0)
    most = checks.whole("most", most, least=1)
    begins = _starts(unknown, starts)
    workers = checks.whole("workers", workers, least=1)
    if workers > 1 and comm.size > 1:
        raise checks.refuse("workers", workers, f"1 where {comm.size} ranks compute each experiment together")
    tasks = [probe(test, unknown.values(begins[0]), comm) for test in found]
    with Evaluator(tasks, workers, comm) as evaluator:
        objective = Objective(found, unknown, evaluator, comm)
        ends = [_one_start(objective, v, known, most, first=k == 0) for k, v in enumerate(begins)]
    best = min((end for end in ends if end is not None), key=lambda end: end.objective)
    return make_fit(objective, best, [e for e in ends if e is not None], limit, workers)


def _starts(free: Free, starts: Any) -> list[np.ndarray]:
    n = len(free.names)
    if checks.several(starts) and not isinstance(starts, np.ndarray):
        out = [np.zeros(n)]
        for k, values in enumerate(starts):
            if not isinstance(values, Mapping) or not all(name in free.names for name in values):
                raise checks.refuse(f"starts[{k}]", values, f"values by name of {', '.join(free.names)}")
            values = {name: checks.number(f"starts[{k}]: {name}", m) for name, m in values.items()}
            try:
                out.append(free.unknowns(values))
            except InputError as e:
                raise InputError(f"starts[{k}]: {e}") from None
        return out
    number = checks.whole("starts", starts, least=1, allowed="a positive whole number, or a list of starts")
    drawn = np.random.default_rng(1).standard_normal((number - 1, n))
    return [np.zeros(n), *(_SPREAD * row for row in drawn)]


def _one_start(objective: Objective, v: np.ndarray, priors: Priors, most: int, first: bool) -> Start | None:
    """From one start to a minimum; None if the very start fails."""
    before = objective.evaluations
    if objective(v, first) is None:
        return None

    def left() -> int:
        return most - (objective.evaluations - before)

    now = priors
    v, end = minimised(objective, v, priors, left(), until_shown=True)
    if end == "shown":
        now = priors.without_weak()
        v, end = minimised(objective, v, now, left())
        if not (judged(objective, v, now).spread <= TRUSTED).all():
            # without the prior it has gone to where the data show less: once more, to the end with it
            now = priors
            v, end = minimised(objective, v, now, left())
    judgement = judged(objective, v, now)
    found = objective(v)
    assert found is not None
    chi2 = float(found[0] @ found[0])
    whole = chi2 + float((((v - now.mean) / now.sd) ** 2).sum())
    return Start(v, chi2, whole, most - left(), judgement, now.mean, end == "minimum")
