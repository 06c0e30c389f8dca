"""Nodal values that follow others: what holds slopes, and mirrors fields, on planes of the grid.

A tie says x_f = b_f + g (x_l - b_l): the increment of an unknown, the follower, is a multiple g of that of
another one, the leader, counted from the base, the last converged state. Ties of several planes make chains,
at corners. Where a chain ends at a prescribed unknown, all of its unknowns are prescribed; they belong to
`fixed`. Otherwise they are *tied* to the one at its end, which is the only unknown of the chain: rows and
columns of the others are added to its own ones (`assembly.folding`). A follower's leader is among the nodes
of all points that weight the follower (`Basis.mirror`): a rank that has the one has the other, and the sparse
matrix couples nothing new.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..basis.base import Layer
from ..geometry.grid import Grid
from .supports import Mirror, Support


@dataclass
class _Relations:
    """All ties of this rank: rows of follower and leader, column, factor, number of the support."""

    follower: np.ndarray
    leader: np.ndarray
    column: np.ndarray
    factor: np.ndarray
    support: np.ndarray

    def turned(self, which: np.ndarray) -> _Relations:
        """Of some (bool), follower and leader the other way round."""
        return _Relations(
            np.where(which, self.leader, self.follower),
            np.where(which, self.follower, self.leader),
            self.column,
            np.where(which, 1.0 / self.factor, self.factor),
            self.support,
        )

    def part(self, which: np.ndarray) -> _Relations:
        return _Relations(
            *(a[which] for a in (self.follower, self.leader, self.column, self.factor, self.support))
        )


class Ties:
    """Ties of the nodes between two resets. Arrays are (nodes, block). Collective.

    Args:
        fixed: unknowns that supports prescribe, the same on all ranks.

    Attributes:
        fixed: those, and all that follow them.
        tied: unknowns that follow one that is free.
        master, factor: row of the node that these follow, and by which factor.
    """

    def __init__(self, nodes: Any, supports: Sequence[Support], fixed: np.ndarray, comm: MPI.Comm):
        self.nodes, self.comm, self._shape = nodes, comm, fixed.shape
        self.fixed = fixed.copy()
        self._depth = np.zeros(self._shape, dtype=np.int64)  # followers: steps to where their chain ends
        self.depth = 0
        relations = self._given(supports)
        # what acts on both ends of a tie is summed where the first one given is owned: that rank has both
        self._mine = relations.follower < nodes.owned
        self._ties = self._follow_fixed(relations)
        self._resolve()

    # chains ---------------------------------------------------------------------------------------
    def _given(self, supports: Sequence[Support]) -> _Relations:
        """The ties of all supports; of those that give an unknown two leaders the first one counts."""
        grid, lattice = self.nodes.grid, self.nodes.lattice
        index = grid.node_index(lattice)
        leader = np.full(self._shape, -1, dtype=np.int64)
        factor, support = np.ones(self._shape), np.full(self._shape, -1, dtype=np.int64)
        for number, mirror in [(k, s.mirror) for k, s in enumerate(supports) if s.mirror is not None]:
            for column, even in mirror.even.items():
                for layer in _layers(grid, mirror, even):
                    rows = np.flatnonzero(
                        (index[:, mirror.axis] == layer.follower) & (support[:, column] < 0)
                    )
                    step = (layer.leader - layer.follower) * int(grid.strides[mirror.axis])
                    leader[rows, column] = self.nodes.find(lattice[rows] + step)
                    factor[rows, column], support[rows, column] = layer.factor, number
        lost = self._anywhere((support >= 0) & (leader < 0))
        at = np.nonzero((support >= 0) & ~lost)
        return _Relations(at[0], leader[at], at[1], factor[at], support[at])

    def _anywhere(self, flags: np.ndarray) -> np.ndarray:
        """What is true (nodes, block) on one of the ranks that share a node."""
        found = flags.astype(float)
        self.nodes.add_to_owners(found)
        self.nodes.update_ghosts(found)
        somewhere: np.ndarray = found > 0.0
        return somewhere

    def _follow_fixed(self, given: _Relations) -> _Relations:
        """Mark what follows prescribed unknowns, in either direction; the ties turned accordingly."""
        turned, used = (np.zeros(len(given.column), dtype=bool) for _ in range(2))
        while True:
            self.depth += 1
            new = np.zeros(self._shape, dtype=bool)
            for back in (False, True):
                r = given.turned(np.full(len(turned), back))
                found = self.fixed[r.leader, r.column] & ~self.fixed[r.follower, r.column]
                new[r.follower[found], r.column[found]] = True
                turned[found], used[found] = back, True
            if not self.comm.allreduce(bool(np.any(new)), op=MPI.LOR):
                break
            new = self._anywhere(new)
            self.fixed |= new
            self._depth[new] = self.depth
        # those between two prescribed unknowns say nothing more
        says = used | ~self.fixed[given.follower, given.column]
        self._mine = self._mine[says]
        made = given.turned(turned).part(says)
        # an unknown may follow several others that are prescribed alike, on several ranks: each for a share
        count = np.zeros(self._shape)
        np.add.at(count, (made.follower, made.column), self._mine)
        self.nodes.add_to_owners(count)
        self.nodes.update_ghosts(count)
        self._weight = 1.0 / np.maximum(count, 1.0)[made.follower, made.column]
        return made

    def _resolve(self) -> None:
        """Find where chains of free unknowns end."""
        t = self._ties
        self.master = np.tile(np.arange(self._shape[0])[:, None], (1, self._shape[1]))
        self.factor = np.ones(self._shape)
        free = ~self.fixed[t.follower, t.column]
        rows, columns = t.follower[free], t.column[free]
        self.master[rows, columns], self.factor[rows, columns] = t.leader[free], t.factor[free]
        self.tied = self.master != np.arange(self._shape[0])[:, None]
        self._depth[self.tied] = 1
        step, way = self.master.copy(), self.factor.copy()
        at = np.arange(self._shape[1])
        for _ in range(2 * self._shape[1]):
            further = self.tied[self.master, at]
            if not np.any(further):
                break
            self.factor = np.where(further, self.factor * way[self.master, at], self.factor)
            self.master = np.where(further, step[self.master, at], self.master)
            self._depth += further
        # each follows the other, at a distance from it: only zero does
        self.still = self._anywhere(self.tied & self.tied[self.master, at])
        self.fixed |= self.still
        self.tied &= ~self.still
        self.depth = int(self.comm.allreduce(int(self._depth.max(initial=0)), op=MPI.MAX))

    @property
    def touched(self) -> np.ndarray:
        """Unknowns that are tied, and those that they follow, bool."""
        out = self.tied.copy()
        t = self._ties
        out[t.leader, t.column] |= self.tied[t.follower, t.column]
        return self._anywhere(out)

    # values ---------------------------------------------------------------------------------------
    def put_prescribed(self, values: np.ndarray, base: np.ndarray) -> None:
        """Complete prescribed increments (nodes, block) by those that follow them. Collective."""
        t = self._ties
        for depth in range(1, self.depth + 1):
            of_depth = self.fixed & ~self.still & (self._depth == depth)
            if not self.comm.allreduce(bool(np.any(of_depth)), op=MPI.LOR):
                continue
            which = self._mine & of_depth[t.follower, t.column]
            r, found = t.part(which), np.zeros(self._shape)
            to, of = (r.follower, r.column), (r.leader, r.column)
            gained = r.factor * (values[of] - base[of])
            np.add.at(found, to, self._weight[which] * (base[to] + gained))
            self.nodes.add_to_owners(found)
            self.nodes.update_ghosts(found)
            values[of_depth] = found[of_depth]

    def follow(self, step: np.ndarray) -> None:
        """Complete a correction (nodes, block) by what follows free unknowns."""
        rows, columns = np.nonzero(self.tied)
        step[rows, columns] = self.factor[rows, columns] * step[self.master[rows, columns], columns]

    # forces ---------------------------------------------------------------------------------------
    def fold(self, forces: np.ndarray) -> np.ndarray:
        """Forces (nodes, block), complete on owned rows, on the unknowns that are left: those on tied ones
        act on what they follow. Zero at prescribed and tied unknowns; owned rows count. Collective."""
        own = self.nodes.owned
        rows, columns = np.nonzero(self.tied[:own])
        moved = np.zeros(self._shape)
        np.add.at(
            moved,
            (self.master[rows, columns], columns),
            self.factor[rows, columns] * forces[rows, columns],
        )
        self.nodes.add_to_owners(moved)
        folded: np.ndarray = np.where(self.fixed | self.tied, 0.0, forces + moved)
        return folded

    def shares(self, forces: np.ndarray) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Forces (nodes, block), complete on owned rows, of supports: what those do that prescribe values,
        and by the number of the others what their ties do, which is a force on the follower, and its reaction
        on the leader. Owned rows count. Collective."""
        t, rest = self._ties, forces.copy()
        numbers = self.comm.allreduce(sorted({int(k) for k in t.support}))
        out = {k: np.zeros(self._shape) for k in sorted(set(numbers))}
        # what stands still belongs to its first tie
        for k, found in out.items():
            mine = self._mine & (t.support == k) & self.still[t.follower, t.column]
            found[t.follower[mine], t.column[mine]] = rest[t.follower[mine], t.column[mine]]
        rest[self.still] = 0.0
        for depth in range(self.depth, 0, -1):
            self.nodes.update_ghosts(rest)
            of_depth = (self._depth == depth) & ~self.still
            back = np.zeros(self._shape)
            for k, found in out.items():
                which = self._mine & (t.support == k) & of_depth[t.follower, t.column]
                r = t.part(which)
                force = self._weight[which] * rest[r.follower, r.column]
                np.add.at(found, (r.follower, r.column), force)
                np.add.at(found, (r.leader, r.column), -r.factor * force)
                np.add.at(back, (r.leader, r.column), r.factor * force)
            self.nodes.add_to_owners(back)
            rest = np.where(of_depth, 0.0, rest + back)
        for found in out.values():
            self.nodes.add_to_owners(found)
        return rest, out


def _layers(grid: Grid, mirror: Mirror, even: bool) -> list[Layer]:
    return mirror.basis.mirror(grid, mirror.axis, mirror.index, mirror.side, even)
