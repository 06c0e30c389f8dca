"""What the rest of the code asks of a basis: weights, positions of nodes, what its functions allow."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import MARGIN, Grid, box_indices
from ..geometry.planes import PlaneSpec
from ..kinematics.stretch import domain_half_length
from ..tools import checks
from .aggregation import supporting_cells


@dataclass
class Weights:
    """Weights of points in each direction; the weighting function is their product, T (2.28)-(2.30).

    Attributes:
        lowest: lattice index of the lowest node (n, d).
        count: number of nodes in each direction (n, d).
        table: values and gradients (1/m), and where asked for second derivatives (1/m^2), in each direction
           , (n, d, 2 or 3, slots); unused slots are zero.

    Raises:
        InputError: arrays that aren't so.
    """

    lowest: np.ndarray
    count: np.ndarray
    table: np.ndarray

    def __post_init__(self) -> None:
        try:
            lowest, count, table = (np.asarray(a) for a in (self.lowest, self.count, self.table))
        except (TypeError, ValueError, RuntimeError) as e:  # rows of several lengths, say
            raise InputError(f"Weights: arrays are needed: {e}") from e
        self.lowest, self.count, self.table = lowest, count, table
        fits = lowest.ndim == 2 and lowest.shape == count.shape == table.shape[:2] and table.ndim == 4
        fits = (
            fits
            and table.shape[2] in (2, 3)
            and table.dtype.kind == "f"
            and lowest.dtype.kind == count.dtype.kind == "i"
        )
        if not (fits and count.min(initial=1) >= 1 and count.max(initial=1) <= table.shape[3]):
            raise InputError(
                f"Weights: lowest {lowest.dtype} {lowest.shape}, count {count.dtype} {count.shape}, table "
                f"{table.dtype} {table.shape}: whole numbers (n, d), numbers of nodes (n, d) from 1 to "
                "slots, and (n, d, 2 or 3, slots) are needed"
            )
        if not np.isfinite(table.sum()):
            row = int(np.flatnonzero(~np.isfinite(table).all(axis=(1, 2, 3)))[0])
            raise InputError(f"Weights: table has a value in row {row} that isn't finite")

    def products(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """Lattice numbers of each point's nodes and their weights, (n, slots^d); unused slots weigh zero."""
        index = box_indices((self.table.shape[-1],) * grid.dim)
        numbers = grid.node_number(self.lowest)[:, None] + index @ grid.strides
        value = np.prod([self.table[:, i, 0, index[:, i]] for i in range(grid.dim)], axis=0)
        return numbers, value


@dataclass(frozen=True)
class Chosen:
    """Which polynomials weight points, for others near them (`Basis.continued`).

    Attributes:
        x: positions (n, d) (m); half_length: of the domains (n, d) (m), None where there are none.
        cells: from `supporting_cells` (n, d).
        lowest, count: as of the points' `Weights`.
        orders: as of `Basis.weights`.
    """

    x: np.ndarray
    half_length: np.ndarray | None
    cells: np.ndarray
    lowest: np.ndarray
    count: np.ndarray
    orders: int

    @classmethod
    def by(
        cls, basis: Basis, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, orders: int
    ) -> Chosen:
        """What a basis has chosen for points at x (n, d) (m). Collective."""
        cells = basis.supporting_cells(grid, x)
        w = basis.weights(grid, x, half_length, cells if basis.sliver else None, orders)
        return cls(x, half_length, cells, w.lowest, w.count, orders)


class Layer(NamedTuple):
    """Nodal values of a layer of nodes, across an axis, that are a multiple of those of another.

    Attributes:
        follower, leader: lattice indices of the layers along the axis.
        factor: the multiple.
    """

    follower: int
    leader: int
    factor: float


def patch_table(cells: int, size: int) -> np.ndarray:
    """Along a line of cells: the patch of each, and that patch's first cell and number of cells, (3, cells).
    Patches of two cells begin at both ends; of an odd number of cells one or three are left in the middle."""
    cell = np.arange(cells)
    if size != 2 or cells % 2 == 0:
        index = cell // size
        return np.stack([index, size * index, np.full(cells, size)])
    half = cells // 2
    sizes = [2] * (half // 2) + [1 + 2 * (half % 2)] + [2] * (half // 2)
    index = np.repeat(np.arange(len(sizes)), sizes)
    first = np.cumsum([0, *sizes[:-1]])
    return np.stack([index, first[index], np.array(sizes)[index]])


class Basis(ABC):
    """Functions on the lattice that weight material points; those of several directions are products.

    The functions of a cell are numbered like lattice nodes, the first one like the cell's lower corner: cell
    c has the functions c .. c + degree in each direction. To add a basis, derive from this class (`Splines`,
    if its functions are), say what differs from the defaults, and register it (`registry`).

    Attributes:
        name: which users write as `basis`.
        degree: of the functions in each direction; a cell has one more of them. At most 5.
        walls_only: values can be prescribed on the boundary planes of the grid only.
        gradients_jump: at the faces of cells, so that a ghost penalty has something to penalise.
        curvatures_jump: gradients don't, but second derivatives do, for a ghost penalty.
        no_projection: why the points' moments can't be projected on the quadrature points of cells; "": they
            can.
        locks: linear functions, which lock in bending and where volume is kept.
        sliver: largest thickness, in cells, of what fills a cell so little that its points are weighted with
            the functions of the cell behind it (`aggregation`); 0: there is no such thing.
        uses_domains: weights depend on the points' current domains, not on their positions alone.
        no_slope: why slopes can't be held on planes of the grid; "": they can (`mirror`).
        patch: cells in each direction of the patches over which stiff scalars are projected against locking;
            0: there are none that suit.
        patch_linear: with linear functions; else with constants.
        patch_stiffness: of what holds elastic points to their patch, over the shear modulus.
        costly: others reach the same error in less time (docs/accuracy.md), which problems say.
        fills_boxes: second derivatives are known (`curvatures`), so that points integrate over their own
            boxes.
        thin_reach: some points reach nodes by so little of their domains that balancing forces there by
            stresses would take stresses as large as the body's own (`assembly.carrying`).
    """

    name: str
    degree: int
    walls_only: bool = False
    gradients_jump: bool = False
    curvatures_jump: bool = False
    no_projection: str = ""
    no_slope: str = "it doesn't say which of its functions have a slope on a plane"
    locks: bool = False
    costly: bool = False
    sliver: float = 0.0
    uses_domains: bool = False
    thin_reach: bool = False
    fills_boxes: bool = False
    patch: int = 0
    patch_linear: bool = False
    patch_stiffness: float = 0.0

    @property
    def functions(self) -> int:
        """Functions of a cell in each direction."""
        return self.degree + 1

    @abstractmethod
    def lines(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Values and gradients (1/m) in each direction of the functions of cells of lattice index (n, d) at
        positions x (n, d) (m), continued beyond the cells: (n, d, 2, functions)."""

    def curvatures(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Second derivatives (1/m^2) in each direction, where `lines` gives values and gradients: (n, d,
        functions). Needed where the basis `fills_boxes`."""
        raise NotImplementedError(f"basis {self.name!r} has no second derivatives")

    def derivatives(self, grid: Grid, x: np.ndarray, cells: np.ndarray, orders: int) -> np.ndarray:
        """What `lines` gives, with `orders` 3 followed by `curvatures`: (n, d, orders, functions)."""
        table = self.lines(grid, x, cells)
        if orders == 2:
            return table
        return np.concatenate([table, self.curvatures(grid, x, cells)[:, :, None]], axis=2)

    def positions(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        """Positions (m), (n, d), of nodes of lattice numbers (n,): there nodal values of a linear field are
        the field's own."""
        return grid.node_position(numbers)

    def extents(self, grid: Grid, numbers: np.ndarray) -> np.ndarray:
        """Integrals (m), (n, d), of the functions of nodes of lattice numbers (n,) along each axis, as if the
        grid went on beyond its walls."""
        return grid.sizes_around(grid.node_position(numbers))

    def domains(self, F: np.ndarray, half_length0: np.ndarray) -> np.ndarray:
        """Half lengths (m), (n, d), of the domains over which points are weighted, from their deformation
        gradients (n, 3, 3) and initial half lengths (n, d) (m); asked for where `uses_domains`."""
        return domain_half_length(F, half_length0)

    def weights(
        self,
        grid: Grid,
        x: np.ndarray,
        half_length: np.ndarray | None = None,
        cells: np.ndarray | None = None,
        orders: int = 2,
    ) -> Weights:
        """Weights of points at x (n, d) (m). Collective.

        Args:
            half_length: of the domains (n, d) (m), from `domains`; needed where `uses_domains`.
            cells: lattice index (n, d) of the cells whose functions weight the points, from
                `supporting_cells`. Default: those that the points are in.
            orders: 3 for second derivatives, too, where the basis `fills_boxes`.

        Raises:
            InputError: domains reach too far beyond the grid.
        """
        lowest = grid.cells_of(x) if cells is None else cells
        table = self.derivatives(grid, x, lowest, orders)
        return Weights(lowest, np.full(x.shape, self.functions, dtype=np.int32), table)

    def continued(self, grid: Grid, x: np.ndarray, half_length: np.ndarray | None, like: Chosen) -> Weights:
        """Weights of points at x (n, d) (m) by the polynomials that weight others, near them: smooth in x and
        in the domains, as derivatives by a parameter want them.

        Args:
            half_length: of the domains (n, d) (m), from `domains`; needed where `uses_domains`.
        """
        return Weights(like.cells, like.count, self.derivatives(grid, x, like.cells, like.orders))

    def of_rows(self, rows: np.ndarray | slice) -> Basis:
        """The basis as some of the points see it, which may be all of a body among several."""
        return self

    def carriers(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Ranks (n,) and lattice index (n, d) of the cells that carry the places of a surface of a name,
        where that is settled; else the nearest ones do."""
        return None

    def at(self, grid: Grid, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Values and gradients (1/m) at x (n, d) (m) of the functions of cells of lattice index (n, d),
        continued beyond the cells: (n, 1 + d, functions^d), the last axis running fastest."""
        line, index = self.lines(grid, x, cells), box_indices((self.functions,) * grid.dim)

        def product(derivative: int) -> np.ndarray:
            out = np.ones((len(x), len(index)))
            for i in range(grid.dim):
                out *= line[:, i, int(i == derivative)][:, index[:, i]]
            return out

        return np.stack([product(k) for k in (-1, *range(grid.dim))], axis=1)

    def supporting_cells(self, grid: Grid, x: np.ndarray) -> np.ndarray:
        """Lattice index (n, d) of the cells whose functions weight all points at x (n, d) (m). Collective."""
        return supporting_cells(grid, x, self.sliver) if self.sliver else grid.cells_of(x)

    def patches(
        self, grid: Grid, x: np.ndarray, cells: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Lattice index (n, d) of the patches that points at x (n, d) (m) belong to, in patches, and the
        points' places over the patches' size. Mirrored bodies on a grid have mirrored patches. Collective.

        Args:
            cells: from `supporting_cells`; default: asked for here.
        """
        cells = self.supporting_cells(grid, x) if cells is None else cells
        tables = [patch_table(int(n), self.patch) for n in grid.shape]
        rows = [table[:, cells[:, axis]] for axis, table in enumerate(tables)]
        index, first, count = (np.stack([row[k] for row in rows], axis=1) for k in range(3))
        if grid.equal:
            places = (cells - first + grid.within(x, cells)) / self.patch
        else:  # linear functions are linear in space
            lower = grid.corners(first)
            places = (x - lower) / (grid.corners(first + count) - lower)
        return index, places

    def cells_of_groups(self, count: np.ndarray) -> np.ndarray:
        """Cells (m, d) in each direction, from the one of the lowest node on, on which groups of points with
        `count` (m, d) nodes in each direction have their weights."""
        return count - self.degree

    def mirror(self, grid: Grid, axis: int, index: int, side: int, even: bool) -> list[Layer]:
        """Layers of nodes that follow others where a field is mirrored at a plane of the grid.

        All nodes of points that a follower weights include its leader, so that nothing new is coupled. That
        the value of an odd field vanishes on the plane isn't said here. Default: none; a field without
        anything prescribed for its slope tends to what it has to be.

        Args:
            axis, index: lattice index of the plane along its axis.
            side: where the body isn't, -1 below the plane, 1 above.
            even: the field is the same on both sides, its slope vanishes on the plane; False: it changes its
                sign.
        """
        return []

    def check_plane(self, plane: PlaneSpec, grid: Grid) -> None:
        """Raise InputError for a plane of the grid on which this basis can't prescribe values."""
        if self.walls_only and plane.axis < grid.dim and not plane.is_wall(grid):
            raise InputError(
                f"plane {plane.name} is not a boundary plane of the grid; with basis = {self.name!r} allowed "
                f"are {grid.lower[plane.axis]:g} and {grid.upper[plane.axis]:g}"
            )


def check_basis(basis: Basis) -> None:
    """Try a basis on a few points of a small lattice.

    Raises:
        InputError: an attribute isn't what `Basis` says, or the functions aren't: other shapes, values that
            aren't finite or don't sum up to one, gradients that don't sum up to zero.
    """
    what = f"basis {type(basis).__name__}"
    checks.text(f"{what}: name", getattr(basis, "name", None))
    what = f"basis {basis.name!r}"
    checks.whole(f"{what}: degree", getattr(basis, "degree", None), least=1, most=5)
    checks.number(f"{what}: sliver", basis.sliver, least=0, below=1)
    jumps = ("gradients_jump", "curvatures_jump")
    for name in (*jumps, "walls_only", "locks", "uses_domains", "thin_reach", "fills_boxes"):
        checks.flag(f"{what}: {name}", getattr(basis, name))
    orders = 3 if basis.fills_boxes else 2
    for dim in (2, 3):
        grid = Grid.box((0.0,) * dim, (12.0,) * dim, 2.0, MPI.COMM_SELF)
        x = np.linspace(0.0, 12.0, 9 * dim).reshape(9, dim)
        cells = grid.cells_of(x)
        try:
            table = np.asarray(basis.derivatives(grid, x, cells, orders))
        except Exception as e:  # a user's class may raise anything
            if not checks.ordinary(e):
                raise
            raise InputError(f"{what}: its functions can't be evaluated: {type(e).__name__}: {e}") from e
        shape = (9, dim, orders, basis.functions)
        if table.shape != shape or table.dtype.kind != "f":
            raise InputError(
                f"{what}: functions of shape {table.shape} and type {table.dtype}; {shape} needed"
            )
        sums = table.sum(axis=3)
        if not (np.allclose(sums[:, :, 0], 1, atol=1e-9) and np.allclose(sums[:, :, 1:], 0, atol=1e-9)):
            raise InputError(
                f"{what}: the functions of a cell don't sum up to one, or their gradients to zero"
            )


def check_margin(grid: Grid, lowest: np.ndarray, last: np.ndarray) -> None:
    """Raise InputError unless the lattice has all nodes from index `lowest` (n, d) to `last` (n, d)."""
    if np.any(lowest < -MARGIN) or np.any(last > np.array(grid.shape) + MARGIN):
        raise InputError(f"point domains reach more than {MARGIN} cells beyond the grid")
