"""Least squares of the residuals of all experiments, with priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks
from .curving import Model, Point, best_step, latest
from .evaluating import Evaluator
from .experiment import Experiment
from .judging import TRUSTED, Judgement, judge
from .transforms import Free

_SCALE = 0.3  # of unknowns: the first step is no longer
_NEAR = 1e-3  # decrease of chi2 that isn't worth an evaluation: .03 standard deviations
_NOISY = 0.1  # chi2 per value from which on data count as noisy; others are followed to the last digit
_TOLERANCES = {"xtol": 1e-4, "ftol": 1e-5, "gtol": 1e-10}  # of steps, decreases and gradients
_POOR, _GOOD = 0.25, 0.75  # shares of the predicted decrease: the trust region shrinks, or may grow


@dataclass
class Objective:
    """Residuals of all data over their standard deviations, and derivatives by the unknowns.

    Attributes:
        failures: why runs have failed, at which parameters.
        evaluations: at how many sets of parameters all experiments have been computed.
    """

    tests: Sequence[Experiment]
    free: Free
    evaluator: Evaluator
    comm: MPI.Comm
    failures: list[str] = field(default_factory=list)
    evaluations: int = 0
    _known: dict[bytes, Any] = field(default_factory=dict)

    def __call__(self, v: np.ndarray, first: bool = False) -> tuple[np.ndarray, np.ndarray, list[Any]] | None:
        """Residuals (N,), derivatives (N, n) and the values of each experiment; None where a run fails."""
        v = np.array(self.comm.bcast(v) if self.comm.size > 1 else v)
        key = v.tobytes()
        if key not in self._known:
            self.evaluations += 1
            p = self.free.values(v)
            slopes = dict(zip(self.free.names, self.free.slopes(p), strict=True))
            self._known[key] = self._computed(p, slopes, first)
        found: tuple[np.ndarray, np.ndarray, list[Any]] | None = self._known[key]
        return found

    def _computed(self, p: dict[str, float], slopes: dict[str, float], first: bool) -> Any:
        answers = self.evaluator(p, slopes, first)
        for k, one in enumerate(answers):
            if one.failure:
                where = ", ".join(f"{name} = {p[name]:.4g}" for name in slopes)
                self.failures.append(f"experiment {k + 1} at {where}: {one.failure}")
                return None
        residuals, rates = [], []
        for test, task, one in zip(self.tests, self.evaluator.tasks, answers, strict=True):
            for d in test.datasets:
                assert d.measured is not None
                there = task.compared(d)
                value = _fitting(one.values[d.name][d.rows], d.measured, d.name)
                residuals.append(((value - d.measured) / d.sigma)[there])
                rates.append((one.rates[d.name][d.rows] / d.sigma[..., None])[there])
        found = np.concatenate(residuals), np.concatenate(rates), [one.values for one in answers]
        return self.comm.bcast(found) if self.comm.size > 1 else found


def _fitting(value: np.ndarray, measured: np.ndarray, name: str) -> np.ndarray:
    if value.shape != measured.shape:
        raise InputError(
            f"data: {name}: the measured values have the shape {measured.shape}, the computed ones "
            f"{value.shape}"
        )
    return value


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known of the unknowns before: means and standard deviations (n,), inf where nothing is.

    Attributes:
        weak: of those whose prior is only there to keep them finite.
    """

    mean: np.ndarray
    sd: np.ndarray
    weak: np.ndarray

    def without_weak(self) -> Priors:
        return Priors(self.mean, np.where(self.weak, np.inf, self.sd), np.zeros_like(self.weak))


def make_priors(free: Free, given: Any, weak: float | None) -> Priors:
    """Priors in terms of the unknowns of `{name: (value, standard deviation)}` in the parameters' units."""
    n = len(free.names)
    sd, is_weak = np.full(n, np.inf if weak is None else weak), np.full(n, weak is not None)
    mean = np.zeros(n)
    if given is not None and not isinstance(given, Mapping):
        raise checks.refuse("priors", given, "(value, standard deviation) by name of a free parameter")
    for name, pair in (given or {}).items():
        if name not in free.names:
            raise checks.refuse("priors", name, f"one of the free parameters, {', '.join(free.names)}")
        value, spread = checks.sequence(f"priors: {name}", pair, 2, "numbers, value and standard deviation,")
        value = checks.number(f"priors: {name}: the value", value)
        spread = checks.number(f"priors: {name}: the standard deviation", spread, above=0.0)
        k, transform = free.names.index(name), free.transforms[name]
        try:
            mean[k] = transform.forward(value) - free.origin(name)
        except InputError as e:
            raise InputError(f"priors: {name}: {e}") from None
        sd[k], is_weak[k] = spread / abs(transform.slope(value)), False
    return Priors(mean, sd, is_weak)


def _to_gain(jacobian: np.ndarray, residual: np.ndarray) -> float:
    """By how much a Gauss-Newton step would make the sum of squares smaller: squared, the distance to the
    minimum in standard deviations."""
    step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
    return float(np.square(jacobian @ step).sum())


def judged(objective: Objective, v: np.ndarray, priors: Priors) -> Judgement:
    found = objective(v)
    assert found is not None
    return judge(found[1], priors.sd)


def minimised(
    objective: Objective, v0: np.ndarray, priors: Priors, most: int, until_shown: bool = False
) -> tuple[np.ndarray, str]:
    """The minimum next to v0 and "minimum"; a point on the way at which the data show all unknowns, and
    "shown"; or the best one so far after the most evaluations, and "stopped"."""
    if not len(v0):
        return v0, "minimum"
    search = _Search(objective, priors)
    here, last, first = search.point(v0), v0, objective.evaluations
    assert here is not None
    region, known = _SCALE, [here]
    while True:
        if until_shown and search.shown(here, last):
            return here.v, "shown"
        if search.is_near(here):
            return here.v, "minimum"
        last = here.v
        while here.v is last:
            if objective.evaluations - first >= most:
                return here.v, "stopped"
            step, gain = best_step(Model(here, latest(here, known)), region)
            trial = search.point(here.v + step)
            size, won = float(np.linalg.norm(step)), -np.inf
            if trial is not None:
                known.append(trial)
                won = here.square - trial.square
            share = won / gain if gain > 0.0 else 0.0
            region = _next_region(region, size, share)
            small = size < _TOLERANCES["xtol"] * (_TOLERANCES["xtol"] + float(np.linalg.norm(here.v - v0)))
            ended = small or (won < _TOLERANCES["ftol"] * here.square and share > _POOR)
            if trial is not None and won > 0.0:
                here = trial
            if ended:
                return here.v, "minimum"


def _next_region(region: float, size: float, share: float) -> float:
    """Radius of the trust region after a step of some size that has won a share of what it should have."""
    if share < _POOR:
        return _POOR * size
    return 2.0 * region if share > _GOOD and size > 0.95 * region else region


@dataclass
class _Search:
    """What a search for a minimum knows.

    Attributes:
        data: how many there are.
    """

    objective: Objective
    priors: Priors
    data: int = 0

    def point(self, v: np.ndarray) -> Point | None:
        """Residuals of data and priors, and their derivatives; None where a run fails."""
        found, sd = self.objective(v), self.priors.sd
        if found is None:
            return None
        self.data = len(found[0])
        whole = np.append(found[0], (v - self.priors.mean) / sd)
        return Point(v, whole, np.vstack([found[1], np.diag(1.0 / sd)]))

    def shown(self, here: Point, last: np.ndarray) -> bool:
        """Whether the data show all parameters by now, so that the weak prior can go."""
        if not self.priors.weak.any() or np.abs(here.v - last).max() >= _SCALE:
            return False
        return bool((judged(self.objective, here.v, self.priors).spread < TRUSTED).all())

    def is_near(self, here: Point) -> bool:
        """Whether what is left to the minimum is much less than the noise, of data that have some; or
        nothing at all."""
        of_data = here.residual[: self.data]
        if np.abs(here.jacobian.T @ here.residual).max() < _TOLERANCES["gtol"]:
            return True
        noisy = of_data @ of_data > _NOISY * self.data
        return bool(noisy and _to_gain(here.jacobian, here.residual) < _NEAR)
