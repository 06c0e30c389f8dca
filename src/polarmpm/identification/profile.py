"""The misfit along one parameter, the others being fitted anew: intervals where those of first order fail."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks
from ..tools.meetings import collective
from .drawing import profile_curve
from .evaluating import Evaluator, probe
from .experiment import experiments
from .judging import quantile
from .minimising import Objective, Priors, minimised

_MOST = 3.0  # how far the unknown goes


@dataclass(frozen=True, eq=False)
class Profile:
    """How the misfit rises as one parameter is held away from its value, the others being fitted anew.

    Attributes:
        name: of the parameter.
        values: at which it was held (m,), rising.
        rise: of the misfit (chi2 and priors) over the least one (m,); NaN where runs failed.
        others: the other free parameters there, an array (m,) by name.
    """

    name: str
    values: np.ndarray
    rise: np.ndarray
    others: dict[str, np.ndarray]

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Where the misfit rises by the square of the level's normal quantile, between the held values by
        interpolation; -inf or inf where it isn't reached.

        Raises:
            InputError: a level that isn't between 0 and 1.
        """
        z = quantile(checks.number("level", level, above=0.0, below=1.0))
        there = np.isfinite(self.rise)
        values, root = self.values[there], np.sqrt(np.maximum(self.rise[there], 0.0))
        least = int(root.argmin())
        return (
            _crossing(values[least::-1], root[least::-1], z, -np.inf),
            _crossing(values[least:], root[least:], z, np.inf),
        )

    def plot(self, ax: Any = None) -> Any:
        """The rise of the misfit over the held values, with the levels of 68 and 95 %. Returns the axes, of
        `polarmpm.plot`'s style; `plot.save` writes them.

        Args:
            ax: axes to draw into; None makes a figure.
        """
        return profile_curve(self, ax)

    def __str__(self) -> str:
        low, high = self.interval()
        return f"{self.name}: 95 % interval {low:.5g} to {high:.5g} by its profile"


def _crossing(values: np.ndarray, root: np.ndarray, z: float, none: float) -> float:
    beyond = np.flatnonzero(root >= z)
    if not len(beyond):
        return none
    k = int(beyond[0])
    if k == 0:
        return float(values[0])
    share = (z - root[k - 1]) / (root[k] - root[k - 1])
    return float(values[k - 1] + share * (values[k] - values[k - 1]))


@collective("profile", comm=lambda fit, *args: fit.comm)
def profile(fit: Any, name: str, points: int, reach: float, tests: Any) -> Profile:
    """See `Fit.profile`."""
    if name not in fit.names:
        raise checks.refuse("name", name, f"one of the free parameters, {', '.join(fit.names)}")
    points = checks.whole("points", points, least=3)
    reach = checks.number("reach", reach, above=0.0)
    found = experiments(fit.tests if tests is None else tests) if tests is not None or fit.tests else None
    if found is None:
        raise InputError("tests: a fit of a file needs its experiments for a profile")
    k = fit.names.index(name)
    far = min(reach * float(fit.judgement.sd[k]), _MOST)
    held = far * np.linspace(-1, 1, points + (points + 1) % 2)
    middle = len(held) // 2
    others = np.delete(fit.v, k)
    sd = np.delete(fit.judgement.priors, k)
    priors = Priors(np.delete(fit.prior_means, k), sd, np.zeros(len(sd), dtype=bool))
    rows: dict[int, tuple[float, np.ndarray]] = {middle: (fit.misfit, others)}
    tasks = [probe(test, fit.parameters, fit.comm) for test in found]
    with Evaluator(tasks, fit.workers, fit.comm) as evaluator:
        for way in (range(middle + 1, len(held)), range(middle - 1, -1, -1)):
            near = others
            for i in way:
                free = fit.free.without(name, fit.free.value(name, fit.v[k] + held[i]))
                objective = Objective(found, free, evaluator, fit.comm)
                if objective(near) is None:
                    break
                near = minimised(objective, near, priors, most=20)[0]
                end = objective(near)
                assert end is not None
                own = ((fit.v[k] + held[i] - fit.prior_means[k]) / fit.judgement.priors[k]) ** 2
                misfit = float(end[0] @ end[0]) + float((((near - priors.mean) / sd) ** 2).sum() + own)
                rows[i] = (misfit, near)
    return _gathered(fit, name, held, rows)


def _gathered(fit: Any, name: str, held: np.ndarray, rows: dict[int, tuple[float, np.ndarray]]) -> Profile:
    k, n = fit.names.index(name), len(held)
    values = np.array([fit.free.value(name, fit.v[k] + h) for h in held])
    rise = np.array([rows[i][0] - fit.misfit if i in rows else np.nan for i in range(n)])
    names = [one for one in fit.names if one != name]
    others = {
        one: np.array([fit.free.value(one, rows[i][1][j]) if i in rows else np.nan for i in range(n)])
        for j, one in enumerate(names)
    }
    order = np.argsort(values, kind="stable")
    return Profile(name, values[order], rise[order], {one: a[order] for one, a in others.items()})
