"""A basis whose choices are those of another run: which cells' polynomials weight the points.

The answer of a run is smooth in a parameter only while points keep their polynomials. A run beside it that is
to tell a derivative takes them over, where its own points may lie just beyond a plane of the grid.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.grid import Grid
from ..geometry.planes import PlaneSpec
from .base import Basis, Chosen, Layer, Weights

_TOLD = tuple(name for name in Basis.__annotations__)


class Followed(Basis):
    """The functions of a basis, with choices that are put in at each reset.

    Attributes:
        like: the points' polynomials.
        places: ranks (n,) and cells (n, d) that carry the places of surfaces, by name; see `carriers`.
    """

    def __init__(self, basis: Basis):
        self._basis = basis
        for name in _TOLD:
            setattr(self, name, getattr(basis, name))
        self.like: Chosen | None = None
        self.places: Mapping[str, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def functions(self) -> int:
        return self._basis.functions

    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        return self._basis.lines(grid, x, cells)

    def curvatures(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        return self._basis.curvatures(grid, x, cells)

    def derivatives(self, grid: Grid, x: np.ndarray, cells: np.ndarray, orders: int) -> np.ndarray:
        return self._basis.derivatives(grid, x, cells, orders)

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        return self._basis.positions(grid, numbers)

    def extents(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        return self._basis.extents(grid, numbers)

    def domains(self, F: np.ndarray, half_length0: np.ndarray) -> np.ndarray:
        return self._basis.domains(F, half_length0)

    def at(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        return self._basis.at(grid, x, cells)

    def cells_of_groups(self, count: np.ndarray) -> np.ndarray:
        return self._basis.cells_of_groups(count)

    def mirror(self, grid: Grid, axis: int, index: int, side: int, even: bool) -> list[Layer]:
        return self._basis.mirror(grid, axis, index, side, even)

    def check_plane(self, plane: PlaneSpec, grid: Grid) -> None:
        self._basis.check_plane(plane, grid)

    # choices ----------------------------------------------------------------------------------------
    def of_rows(self, rows: np.ndarray | slice) -> Followed:
        """With the choices of some of the points."""
        out = Followed(self._basis)
        out.places = self.places
        if self.like is not None:
            c = self.like
            half = None if c.half_length is None else c.half_length[rows]
            out.like = Chosen(c.x[rows], half, c.cells[rows], c.lowest[rows], c.count[rows], c.orders)
        return out

    def supporting_cells(self, grid: Grid, x: np.ndarray) -> np.ndarray:
        return self._basis.supporting_cells(grid, x) if self.like is None else self.like.cells

    def patches(
        self, grid: Grid, x: np.ndarray, cells: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        return self._basis.patches(grid, x, self.supporting_cells(grid, x) if cells is None else cells)

    def carriers(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        return self.places.get(name)

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        if self.like is None:
            return self._basis.weights(grid, x, half_length, cells, orders)
        return self._basis.continued(grid, x, half_length, self.like)
