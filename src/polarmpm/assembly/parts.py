"""Parts of a body: what hangs together through the nodes that stresses act on. For diagnoses; collective."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..geometry.grid import box_indices
from ..geometry.nodes import Nodes
from ..kernels import native
from .elements import ElementSystem
from .loadedpoints import LoadedPoints
from .system import NodalSystem

_FELT = 1e-9  # weights, and gradients over a cell, below which a point doesn't feel a node
_CHUNK = 50_000  # points that are looked at at once

Sets = list[tuple[np.ndarray, np.ndarray]]  # rows of nodes (m, n), and which of them count (m, n)


@dataclass
class Parts:
    """Parts of a body, the same numbers on all ranks, the largest first.

    Attributes:
        nodes: number of the part of each node (nodes,); -1: no point feels it.
        points: number of the part of each of this rank's points (np,).
        count: points of each part (parts,).
        centre: mean position of its points (m), (parts, d).
        size: root of the mean square distance of its points from there (m), (parts,).
    """

    nodes: np.ndarray
    points: np.ndarray
    count: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, system: NodalSystem, points: Any) -> Parts:
        """Of a body whose current points these are."""
        comm, first = system.comm, np.zeros(len(points), dtype=np.int64)
        sets: Sets = []
        for rows, mask, at, which in _sets(system, points):
            sets.append((rows, mask))
            first[at] = rows[np.arange(len(rows)), mask.argmax(axis=1)][which]
        label = joined(len(system.nodes), sets)
        felt: np.ndarray = np.zeros(len(system.nodes), dtype=bool)
        for rows, mask in sets:
            felt[rows[mask]] = True
        block = system.layout.block
        everywhere = _over_ranks(comm, system.nodes, label, felt, block)
        of_points = everywhere[first]
        everywhere = _of_owners(system.nodes, everywhere, block)
        anywhere = np.tile(felt[:, None].astype(float), (1, block))
        system.nodes.add_to_owners(anywhere)
        felt = _of_owners(system.nodes, anywhere[:, 0] > 0, block) > 0
        found = _unique(comm, of_points)
        compact = _Compact(comm, found, of_points, points.x)
        return cls(
            np.where(felt, compact.number(everywhere), -1),
            compact.number(of_points),
            compact.count,
            compact.centre,
            compact.size,
        )


class _Compact:
    """Numbers of parts in the order of their points."""

    def __init__(self, comm: MPI.Comm, found: np.ndarray, of_points: np.ndarray, x: np.ndarray):
        at, n = np.searchsorted(found, of_points), len(found)
        sums = np.stack([np.bincount(at, w, n) for w in (np.ones(len(x)), *x.T, np.sum(x**2, axis=1))])
        sums = comm.allreduce(sums)
        order = np.argsort(-sums[0], kind="stable")
        self._found, self._place = found, np.argsort(order)
        sums = sums[:, order]
        self.count = sums[0].astype(np.int64)
        self.centre = (sums[1:-1] / sums[0]).T
        spread = sums[-1] / sums[0] - np.sum(self.centre**2, axis=1)
        self.size = np.sqrt(np.maximum(spread, 0.0))

    def number(self, labels: np.ndarray) -> np.ndarray:
        at = np.minimum(np.searchsorted(self._found, labels), len(self._found) - 1)
        number: np.ndarray = np.where(self._found[at] == labels, self._place[at], -1)
        return number


def joined(count: int, sets: Sets) -> np.ndarray:
    """Lowest node of those that hang together with each of `count` nodes, through sets of them."""
    label: np.ndarray = np.arange(count)
    flat = [(rows[mask], mask.sum(axis=1)) for rows, mask in sets]
    flat = [(nodes, numbers[numbers > 0]) for nodes, numbers in flat if len(nodes)]
    while True:
        before = label
        label = label.copy()
        for nodes, numbers in flat:
            starts = np.cumsum(numbers) - numbers
            lowest = np.repeat(np.minimum.reduceat(label[nodes], starts), numbers)
            np.minimum.at(label, label[nodes], lowest)
            np.minimum.at(label, nodes, lowest)
        label = label[label]
        if np.array_equal(label, before):
            return label


def _over_ranks(comm: MPI.Comm, nodes: Nodes, label: np.ndarray, felt: np.ndarray, block: int) -> np.ndarray:
    """Labels that hold on all ranks, of labels of local nodes that some local point feels."""
    if comm.size == 1:
        return label
    start = comm.exscan(len(label)) or 0
    here = label + start
    owners = _of_owners(nodes, here, block)  # a label of its own where the owner doesn't feel the node
    ghost = np.flatnonzero(felt)
    pairs = np.unique(np.stack([here[ghost], owners[ghost]], axis=1), axis=0)
    every = np.concatenate(comm.allgather(pairs))
    numbers, at = np.unique(every, return_inverse=True)
    rows = at.reshape(-1, 2)
    same = numbers[joined(len(numbers), [(rows, np.ones(rows.shape, dtype=bool))])]
    place = np.minimum(np.searchsorted(numbers, here), max(0, len(numbers) - 1))
    out: np.ndarray = here.copy()
    if len(numbers):
        out = np.where(numbers[place] == here, same[place], here)
    return out


def _of_owners(nodes: Nodes, values: np.ndarray, block: int) -> np.ndarray:
    """Whole numbers (nodes,), of ghosts the owners'."""
    told = np.tile(values[:, None].astype(float), (1, block))
    nodes.update_ghosts(told)
    return told[:, 0].astype(np.int64)


def _unique(comm: MPI.Comm, values: np.ndarray) -> np.ndarray:
    found: np.ndarray = np.unique(np.concatenate(comm.allgather(np.unique(values))))
    return found


def _sets(
    system: NodalSystem, points: Any
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Sets of nodes that points feel together: rows (m, n), which count (m, n), local points (k,), and the
    set of each."""
    if isinstance(system, ElementSystem):
        e = system.forms.elements
        rows = e.live_nodes.astype(np.int64)
        cells = np.repeat(np.arange(len(rows)), len(e.reference_points))
        yield rows, np.ones(rows.shape, dtype=bool), np.arange(len(points)), cells
        return
    assert isinstance(system, LoadedPoints)
    for batch in system.interpolation.batches:
        for rows, mask, at, which in _of_batch(batch.batch, system.length):
            yield rows, mask, batch.rows[at], which


def _of_batch(
    batch: native.Batch, length: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    kept = batch.kept
    counts, offsets, node_offsets = kept["count"], kept["offsets"], kept["node_offsets"]
    for size in np.unique(counts, axis=0):
        index = box_indices(tuple(int(n) for n in size))
        groups = np.flatnonzero(np.all(counts == size, axis=1))
        rows = kept["nodes"][node_offsets[groups][:, None] + np.arange(len(index))].astype(np.int64)
        number = np.diff(offsets)[groups]
        which = np.repeat(np.arange(len(groups)), number)
        at = np.arange(len(which)) + np.repeat(offsets[groups] - (np.cumsum(number) - number), number)
        mask = np.zeros(rows.shape, dtype=bool)
        for begin in range(0, len(at), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            np.logical_or.at(mask, which[part], _felt(kept["weights"][at[part]], index, length))
        yield rows, mask, at, which


def _felt(weights: np.ndarray, index: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Which nodes points feel (m, n), of weights (m, d, orders, slots) in each direction."""
    dim, orders = weights.shape[1:3]
    lines = [[weights[:, a, o][:, index[:, a]] * length[a] ** o for o in range(orders)] for a in range(dim)]
    if orders > 2:  # integrated over boxes: mixed derivatives count, too
        most = [np.max(np.abs(line), axis=0) for line in lines]
        felt: np.ndarray = np.prod(most, axis=0) > _FELT
        return felt
    found = np.abs(np.prod([line[0] for line in lines], axis=0))
    for a in range(dim):
        slope = np.prod([lines[b][int(a == b)] for b in range(dim)], axis=0)
        found = np.maximum(found, np.abs(slope))
    felt = found > _FELT
    return felt
