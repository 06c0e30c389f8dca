"""Rigid bodies in a system's tangent: what the nodes' increments do to them, and they to the nodes.

Where the place q of a body follows from the increments x, as forces on it are in balance, the residual
r(x, q(x)) has the tangent K - B D^-1 C, with B = dr/dq, and C and D the derivatives of the body's forces by x
and q. K keeps its sparsity; the rest, of low rank, is put in by a few more solutions with the factor of K
(Woodbury's formula).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import numpy as np


class Condensed:
    """The matrix -B D^-1 C beside the nodes' own tangent.

    Args:
        to_nodes: B, as (k, nodes, b), complete on owned rows.
        to_bodies: C, as (k, nodes, b), this rank's part, ghosts included.
        inverse: of D (k, k).
        owned: number of nodes that this rank owns.
    """

    def __init__(
        self, to_nodes: np.ndarray, to_bodies: np.ndarray, inverse: np.ndarray, owned: int, comm: MPI.Comm
    ):
        self.to_nodes, self.to_bodies, self.inverse = to_nodes, to_bodies, inverse
        self.owned, self.comm = owned, comm
        self._moved: np.ndarray | None = None  # K^-1 B

    def _forces(self, x: np.ndarray) -> np.ndarray:
        """C x of increments (..., nodes, b), ghosts included. Collective."""
        parts = np.tensordot(self.to_bodies, x, axes=((1, 2), (-2, -1)))
        sums: np.ndarray = np.sum(self.comm.allgather(parts), axis=0)
        return sums

    def product(self, x: np.ndarray) -> np.ndarray:
        """B D^-1 C x (nodes, b) of increments (nodes, b). Collective."""
        found: np.ndarray = np.tensordot(self.inverse @ self._forces(x), self.to_nodes, axes=1)
        return found

    def completed(self, step: np.ndarray, solve: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Of a solution (nodes, b) with K that with the whole tangent. Collective.

        Args:
            solve: with K for forces (nodes, b).
        """
        if self._moved is None:
            self._moved = np.stack([solve(column) for column in self.to_nodes])
        coupled = np.eye(len(self.inverse)) - self.inverse @ self._forces(self._moved)
        shares = np.linalg.solve(coupled, self.inverse @ self._forces(step))
        found: np.ndarray = step + np.tensordot(shares, self._moved, axes=1)
        return found


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Square matrices along a diagonal."""
    size = sum(len(block) for block in blocks)
    out, at = np.zeros((size, size)), 0
    for block in blocks:
        out[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return out
