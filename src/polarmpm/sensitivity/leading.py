"""The run that twins go along with: what it has decided and found in each step."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..assembly import rounding
from ..assembly.bodyweights import chosen_of_bodies
from ..assembly.system import NodalSystem
from ..basis.base import Chosen
from ..problems.attempts import Search
from ..problems.observer import Observer
from ..solvers.arclength import Path, least_cosine
from ..solvers.newton import Controls, Outcome
from ..tools.parallel import reduced


@dataclass
class Record:
    """What a converged step has found. Arrays are (nodes, block), increments since the reset.

    Attributes:
        start: at its beginning; of a step along the path whose start has been relaxed: then.
        end, residual: at its end.
        shares: what counts of the points' boxes, by batch; None without boxes.
        level: forces that rounding makes.
        path: of a step along the path, else None.
    """

    start: np.ndarray
    end: np.ndarray
    residual: np.ndarray
    shares: list[np.ndarray] | None
    level: float
    path: Along | None = None


@dataclass
class Along:
    """A step along the path.

    Attributes:
        length, to, kink: what was asked for.
        relaxed: increments (nodes, block) after the start was relaxed, and what that left out of balance;
            None: it wasn't.
        begin, end: load factors.
        excess: of its length.
        stopped: it has ended at the load factor `to`, at another length.
    """

    length: float
    to: float | None
    kink: bool
    relaxed: tuple[np.ndarray, np.ndarray] | None
    begin: float
    end: float
    excess: float
    stopped: bool


class Leading(Search):
    """Finds equilibrium as ever, and takes note of it.

    Attributes:
        record: of the last attempt that has converged.
    """

    record: Record | None = None

    def _note(self, system: NodalSystem, start: np.ndarray, path: Along | None = None) -> None:
        boxes = getattr(system, "_boxes", None)
        shares = None if boxes is None else [b.share for b in boxes]
        most = float(np.abs(system.x[:, system.dim :]).max(initial=0.0))
        level = rounding.level(system.step.rounding, reduced(system.comm, most, MPI.MAX))
        self.record = Record(start, system.x, system.residual, shares, level, path)

    def at_factor(
        self, system: NodalSystem, start: np.ndarray, increments: np.ndarray, controls: Controls
    ) -> Outcome:
        outcome = super().at_factor(system, start, increments, controls)
        if outcome.converged:
            self._note(system, start)
        return outcome

    def along(self, path: Path, controls: Controls, to: float | None) -> Outcome:
        start = path.start
        outcome = super().along(path, controls, to)
        if outcome.converged:
            relaxed = None if path.left is None else (path.start, path.left)
            kink = path.bend == least_cosine(True)
            stopped = to is not None and path.factor == to
            ends = path.begin, path.factor
            along = Along(path.length, to, kink, relaxed, *ends, path.excess(), stopped)
            self._note(path.system, start, along)  # type: ignore[arg-type]
        return outcome


class Following(Protocol):
    """What goes along with a run."""

    def reset(self) -> None:
        """Increments of the leading run count from its present state on."""

    def converged(self) -> None:
        """A step of the leading run has converged, and its body has still the state of the last one."""


class Watch(Observer):
    """Tells those that follow of resets, at once, while the leading run has the factor of what it carries."""

    def __init__(self, leader: Leader):
        self._leader = weakref.ref(leader)  # no circles: a run that is dropped is gone
        self.rebased, self.factor = False, 0.0

    def after_reset(self, problem: Any) -> None:
        leader = self._leader()
        if leader is not None:
            leader.was_reset()

    def after_convergence(self, problem: Any, factor: float) -> None:
        leader, self.factor = self._leader(), factor
        if leader is not None:
            for follower in leader.followers:
                follower.converged()

    def after_commit(self, problem: Any, rebased: bool) -> None:
        self.rebased = rebased


class Leader:
    """A run that others go along with.

    Attributes:
        problem: its problem.
        on_grid: it has a grid, whose resets others have to follow.
        followers: told of resets.
        search: has the record of the last step.
    """

    def __init__(self, problem: Any):
        self.problem = problem
        self.on_grid = hasattr(problem, "basis")
        self.followers: list[Following] = []
        problem.search = self.search = Leading()
        self.watch = Watch(self)
        problem.observers.append(self.watch)
        self._chosen: Chosen | None = None
        self._places: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def record(self) -> Record:
        """Of the last step."""
        assert self.search.record is not None
        return self.search.record

    @property
    def rebased(self) -> bool:
        """Whether the last step has ended with a new base of the rotations."""
        return self.watch.rebased

    @property
    def factor(self) -> float:
        """Load factor of the last step that has converged, from then on."""
        return self.watch.factor

    @property
    def fell_back(self) -> bool:
        """Whether carried forces stand in the place of initial stresses since the last reset. Collective."""
        initial = getattr(self.problem.system, "initial", None)
        return initial is not None and not initial.active()

    def was_reset(self) -> None:
        """The grid has been reset. Collective."""
        if self.on_grid and self.followers:
            self._chosen, self._places = self._find_chosen(), self._find_places()
            for follower in self.followers:
                follower.reset()

    @property
    def chosen(self) -> Chosen | None:
        """The points' polynomials since the last reset."""
        return self._chosen

    @property
    def places(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Ranks (n,) and lattice index (n, d) of the cells that carry the places of surfaces, by name."""
        return self._places

    def _find_chosen(self) -> Chosen:
        p = self.problem
        i = p.system.interpolation
        r, half = i.reference, None
        if p.basis.uses_domains:
            half0 = p.points.half_length0
            half = np.minimum(p.basis.domains(r.F, half0), p._most_growth * half0)
        return chosen_of_bodies(i.grid, p.basis, p.points, r.x, half, i.batches[0].batch.orders)

    def _find_places(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        p, found = self.problem, {}
        grid, comm = p.grid, p.comm
        for piece in p.system.interpolation.pieces:
            surface, rows = getattr(piece.of, "surface", None), getattr(piece, "rows", None)
            if surface is None or not isinstance(rows, np.ndarray):
                continue
            owner, cells = np.full(len(surface), -1), np.full((len(surface), grid.dim), -1)
            owner[rows], cells[rows] = comm.rank, grid.node_index(piece.boxes.lowest)
            comm.Allreduce(MPI.IN_PLACE, owner, op=MPI.MAX)
            comm.Allreduce(MPI.IN_PLACE, cells, op=MPI.MAX)
            found[piece.name] = owner, cells
        return found


class Lead:
    """By which a twin knows its leading run, without keeping it alive."""

    def __init__(self, leader: Leader):
        self.follow(leader)

    def follow(self, leader: Leader) -> None:
        """Go along with another run from here on."""
        self._ref = weakref.ref(leader)

    @property
    def run(self) -> Leader:
        """The leading run."""
        leader = self._ref()
        assert leader is not None
        return leader

    def system(self) -> Any:
        """That it solves with."""
        return self.run.problem.system
