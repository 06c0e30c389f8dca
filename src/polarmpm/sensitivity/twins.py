"""Twins: runs beside a run, with a parameter that is a little different (docs/sensitivity.md).

A twin begins a step with the increments that the leading run has made in it, and makes chord steps with that
run's factor, x += -K^-1 (r - r_leading): the leading run's own residual cancels, so that its tolerance
doesn't matter. What the leading run has decided (load factors, resets, cuts, bases of the rotations,
polynomials of the points) holds for the twin, too, whose answer is then smooth in the parameter.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from ..assembly.borrowed import BorrowedElements, BorrowedPoints
from ..assembly.system import NodalSystem
from ..basis.followed import Followed
from ..bodies.partition import LoadShares
from ..bodies.points import Points
from ..errors import LocalFailure, NotConserved, PointsOutsideGrid, PolarMPMError, SupportLost
from ..problems.attempts import Search
from ..solvers.arclength import Path
from ..solvers.linear import SingularTangent
from ..solvers.newton import Controls, Outcome
from ..tools.parallel import Route, values_by_number
from .leading import Along, Lead, Leader, Record

CHORDS, MOST_CHORDS = 2, 25
ENOUGH = 1e-9  # imbalance after the chord steps over that before, at which there are enough of them
BAR = 1e-3  # the same, above which a twin is no twin
_ROUNDING, _LEVEL = 0.01, 1.0  # times the level of rounding: what chord steps can't make smaller; may leave
_STALLED = 0.5  # ratio of imbalances above which another chord step brings nothing
_GOOD, _PATIENCE = (
    1e-4,
    4,
)  # while more than this share of the imbalance is left, so many steps may bring nothing
_RANK = 1e-14  # of the products of earlier steps


class Apart(PolarMPMError, RuntimeError):
    """A twin couldn't go along with the leading run."""


class TwinSearch(Search):
    """Finds a twin's equilibrium by chord steps beside that of the leading run.

    Attributes:
        check: imbalance after the chord steps over that before them, of the last step.
        mirror: of a twin with a change of the parameter to the other side, which goes first; None: there is
            none. To second order it is as far from the leading run.
    """

    def __init__(self, lead: Lead):
        self.lead = lead
        self.check = 0.0
        self.mirror: TwinSearch | None = None
        self._before = 0.0
        self._found: tuple[Record, np.ndarray, float] | None = None  # the step, its end, the imbalance before

    def at_factor(
        self, system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls
    ) -> Outcome:
        record = self.lead.run.record
        self._put_shares(system, record)
        return self._tried(partial(self._chords, system, start, increments, record))

    def along(self, path: Path, controls: Controls, to: float | None) -> Outcome:
        record = self.lead.run.record
        self._put_shares(path.system, record)
        assert record.path is not None
        return self._tried(partial(self._along, path, record, record.path))

    def _tried(self, search: Any) -> Outcome:
        outcome = Outcome()
        try:
            search()
            outcome.converged = self.check <= BAR
            if not outcome.converged:
                outcome.reason = f"chord steps leave {self.check:.2g} of the imbalance, {BAR:g} is allowed"
        except (LocalFailure, SingularTangent) as e:
            outcome.reason = str(e)
        return outcome

    def _put_shares(self, system: Any, record: Record) -> None:
        """Boxes of points count as much as in the leading run."""
        if record.shares is not None and system._boxes is not None:
            for boxes, share in zip(system._boxes, record.shares, strict=True):
                boxes.put_shares(share)

    # at a load factor -------------------------------------------------------------------------------
    def _chords(self, system: NodalSystem, start: np.ndarray, increments: np.ndarray, record: Record) -> None:
        fixed, other = system.prescribed.fixed, None if self.mirror is None else self.mirror._found
        guess, before = start + (record.end - record.start), 0.0
        if other is not None and other[0] is record:
            guess, before = 2.0 * record.end - other[1], other[2]
        _put(system, np.where(fixed, increments, guess))
        self.check = self._balance(system, record.residual, record.level, before=before)
        self._found = record, system.x, self._before

    def _balance(
        self,
        system: NodalSystem,
        left: np.ndarray,
        level: float,
        path: Path | None = None,
        before: float = 0.0,
    ) -> float:
        """Chord steps; what they leave of the imbalance. Collective.

        Args:
            left: out of balance in the leading run (nodes, block).
            level: forces that rounding makes.
            path: its load factor is an unknown, too.
            before: imbalance where the parameter's change alone is felt; 0: that of the start.
        """
        found: list[float] = []
        secants, best = _Secants(system), system.x
        while True:
            system.evaluate(False)
            r = system.residual - left
            found.append(_norm(system, r))
            best = system.x if found[-1] <= min(found) else best
            self._before = first = max(found[0], before)
            if _ended(found, level, first):
                break
            if path is None:
                system.add(secants.step(r))
            else:
                _correct(path, r, self.lead.run.record)
        if path is None and found[-1] > min(found):  # iterations have led on to something worse
            system.jump(best)
            system.evaluate(False)
            found.append(min(found))
        last = found[-1]
        if not np.isfinite(last):
            return np.inf
        share = last / first if first > 0.0 else 0.0
        return 0.0 if share > BAR and last <= _LEVEL * level else share

    # along the path ---------------------------------------------------------------------------------
    def _along(self, path: Path, record: Record, along: Along) -> None:
        system: Any = path.system
        path.put_load()
        checks, start = [0.0], record.start
        if along.relaxed is not None:
            relaxed, left = along.relaxed
            _put(system, path.start + (relaxed - start))
            checks.append(self._balance(system, left, record.level))
            path.start, path.settled, start = system.x.copy(), True, relaxed
        _put(system, path.start + (record.end - start))
        if along.stopped:
            assert along.to is not None
            path.factor = along.to
            path.put_load()
            checks.append(self._balance(system, record.residual, record.level))
        else:
            path.factor = path.factor + (along.end - along.begin)
            path.put_load()
            checks.append(self._balance(system, record.residual, record.level, path))
        self.check = max(checks)


def _ended(found: list[float], level: float, first: float) -> bool:
    """Whether chord steps have come to their end, of the imbalances at the start and after each, and of that
    which the parameter's change makes."""
    steps, now = len(found) - 1, found[-1]
    if not np.isfinite(now) or now == 0.0 or steps == MOST_CHORDS:
        return True
    if steps < CHORDS:
        return steps > 0 and now <= _ROUNDING * level
    patience = 1 if min(found) <= _GOOD * first else _PATIENCE
    stalled = steps >= CHORDS + patience - 1 and min(found[-patience:]) > _STALLED * min(found[:-patience])
    return now <= max(ENOUGH * first, _ROUNDING * level) or stalled


class _Secants:
    """Chord steps; where a factor is a poor one, such as that of an iteration that was far away, what earlier
    steps have done to the residual is put to use (Anderson's acceleration, in the norm of forces)."""

    def __init__(self, system: NodalSystem):
        self._system = system
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._moved: list[np.ndarray] = []
        self._changed: list[np.ndarray] = []

    def step(self, residual: np.ndarray) -> np.ndarray:
        """Correction (nodes, block) for a residual. Collective."""
        system, x = self._system, self._system.x
        forces = system.on_free(residual)
        if self._last is not None:
            self._moved.append(x - self._last[0])
            self._changed.append(forces - self._last[1])
        self._last = x, forces
        moved: np.ndarray = np.zeros_like(x)
        if self._changed:
            for share, m, change in zip(self._shares(forces), self._moved, self._changed, strict=True):
                moved -= share * m
                forces = forces - share * change
        moved += system.solve_free(-forces, False)
        return moved

    def _shares(self, forces: np.ndarray) -> np.ndarray:
        """By which earlier changes of the residual make most of it vanish. Collective."""
        own, scale = slice(0, self._system.owned), self._system.as_force
        rows = np.array([(c[own] * scale).ravel() for c in (*self._changed, forces)])
        products = self._system.comm.allreduce(rows @ rows.T)
        size = np.sqrt(np.diag(products)[:-1])
        size = np.where(size > 0.0, size, 1.0)
        matrix = products[:-1, :-1] / np.outer(size, size)
        shares: np.ndarray = np.linalg.lstsq(matrix, products[:-1, -1] / size, rcond=_RANK)[0] / size
        return shares


def _put(system: NodalSystem, x: np.ndarray) -> None:
    """Put increments (nodes, block) in, of prescribed unknowns too."""
    system.jump(x)
    system.step.lift, system.step.pending = np.zeros_like(x), False


def _norm(system: NodalSystem, forces: np.ndarray) -> float:
    """Of forces (nodes, block) on free unknowns, couples as forces. Collective."""
    own = slice(0, system.owned)
    square = float(np.sum((system.on_free(forces)[own] * system.as_force) ** 2))
    return float(np.sqrt(system.comm.allreduce(square)))


def _correct(path: Path, residual: np.ndarray, record: Record) -> None:
    """A chord step on residual and length, as long as the leading run's step."""
    system = path.system
    relaxed = system.solve_free(-residual, False)
    along = system.solve_free(path.loads[1], False)
    assert record.path is not None
    now, excess = path.increment, path.excess() - record.path.excess
    slope = 2.0 * path.inner(now, along)
    if slope == 0.0:
        raise SingularTangent("the path is at right angles to the step")
    growth = -(excess * path.size + 2.0 * path.inner(now, relaxed)) / slope
    system.add(relaxed + growth * along)
    path.factor += growth
    path.put_load()


class _Policy:
    """Resets when the leading run has them: `Twin` puts that in."""

    def due(self, steps: int, gradient: np.ndarray, comm: Any) -> bool:
        return False


class _Shares(LoadShares):
    """Looks at each reset where the leading run's points are."""

    def due(self) -> bool:
        return bool(self.comm.size > 1)


def distribute(lead: Lead, points: Points) -> Route | None:
    """Points go where the leading run's are. Collective."""
    there, comm = lead.run.problem.points.id, points.comm
    rank = np.full((len(there), 1), float(comm.rank))
    to = values_by_number(comm, there, rank, points.id)[:, 0].astype(np.int64)
    route = points.migrate(to) if comm.allreduce(int(np.any(to != comm.rank))) else None
    if comm.allreduce(int(not np.array_equal(points.id, there))):
        raise Apart("points are in another order than those of the leading run")
    return route


class Twin:
    """A problem that goes along with a leading run.

    Attributes:
        problem, observables: of its own.
        check: see `TwinSearch`.
    """

    def __init__(self, leader: Leader, problem: Any, observables: Mapping[str, Any]):
        self.problem, self.observables = problem, observables
        self._lead = Lead(leader)
        problem.search = self.search = TwinSearch(self._lead)
        self._basis: Followed | None = None
        self._lost = ""  # why it could not follow a reset
        if leader.on_grid:
            problem.basis = self._basis = Followed(problem.basis)
            problem.policy = _Policy()
            problem.systems = partial(BorrowedPoints, leader=self._lead.system)
            problem.distribution = partial(distribute, self._lead, problem.points)
            problem.load_shares = _Shares(problem.comm, None)
        else:
            problem.systems = partial(BorrowedElements, leader=self._lead.system)
        self.follow_on(leader)

    def follow_on(self, leader: Leader) -> None:
        """Go along with another run from here on, that is in the same state."""
        self._lead.follow(leader)
        leader.followers.append(self)

    @property
    def check(self) -> float:
        return self.search.check

    def reset(self) -> None:
        """Reset the grid as the leading run has. What goes wrong, which is no fault of that run, is told by
        `follow`. Collective."""
        try:
            with apart():
                self._reset()
        except Apart as e:
            self._lost = str(e)

    def converged(self) -> None:
        """The leading run's step is followed when it has been committed."""

    def _reset(self) -> None:
        p, leader = self.problem, self._lead.run
        assert self._basis is not None
        self._basis.like, self._basis.places = leader.chosen, leader.places
        p.progress.reset_due = True
        with quiet():
            p.whole(self._prepare)
        own, other = p.system, leader.problem.system
        apart = not (
            np.array_equal(own.nodes.lattice, other.nodes.lattice)
            and np.array_equal(own.prescribed.fixed, other.prescribed.fixed)
        )
        if p.comm.allreduce(int(apart)):
            raise Apart("its nodes, or those that supports hold, are others than in the leading run")

    def _prepare(self) -> None:
        self.problem._use_materials(self.problem._settled)
        self.problem._prepare()

    def follow(self) -> None:
        """Take the step that the leading run has taken. Collective.

        Raises:
            Apart: it can't.
        """
        if self._lost:
            raise Apart(self._lost)
        p, leader = self.problem, self._lead.run
        path = leader.record.path
        if leader.on_grid:
            p._rotation_limit = np.finfo(float).tiny if leader.rebased else np.inf
            initial = p.system.initial
            if leader.fell_back and initial is not None and initial.active():
                p.whole(p._fall_back)
        with quiet(), apart():
            if path is None:
                outcome = p.attempt(leader.problem.progress.factor)
            else:
                outcome, _ = p.attempt_along(path.length, path.to, path.kink)
        if not outcome.converged:
            raise Apart(outcome.reason)
        p.progress.reset_due = leader.problem.progress.reset_due

    def close(self) -> None:
        """Free its memory. Collective."""
        self.problem.close()


@contextmanager
def apart() -> Iterator[None]:
    """What ends a twin's step, and didn't end the run's, tells that it is none."""
    try:
        yield
    except (NotConserved, PointsOutsideGrid, SupportLost) as e:
        raise Apart(str(e)) from e


def quiet() -> Any:
    """Warnings are the leading run's."""
    return warnings.catch_warnings(action="ignore")
