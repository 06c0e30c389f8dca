"""What a fit has found, and how sure it is: numbers, words, JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..io.files import check_output, not_written, replace_file
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import raise_on_all_ranks
from .drawing import correlations, fit_against_data
from .judging import Judgement, direction_in_words, dominated, intervals, unidentifiable
from .profile import Profile, profile
from .transforms import Free, told, untold
from .wording import fit_in_words

if TYPE_CHECKING:
    from .experiment import Experiment

_FORMAT = 1  # of JSON files
_CHANCE = 0.01  # that one of all values is flagged though it is as good as the others
_MAD = 1.4826  # from the median of normal deviations to their standard deviation


@dataclass(frozen=True, eq=False)
class Start:
    """Where one start has led.

    Attributes:
        v: the unknowns (n,).
        chi2: sum of squares of the data's residuals.
        objective: the same with the priors' part.
        evaluations: it has taken.
        judgement: of the derivatives there.
        priors: means (n,) of the priors of the unknowns.
        converged: a minimum was found before the most evaluations were made.
    """

    v: np.ndarray
    chi2: float
    objective: float
    evaluations: int
    judgement: Judgement
    priors: np.ndarray
    converged: bool


@dataclass(frozen=True, eq=False)
class Compared:
    """Measured and computed values of one observable of an experiment.

    Attributes:
        experiment: its number, from 0.
        label: of the experiment.
        name: of the observable.
        at: load factors, or abscissae (n,).
        measured, sigma, model: values (n, ...), NaN where nothing was measured.
    """

    experiment: int
    label: str
    name: str
    at: np.ndarray
    measured: np.ndarray
    sigma: np.ndarray
    model: np.ndarray

    @property
    def residuals(self) -> np.ndarray:
        """(computed - measured) / sigma (n, ...)."""
        found: np.ndarray = (self.model - self.measured) / self.sigma
        return found


@dataclass(frozen=True)
class Outlier:
    """A measured value that doesn't belong to the others.

    Attributes:
        experiment, name: which one it is of.
        index: in the measured array.
        at: load factor, or abscissa.
        residual: (computed - measured) / sigma.
    """

    experiment: int
    name: str
    index: tuple[int, ...]
    at: float
    residual: float


@dataclass(eq=False)
class Fit:
    """Parameters that `identify` has found.

    Attributes:
        names: of the free parameters, in the order of all arrays.
        parameters: all of them, those that were held included.
        limit: see `identify`.
        chi2: sum of squares of residuals over their standard deviations; about `dof` where model and standard
            deviations are right.
        dof: number of data less that of free parameters.
        evaluations: of all experiments, by all starts.
        compared: measured and computed values.
        starts: for each start its `chi2`, `evaluations` and `values`, the one that was taken first.
        failures: runs that have failed on the way, and why.
        converged: a minimum was found before the most evaluations were made.
        dominated: parameters that are held by their priors, weak ones included, rather than by data.
    """

    free: Free
    v: np.ndarray
    judgement: Judgement
    prior_means: np.ndarray
    chi2: float
    evaluations: int
    compared: list[Compared]
    starts: list[dict[str, Any]]
    failures: list[str]
    limit: float
    converged: bool
    tests: Sequence[Experiment] = ()
    workers: int = 1
    comm: MPI.Intracomm = field(default_factory=lambda: MPI.COMM_WORLD)

    @property
    def names(self) -> list[str]:
        return self.free.names

    @property
    def parameters(self) -> dict[str, float]:
        return self.free.values(self.v)

    @property
    def values(self) -> dict[str, float]:
        """The free parameters, in their units."""
        return {name: self.parameters[name] for name in self.names}

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations in the parameters' units, of first order, with the priors."""
        slopes = np.abs(self.free.slopes(self.parameters))
        return dict(zip(self.names, (slopes * self.judgement.sd).tolist(), strict=True))

    @property
    def relative_sd(self) -> dict[str, float]:
        """Standard deviations of the unknowns by the data alone: relative ones for "log"; inf where the data
        say nothing."""
        return dict(zip(self.names, self.judgement.spread.tolist(), strict=True))

    @property
    def covariance(self) -> np.ndarray:
        """(n, n), in the parameters' units, of first order, with the priors."""
        slopes = self.free.slopes(self.parameters)
        found: np.ndarray = self.judgement.covariance * np.outer(slopes, slopes)
        return found

    @property
    def correlation(self) -> np.ndarray:
        """(n, n)."""
        return self.judgement.correlation

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Lower and upper end by name, in the parameters' units: symmetric about the unknowns, so that they
        stay within bounds. To be trusted while the standard deviation of the unknown is below 0.3; `profile`
        tells beyond that.

        Raises:
            InputError: a level that isn't between 0 and 1.
        """
        return intervals(self.free, self.v, self.judgement.sd, level)

    @property
    def unidentifiable(self) -> list[str]:
        """Parameters that the data alone don't show to within `limit`."""
        return [self.names[k] for k in unidentifiable(self.judgement, self.limit)]

    @property
    def dominated(self) -> list[str]:
        return [self.names[k] for k in dominated(self.judgement)]

    @property
    def dof(self) -> int:
        return sum(int(np.isfinite(c.residuals).sum()) for c in self.compared) - len(self.names)

    @property
    def misfit(self) -> float:
        """chi2 and the priors' part, of which the least was sought."""
        return self.chi2 + float((((self.v - self.prior_means) / self.judgement.priors) ** 2).sum())

    @property
    def weakest(self) -> str:
        """The direction of which the data say least, in words."""
        return direction_in_words(self.judgement, self.free, self.v)

    @property
    def weak_directions(self) -> list[str]:
        """All directions along which the data's standard deviation is beyond `limit`, the weakest first."""
        bad = [k for k, s in enumerate(self.judgement.singular) if s * self.limit < 1]
        return [direction_in_words(self.judgement, self.free, self.v, k) for k in reversed(bad)]

    @property
    def outliers(self) -> list[Outlier]:
        """Values whose residual is too large for one of so many, the largest first.

        Residuals are compared with their own scatter where that is larger than the standard deviations say,
        so that a model that fits nowhere makes no outliers of all data.
        """
        every = [c.residuals[np.isfinite(c.residuals)] for c in self.compared]
        whole = np.concatenate(every)
        threshold = NormalDist().inv_cdf(1 - 0.5 * _CHANCE / max(1, len(whole)))
        threshold *= max(1.0, _MAD * float(np.median(np.abs(whole))))
        out = []
        for c in self.compared:
            residuals = c.residuals
            for index in zip(*np.nonzero(np.abs(np.nan_to_num(residuals)) > threshold), strict=True):
                where = tuple(int(i) for i in index)
                out.append(
                    Outlier(c.experiment, c.name, where, float(c.at[where[0]]), float(residuals[index]))
                )
        return sorted(out, key=lambda one: -abs(one.residual))

    def profile(self, name: str, *, points: int = 9, reach: float = 2.5, tests: Any = None) -> Profile:
        """How the misfit grows as one parameter is held away from its value and all others are fitted anew.
        Collective.

        Args:
            name: of a free parameter.
            points: held values, the found one included.
            reach: how many standard deviations to either side (at most 3 of the unknown).
            tests: the experiments, of a fit that was loaded from a file.

        Raises:
            InputError: no free parameter; no experiments.
        """
        return profile(self, name, points, reach, tests)

    def plot_data(self, names: Any = None) -> Any:
        """Measured and computed values: a panel for each observable, in which the experiments' curves lie; of
        fields the residuals over the measured values. Returns the axes, in an array, of `polarmpm.plot`'s
        style; `plot.save(axes[0], path)` writes the figure.

        Args:
            names: of observables; None: all, at most twelve.
        """
        return fit_against_data(self, names)

    def plot_correlation(self, ax: Any = None) -> Any:
        """Correlations as a coloured table. Returns the axes.

        Args:
            ax: axes to draw into; None makes a figure.
        """
        return correlations(self, ax)

    def __str__(self) -> str:
        return fit_in_words(self)

    def __repr__(self) -> str:
        values = ", ".join(f"{k}={v:.6g}" for k, v in self.values.items())
        return f"Fit({values}; chi2 {self.chi2:.4g}, dof {self.dof})"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a JSON file, without the experiments' functions. Collective.

        Raises:
            InputError: the file can't be written; on every rank alike.
            OutputError: the disc is full; an old file stays.
        """
        write_json(self.comm, path, self.as_dict())

    def as_dict(self) -> dict[str, Any]:
        """All numbers, as JSON has them."""
        j = self.judgement
        return {
            "format": _FORMAT,
            "kind": "polarmpm fit",
            "values": self.values,
            "sd": _plain(self.sd),
            "intervals": {name: _plain(ends) for name, ends in self.intervals().items()},
            "unidentifiable": self.unidentifiable,
            "dominated": self.dominated,
            "weakest": self.weakest,
            "chi2": self.chi2,
            "dof": self.dof,
            "evaluations": self.evaluations,
            "limit": self.limit,
            "converged": self.converged,
            "start": self.free.start,
            "free": {name: told(t) for name, t in self.free.transforms.items()},
            "unknowns": self.v.tolist(),
            "covariance_of_unknowns": _plain(j.covariance),
            "spread": _plain(j.spread),
            "singular": _plain(j.singular),
            "directions": _plain(j.directions),
            "priors": _plain(j.priors),
            "prior_means": self.prior_means.tolist(),
            "starts": self.starts,
            "failures": self.failures,
            "outliers": [vars(one) | {"index": list(one.index)} for one in self.outliers],
            "compared": [{k: _plain(v) for k, v in vars(c).items()} for c in self.compared],
        }

    @classmethod
    @collective("load of a fit", comm=lambda *args, comm=MPI.COMM_WORLD: comm)
    def load(cls, path: str | os.PathLike[str], *, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Fit:
        """A fit that `save` has written. Collective.

        Raises:
            InputError: no such file, or none of a fit; on every rank alike.
        """
        told = read_json(checks.communicator("comm", comm), path)
        try:
            free = Free(told["start"], {n: untold(n, t, told["start"][n]) for n, t in told["free"].items()})
            compared = [
                Compared(
                    c["experiment"],
                    c["label"],
                    c["name"],
                    *(_array(c[k]) for k in ("at", "measured", "sigma", "model")),
                )
                for c in told["compared"]
            ]
            names = ("covariance_of_unknowns", "spread", "singular", "directions", "priors")
            judgement = Judgement(*(_array(told[name], np.inf) for name in names))
            fit = cls(
                free, np.array(told["unknowns"]), judgement, np.array(told["prior_means"]), told["chi2"],
                told["evaluations"], compared, told["starts"], told["failures"], told["limit"],
                told["converged"], comm=comm,
            )  # fmt: skip
        except (KeyError, TypeError, ValueError, AttributeError) as e:
            raise InputError(
                f"path = {os.fspath(path)!r} has no fit of polarmpm: {type(e).__name__} {e}"
            ) from None
        return fit


def make_fit(objective: Any, best: Start, all_: Sequence[Start], limit: float, workers: int) -> Fit:
    """The result of the best start."""
    found = objective(best.v)
    compared = []
    tasks = objective.evaluator.tasks
    for k, (test, task, values) in enumerate(zip(objective.tests, tasks, found[2], strict=True)):
        for d in test.datasets:
            measured = np.where(task.compared(d), d.measured, np.nan)
            compared.append(
                Compared(k, test.label, d.name, test.at[d.rows], measured, d.sigma, values[d.name][d.rows])
            )
    ordered = [best, *(one for one in all_ if one is not best)]
    starts = [
        {
            "chi2": s.chi2,
            "evaluations": s.evaluations,
            "converged": s.converged,
            "values": {n: objective.free.value(n, w) for n, w in zip(objective.free.names, s.v, strict=True)},
        }
        for s in ordered
    ]
    return Fit(
        objective.free, best.v, best.judgement, best.priors, best.chi2, objective.evaluations, compared,
        starts, list(objective.failures), limit, best.converged, objective.tests, workers, objective.comm,
    )  # fmt: skip


# JSON -------------------------------------------------------------------------------------------------
def _plain(value: Any) -> Any:
    """Lists of numbers; what is not finite is null."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _array(value: Any, missing: float = np.nan) -> np.ndarray:
    found = np.array(value, dtype=object)
    flat = [missing if one is None else float(one) for one in found.ravel()]
    return np.array(flat).reshape(found.shape)


@collective("save of a fit", comm=lambda comm, *args: comm)
def write_json(comm: MPI.Intracomm, path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """A file of rank 0. Collective."""
    file = check_output(comm, path)
    error: Exception | None = None
    if comm.rank == 0:
        try:
            replace_file(file, (json.dumps(content, indent=1) + "\n").encode())
        except OSError as e:
            error = not_written("fit", file, e)
    raise_on_all_ranks(comm, error)


def read_json(comm: MPI.Intracomm, path: str | os.PathLike[str]) -> Any:
    """What a file has, on all ranks. Collective."""
    file: Path = checks.path("path", path)
    error: Exception | None = None
    found: Any = None
    if comm.rank == 0:
        try:
            found = json.loads(file.read_text())
            if (
                not isinstance(found, dict)
                or found.get("kind") != "polarmpm fit"
                or found.get("format") != _FORMAT
            ):
                raise ValueError("no fit of polarmpm, or of another version")
        except (OSError, ValueError) as e:
            error = InputError(f"path = {str(file)!r} can't be read as a fit: {e}")
    raise_on_all_ranks(comm, error)
    return comm.bcast(found)
