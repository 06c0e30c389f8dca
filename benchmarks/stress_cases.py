"""What the stress tests share: their records, a block of points anywhere in the grid, condition numbers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields

from mpi4py import MPI

import numpy as np

import polarmpm as pm
from polarmpm.bodies.points import Points

COMM = MPI.COMM_SELF
MICROPOLAR = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)  # Pa, N
NEO_HOOKEAN = pm.NeoHookean(lam=3e3, mu=2e3)
YOUNG = MICROPOLAR.engineering()["E"]
BASES = ("mpm", "gimpm", "bspline")


@dataclass
class Record:
    """One case.

    Attributes:
        passed: what `measure` says has been kept.
        iterations: most linear solves of a load step.
        cuts: load steps that failed and were tried again.
        condition, scaled: largest condition number of the free tangent, as it stands and with its diagonal
            scaled to one, without its modes of no stiffness.
        singular: most modes of no stiffness (below 1e-13 of the largest, scaled).
        error: the worst one, as described by `measure`.
    """

    group: str
    case: str
    passed: bool
    iterations: int | None = None
    cuts: int | None = None
    condition: float | None = None
    scaled: float | None = None
    singular: int | None = None
    error: float | None = None
    measure: str = ""


def text(value: object) -> str:
    """A cell of the table."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "**no**"
    return f"{value:.2g}" if isinstance(value, float) else str(value)


def line(record: Record) -> str:
    """A row of the table in Markdown."""
    return "| " + " | ".join(text(v) for v in asdict(record).values()) + " |"


def head() -> str:
    """The table's first two rows."""
    names = [f.name for f in fields(Record)]
    return "| " + " | ".join(names) + " |\n" + "|" + "---|" * len(names)


# a block ------------------------------------------------------------------------------------------
def block_points(corner, size, per_cell, material, cell=1.0):
    """Points in rows of equal spacing that fill a box; `per_cell` of them or more in the length of a cell.

    Args:
        corner, size: of the box, in cells.
        per_cell: in each direction.
    """
    corner, size = np.asarray(corner, float), np.asarray(size, float)
    count = np.maximum(1, np.ceil(size * per_cell - 1e-9)).astype(int)
    axes = [(np.arange(n) + 0.5) / n * s + c for n, s, c in zip(count, size, corner, strict=True)]
    x = cell * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(size))
    volume = np.full(len(x), np.prod(cell * size / count))
    return Points(x, volume, np.tile(0.5 * cell * size / count, (len(x), 1)), material, COMM)


def clamp(problem, end, **more):
    """Hold all nodes up to x = end (m)."""
    theta = {"theta": 0} if problem.layout.rotations else {}
    return problem.fix(lambda x: x[:, 0] <= end, u=0, **theta, **more)


# condition ----------------------------------------------------------------------------------------
def free_tangent(problem):
    """The tangent of the free unknowns at the last converged state, dense."""
    system = problem.system
    system.jump(system.x)  # iterations predict stresses; here the tangent is wanted as it is
    system.evaluate(True)
    p = system.pattern
    rows = np.repeat(np.arange(len(p.indptr) - 1), np.diff(p.indptr))
    dense = np.zeros((len(p.indptr) - 1,) * 2)
    dense[rows, p.indices] = p.values[: p.owned_entries]
    if p.symmetric:
        dense += np.triu(dense, 1).T
    free = ~system.prescribed.fixed.ravel()
    return dense[np.ix_(free, free)]


def conditions(problem):
    """Condition numbers of the free tangent, as it stands and scaled, without the modes of no stiffness of
    the scaled one; the number of these modes."""
    k = free_tangent(problem)
    d = np.sqrt(np.abs(np.diag(k)))
    held = d > 0
    scaled = k[np.ix_(held, held)] / np.outer(d[held], d[held])
    values = np.linalg.svd(scaled, compute_uv=False)
    stiff = values[values > 1e-13 * values[0]]
    plain = np.linalg.svd(k, compute_uv=False)
    number = len(stiff)
    return plain[0] / plain[number - 1], stiff[0] / stiff[-1], len(k) - number


class Watch:
    """Marches a problem, and keeps the worst of its steps.

    Attributes: as of `Record`; failure: why it ended early, or "".
    """

    def __init__(self, problem, steps, *, tangents=True, each=None, **options):
        self.problem, self.iterations, self.cuts, self.failure = problem, 0, 0, ""
        self.condition = self.scaled = 0.0
        self.singular = 0
        try:
            for step in problem.march(steps, progress=False, **options):
                self.iterations = max(self.iterations, step.iterations)
                self.cuts += step.cuts
                if tangents:
                    self.look()
                if each:
                    each(step)
        except (pm.NotConverged, pm.PointsOutsideGrid) as e:
            self.failure = str(e)

    def look(self):
        """Take down the present condition numbers."""
        plain, scaled, singular = conditions(self.problem)
        self.condition, self.scaled = max(self.condition, plain), max(self.scaled, scaled)
        self.singular = max(self.singular, singular)

    @classmethod
    def worst(cls, watches):
        """The worst numbers of several marches, in one watch."""
        found, watches = object.__new__(cls), list(watches)
        for name in ("iterations", "condition", "scaled", "singular"):
            setattr(found, name, max(getattr(w, name) for w in watches))
        found.cuts = sum(w.cuts for w in watches)
        found.failure = "; ".join(w.failure for w in watches if w.failure)
        return found

    def record(self, group, case, passed=True, **more):
        """A record of the march; a march that failed hasn't passed."""
        numbers = {"iterations": self.iterations, "cuts": self.cuts}
        if self.scaled:
            numbers |= {"condition": self.condition, "scaled": self.scaled, "singular": self.singular}
        return Record(group, case, bool(passed and not self.failure), **numbers, **more)
