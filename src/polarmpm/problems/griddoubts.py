"""What is kept of the grid's own error in the course of a run, as strains and stresses tell it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from mpi4py import MPI

import numpy as np

from ..assembly.loadedpoints import LoadedPoints
from ..bodies.points import Points
from . import doubts

COARSE = 0.1  # roughness of an elastic body's first strains, by tents: about the answer's error
COARSE_SPLINES = 0.15  # by splines, of any of its strains: a few cells along a beam that bends far
MANY = 200_000  # points of bodies with cells enough, of which tents' roughness and flow alone are looked at
EXCESS = 0.15  # of the strain increments of bodies that flow over smooth ones: loads are a tenth off
IMBALANCE = 0.06  # of the forces of smooth stresses in cells of tents
SLIGHT = 0.1  # of the largest strain increments of a step: of what is less nothing is learnt
_FINER = "take smaller cells, or the default basis"


class GridRecord:
    """What strains and stresses say of the grid's own error. All methods are collective.

    Looked at are: the first step in which the body is strained, by tents; of elastic bodies by splines, but
    for very large ones, the first step, the fourth, sixteenth ...; of bodies that flow the first step with
    flow, the second, fourth, eighth ...

    Attributes:
        rough: roughness of an elastic body's strains: of the first ones by tents; by splines the largest,
            times the share of the work that isn't done inside the points' boxes.
        excess: largest excess of a flowing body's strain increments over smooth ones.
        imbalance: largest imbalance of smooth stresses, by tents.
        seen: whether anything has been looked at.
    """

    def __init__(self, points: Points, comm: MPI.Comm):
        self.points, self.comm = points, comm
        self.rough = self.excess = self.imbalance = 0.0
        self.seen = False
        self._flowing, self._strained, self._stresses = 0, 0.0, False
        self._tents, self._steps, self._rough = False, 0, 0.0

    @property
    def flows(self) -> bool:
        """Whether points have flowed in some step."""
        return self._flowing > 0

    def look(self, system: LoadedPoints, start: np.ndarray, gradient: np.ndarray | None = None) -> None:
        """Look at the strains of a step that has converged, from increments `start` (nodes, block) on;
        `gradient`: of those at its end at the points (np, d, d), where it is known."""
        self._tents, self._stresses = not system.interpolation.basis.fills_boxes, False
        self._rough = 0.0
        if self._looks_at_flow(system):
            excess, size = doubts.excess(system, start, gradient)
            self._strained = max(self._strained, size)
            if size > max(SLIGHT * self._strained, doubts.ROUNDING):  # or there is little but rounding
                self.excess, self.seen, self._stresses = max(self.excess, excess), True, self._tents
        elif self._looks_at_strains(system):
            rough, size = doubts.roughness(system, start, gradient)
            self._strained = max(self._strained, size)
            if size > max(SLIGHT * self._strained, doubts.ROUNDING):
                self.seen, self._stresses = True, self._tents
                self._rough = 0.0 if self.points.plastic else rough

    def weigh(self, share: float) -> None:
        """Take the share of the step's work inside the boxes into account, which strains at points don't
        show."""
        self.rough = max(self.rough, self._rough * max(0.0, 1.0 - share))

    def _looks_at_strains(self, system: LoadedPoints) -> bool:
        """Whether this is a step of which the strains of a body that doesn't flow are looked at."""
        if system.inertia is not None:
            return False
        if self._tents:
            return not self._strained
        if self.points.plastic or self.points.total > MANY:
            return False
        self._steps += 1
        return self._steps & (self._steps - 1) == 0 and self._steps.bit_length() % 2 == 1

    def _looks_at_flow(self, system: LoadedPoints) -> bool:
        """Whether the body flows, and this is a step of which the flow is looked at."""
        if not self.points.plastic:
            return False
        flows = any(m is not None and m.yielding is not None for m in system.mappings)
        if not self.comm.allreduce(flows or bool(np.any(self.points.hardening > 0.0)), op=MPI.LOR):
            return False
        self._flowing += 1
        return self._flowing & (self._flowing - 1) == 0

    def look_at_stresses(self, system: LoadedPoints, stresses: Callable[[], np.ndarray]) -> None:
        """Look at the stresses (np, 3, 3) after a step whose strains were looked at, without inertia and
        while balanced resets carry none along."""
        if not self._stresses or system.inertia is not None or self.points.second_gradient:
            return
        if self.points.total > MANY:
            return
        if not self.comm.allreduce(bool(system.interpolation.reference.initial_stress.any()), op=MPI.LOR):
            self.imbalance = max(self.imbalance, doubts.imbalance(system, stresses()))

    def doubts(self) -> Iterator[str]:
        """What there is against the answer."""
        if self.rough > COARSE and self._tents:
            yield (
                f"{100 * self.rough:.0f} % of the strains' squares are rough over two cells, and the body is "
                f"about as much too stiff: {_FINER}"
            )
        if self.rough > COARSE_SPLINES and not self._tents:
            yield (
                f"{100 * self.rough:.0f} % of the strains' squares aren't smooth over two cells: the answer "
                "may be more than a tenth off; take smaller cells, and compare"
            )
        if self.imbalance > IMBALANCE:
            yield (
                "stresses that are smooth over two cells aren't in equilibrium, by "
                f"{100 * self.imbalance:.0f} % of their squares: the body may be far too stiff: {_FINER}"
            )
        if self.excess > EXCESS:
            yield (
                f"the body flows, and its strains are {100 * self.excess:.0f} % larger than strains that are "
                "smooth over two cells: loads may be more than a tenth off; take smaller cells, and compare"
            )

    def summary(self) -> str:
        """What was seen, in part of a line."""
        parts = []
        if self.points.plastic and self.flows:
            parts.append(f"strains of the flowing body are {100 * self.excess:.2g} % larger than smooth ones")
        elif self.seen:
            parts.append(f"{100 * self.rough:.2g} % of the strains' squares aren't smooth over two cells")
        if self.imbalance:
            parts.append(f"smooth stresses are out of balance by {100 * self.imbalance:.2g} %")
        return ", ".join(parts)

    def state(self) -> list[float]:
        """For a restart file."""
        whole = float(self.seen), float(self._flowing), float(self._steps), float(self._tents)
        return [self.rough, self.excess, self.imbalance, self._strained, *whole]

    def restore(self, state: Sequence[float]) -> None:
        """Put in what `state` gave."""
        self.rough, self.excess, self.imbalance, self._strained = map(float, state[:4])
        seen, flowing, steps, tents = state[4:]
        self.seen, self._flowing, self._steps, self._tents = bool(seen), int(flowing), int(steps), bool(tents)
