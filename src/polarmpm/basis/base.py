"""What a basis gives, and their names."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.grid import MARGIN, Grid

BASES = ("gimpm", "mpm", "bspline")


@dataclass
class Weights:
    """Weights of points in each direction; the weighting function is their product, T (2.28)-(2.30).

    Attributes:
        first: lattice index of the first node (n, d).
        count: number of nodes in each direction (n, d).
        table: values and gradients (1/m), (n, d, 2, slots); unused slots are zero.
    """

    first: np.ndarray
    count: np.ndarray
    table: np.ndarray

    def products(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Lattice numbers of each point's nodes and their weights, (n, slots^d); unused slots weigh zero."""
        slots = self.table.shape[-1]
        index = np.stack(np.unravel_index(np.arange(slots**grid.dim), (slots,) * grid.dim), axis=-1)
        numbers = grid.node_number(self.first)[:, None] + index @ grid.strides
        value = np.prod([self.table[:, i, 0, index[:, i]] for i in range(grid.dim)], axis=0)
        return numbers, value


def check_basis(basis: str) -> str:
    """Raise InputError for an unknown basis."""
    if basis not in BASES:
        raise InputError(f"basis = {basis!r}: allowed are {', '.join(BASES)}")
    return basis


def check_margin(grid: Grid, first: np.ndarray, last: np.ndarray) -> None:
    if np.any(first < -MARGIN) or np.any(last > np.array(grid.shape) + MARGIN):
        raise InputError(f"point domains reach more than {MARGIN} cells beyond the grid")
