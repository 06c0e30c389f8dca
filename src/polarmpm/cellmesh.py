"""Cells of the lattice as a dolfinx mesh, for output and for forms on the grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import _compat
from .grid import Grid
from .nodes import ActiveNodes
from .parallel import Route


def occupied_cells(grid: Grid, x: np.ndarray) -> np.ndarray:
    """Lattice numbers, ascending, of the cells that contain points x (n, d); each on one rank. Collective."""
    mine = np.unique(grid.cell_number(grid.cells_of(x)))
    if grid.comm.size == 1:
        return mine
    return np.unique(Route(grid.comm, mine % grid.comm.size).forward(mine))


def corner_numbers(grid: Grid, cells: np.ndarray) -> np.ndarray:
    """Lattice numbers of the cells' corners (m, 2^d), the first axis running fastest (dolfinx' order)."""
    corner = np.array([[(k >> axis) & 1 for axis in range(grid.dim)] for k in range(2**grid.dim)])
    return cells[:, None] + corner @ grid.strides


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
    """Mesh of the cells with the given lattice numbers, each given by one rank. Collective."""
    corners = corner_numbers(grid, cells)
    nodes = ActiveNodes.build(grid, np.unique(corners))
    table = nodes.number[nodes.local(corners.ravel())].reshape(corners.shape).astype(np.int64)
    name = "quadrilateral" if grid.dim == 2 else "hexahedron"
    return CellMesh(_compat.create_mesh(grid.comm, table, nodes.position[: nodes.owned].copy(), name), nodes)
