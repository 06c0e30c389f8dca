"""Contributions to the nodal system that don't come from the stresses of a body."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from ..geometry.grid import Grid


@dataclass(frozen=True)
class Boxes:
    """Boxes of lattice nodes.

    Attributes:
        count: nodes in each direction.
        first: lattice number of each box's lowest node (m,).
    """

    count: tuple[int, ...]
    first: np.ndarray

    @cached_property
    def offsets(self) -> np.ndarray:
        """Lattice distance of a box's nodes from its lowest one, (n, d)."""
        index = np.stack(np.meshgrid(*map(np.arange, self.count), indexing="ij"), axis=-1)
        return index.reshape(-1, len(self.count))

    def numbers(self, grid: Grid) -> np.ndarray:
        """Lattice numbers of the nodes (m, n)."""
        return self.first[:, None] + self.offsets @ grid.strides


class Term(Protocol):
    """One contribution between two resets.

    Attributes:
        name: under which its work is summed.
        boxes: where it acts.
        pairs: components (i, j) that it couples, (k, 2).
        symmetric: its tangent is symmetric.
        linear: its tangent doesn't change until the next reset.
        external: a load or a support; its forces count as such in the convergence measure.
    """

    name: str
    boxes: Boxes
    pairs: np.ndarray
    symmetric: bool
    linear: bool
    external: bool

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Residual forces (m, n, b) at increments since the reset (m, n, b)."""

    def matrices(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of the forces' components i by increments' components j, (m or 1, n, n, k)."""

    def commit(self, x: np.ndarray) -> None:
        """Take note of the increments (m, n, b) of a converged step. Collective."""


class TermSource(Protocol):
    """What makes terms at a reset."""

    def begin(self) -> None:
        """A reset: increments count from the present state."""

    def terms(self, grid: Grid, reached: np.ndarray) -> list[Term]:
        """Terms from now on; `reached` holds the lattice numbers of the cells that this rank's points reach,
        ascending. Collective."""


def multiply(pairs: np.ndarray, matrices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products (m, n, b) of matrices (m or 1, n, n, k) and values (m, n, b)."""
    parts = np.einsum("maqk,mqk->mak", matrices, x[:, :, pairs[:, 1]])
    out = np.zeros_like(x)
    for k, i in enumerate(pairs[:, 0]):
        out[:, :, i] += parts[:, :, k]
    return out
