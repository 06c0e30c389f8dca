"""Least squares of the residuals of all experiments, with priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks
from .evaluating import Evaluator
from .experiment import Experiment
from .judging import TRUSTED, Judgement, judge
from .transforms import Free

_SCALE = 0.3  # of unknowns: the first steps are no longer
_NEAR = 1e-3  # decrease of chi2 that isn't worth an evaluation: .03 standard deviations
_NOISY = 0.1  # chi2 per value from which on data count as noisy; others are followed to the last digit
_TOLERANCES = {"xtol": 1e-4, "ftol": 1e-5, "gtol": 1e-10}


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


class _Near(Exception):
    """What is left to the minimum is much less than the noise."""


def _to_gain(jacobian: np.ndarray, residual: np.ndarray) -> float:
    """By how much a Gauss-Newton step would make the sum of squares smaller: squared, the distance to the
    minimum in standard deviations."""
    step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
    return float(np.square(jacobian @ step).sum())


class _Shown(Exception):
    """The data show all parameters by now: the weak prior can go."""


def judged(objective: Objective, v: np.ndarray, priors: Priors) -> Judgement:
    found = objective(v)
    assert found is not None
    return judge(found[1], priors.sd)


def minimised(
    objective: Objective, v0: np.ndarray, priors: Priors, most: int, until_shown: bool = False
) -> tuple[np.ndarray, str]:
    """The minimum next to v0 and "minimum"; a point on the way at which the data show all unknowns, and
    "shown"; or the best one so far after the most evaluations, and "stopped"."""
    from scipy.optimize import least_squares  # takes a while to import

    if not len(v0):
        return v0, "minimum"
    last = v0

    def residual(w: np.ndarray) -> np.ndarray:
        found, of_prior = objective(v0 + w), (v0 + w - priors.mean) / priors.sd
        if found is None:
            return np.full(size + len(of_prior), np.nan)
        return np.append(found[0], of_prior)

    def jacobian(w: np.ndarray) -> np.ndarray:
        nonlocal last
        found = objective(v0 + w)
        assert found is not None
        step, last = np.abs(v0 + w - last).max(), v0 + w
        if (
            until_shown
            and priors.weak.any()
            and step < _SCALE
            and (judged(objective, last, priors).spread < TRUSTED).all()
        ):
            raise _Shown
        whole = np.vstack([found[1], np.diag(1.0 / priors.sd)])
        if found[0] @ found[0] > _NOISY * size and _to_gain(whole, residual(w)) < _NEAR:
            raise _Near
        return whole

    at_start = objective(v0)
    assert at_start is not None
    size = len(at_start[0])
    if most < 1:
        return v0, "stopped"
    # the first trust region is as large as the start, so that the start has to be 0
    options: dict[str, Any] = {**_TOLERANCES, "x_scale": _SCALE, "max_nfev": most + 1}
    try:
        end = least_squares(residual, np.zeros_like(v0), jac=jacobian, method="trf", **options)
    except _Shown:
        return last, "shown"
    except _Near:
        return last, "minimum"
    return v0 + end.x, "minimum" if end.status > 0 else "stopped"
