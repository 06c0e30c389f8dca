"""The background grid: a Cartesian lattice of box cells.

The lattice is only arithmetic: cells and nodes exist as integer triples (pairs in plane strain), so empty
space costs nothing. `geometry.cells` presents the cells that matter as a dolfinx mesh.

Where the grid's planes are is asked through `sizes`, `corners`, `position`, `local`, `within` and `plane`: no
other module knows whether they are equidistant (`Grid.box`) or not (`Grid.graded`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, TrustWarning
from ..tools import checks
from ..tools.caller import warn
from ..tools.parallel import communicator_named, name_of
from .axes import STEEP, Axes, checked_lines, equal_size, evened, steepest

# Lattice nodes outside the box that points' domains may reach: they belong to walls ("at and beyond").
MARGIN = 4
_SLACK = 1e-9  # of a cell, by which points may be outside
_FAR = 1e12  # cells from the origin of coordinates, where rounding is a ten-thousandth of a cell


@dataclass(frozen=True)
class Grid:
    """Box-shaped lattice; build it with `Grid.box` or `Grid.graded`.

    Attributes:
        origin: lower corner (m), shape (d,).
        cell: cell sizes (m), shape (d,), means where lines are graded; other modules ask for `sizes`,
            `smallest` or `largest`.
        shape: number of cells in each direction.
        comm: MPI communicator of all that lives on the grid.

    A grid never changes, so that copies of it are the grid itself. It can be pickled on COMM_WORLD and
    COMM_SELF.

    Raises:
        InputError: an attribute that isn't so.
    """

    origin: tuple[float, ...]
    cell: tuple[float, ...]
    shape: tuple[int, ...]
    comm: MPI.Comm = field(default_factory=lambda: MPI.COMM_WORLD)

    def __post_init__(self) -> None:
        if type(self) is Grid:  # lattices with lines of their own may have no cell size
            self._check()

    def _check(self) -> None:
        origin = checks.numeric("origin", self.origin, "the lower corner")
        if origin.shape not in ((2,), (3,)):
            raise checks.refuse("origin", self.origin, "two or three coordinates (m) are needed")
        dim = origin.size
        origin = checks.vector("origin", origin, dim)
        cell = checks.vector("cell", self.cell, dim, f"a size for each of {dim} axes")
        if np.any(cell <= 0):
            raise checks.refuse("cell", self.cell, "sizes (m) must be positive")
        shape = checks.sequence("shape", self.shape, dim, "numbers of cells")
        shape = tuple(checks.whole("shape", n, least=1) for n in shape)
        if math.prod(n + 2 * MARGIN + 1 for n in shape) > 2**62:
            raise checks.refuse("cell", self.cell, "the lattice has more than 2^62 nodes")
        away = np.maximum(np.abs(origin), np.abs(origin + cell * shape)) / cell
        if not np.all(away < _FAR):
            raise checks.refuse(
                "cell", self.cell, f"at {away.max():.3g} cells from the origin rounding moves points in them"
            )
        checks.communicator("comm", self.comm)
        for name, value in (("origin", origin.tolist()), ("cell", cell.tolist()), ("shape", shape)):
            object.__setattr__(self, name, tuple(value))

    @classmethod
    def box(
        cls,
        lower: Sequence[float],
        upper: Sequence[float],
        cell: float | Sequence[float],
        comm: MPI.Comm = MPI.COMM_WORLD,
    ) -> Grid:
        """Lattice of the box from `lower` to `upper` (m) with cells of size `cell` (m; one or for each axis).

        Raises:
            InputError: not two or three coordinates, an empty box, a cell that does not divide it, cells too
                small for their distance from the origin, or no communicator.
        """
        lo, up = checks.numeric("lower", lower), checks.numeric("upper", upper)
        if lo.shape not in ((2,), (3,)) or up.shape != lo.shape:
            raise InputError(
                f"lower = {checks.shown(lower)}, upper = {checks.shown(upper)}: two or three coordinates each"
            )
        h = checks.numeric("cell", cell)
        if h.shape not in ((), lo.shape) or not np.all(np.isfinite(h)) or np.any(h <= 0):
            raise checks.refuse("cell", cell, f"one positive size, or one for each of {lo.size} axes")
        h = np.broadcast_to(h, lo.shape)
        if not np.all(np.isfinite(lo) & np.isfinite(up)) or np.any(up <= lo):
            raise checks.refuse(
                "upper", upper, f"must exceed lower = {checks.shown(lower)} in every direction, and be finite"
            )
        with np.errstate(over="ignore"):
            length = up - lo
            number = length / h
        whole = np.rint(number)
        for axis in range(lo.size):
            if number[axis] < 2.0**62 and not 0 < whole[axis] >= abs(number[axis] - whole[axis]) * 1e8:
                raise InputError(
                    f"cell = {h[axis]:g} does not divide the box along {'xyz'[axis]}: "
                    f"{length[axis]:g} / {h[axis]:g} = {number[axis]:g}; whole numbers are allowed"
                )
        if math.fsum(np.log2(whole + 2.0 * MARGIN + 1.0)) > 62:
            raise checks.refuse("cell", cell, "the lattice has more than 2^62 nodes")
        return cls(
            tuple(map(float, lo)),
            tuple(float(x) for x in length / whole),
            tuple(int(n) for n in whole),
            comm,
        )

    @classmethod
    def graded(
        cls,
        x: Sequence[float],
        y: Sequence[float],
        z: Sequence[float] | None = None,
        comm: MPI.Comm = MPI.COMM_WORLD,
    ) -> Grid:
        """Lattice with any increasing lines along each axis: fine where it matters, coarse elsewhere.

        Lines that are equidistant along all axes make the lattice that `Grid.box` makes, to the same digits.
        `pm.lines` and `pm.lines_from` help with the lines.

        Args:
            x, y, z: coordinates (m) of the lines across each axis, the grid's walls included; z in space.

        Warns:
            TrustWarning: neighbours whose sizes differ by more than a factor of three.

        Raises:
            InputError: lines that don't increase (the message names the line), cells too small for their
                distance from the origin, or no communicator.
        """
        given = {"x": x, "y": y} | ({} if z is None else {"z": z})
        lines = {name: checked_lines(name, value) for name, value in given.items()}
        comm = checks.communicator("comm", comm)
        if math.fsum(math.log2(len(a) + 2.0 * MARGIN) for a in lines.values()) > 62:
            raise checks.refuse("x, y, z", [len(a) for a in lines.values()], "more than 2^62 nodes")
        for name, a in lines.items():
            ratio, k = steepest(a)
            if ratio > STEEP * (1.0 + 1e-9):
                warn(
                    f"{name}: the cells on both sides of line {k} at {a[k]:.6g} differ by a factor of "
                    f"{ratio:.3g}; beyond {STEEP:g} the error of the larger one spoils what the smaller one "
                    "is for. pm.lines makes lines that grow smoothly",
                    TrustWarning,
                )
        axes, shape = tuple(map(evened, lines.values())), tuple(len(a) - 1 for a in lines.values())
        origin, mean = (
            tuple(float(v) for v in values)
            for values in ([a[0] for a in axes], [(a[-1] - a[0]) / (len(a) - 1) for a in axes])
        )
        if all(equal_size(a) is not None for a in axes):
            return Grid(origin, mean, shape, comm)
        return GradedGrid(origin, mean, shape, comm, tuple(tuple(map(float, a)) for a in axes))

    def __repr__(self) -> str:
        rows = (" x ", self.shape), (" x ", self.cell), (", ", self.lower), (", ", self.upper)
        cells, sizes, lower, upper = (join.join(f"{v:.6g}" for v in values) for join, values in rows)
        return f"<Grid: {cells} cells of {sizes} m, from ({lower}) to ({upper}) m>"

    def __copy__(self) -> Grid:
        return self  # nothing of it ever changes

    def __deepcopy__(self, memo: dict[int, Any]) -> Grid:
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "comm": name_of(self.comm)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({**state, "comm": communicator_named(state["comm"])})

    @property
    def dim(self) -> int:
        return len(self.shape)

    @property
    def lower(self) -> tuple[float, ...]:
        """Lower corner (m)."""
        return self.origin

    @property
    def upper(self) -> tuple[float, ...]:
        """Upper corner (m)."""
        return tuple(self.plane(axis, n) for axis, n in enumerate(self.shape))

    def description(self) -> dict[str, tuple[float, ...]]:
        """What tells this lattice from others, by name; for files."""
        return {"origin": self.origin, "cell": self.cell, "shape": self.shape}

    def part(self, lower: np.ndarray, upper: np.ndarray) -> Grid:
        """The lattice of the cells from index `lower` (d,) up to `upper` (d,), which isn't in it."""
        lower, upper = np.asarray(lower, dtype=np.int64), np.asarray(upper, dtype=np.int64)
        origin, shape = self.corners(lower), upper - lower
        made = object.__new__(type(self))  # unchecked, as it may be empty
        made.__dict__.update(
            {**self.__dict__, "origin": tuple(map(float, origin)), "shape": tuple(map(int, shape))}
        )
        return made

    def stretched(self, axis: int, index: int, anchor: int, at: float) -> Grid:
        """This lattice stretched evenly along an axis, its plane `anchor` staying and its plane `index` at
        the coordinate `at` (m).

        Raises:
            InputError: the plane would lie on the one that stays, or beyond it.
        """
        stays = self.plane(axis, anchor)
        cell = (at - stays) / (index - anchor)
        if not cell > 1e-6 * self.cell[axis]:
            raise InputError(f"plane {'xyz'[axis]} = {at:g} has reached the wall {stays:g} of the grid")
        origin = self.origin[axis] if anchor == 0 else stays - anchor * cell

        def changed(values: tuple[float, ...], value: float) -> tuple[float, ...]:
            return (*values[:axis], value, *values[axis + 1 :])

        return replace(self, origin=changed(self.origin, origin), cell=changed(self.cell, cell))

    # lines --------------------------------------------------------------------------------------
    @property
    def equal(self) -> bool:
        """Whether all cells have the same size."""
        return True

    @property
    def lines(self) -> tuple[np.ndarray, ...]:
        """Coordinates (m) of the lines across each axis, walls included: for each axis (cells + 1,)."""
        return tuple(
            np.array([self.plane(axis, i) for i in range(n + 1)]) for axis, n in enumerate(self.shape)
        )

    @property
    def smallest(self) -> tuple[float, ...]:
        """Size (m) of the smallest cells in each direction, (d,)."""
        return self.cell

    @property
    def largest(self) -> tuple[float, ...]:
        """Size (m) of the largest cells in each direction, (d,)."""
        return self.cell

    def sizes(self, index: np.ndarray) -> np.ndarray:
        """Sizes (m) of the cells of lattice index (n, d), (n, d); not to be written to."""
        return np.broadcast_to(np.array(self.cell), np.shape(index))

    def sizes_around(self, x: np.ndarray) -> np.ndarray:
        """Sizes (m), (n, d), of the cells at positions x (n, d) (m); on planes the mean of both sides."""
        xi = snap(self.local(x))
        above = np.floor(xi).astype(np.int64)
        below = np.where(above == xi, above - 1, above)
        mean: np.ndarray = 0.5 * (self.sizes(above) + self.sizes(below))
        return mean

    def corners(self, index: np.ndarray) -> np.ndarray:
        """Lower corners (m) of the cells of lattice index (n, d), (n, d)."""
        return self.position(index)

    def plane(self, axis: int, index: int) -> float:
        """Coordinate (m) along an axis of its plane number `index`."""
        return self.origin[axis] + index * self.cell[axis]

    def planes_of(self, axis: int) -> str:
        """Where the planes across an axis are; for messages."""
        return f"{self.origin[axis]:g} + k {self.cell[axis]:g} up to {self.upper[axis]:g}"

    def position(self, xi: np.ndarray) -> np.ndarray:
        """Coordinates (m), (n, d), of lattice coordinates (n, d); the inverse of `local`."""
        x: np.ndarray = np.array(self.origin) + xi * np.array(self.cell)
        return x

    def local(self, x: np.ndarray) -> np.ndarray:
        """Lattice coordinates (n, d) of positions x (n, d) (m): cells from the lower corner."""
        xi: np.ndarray = (x - np.array(self.origin)) / np.array(self.cell)
        return xi

    def within(self, x: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Coordinates (n, d) of positions x (n, d) (m) in the cells of lattice index (n, d): 0 at the lower
        face, 1 at the upper one, continued beyond them."""
        r: np.ndarray = self.local(x) - index
        return r

    # lattice ------------------------------------------------------------------------------------
    @cached_property
    def _sides(self) -> np.ndarray:
        return np.array([n + 1 + 2 * MARGIN for n in self.shape], dtype=np.int64)

    @cached_property
    def strides(self) -> np.ndarray:
        """Step of the node number for one cell in each direction; the last axis runs fastest."""
        sides = self._sides
        return np.array([int(np.prod(sides[i + 1 :])) for i in range(self.dim)], dtype=np.int64)

    @property
    def numbers(self) -> int:
        """Lattice numbers of a body's nodes: those of body b begin at b times this."""
        return math.prod(int(n) for n in self._sides)

    def of_bodies(self, index: np.ndarray, body: np.ndarray) -> np.ndarray:
        """Indices (n, d) whose `node_number` is that of bodies (n,), each with a copy of the lattice."""
        moved = np.array(index, dtype=np.int64)
        moved[:, 0] += self._sides[0] * np.asarray(body, dtype=np.int64)
        return moved

    def node_number(self, index: np.ndarray) -> np.ndarray:
        """Lattice number of nodes (n, d), counted from the origin; MARGIN nodes beyond each wall exist."""
        number: np.ndarray = (np.asarray(index, dtype=np.int64) + MARGIN) @ self.strides
        return number

    def node_index(self, number: np.ndarray) -> np.ndarray:
        """Inverse of `node_number`: (n,) -> (n, d), of whatever body (`of_bodies`)."""
        rest, out = np.asarray(number, dtype=np.int64) % self.numbers, []
        for stride in self.strides:
            out.append(rest // stride - MARGIN)
            rest = rest % stride
        return np.stack(out, axis=-1)

    def node_position(self, number: np.ndarray) -> np.ndarray:
        """Coordinates (m) of nodes, (n, d)."""
        return self.position(self.node_index(number))

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Which points (n, d) lie in the box, its boundary included."""
        mask = np.ones(len(x), dtype=bool)
        for along, number in zip(self.local(x).T, self.shape, strict=True):
            mask &= (along >= -_SLACK) & (along <= number + _SLACK)
        return mask

    def cell_number(self, index: np.ndarray) -> np.ndarray:
        """Lattice number of cells (n, d): the number of their lowest node."""
        return self.node_number(index)

    def cells_of(self, x: np.ndarray) -> np.ndarray:
        """Lattice index (n, d) of the cell that contains each point; the upper cell on an inner face."""
        snapped = snap(self.local(x))
        cells: np.ndarray = np.clip(np.floor(snapped).astype(np.int64), 0, np.array(self.shape) - 1)
        return cells


@dataclass(frozen=True, repr=False)
class GradedGrid(Grid):
    """A lattice whose cells have several sizes; `Grid.graded` makes it.

    Attributes:
        planes: coordinates (m) of the lines across each axis.
    """

    planes: tuple[tuple[float, ...], ...] = ()

    def __repr__(self) -> str:
        cells = " x ".join(map(str, self.shape))
        sizes = " x ".join(f"{s:.6g} ... {g:.6g}" for s, g in zip(self.smallest, self.largest, strict=True))
        lower, upper = (", ".join(f"{v:.6g}" for v in corner) for corner in (self.lower, self.upper))
        return f"<Grid: {cells} cells of {sizes} m, from ({lower}) to ({upper}) m>"

    def description(self) -> dict[str, tuple[float, ...]]:
        return {"shape": self.shape} | {f"lines {'xyz'[i]}": a for i, a in enumerate(self.planes)}

    def part(self, lower: np.ndarray, upper: np.ndarray) -> Grid:
        made = object.__new__(GradedGrid)  # unchecked, as it may be empty
        planes = tuple(a[int(i) : int(j) + 1] for a, i, j in zip(self.planes, lower, upper, strict=True))
        shape = tuple(len(a) - 1 for a in planes)
        cell = tuple((a[-1] - a[0]) / max(len(a) - 1, 1) for a in planes)
        known = {"origin": tuple(a[0] for a in planes), "cell": cell, "shape": shape, "comm": self.comm}
        made.__dict__.update({**known, "planes": planes})
        return made

    def stretched(self, axis: int, index: int, anchor: int, at: float) -> Grid:
        old = np.array(self.planes[axis])
        ratio = (at - old[anchor]) / (old[index] - old[anchor])
        if not ratio > 1e-6:
            raise InputError(f"plane {'xyz'[axis]} = {at:g} has reached the wall {old[anchor]:g} of the grid")
        new = old[anchor] + ratio * (old - old[anchor])
        new[index] = at
        planes = tuple(tuple(map(float, new)) if k == axis else a for k, a in enumerate(self.planes))
        mean = tuple((a[-1] - a[0]) / (len(a) - 1) for a in planes)
        return replace(self, origin=tuple(a[0] for a in planes), cell=mean, planes=planes)

    @cached_property
    def _axes(self) -> Axes:
        return Axes(self.planes, MARGIN)

    @property
    def equal(self) -> bool:
        return False

    @property
    def lines(self) -> tuple[np.ndarray, ...]:
        return tuple(np.array(a) for a in self.planes)

    @property
    def smallest(self) -> tuple[float, ...]:
        return tuple(float(size.min()) for size in self._axes.sizes_of)

    @property
    def largest(self) -> tuple[float, ...]:
        return tuple(float(size.max()) for size in self._axes.sizes_of)

    def sizes(self, index: np.ndarray) -> np.ndarray:
        return self._axes.sizes(index)

    def corners(self, index: np.ndarray) -> np.ndarray:
        return self._axes.corners(index)

    def plane(self, axis: int, index: int) -> float:
        return float(self._axes.planes[axis][index + MARGIN])

    def planes_of(self, axis: int) -> str:
        a = [f"{v:g}" for v in self.planes[axis]]
        return ", ".join(a if len(a) <= 12 else [*a[:9], "...", *a[-2:]])

    def position(self, xi: np.ndarray) -> np.ndarray:
        return self._axes.position(xi)

    def local(self, x: np.ndarray) -> np.ndarray:
        return self._axes.local(x)

    def within(self, x: np.ndarray, index: np.ndarray) -> np.ndarray:
        r: np.ndarray = (x - self.corners(index)) / self.sizes(index)
        return r


def box_indices(count: Sequence[int]) -> np.ndarray:
    """Indices (m, d) in a box of `count` nodes or cells in each direction, the last axis running fastest."""
    count = tuple(int(n) for n in count)
    return np.stack(np.unravel_index(np.arange(math.prod(count)), count), axis=-1)


def snap(xi: np.ndarray, tolerance: float = 1e-8) -> np.ndarray:
    """Put lattice coordinates that are within rounding of a grid plane exactly on it."""
    near = np.rint(xi)
    return np.where(np.abs(xi - near) < tolerance, near, xi)
