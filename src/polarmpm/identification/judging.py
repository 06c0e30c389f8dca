"""What data say of parameters, by the derivatives of the residuals: spreads, correlations, weakest
directions, and which parameters they don't show."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from ..tools import checks
from .transforms import Free

LIMIT = 0.125  # standard deviation of an unknown beyond which its parameter counts as not identifiable
TRUSTED = 0.3  # up to here intervals from derivatives cover what they say
_ROUND = 1e-13  # singular values below this part of the largest one are rounding
_TOGETHER = 0.3  # part of a direction from which on a parameter is named
_UNKNOWN = 7.0  # more than a factor of 1000
_PAIR = 0.9  # correlation that is worth a word


@dataclass(frozen=True, eq=False)
class Judgement:
    """Of n unknowns; all numbers are those of the unknowns, which have no unit.

    Attributes:
        covariance: (n, n), of data and priors.
        spread: standard deviations of the data alone (n,); inf where they say nothing.
        singular: singular values (n,) of the data's derivatives over their standard deviations, falling.
        directions: their directions (n, n), a row each.
        priors: standard deviations (n,) of priors, inf where there is none.
    """

    covariance: np.ndarray
    spread: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    priors: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations (n,) of data and priors."""
        root: np.ndarray = np.sqrt(np.diag(self.covariance))
        return root

    @property
    def correlation(self) -> np.ndarray:
        """(n, n), with ones on the diagonal; 0 where a standard deviation is infinite."""
        sd = self.sd
        with np.errstate(invalid="ignore", divide="ignore"):
            found: np.ndarray = self.covariance / np.outer(sd, sd)
        found[~np.isfinite(found)] = 0.0
        np.fill_diagonal(found, 1.0)
        return found


def judge(jacobian: np.ndarray, priors: np.ndarray) -> Judgement:
    """Of derivatives (N, n) of residuals over their standard deviations by the unknowns, and standard
    deviations (n,) of priors, inf where there is none."""
    singular, directions = _decomposed(jacobian)
    precision = np.diag(1.0 / priors)
    both = _decomposed(np.vstack([jacobian, precision]))
    covariance = _covariance(*both)
    return Judgement(
        covariance, np.sqrt(np.diag(_covariance(singular, directions))), singular, directions, priors
    )


def _decomposed(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values (n,), zeros where there are fewer rows or only rounding, and directions (n, n)."""
    n = rows.shape[1]
    _, s, directions = np.linalg.svd(np.vstack([rows, np.zeros((n, n))]), full_matrices=False)
    singular = np.where(s > _ROUND * max(float(s.max(initial=0.0)), 1e-300), s, 0.0)
    return singular, directions


def _covariance(singular: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Inverse of the normal equations' matrix; where they are singular, inf on the diagonal."""
    there = singular > 0
    rows = directions[there] / singular[there, None]
    covariance = rows.T @ rows
    unseen = (np.abs(directions[~there]) > 1e-6).any(axis=0)
    covariance[unseen] = 0.0
    covariance[:, unseen] = 0.0
    covariance[unseen, unseen] = np.inf
    return np.asarray(covariance)


def unidentifiable(of: Judgement, limit: float) -> list[int]:
    """Unknowns that the data alone don't show to within the limit."""
    return [int(k) for k in np.flatnonzero(~(of.spread <= limit))]


def dominated(of: Judgement) -> list[int]:
    """Unknowns that are held by their own priors: these have a quarter or more of what is known of them."""
    return [int(k) for k in np.flatnonzero(of.sd > 0.5 * of.priors)]


def quantile(level: float) -> float:
    """How many standard deviations an interval of a level reaches to either side."""
    return NormalDist().inv_cdf(0.5 + level / 2)


def intervals(free: Free, v: np.ndarray, sd: np.ndarray, level: float) -> dict[str, tuple[float, float]]:
    """Lower and upper end by name, in the parameters' units, of unknowns v with standard deviations sd.

    Raises:
        InputError: a level that isn't between 0 and 1.
    """
    z, out = quantile(checks.number("level", level, above=0.0, below=1.0)), {}
    for name, middle, one in zip(free.names, v, sd, strict=True):
        low, high = np.clip([middle - z * one, middle + z * one], -250.0, 250.0)
        ends = sorted(free.value(name, w) for w in (low, high))
        out[name] = (ends[0], ends[1])
    return out


def direction_in_words(of: Judgement, free: Free, v: np.ndarray, k: int = -1) -> str:
    """What goes along a direction (the weakest one), and how little that changes the data."""
    along, s = of.directions[k], float(of.singular[k])
    along = along * np.sign(along[np.abs(along).argmax()])
    size = min(1.0 / s, 1.0) if s > 0 else 1.0
    names = free.names
    order = [int(i) for i in np.argsort(-np.abs(along), kind="stable") if abs(along[i]) >= _TOGETHER][:4]
    values = [
        (names[i], free.value(names[i], v[i]), free.value(names[i], v[i] + size * along[i])) for i in order
    ]
    moved = " with ".join(f"{name} {a:.3g} -> {b:.3g}" for name, a, b in values)
    change = size * s
    much = (
        f"{change:.2g} standard deviation{'s' * (change != 1.0)}"
        if change < 0.995
        else "one standard deviation"
    )
    return f"{moved} changes all data together by {much}"


def pairs_in_words(of: Judgement, names: list[str]) -> list[str]:
    """Pairs of parameters that the data hardly tell apart, the worst first, at most three."""
    c = np.triu(of.correlation, 1)
    found = sorted(
        ((abs(c[i, j]), i, j) for i, j in zip(*np.nonzero(np.abs(c) > _PAIR), strict=True)), reverse=True
    )
    return [f"{names[i]} with {names[j]} ({c[i, j]:+.3f})" for _, i, j in found[:3]]


def percent(sd: float) -> str:
    """A standard deviation of an unknown, for tables."""
    if sd < 1:
        return f"{100 * sd:.2g} %"
    return f"x {np.exp(sd):.2g}" if sd < _UNKNOWN else "unknown"
