"""When a run takes another grid, and which: policies for `regrid=`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..bodies.selection import Selection, check_selection
from ..bodies.variation import largest_changes
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.lines import GROWTH, refined
from ..tools import checks

_FINE = 1.0 + 1e-6  # times h: cells that are fine
_FELT = 0.1  # share of the largest change of F from which on an axis is refined
_CELLS = 16  # of size h, the default margin on either side of what yields


@dataclass(frozen=True)
class Trial:
    """A step that has converged but isn't taken yet, at the local points.

    Attributes:
        reset_x: positions (np, d) (m) at the last reset.
        x, F: positions (np, d) (m) and deformation gradients (np, 3, 3) at its end.
        flowed: which have flowed in it, or before (np,).
    """

    reset_x: np.ndarray
    x: np.ndarray
    F: np.ndarray
    flowed: np.ndarray


class RegridPolicy(Protocol):
    """Decides on grids. Methods are collective, and answer alike on all ranks.

    Attributes:
        splits: its cells may be smaller than those of before, so that points are split.
        repeats: it may have steps taken again.
    """

    splits: bool
    repeats: bool

    def check(self, problem: Any) -> None:
        """Raise InputError for a problem that it can't be used in."""

    def at_reset(self, problem: Any) -> Grid | None:
        """The grid for the steps to come, at a reset; None: as it is."""

    def after_trial(self, problem: Any, trial: Trial) -> Grid | None:
        """The grid with which a step is to be taken again, from its beginning; None: the step is good."""


@dataclass(frozen=True)
class AlongBands:
    """Fine cells where the body yields: a step in which points flow in coarser cells isn't taken, but taken
    again in a grid that is fine there, so that nothing of the history comes from coarse cells.

    For micropolar and second-gradient materials, whose bands have a width. The fine zone has the points
    that have flowed, and grows with them; its lines go through the whole grid. It never becomes coarser.

    Args:
        h: size of the fine cells (m); a quarter of the material's length resolves a band.
        margin: of the fine zone on both sides of what has flowed (m); default 16 h. When less than half of it
            is left, the zone is extended.
        axes: those along which cells become finer, such as "y" or "xy"; default: those along which the
            deformation changes at least a tenth as fast as along the one where it changes fastest.
        growth: largest ratio of the sizes of two neighbours.
        keep: for axes, by their names, coordinates (m) that are to be lines, as of `lines_from`; planes of
            supports always are.

    Raises:
        InputError: an argument that isn't so.
    """

    h: float
    margin: float | None = None
    axes: str | None = None
    growth: float = GROWTH
    keep: Mapping[str, Sequence[float]] = field(default_factory=dict)
    splits = True
    repeats = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "h", checks.number("h", self.h, above=0.0))
        if self.margin is not None:
            object.__setattr__(self, "margin", checks.number("margin", self.margin, above=0.0))
        object.__setattr__(self, "growth", checks.number("growth", self.growth, above=1.0))
        object.__setattr__(self, "axes", _axes("axes", self.axes))
        object.__setattr__(self, "keep", _kept("keep", self.keep))

    def check(self, problem: Any) -> None:
        materials = [m for m in problem.points.materials if m.plastic]
        if not materials:
            raise InputError("regrid: AlongBands: none of the materials yields, so that there are no bands")
        local = [type(m).__name__ for m in materials if not (m.micropolar or m.second_gradient)]
        if local:
            raise InputError(
                f"regrid: AlongBands: {local[0]} of a classical material has no length, so that its bands "
                "are as thin as the cells; micropolar and second-gradient materials are allowed"
            )
        _check_names("axes", self.axes or (), problem.grid)
        _check_names("keep", self.keep, problem.grid)

    def at_reset(self, problem: Any) -> Grid | None:
        return None

    def after_trial(self, problem: Any, trial: Trial) -> Grid | None:
        comm, grid = problem.comm, problem.grid
        if not comm.allreduce(bool(np.any(trial.flowed)), op=MPI.LOR):
            return None
        margin = self.margin or _CELLS * self.h
        at, p = trial.reset_x[trial.flowed], problem.points
        reach = [_intervals(comm, at[:, axis], 0.5 * margin) for axis in range(grid.dim)]
        coarse = [axis for axis in range(grid.dim) if _coarse(grid.lines[axis], reach[axis], self.h)]
        wanted = self._refined(problem, trial, coarse)
        if not wanted:
            return None
        x = np.concatenate([p.x[trial.flowed], trial.x[trial.flowed]])
        now, lines = problem.regridding.now(problem), []
        for axis, name in enumerate("xyz"[: grid.dim]):
            zones = _fine_zones(now.lines[axis], self.h) if self._finer(problem, axis) else []
            if axis in wanted:
                zones += _intervals(comm, x[:, axis], margin)
            lines.append(_new_lines(problem, axis, zones, self.h, self.growth, self.keep.get(name, ())))
        return _graded(lines, comm)

    def _refined(self, problem: Any, trial: Trial, coarse: list[int]) -> list[int]:
        """Those of some axes along which cells are to become finer. Collective."""
        if self.axes is not None or not coarse:
            return [axis for axis in coarse if "xyz"[axis] in (self.axes or "")]
        p = problem.points
        found = largest_changes(problem.initial_grid, p.X, trial.F, p.X, p.volume0)
        most = [float(values.max()) for values in found]
        return [axis for axis in coarse if most[axis] >= _FELT * max(most)]

    def _finer(self, problem: Any, axis: int) -> bool:
        """Whether cells along an axis have become finer already."""
        given = problem.regridding.given_lines(problem, axis)
        return bool(problem.regridding.now(problem).smallest[axis] < 0.99 * np.diff(given).min())


@dataclass(frozen=True)
class FollowBody:
    """A grid that goes along with a body, or with a part of it.

    Without `h` the grid goes on with cells like those at its walls, where the body has come near to them: but
    for walls that supports hold, and axes along which planes move. With `h` cells are fine around the body,
    or the part, and as they were given elsewhere; where it has been, they become coarse again, but points
    that were split stay so.

    Args:
        margin: around the body (m); when less than half of it is left, the grid is changed at the next reset.
        h: size of the fine cells (m).
        part: points that the fine cells follow, such as those under a footing; default: all.
        axes: those along which cells become finer; default: all.
        growth: largest ratio of the sizes of two neighbours.
        keep: as of `AlongBands`.

    Raises:
        InputError: an argument that isn't so.
    """

    margin: float
    h: float | None = None
    part: Selection | None = None
    axes: str | None = None
    growth: float = GROWTH
    keep: Mapping[str, Sequence[float]] = field(default_factory=dict)
    repeats = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "margin", checks.number("margin", self.margin, above=0.0))
        if self.h is not None:
            object.__setattr__(self, "h", checks.number("h", self.h, above=0.0))
        elif self.part is not None or self.axes is not None:
            raise InputError("FollowBody: h: a size of fine cells is needed beside part and axes")
        if self.part is not None:
            check_selection(self.part)
        object.__setattr__(self, "growth", checks.number("growth", self.growth, above=1.0))
        object.__setattr__(self, "axes", _axes("axes", self.axes))
        object.__setattr__(self, "keep", _kept("keep", self.keep))

    @property
    def splits(self) -> bool:
        return self.h is not None

    def check(self, problem: Any) -> None:
        _check_names("axes", self.axes or (), problem.grid)
        _check_names("keep", self.keep, problem.grid)
        if self.part is not None:
            problem.points.check(self.part)
            if not len(self.part):
                raise InputError("FollowBody: part: the selection contains no point")

    def at_reset(self, problem: Any) -> Grid | None:
        grid, lines, changed = problem.regridding.now(problem), [], False
        whole, part = _bounds(problem.points, None), _bounds(problem.points, self.part)
        for axis, name in enumerate("xyz"[: grid.dim]):
            now = grid.lines[axis]
            ends = _extended(problem, axis, now, whole[:, axis], self.margin)
            changed |= ends is not now
            if self.h is None:
                lines.append(ends)
                continue
            low, high = part[:, axis]
            follow = self.axes is None or name in self.axes
            near = [(low - 0.5 * self.margin, high + 0.5 * self.margin)]
            changed |= follow and _coarse(now, near, self.h)
            zones = [(low - self.margin, high + self.margin)] if follow else []
            lines.append(_new_lines(problem, axis, zones, self.h, self.growth, self.keep.get(name, ()), ends))
        return _graded(lines, problem.comm) if changed else None

    def after_trial(self, problem: Any, trial: Trial) -> Grid | None:
        return None


@dataclass
class ByFunction:
    """A script's function: of the problem, asked at each reset; or of the problem and a trial, asked after
    each step that has converged, before it is taken."""

    function: Any
    repeats: bool
    splits = True

    def check(self, problem: Any) -> None:
        pass

    def at_reset(self, problem: Any) -> Grid | None:
        return None if self.repeats else self._other(problem, problem.regridding.now(problem))

    def after_trial(self, problem: Any, trial: Trial) -> Grid | None:
        return self._other(problem, problem.grid, trial) if self.repeats else None

    def _other(self, problem: Any, now: Grid, *more: Trial) -> Grid | None:
        """What the function returns, unless it is the grid that there is."""
        found = self.function(problem, *more)
        if found is None:
            return None
        checks.instance("regrid: what the function returns", found, Grid, "a Grid, or None, is")
        same = found.shape == now.shape and all(
            bool(np.all(np.abs(a - b) <= 1e-9 * np.diff(b).min()))
            for a, b in zip(found.lines, now.lines, strict=True)
        )
        return None if same else found


def make_policy(regrid: Any) -> RegridPolicy | None:
    """A policy, or a function of the problem, or of the problem and a `Trial`, that returns a grid or None.

    Raises:
        InputError: something else.
    """
    if regrid is None or all(hasattr(regrid, name) for name in ("check", "at_reset", "after_trial")):
        found: RegridPolicy | None = regrid
        return found
    what = "AlongBands(h=...), FollowBody(margin=...), a function of the problem, or None is"
    function = checks.function("regrid", regrid, what)
    try:
        checks.function("regrid", regrid, what, takes=("problem",))
    except InputError as refused:
        try:
            checks.function("regrid", regrid, what, takes=("problem", "trial"))
        except InputError:
            raise refused from None
        return ByFunction(function, repeats=True)
    return ByFunction(function, repeats=False)


# arguments --------------------------------------------------------------------------------------------
def _axes(name: str, value: Any) -> str | None:
    if value is None:
        return None
    if not isinstance(value, str) or not value or not set(value) <= set("xyz"):
        raise checks.refuse(name, value, "names of axes, such as 'y' or 'xy', are needed")
    return value


def _kept(name: str, value: Any) -> dict[str, tuple[float, ...]]:
    if not isinstance(value, Mapping) or not set(value) <= set("xyz"):
        raise checks.refuse(name, value, "coordinates by the names of axes, {'x': [1.0]}, are needed")
    found = {}
    for axis, given in value.items():
        a = np.atleast_1d(checks.numeric(f"{name} {axis}", given, "coordinates (m)"))
        if a.ndim != 1 or not np.all(np.isfinite(a)):
            raise checks.refuse(f"{name} {axis}", given, "coordinates (m) are needed")
        found[axis] = tuple(map(float, a))
    return found


def _check_names(name: str, axes: Any, grid: Grid) -> None:
    beyond = [axis for axis in axes if "xyz".index(axis) >= grid.dim]
    if beyond:
        raise InputError(f"regrid: {name}: {beyond[0]!r}, but the grid has {grid.dim} dimensions")


# lines ------------------------------------------------------------------------------------------------
def _intervals(comm: MPI.Intracomm, x: np.ndarray, margin: float) -> list[tuple[float, float]]:
    """Intervals (from, to) (m) within a margin of places (n,) of all ranks. Collective."""
    x = np.unique(np.concatenate(comm.allgather(_thinned(x, margin))))
    if not len(x):
        return []
    gaps = np.flatnonzero(np.diff(x) > 2.0 * margin)
    starts, ends = x[np.r_[0, gaps + 1]], x[np.r_[gaps, len(x) - 1]]
    return [(float(a - margin), float(b + margin)) for a, b in zip(starts, ends, strict=True)]


def _thinned(x: np.ndarray, margin: float) -> np.ndarray:
    """Places without those that lie between two others which are near enough to each other."""
    x = np.unique(x)
    if len(x) < 3:
        return x
    between = x[2:] - x[:-2] <= margin
    while np.any(between):
        keep = np.ones(len(x), dtype=bool)
        keep[1:-1] = ~between
        keep[1:-1:2] = True  # every other one stays, so that gaps don't add up
        if np.all(keep):
            break
        x = x[keep]
        if len(x) < 3:
            break
        between = x[2:] - x[:-2] <= margin
    return x


def _coarse(lines: np.ndarray, intervals: Sequence[tuple[float, float]], h: float) -> bool:
    """Whether a cell within intervals is larger than h."""
    size = np.diff(lines)
    large = size > _FINE * h
    return any(bool(np.any(large & (lines[:-1] < b) & (lines[1:] > a))) for a, b in intervals)


def _fine_zones(lines: np.ndarray, h: float) -> list[tuple[float, float]]:
    """Intervals whose cells are of size h."""
    fine = np.concatenate([[False], np.diff(lines) <= _FINE * h, [False]])
    edges = np.flatnonzero(fine[1:] != fine[:-1])
    return [(float(lines[a]), float(lines[b])) for a, b in edges.reshape(-1, 2)]


def _new_lines(
    problem: Any,
    axis: int,
    zones: Sequence[tuple[float, float]],
    h: float,
    growth: float,
    keep: Sequence[float],
    ends: np.ndarray | None = None,
) -> np.ndarray:
    """Lines as the given grid's, and fine in zones; `ends`: the present ones, where they have gone on beyond
    the walls."""
    base: np.ndarray = problem.regridding.given_lines(problem, axis)
    if ends is not None:
        near = 0.5 * min(base[1] - base[0], base[-1] - base[-2])
        base = np.concatenate([ends[ends < base[0] - near], base, ends[ends > base[-1] + near]])
    low, high = base[0], base[-1]
    inside = [(max(a, low), min(b, high)) for a, b in zones if min(b, high) > max(a, low)]
    if not inside:
        return base
    kept = [*problem.regridding.lines_to_keep(problem, axis), *keep]
    return refined(base, inside, h, growth, kept)


def _extended(problem: Any, axis: int, lines: np.ndarray, body: np.ndarray, margin: float) -> np.ndarray:
    """Lines that go on beyond walls that nothing holds, where a body from `body[0]` to `body[1]` (m) has come
    near; the lines themselves where it hasn't."""
    if problem.regridding.moves(problem, axis):
        return lines
    held = problem.regridding.lines_to_keep(problem, axis)
    parts = [lines]
    for wall, step, at in (
        (lines[0], lines[0] - lines[1], body[0]),
        (lines[-1], lines[-1] - lines[-2], body[1]),
    ):
        left = (wall - at) * np.sign(step)
        if left >= 0.5 * margin or any(abs(wall - v) < 1e-6 * abs(step) for v in held):
            continue
        number = max(1, int(np.ceil((margin - left) / abs(step))))
        more = wall + step * np.arange(1, number + 1)
        parts = [more[::-1], *parts] if step < 0 else [*parts, more]
    return np.concatenate(parts) if len(parts) > 1 else lines


def _bounds(points: Any, part: Selection | None) -> np.ndarray:
    """Lower and upper corner (2, d) (m) of the boxes of points. Collective."""
    rows, d = points.rows(part), points.dim
    reach = np.einsum("pij,pkj->pki", points.F[rows, :d, :d], points.half_axes0[rows])
    reach = np.maximum(np.abs(reach).sum(axis=1), points.half_length[rows])
    x = points.x[rows]
    ends = np.stack([(x - reach).min(axis=0, initial=np.inf), -(x + reach).max(axis=0, initial=-np.inf)])
    points.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MIN)
    return np.stack([ends[0], -ends[1]])


def _graded(lines: Sequence[np.ndarray], comm: MPI.Intracomm) -> Grid:
    along: dict[str, Any] = dict(zip("xyz", lines, strict=False))
    return Grid.graded(**along, comm=comm)
