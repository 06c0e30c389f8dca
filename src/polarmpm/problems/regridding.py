"""Other grids in the course of a run: points are split where cells become finer, and conditions follow.

A policy (`gridpolicies`) is asked at resets, and after each step that has converged. In the latter case the
step isn't taken: it is gone back to its beginning, the grid is changed there, and the step is taken again,
until the policy is content. What the new grid can't balance of the points' stresses is carried along as at
any other balanced reset.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..bodies.lineage import Lineage
from ..bodies.points import Points
from ..bodies.splitting import Split, check_splittable, parts_for, parts_of_large, points_per_cell, split
from ..bodies.validity import Seal
from ..conditions.supports import Support
from ..errors import InputError, TrustWarning
from ..geometry.grid import GradedGrid, Grid
from ..geometry.planes import Plane, PlaneSpec
from ..solvers.newton import Outcome
from ..terms.base import Term
from ..terms.sites import Sites
from ..tools.parallel import errors_on_all_ranks, warn_on_one_rank
from ..tools.saying import say
from .gridpolicies import RegridPolicy, Trial, make_policy
from .stages import Staged
from .whole import Changing

_TIMES = 20  # grids that a step may be tried in
_SEED = "seed 2 points a direction (docs/accuracy.md)"
_LARGE = f"their boxes are as large as a cell, and the grid is reset; {_SEED}"
_UNSPLIT = (
    "{} points have boxes as large as a cell, which a reset of the grid leaves in two of them, and can't be "
    f"split ({{}}): the answer may be far off; {_SEED}"
)
_SHARED = ("forces", "couples", "box_energy", "handed ")  # rows that parts of a point share


@dataclass(frozen=True)
class Regrid:
    """A change of the grid.

    Attributes:
        step: number of the last converged step before it, after which it is.
        factor: load factor (time) then.
        cells: number of cells of the new grid along each axis.
        split: how many points have been split.
        points: how many there are since.
    """

    step: int
    factor: float
    cells: tuple[int, ...]
    split: int
    points: int

    def __str__(self) -> str:
        cells = " x ".join(map(str, self.cells))
        return f"after step {self.step}: {cells} cells, {self.split} point(s) split, {self.points} since"


def goes_with_points(term: Term) -> bool:
    """Whether a term goes along with points one by one, which then can't be split."""
    return isinstance(term, Sites) or bool(term.rows)


class Regridding:
    """What a problem knows of its grids.

    Attributes:
        policy: decides on them; None: the grid stays.
        wanted: the next one, with which a step is to be taken again.
        done: the changes so far.
        split: how many points have been split as their boxes are too large.
        told: it has been said that they can't be.
    """

    def __init__(self, regrid: Any):
        self.policy: RegridPolicy | None = make_policy(regrid)
        self.wanted: Grid | None = None
        self.done: list[Regrid] = []
        self.split, self.told = 0, False
        self._per_cell: np.ndarray = np.ones(1, dtype=np.int64)

    @property
    def splits(self) -> bool:
        """Whether points may be split."""
        return self.policy is not None and bool(self.policy.splits)

    @property
    def repeats(self) -> bool:
        """Whether steps may be taken again."""
        return self.policy is not None and bool(getattr(self.policy, "repeats", True))

    def begin(self, problem: Any) -> None:
        """Check the problem as it is made. Collective."""
        if self.policy is None:
            return
        self.policy.check(problem)
        self._per_cell = points_per_cell(problem.points, problem.grid)
        if self.splits:
            if hasattr(problem, "velocity"):
                raise InputError(
                    "regrid: bodies in motion don't split their points; FollowBody(margin=...) without h is "
                    "allowed"
                )
            check_splittable(problem.points)
            if not problem.balanced_reset:
                raise InputError(
                    "balanced_reset = False: with regrid, what a new grid can't balance has to be carried "
                    "along"
                )

    def check_term(self, term: Term) -> None:
        """Raise InputError for a term that doesn't go along with points that are split."""
        if self.splits and goes_with_points(term):
            raise InputError(
                f"{term.name}: goes along with points one by one (contact does), and regrid splits points; "
                "use a grid that is fine from the start"
            )

    def before(self, number: int) -> int:
        """How often the grid was changed right before step `number`."""
        return sum(one.step == number - 1 for one in self.done)

    def parts(self, points: Points, before: Grid, grid: Grid) -> np.ndarray:
        """Into how many parts points are to be cut (np, d)."""
        return parts_for(points, before, grid, self._per_cell)

    # what policies ask for ------------------------------------------------------------------------
    def now(self, problem: Any) -> Grid:
        """The present grid, with planes where they have moved to since the last reset."""
        p = problem.progress
        found: Grid = problem._moving.at(p.factor if p.step else None, problem.supports)
        return found

    def moves(self, problem: Any, axis: int) -> bool:
        """Whether planes of the grid move along an axis."""
        return bool(problem._moving.follows(axis))

    def lines_to_keep(self, problem: Any, axis: int) -> list[float]:
        """Coordinates (m) of planes that conditions need in the present grid."""
        found: list[float] = problem._moving.lines_to_keep(axis, self.now(problem), problem.supports)
        return found

    def given_lines(self, problem: Any, axis: int) -> np.ndarray:
        """Coordinates (m) of the lines of the grid that was given, where they have been stretched to."""
        return self.stretched(problem, axis, problem.initial_grid.lines[axis], self.now(problem))

    def stretched(self, problem: Any, axis: int, x: np.ndarray, grid: Grid) -> np.ndarray:
        """Where coordinates (m) of the given grid are in another one, between whose walls they lie alike."""
        if not self.moves(problem, axis):
            return x
        given = problem.initial_grid
        share = (x - given.lower[axis]) / (given.upper[axis] - given.lower[axis])
        low, high = grid.lower[axis], grid.upper[axis]
        return np.where(share == 1.0, high, low + share * (high - low))


class Regridded(Staged):
    """Grids that change by a policy. All methods are collective."""

    regridding: Regridding

    @property
    def regrids(self) -> tuple[Regrid, ...]:
        """Changes of the grid so far."""
        return tuple(self.regridding.done)

    def _changing(self) -> Iterator[Changing]:
        yield from super()._changing()
        yield self.regridding, None

    # what is refused ------------------------------------------------------------------------------
    def _admit_term(self, term: Term) -> None:
        self.regridding.check_term(term)

    def _tie(self, where: Any, support: Support, even: dict[int, bool]) -> None:
        if self.regridding.policy is not None and not where.is_wall(self._moving.initial):
            raise InputError(
                f"{support.name}: slopes of nodes on both sides of a plane in the midst of the grid depend "
                "on its cells, and regrid changes them; let the plane be a wall of the grid"
            )
        super()._tie(where, support, even)

    # planes ---------------------------------------------------------------------------------------
    def _here(self, where: PlaneSpec) -> PlaneSpec:
        """A plane of the given grid where it stood when the grid was changed last."""
        if self._moving.initial is self.initial_grid or where.axis >= self.grid.dim:
            return where
        initial = self._moving.initial
        value = self.regridding.stretched(self, where.axis, np.array([where.value]), initial)
        return PlaneSpec(where.axis, float(value[0]), where.beyond, where.moving)

    # steps ----------------------------------------------------------------------------------------
    def _attempt_or_fall_back(self, factor: float) -> Outcome:
        attempt = super()._attempt_or_fall_back
        outcome: Outcome = self._on_its_grid(partial(attempt, factor), lambda outcome: outcome)
        return outcome

    def _along_or_fall_back(self, length: float, to: float | None, kink: bool) -> tuple[Outcome, float]:
        attempt = super()._along_or_fall_back
        found: tuple[Outcome, float] = self._on_its_grid(
            partial(attempt, length, to, kink), lambda found: found[0]
        )
        return found

    def _on_its_grid(self, attempt: Callable[[], Any], outcome_of: Callable[[Any], Outcome]) -> Any:
        """Try a step, and again in other grids as long as the policy asks for them."""
        r, step = self.regridding, self.progress.step
        tried: list[tuple[float, float]] = []
        if r.policy is None:
            return attempt()
        for term in self.terms:
            r.check_term(term)
        r.wanted = None
        for _ in range(_TIMES):
            found = attempt()
            if r.wanted is None:
                break
            tried += outcome_of(found).history
            self.progress.reset_due = True
        outcome, r.wanted = outcome_of(found), None
        outcome.history[:0] = tried
        outcome.regrids = r.before(step + 1)
        return found

    def _indicate(self, system: LoadedPoints, outcome: Outcome) -> None:
        """Ask the policy whether a step that has converged is to be taken in another grid."""
        r, p = self.regridding, self.points
        if r.policy is None:
            return
        i = system.interpolation
        increments = i.gather(system.x)
        d, F = self.grid.dim, i.reference.F.copy()
        F[:, :d] += increments.gradient @ F[:, :d]
        flowed = p.hardening > 0.0 if p.plastic else np.zeros(len(p), dtype=bool)
        for batch, mapping in zip(i.batches, system.mappings, strict=True):
            if mapping is not None and mapping.yielding is not None:
                flowed[batch.rows[mapping.yielding.rows]] = True
        trial = Trial(i.reference.x, i.reference.x + increments.value[:, :d], F, flowed)
        with errors_on_all_ranks(self.comm, "the policy of grids"):
            r.wanted = r.policy.after_trial(self, trial)
        if r.wanted is not None:
            outcome.converged = False
            outcome.reason = f"regrid asks for another grid, {_TIMES} of which have been tried in this step"

    # grids ----------------------------------------------------------------------------------------
    def _reset(self) -> LoadedPoints:
        r = self.regridding
        if r.policy is not None:
            again = r.wanted
            grid = again or r.policy.at_reset(self)
            if grid is not None:
                r.wanted = None
                with self.timer("regrid"):
                    self._take_grid(grid, late=again is None)
        self._split_large()
        return super()._reset()

    def _split_large(self) -> None:
        """Split points whose boxes were seeded as large as cells, before the first reset after a step: it
        would leave them in two cells, in which splines are two polynomials."""
        r, points = self.regridding, self.points
        if not self.progress.step or not self.boxes or not self.balanced_reset or points.moving:
            return
        parts = parts_of_large(points, self.initial_grid)
        large, total = self.comm.allreduce(np.array([np.sum(np.any(parts > 1, axis=1)), len(points)]))
        if not large:
            return
        hindered = ["a body of revolution"] if points.axisymmetric else []
        hindered += [term.name for term in self.terms if goes_with_points(term)]
        if hindered:
            if not r.told:
                r.told = True
                warn_on_one_rank(self.comm, _UNSPLIT.format(large, hindered[0]), TrustWarning)
            return
        with self.timer("regrid"):
            count, since = self._split_points(parts, r.now(self))
            self._go_on_with_parts()
        if count and not r.split and self.comm.rank == 0 and self.systems is None:  # not of runs beside one
            what = f"{count} of {total} points have been split, {since} since"
            say(logging.INFO, f"step {self.progress.step + 1}: {what}: {_LARGE}")
        r.split += int(count)

    def _take_grid(self, grid: Grid, late: bool = False) -> None:
        """Go on with another grid from the last converged state; `late`: not to take a step again."""
        p, points = self.progress, self.points
        if grid.dim != self.grid.dim:
            raise InputError(f"regrid: the new grid has {grid.dim} dimensions, the body has {self.grid.dim}")
        old = self.regridding.now(self)
        self._moving.renew(grid, p.factor if p.step else None, self.supports)
        parts = self.regridding.parts(points, old, grid)
        if late and points.plastic:
            self._warn_of_history(np.prod(parts, axis=1) > 1)
        count = self._split_points(parts, grid)
        self._put_grid(grid)
        for support in self.supports:
            if isinstance(support.where, Plane):
                support.where.follow(grid)
        self._go_on_with_parts()
        self.regridding.done.append(Regrid(p.step, p.factor, grid.shape, int(count[0]), int(count[1])))

    def _split_points(self, parts: np.ndarray, grid: Grid) -> np.ndarray:
        """Split points into parts (np, d), with all that is kept of them; how many have been split, and how
        many there are since."""
        points, kept, before = self.points, self.kept(), self.points.x
        number = self.comm.allreduce(len(points))
        made = split(points, parts, grid)
        count: np.ndarray = self.comm.allreduce(
            np.array([np.sum(np.bincount(made.rows, minlength=1) > 1), len(points)])
        )
        self.keep({name: self._of_parts(name, rows, made, before) for name, rows in kept.items()})
        self._system = None  # that of before belongs to other points
        self._conservation.points_joined(int(count[1]) - number)
        return count

    def _go_on_with_parts(self) -> None:
        """Go on with points that have been split."""
        self._leave(changed=True)
        self._seal, self._attempted = Seal(self.points), None
        if self._equilibrium is not None:
            self._equilibrium.points_moved = True
        if self.comm.size > 1:
            self._migrate()

    def _warn_of_history(self, smaller: np.ndarray) -> None:
        """Points (np,) that come to smaller cells may have flowed in those of before."""
        flowed: int = self.comm.allreduce(int(np.sum(smaller & (self.points.hardening > 0.0))))
        if flowed:
            warn_on_one_rank(
                self.comm,
                f"regrid: {flowed} point(s) have flowed before cells become finer at them; what larger "
                "cells have put into their history stays. AlongBands and functions of (problem, trial) "
                "take the step in which points flow again instead (docs/grids.md)",
                TrustWarning,
            )

    def _of_parts(self, name: str, rows: np.ndarray, made: Split, before: np.ndarray) -> np.ndarray:
        """What is kept of parts, of rows (np, ...) of the points, which were at `before`."""
        if name.startswith(_SHARED):
            return made.shared(rows)
        if name == "last_x":
            last: np.ndarray = self.points.x + made.copied(rows - before)
            return last
        return made.copied(rows)

    # restart --------------------------------------------------------------------------------------
    def grid_state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What a restart needs of the grids, the same on every rank: facts, and arrays by name; nothing if
        the grid is the one that was given."""
        r, lineage = self.regridding, self.points.lineage
        about: dict[str, Any] = {}
        if r.done:
            facts = self._moving.initial.description()
            about = {"grid": facts, "since": self._moving.since, "done": [asdict(one) for one in r.done]}
        if lineage is None or not (r.done or r.split):
            return about, {}
        return about, {n: getattr(lineage, n) for n in ("parents", "first", "count")}

    def saved_grid(self, about: dict[str, Any]) -> Grid:
        """The grid that `grid_state` tells of; the one that was given if it tells of none."""
        if not about:
            return self.initial_grid
        facts = {name: tuple(values) for name, values in about["grid"].items()}
        planes = tuple(facts[f"lines {a}"] for a in "xyz" if f"lines {a}" in facts)
        if not planes:
            return Grid(facts["origin"], facts["cell"], facts["shape"], self.comm)
        mean = tuple((a[-1] - a[0]) / (len(a) - 1) for a in planes)
        return GradedGrid(tuple(a[0] for a in planes), mean, facts["shape"], self.comm, planes)

    def restore_grid(self, about: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Put in what `grid_state` gave, before points and progress are."""
        if about:
            self._moving.renew(self.saved_grid(about), about["since"], self.supports)
            done = [Regrid(**{**one, "cells": tuple(one["cells"])}) for one in about["done"]]
            self.regridding.done = done
        if arrays:
            self.points.lineage = Lineage(**arrays)
            self.regridding.split = len(self.points.lineage.parents) - sum(
                one.split for one in self.regridding.done
            )
