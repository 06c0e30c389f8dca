"""Points that are several bodies: each has nodes of its own, also where they share cells."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..tools.meetings import collective
from .misfit import warn_of_misfit
from .selecting import Selecting
from .selection import Selection


class Several(Selecting):
    """Which body each point belongs to. Attributes are described at `Points`."""

    body: np.ndarray
    bodies: int = 1
    arrangements: int

    @property
    def total(self) -> int:
        """Number of points of all ranks. Collective."""
        raise NotImplementedError

    def _join_bodies(self, other: Several, apart: bool) -> np.ndarray:
        """Numbers (n,) that another set's bodies get here; its first one is welded to the first one here
        unless it is `apart`."""
        theirs = other.body if other.bodies > 1 else np.zeros(len(other), dtype=np.int32)
        moved = theirs + (self.bodies - 1 + apart)
        count = self.bodies + other.bodies - 1 + apart
        if count > 1 and self.bodies == 1:
            self.body = np.zeros(len(self), dtype=np.int32)
        self.bodies = count
        return (moved if apart else np.where(theirs > 0, moved, 0)).astype(np.int32)

    @collective("separate", compare=True)
    def separate(self, selection: Selection) -> None:
        """Make a body of its own of some points: they share no nodes of the grid with others, not even where
        they touch, and meet them through `problem.contact` alone (docs/contact.md). Before a problem is made
        of them; collective.

        Raises:
            InputError: an empty selection, or one of all points.
        """
        self.check(selection)
        if not 0 < len(selection) < self.total:
            whole = "all points" if len(selection) else "no point"
            raise InputError(f"selection: contains {whole}; some, but not all, can be a body of their own")
        warn_of_misfit(self, selection, "seed the bodies apart and join them: points.join(other, apart=True)")
        if self.bodies == 1:
            self.body = np.zeros(len(self), dtype=np.int32)
        self.body = self.body.copy()
        self.body[self.rows(selection)] = self.bodies
        used, number = self._bodies_used()
        self.body, self.bodies = np.searchsorted(used, self.body).astype(np.int32), number
        self.arrangements += 1

    def _bodies_used(self) -> tuple[np.ndarray, int]:
        """Numbers of bodies that have points, on any rank, and how many these are. Collective."""
        every = self.comm.allgather(np.unique(self.body))
        used: np.ndarray = np.unique(np.concatenate(every))
        return used, len(used)
