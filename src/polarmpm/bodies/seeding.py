"""Filling a body with material points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError, PointsOutsideGrid, TrustWarning
from ..geometry.grid import Grid, box_indices
from ..materials.base import Material, check_material
from ..tools import checks
from ..tools.machine import check_memory
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, known_anywhere, reduced, warn_on_one_rank
from .cutboxes import half_axes, inside_parts
from .partition import distribute
from .points import Points
from .revolution import check_axisymmetric, turned

_CHUNK = 1_000_000  # positions tested at once
_MOST = 2**32  # candidates of a rank: minutes to hours of search
_BYTES = 300  # of a point until a problem is made of it
_GAUSS = 100  # points a direction of Gauss' rule
_SEEN = {2: 11, 3: 9}  # parts of a cell a direction, by the dimension
_STAIRCASE = 0.1  # change of a thin body's second moments by boxes that aren't cut, above which it's told
_ROUNDING = 1e-9  # of a box's half lengths: bounds that near to its faces are on them

Inside = Callable[[np.ndarray], np.ndarray]


@collective("seed", comm=lambda grid, *args, **options: grid.comm, compare=True)
def seed(
    grid: Grid,
    inside: Inside | None = None,
    *,
    material: Material,
    points_per_cell: int | Sequence[int] = 2,
    bounds: tuple[Sequence[float], Sequence[float]] | None = None,
    layout: str = "uniform",
    cut: bool = True,
    axisymmetric: bool = False,
) -> Points:
    """Seed lattice cells with points and keep what is inside the body. Collective.

    Each cell is divided into boxes, one a point. A box that the body's surface cuts becomes a point at the
    centroid of its part inside, with the volume and the second moments of that part: the points have the
    body's volume, centroid and second moments, those of `bounds` exactly. Boxes are halved in each direction
    where there is no whole one in a cell and those around it. Details thinner than an eighth of a cell in the
    plane, and a sixth in space, or than a third of a box may be missed.

    Args:
        grid: background grid.
        inside: predicate of positions (n, d) -> (n,) bool; None keeps all within `bounds`.
        material: of all these points.
        points_per_cell: points in each direction of a cell, one number or one for each axis.
        bounds: lower and upper corner (m) of a box around the body, or without `inside` of the body itself;
            only its cells are searched. Default: the attribute `bounds` of `inside` where it has one, else
            the whole grid.
        layout: "uniform" (equal boxes) or "gauss" (Gauss-Legendre positions and volumes, which integrate
            squares already: the boxes have no half axes, and aren't cut).
        cut: False keeps whole boxes whose centres are inside, as in the papers; the body's volume is then
            only met on average (a `TrustWarning` where they are another body).
        axisymmetric: the body is one of revolution about the axis x = 0, of which this is the section: a
            point stands for the ring that its box becomes by a whole turn, with the ring's volume.

    Raises:
        InputError: an argument is out of range, no point lies inside the body, or more points or candidates
            than this machine can have. What `inside` itself raises is raised on its rank, and as
            `ErrorOnAnotherRank` on the others.
    """
    checks.instance("grid", grid, Grid, "a background grid, such as Grid.box makes it, is")
    check_material(material, grid.dim)
    per_cell = _points_per_cell(points_per_cell, grid.dim)
    xi, share = _cell_layout(layout, per_cell)
    if inside is not None:
        checks.function("inside", inside, "a predicate of positions is", takes=("x",))
    cut = checks.flag("cut", cut)
    corners = _corners(grid, bounds)
    searched = _searched(
        grid, corners if bounds is not None else _corners(grid, getattr(inside, "bounds", None))
    )
    _check_number(searched, len(xi), points_per_cell, everything=inside is None)
    body = _Body(inside, corners, cut and layout == "uniform", _parts(per_cell))
    made = _found(_Candidates(searched, per_cell, xi, share), body)
    made.axes = made.axes if layout == "uniform" else np.zeros_like(made.axes)
    _check_found(grid, made, "bounds" if inside is None else "inside")
    _warn_of_staircase(searched, per_cell, body, made)
    points = made.points(material, grid.comm, checks.flag("axisymmetric", axisymmetric))
    points.lattices = () if grid.equal else ((grid, per_cell),)
    distribute(grid, points)
    return points


def _check_found(grid: Grid, made: _Boxes, of: str) -> None:
    """Raise InputError where there is no point; `of` says where the body is. Collective."""
    if not grid.comm.allreduce(len(made.x)):
        raise InputError(
            f"{of}: none of the candidate points between {grid.lower} and {grid.upper} is in the body"
        )


def _warn_of_staircase(searched: Grid, per_cell: np.ndarray, body: _Body, made: _Boxes) -> None:
    """Warn where a staircase of boxes is another body than what is cut of them. Collective.

    A surface that is moved, on the whole, by a share v of a body's thickness changes its second moments by
    3 v; one that is moved to and fro by a share s changes them by 3 s^2.
    """
    if body.inside is None or body.cut:
        return
    boxes = _Candidates(searched, per_cell, *_cell_layout("uniform", per_cell))
    exact = _found(boxes, replace(body, cut=True))
    with errors_on_all_ranks(searched.comm):
        x, _, volume = boxes.at(of := np.unique(exact.of))
        part = np.bincount(np.searchsorted(of, exact.of), exact.volume, minlength=len(of))
        amiss = np.abs(np.where(_keep(x, body.inside, None), volume, 0.0) - part).sum() if len(of) else 0.0
    sums = np.array([exact.volume.sum(), made.volume.sum(), amiss])
    searched.comm.Allreduce(MPI.IN_PLACE, sums)
    moved, scattered = sums[1] / sums[0] - 1.0, sums[2] / sums[0]
    if 3.0 * (abs(moved) + scattered**2) > _STAIRCASE:
        warn_on_one_rank(
            searched.comm,
            f"seed: boxes that aren't cut make a staircase, {100 * moved:+.1f} % of the body's volume away "
            f"from it, and {100 * scattered:.0f} % of it amiss: a thin body bends differently by more than a "
            "tenth; take cut=True with layout='uniform', or more points a cell",
            TrustWarning,
        )


def _searched(grid: Grid, around: tuple[np.ndarray, np.ndarray] | None) -> Grid:
    """The cells of a box, or all."""
    lower, upper = _cells_within(grid, around)
    return grid.part(lower, np.maximum(upper, lower))


def _parts(per_cell: np.ndarray) -> int:
    """Into how many parts a direction a box is divided to see where the body is: few points a cell must not
    overlook a thin body."""
    return max(3, math.ceil(_SEEN[len(per_cell)] / int(per_cell.min())))


@dataclass
class _Boxes:
    """Points to be: positions (n, d), volumes (n,), half lengths (n, d) and half axes (n, d, d); numbers (n,)
    of the candidates, and whether the body's surface, known by a predicate, cuts these (n,)."""

    x: np.ndarray
    volume: np.ndarray
    half: np.ndarray
    axes: np.ndarray
    of: np.ndarray
    cut: np.ndarray

    @classmethod
    def none(cls, dim: int) -> _Boxes:
        return cls.along_grid(
            np.zeros((0, dim)), np.zeros(0), np.zeros((0, dim)), np.zeros(0, dtype=np.int64)
        )

    @classmethod
    def joined(cls, parts: Sequence[_Boxes]) -> _Boxes:
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def rows(self, rows: np.ndarray) -> _Boxes:
        return _Boxes(*(getattr(self, f.name)[rows] for f in fields(self)))

    def points(self, material: Material, comm: MPI.Comm, axisymmetric: bool) -> Points:
        """Points with these boxes, or with the rings that they become by a turn. Collective."""
        volume = self.volume
        if axisymmetric:
            with errors_on_all_ranks(comm):
                check_axisymmetric(self.x, material)
            volume = turned(volume, self.x)
        return Points(
            self.x, volume, self.half, material, comm, half_axes=self.axes, axisymmetric=axisymmetric
        )

    @classmethod
    def along_grid(cls, x: np.ndarray, volume: np.ndarray, half: np.ndarray, of: np.ndarray) -> _Boxes:
        return cls(x, volume, half, half[:, None, :] * np.eye(x.shape[1]), of, np.zeros(len(x), dtype=bool))


@dataclass
class _Body:
    """What is to be filled: a predicate, or bounds, or neither."""

    inside: Inside | None
    bounds: Any
    cut: bool
    parts: int  # of a box in each direction, on whose corners the predicate is asked

    def chunk(self, dim: int) -> int:
        """Boxes to be treated at once."""
        return _CHUNK // ((self.parts + 1) ** dim if self.cut and self.inside is not None else 1)

    def boxes(self, x: np.ndarray, half: np.ndarray, volume: np.ndarray, of: np.ndarray) -> _Boxes:
        """What is inside of boxes around x (n, d) with half lengths (n, d), volumes (n,) and numbers (n,)."""
        if not self.cut:
            keep = _keep(x, self.inside, self.bounds)
            return _Boxes.along_grid(x[keep], volume[keep], half[keep], of[keep])
        if self.inside is None:
            if self.bounds is None:
                return _Boxes.along_grid(x, volume, half, of)
            return _clipped(x, half, volume, of, self.bounds)
        part = inside_parts(x, half, lambda y: _keep(y, self.inside, None), self.parts)
        kept = part.kept
        made = _Boxes.along_grid(part.centre, volume[kept] * part.share, half[kept], of[kept])
        covariance = part.covariance[part.cut]
        made.axes[part.cut] = half_axes(covariance)
        made.half[part.cut] = np.sqrt(3.0 * np.einsum("nii->ni", covariance))
        made.cut = part.cut
        return made


def _clipped(x: np.ndarray, half: np.ndarray, volume: np.ndarray, of: np.ndarray, bounds: Any) -> _Boxes:
    """Boxes cut by bounds that are the body itself; sides that rounding would move stay."""
    least = _ROUNDING * half
    low, high = np.maximum(x - half, np.asarray(bounds[0])), np.minimum(x + half, np.asarray(bounds[1]))
    keep = np.all(high - low > least, axis=1)
    x, half, volume, of, low, high, least = (a[keep] for a in (x, half, volume, of, low, high, least))
    clipped = 2.0 * half - (high - low) > least
    length = np.where(clipped, 0.5 * (high - low), half)
    return _Boxes.along_grid(
        np.where(clipped, 0.5 * (low + high), x), volume * np.prod(length / half, axis=1), length, of
    )


@dataclass
class _Candidates:
    """Boxes in the cells searched, numbered cell by cell: `per_cell` (d,) of each, at places xi (k, d) with
    shares (k,) of its volume."""

    searched: Grid
    per_cell: np.ndarray
    xi: np.ndarray
    share: np.ndarray

    def __post_init__(self) -> None:
        self.span = np.array(self.searched.shape)
        self.axes = np.argsort(-self.span, kind="stable")  # the longest one varies slowest: ranks get slices

    def cells(self, of: np.ndarray) -> np.ndarray:
        """Lattice index (n, d) of the cells of boxes of these numbers (n,)."""
        number = np.unravel_index(of // len(self.xi), self.span[self.axes])
        return np.stack(number, axis=1)[:, np.argsort(self.axes)]

    def at(self, of: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres (n, d), half lengths (n, d) and volumes (n,) of boxes of these numbers (n,)."""
        index, k = self.cells(of), of % len(self.xi)
        sizes = self.searched.sizes(index)
        volume = self.share[k] * np.prod(sizes, axis=1)
        return self.searched.position(index + self.xi[k]), 0.5 * sizes / self.per_cell, volume


def _found(candidates: _Candidates, body: _Body) -> _Boxes:
    """What is inside of this rank's share of the candidates, in the order of the ids. Collective."""
    comm, dim, each = candidates.searched.comm, candidates.searched.dim, len(candidates.xi)
    cells = int(np.prod(candidates.span))
    start, stop = (each * (cells * r // comm.size) for r in (comm.rank, comm.rank + 1))
    step = max(1, body.chunk(dim) // each) * each
    found, number_found = [_Boxes.none(dim)], 0
    with errors_on_all_ranks(comm):
        for begin in range(start, stop, step):
            of = np.arange(begin, min(begin + step, stop))
            found.append(body.boxes(*candidates.at(of), of))
            number_found += len(found[-1].x)
            check_memory("points_per_cell", candidates.per_cell.tolist(), number_found * _BYTES)
    made = _Boxes.joined(found)
    thin = np.flatnonzero(_is_thin(candidates, made))
    if not comm.allreduce(len(thin)):
        return made
    with errors_on_all_ranks(comm):
        finer = _halved(candidates, body, made.of[thin])
        check_memory("points_per_cell", candidates.per_cell.tolist(), (len(made.x) + len(finer.x)) * _BYTES)
    both = _Boxes.joined([made.rows(np.setdiff1d(np.arange(len(made.x)), thin)), finer])
    return both.rows(np.argsort(both.of, kind="stable"))


def _is_thin(candidates: _Candidates, made: _Boxes) -> np.ndarray:
    """Which boxes are parts of a body that holds no whole box in their cell and those around it, (n,).
    Collective."""
    comm, searched = candidates.searched.comm, candidates.searched
    thin = made.cut.copy()
    if not comm.allreduce(int(thin.any())):
        return thin
    number = searched.cell_number(candidates.cells(made.of))
    whole, cut = np.unique(number[~thin]), np.unique(number[thin])
    around = (box_indices((3,) * searched.dim) - 1) @ searched.strides
    near = known_anywhere(comm, whole, (cut[:, None] + around).ravel()).reshape(len(cut), len(around))
    thin[thin] = ~np.any(near, axis=1)[np.searchsorted(cut, number[thin])]
    return thin


def _halved(candidates: _Candidates, body: _Body, of: np.ndarray) -> _Boxes:
    """What is inside of the halves in each direction of boxes of these numbers."""
    dim, body = candidates.searched.dim, replace(body, parts=max(3, math.ceil(body.parts / 2)))
    side = box_indices((2,) * dim) - 0.5
    step, found = max(1, body.chunk(dim) // len(side)), [_Boxes.none(dim)]
    for begin in range(0, len(of), step):
        some = of[begin : begin + step]
        x, half, volume = candidates.at(some)
        x = (x[:, None] + side * half[:, None]).reshape(-1, dim)
        half, volume = (np.repeat(a, len(side), axis=0) for a in (0.5 * half, volume / len(side)))
        found.append(body.boxes(x, half, volume, np.repeat(some, len(side))))
    return _Boxes.joined(found)


def _points_per_cell(value: Any, dim: int) -> np.ndarray:
    allowed = f"a positive whole number, or {dim} of them; at most {_CHUNK:.0e} points a cell"
    several = checks.several(value)
    if several and len(value) != dim:
        raise checks.refuse("points_per_cell", value, allowed)
    number = [
        checks.whole("points_per_cell", n, least=1, most=_CHUNK, allowed=allowed)
        for n in (value if several else [value] * dim)
    ]
    if math.prod(number) > _CHUNK:
        raise checks.refuse("points_per_cell", value, allowed)
    return np.array(number, dtype=np.int64)


def _check_number(searched: Grid, per_cell: int, given: Any, *, everything: bool) -> None:
    """Raise InputError for more candidates than can be asked about, or than fit into memory as points."""
    number = math.prod(searched.shape) * per_cell
    name = "points_per_cell"
    if number > _MOST * searched.comm.size:
        raise checks.refuse(
            name, given, f"{number:.4g} candidates in {math.prod(searched.shape):.4g} cells; at most "
            f"{_MOST:.4g} a rank are allowed: `bounds` around the body, or a smaller grid, save the search"
        )  # fmt: skip
    if everything:
        check_memory(name, given, number // searched.comm.size * _BYTES)


def _cell_layout(layout: str, per_cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the unit cell (n, d) and shares of its volume (n,)."""
    checks.choice("layout", layout, ("uniform", "gauss"))
    if layout == "uniform":
        rules = [((np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)) for n in per_cell]
    else:
        if per_cell.max() > _GAUSS:
            raise checks.refuse("points_per_cell", per_cell.tolist(), f"at most {_GAUSS} with layout='gauss'")
        raw = [np.polynomial.legendre.leggauss(int(n)) for n in per_cell]
        rules = [((1.0 + a) / 2.0, w / 2.0) for a, w in raw]
    xi = np.stack(np.meshgrid(*(r[0] for r in rules), indexing="ij"), axis=-1).reshape(-1, len(rules))
    share: np.ndarray = np.ones(())
    for _, w in rules:
        share = np.multiply.outer(share, w)
    return xi, share.ravel()


def _corners(grid: Grid, bounds: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Two corners (d,) (m) of a box in the grid; None: there is no box."""
    if bounds is None:
        return None
    given = checks.sequence("bounds", bounds, 2, f"corners of {grid.dim} coordinates")
    lower, upper = (checks.numeric("bounds", b, "two corners") for b in given)
    if lower.shape != (grid.dim,) or upper.shape != (grid.dim,) or not np.all(upper > lower):
        what = f"two corners of {grid.dim} coordinates, the second above the first"
        raise checks.refuse("bounds", bounds, what)
    if not np.all(grid.inside(np.stack([lower, upper]))):
        raise InputError(
            f"bounds = {checks.shown(bounds)} reach outside the grid from {grid.lower} to {grid.upper}"
        )
    return lower, upper


def _cells_within(grid: Grid, bounds: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
    """First and last cell (exclusive) of a box."""
    shape = np.array(grid.shape)
    if bounds is None:
        return np.zeros(grid.dim, dtype=np.int64), shape
    low = np.floor(grid.local(bounds[0][None])[0] + 1e-9).astype(np.int64)
    high = np.ceil(grid.local(bounds[1][None])[0] - 1e-9).astype(np.int64)
    return np.clip(low, 0, shape), np.clip(high, 0, shape)


def _keep(x: np.ndarray, inside: Inside | None, bounds: Any) -> np.ndarray:
    if inside is None:
        if bounds is None:
            return np.ones(len(x), dtype=bool)
        within: np.ndarray = np.all((x >= np.asarray(bounds[0])) & (x <= np.asarray(bounds[1])), axis=1)
        return within
    return checks.mask("inside", inside(x.copy()), len(x))  # it may change what it is given


def check_inside(grid: Grid, points: Points) -> None:
    """Raise PointsOutsideGrid, on every rank, unless all points lie in the grid."""
    outside = ~grid.inside(points.x)
    count = reduced(grid.comm, int(np.count_nonzero(outside)))
    if count:
        ids = np.concatenate(grid.comm.allgather(points.id[outside][:20]))
        lower, upper = (tuple(round(v, 9) for v in c) for c in (grid.lower, grid.upper))
        raise PointsOutsideGrid(np.sort(ids).tolist(), count, f"from {lower} to {upper} m")
