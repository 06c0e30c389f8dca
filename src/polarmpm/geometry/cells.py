"""Cells of the lattice as a dolfinx mesh, for output and for forms on the grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..tools import compat
from ..tools.parallel import lowest_ranks, sharing_ranks
from .grid import Grid
from .nodes import ActiveNodes


def occupied_cells(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Lattice numbers, ascending, of the cells that contain points x (n, d). Collective.

    Each is on one rank, the lowest of those that have points in it.
    """
    mine: np.ndarray = np.unique(grid.cell_number(grid.cells_of(x)))
    return mine if grid.comm.size == 1 else mine[lowest_ranks(grid.comm, mine) == grid.comm.rank]


def unit_corners(dim: int) -> np.ndarray:
    """Corners of the unit box as lattice steps (2^d, d), the first axis running fastest (dolfinx' order)."""
    return np.array([[(k >> axis) & 1 for axis in range(dim)] for k in range(2**dim)])


def corner_numbers(grid: Grid, cells: np.ndarray) -> np.ndarray:
    """Lattice numbers of the cells' corners (m, 2^d), the first axis running fastest (dolfinx' order)."""
    corners: np.ndarray = cells[:, None] + unit_corners(grid.dim) @ grid.strides
    return corners


@dataclass
class CellMesh:
    """A dolfinx mesh of lattice cells.

    Attributes:
        mesh: the mesh; it costs nothing for cells that aren't in it.
        nodes: its nodes in the lattice.
    """

    mesh: Any
    nodes: ActiveNodes


def cell_mesh(grid: Grid, cells: np.ndarray) -> CellMesh:
    """Mesh of the cells with the given lattice numbers, each given by one rank, which owns it. Collective."""
    corners = corner_numbers(grid, cells)
    nodes = ActiveNodes.build(grid, np.unique(corners))
    local = nodes.local(corners.ravel())
    table = nodes.number[local].reshape(corners.shape).astype(np.int64)
    most = 2**grid.dim  # cells at a node
    sharing = sharing_ranks(grid.comm, nodes.lattice, most)[local].reshape(len(cells), most * most)
    name = "quadrilateral" if grid.dim == 2 else "hexahedron"
    positions = nodes.position[: nodes.owned].copy()
    return CellMesh(compat.create_mesh(grid.comm, table, positions, name, sharing), nodes)
