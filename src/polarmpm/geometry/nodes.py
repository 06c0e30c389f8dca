"""Active nodes: the lattice nodes that some point's weighting function reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from mpi4py import MPI

import numpy as np

from ..tools.parallel import Route, lowest_ranks
from .grid import Grid


@dataclass
class ActiveNodes:
    """Nodes of this rank: first the owned ones, then ghosts (touched here, owned elsewhere).

    Attributes:
        lattice: lattice numbers (n,), owned ones ascending, then ghosts ascending.
        number: global numbers (n,); contiguous over the ranks.
        owned: how many are owned.
        start: global number of the first owned node.
        total: number of active nodes of all ranks.
        positions: coordinates (m), (n, d), of lattice numbers (n,); None: the lattice nodes'.
    """

    grid: Grid
    lattice: np.ndarray
    number: np.ndarray
    owner: np.ndarray
    owned: int
    start: int
    total: int
    positions: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def body(self) -> np.ndarray:
        """Number of the body that a node belongs to, (n,)."""
        found: np.ndarray = self.lattice // self.grid.numbers
        return found

    @classmethod
    def build(
        cls,
        grid: Grid,
        touched: np.ndarray,
        positions: Callable[[np.ndarray], np.ndarray] | None = None,
        priorities: np.ndarray | None = None,
    ) -> ActiveNodes:
        """From the sorted lattice numbers that this rank's points reach. Of the ranks that share a node the
        one with the largest of the `priorities` (n,), whole numbers, owns it; where they are equal the lowest
        of them. Collective."""
        comm = grid.comm
        if comm.size == 1:
            n = len(touched)
            return cls(grid, touched, np.arange(n), np.zeros(n, dtype=np.int64), n, 0, n, positions)
        owner = lowest_ranks(comm, touched, priorities)
        mine = owner == comm.rank
        lattice = np.concatenate([touched[mine], touched[~mine]])
        owner = np.concatenate([owner[mine], owner[~mine]])
        owned = int(mine.sum())
        start = comm.exscan(owned) or 0
        ask = Route(comm, owner[owned:])
        wanted = ask.forward(lattice[owned:])
        ghosts = ask.backward(start + np.searchsorted(lattice[:owned], wanted))
        number = np.concatenate([start + np.arange(owned), ghosts])
        return cls(grid, lattice, number, owner, owned, start, comm.allreduce(owned), positions)

    def __len__(self) -> int:
        return len(self.lattice)

    @property
    def comm(self) -> MPI.Comm:
        """Of the ranks that share them."""
        return self.grid.comm

    @cached_property
    def position(self) -> np.ndarray:
        """Coordinates (m), (n, d)."""
        return (self.positions or self.grid.node_position)(self.lattice)

    def local(self, lattice: np.ndarray) -> np.ndarray:
        """Local rows of lattice numbers that are active on this rank."""
        if self.owned == len(self):
            return np.searchsorted(self.lattice, lattice)
        order = np.argsort(self.lattice, kind="stable")
        found: np.ndarray = order[np.searchsorted(self.lattice[order], lattice)]
        return found

    def find(self, lattice: np.ndarray) -> np.ndarray:
        """Local rows of lattice numbers; -1 for those that aren't active on this rank."""
        if not len(self):
            return np.full(len(lattice), -1, dtype=np.int64)
        order = np.argsort(self.lattice, kind="stable")
        rows = order[np.minimum(np.searchsorted(self.lattice[order], lattice), len(self) - 1)]
        found: np.ndarray = np.where(self.lattice[rows] == lattice, rows, -1)
        return found

    # ghosts -------------------------------------------------------------------------------------
    @cached_property
    def _route(self) -> tuple[Route, np.ndarray]:
        route = Route(self.grid.comm, self.owner[self.owned :])
        return route, np.searchsorted(self.lattice[: self.owned], route.forward(self.lattice[self.owned :]))

    def add_to_owners(self, values: np.ndarray) -> None:
        """Add ghosts' rows of values (n, ...) to their owners'; ghost rows keep their part. Collective."""
        if self.grid.comm.size > 1:
            route, rows = self._route
            np.add.at(values, rows, route.forward(values[self.owned :]))

    def update_ghosts(self, values: np.ndarray) -> None:
        """Overwrite ghosts' rows of values (n, ...) with their owners'. Collective."""
        if self.grid.comm.size > 1:
            route, rows = self._route
            values[self.owned :] = route.backward(values[rows])


class Positioned(Protocol):
    """Nodes of this rank."""

    @property
    def position(self) -> np.ndarray: ...

    def __len__(self) -> int: ...


class Nodes(Protocol):
    """Nodes of this rank: first the owned ones, then ghosts; see `ActiveNodes`."""

    number: np.ndarray
    owner: np.ndarray
    owned: int
    start: int
    total: int

    @property
    def comm(self) -> MPI.Comm: ...

    @property
    def position(self) -> np.ndarray: ...

    def __len__(self) -> int: ...

    def add_to_owners(self, values: np.ndarray) -> None: ...

    def update_ghosts(self, values: np.ndarray) -> None: ...
