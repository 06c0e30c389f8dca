"""Grid lines from a run on a coarse grid that has been finished: fine where its strains change most."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..bodies.variation import largest_changes
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.lines import GROWTH, STEEPNESS, number_between, spread
from ..geometry.planes import Plane
from ..problems.points import QuasiStatic
from ..tools import checks
from ..tools.meetings import collective

_PARTS = 8  # of the pilot's cells between which sizes are linear
_FLAT = 1e-6  # of the largest indicator: nothing changes there


def _comm(pilot: Any, *args: Any, **options: Any) -> Any:
    return checks.instance("pilot", pilot, QuasiStatic, "a run of material points is").comm


@collective("indicator", comm=_comm)
def indicator(pilot: QuasiStatic) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """How fast the deformation gradient changes along each axis. Collective.

    Of the means of F in the cells of the undeformed body, the largest change from a cell to the next one
    along the axis over the distance of their centroids.

    Returns:
        For each axis, by its name: coordinates (m) of the pilot's lines (n,), and the largest |dF/dX_i| (1/m)
        in the whole row of cells around each of them (n,).

    Raises:
        InputError: no problem of material points, or one that has made no step yet.
    """
    _comm(pilot)
    if not pilot.progress.step:
        raise InputError("pilot: has made no step yet; march it to the end first")
    grid, p = pilot.initial_grid, pilot.points
    values = largest_changes(grid, p.X, p.F, p.X, p.volume0)
    return {name: (grid.lines[axis], values[axis]) for axis, name in enumerate("xyz"[: grid.dim])}


@collective("lines_from", comm=_comm, compare=True)
def lines_from(
    pilot: QuasiStatic,
    *,
    cells: int | Sequence[int],
    fine: float | Sequence[float],
    growth: float = GROWTH,
    keep: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, np.ndarray]:
    """Lines for `Grid.graded(**lines)` from a finished run on a coarse grid. Collective.

    Sizes of cells go with one over the root of the `indicator`, as far as `fine` and `growth` let them. The
    planes of the pilot's supports stay lines.

    Args:
        pilot: marched to the end; it may have few points a cell.
        cells: how many are wanted along each axis, one number or one for each; about.
        fine: smallest size (m) that is allowed, one or one for each axis.
        growth: largest ratio of the sizes of two neighbours.
        keep: for axes, by their names, more coordinates (m) that are to be lines: {"x": [1.0]}.

    Returns:
        For each axis, by its name, increasing coordinates (m).

    Raises:
        InputError: an argument that isn't so, or a pilot that has made no step.
    """
    found = indicator(pilot)
    dim, grid = len(found), pilot.initial_grid
    wanted = [checks.whole("cells", n, least=1) for n in _several("cells", cells, dim)]
    least = [checks.number("fine", v, above=0.0) for v in _several("fine", fine, dim)]
    growth = checks.number("growth", growth, above=1.0)
    kept = _kept_lines(pilot, keep)
    return {
        name: _lines_along(grid, axis, found[name][1], kept[name], wanted[axis], least[axis], growth)
        for axis, name in enumerate(found)
    }


def _several(name: str, value: Any, dim: int) -> Sequence[Any]:
    return checks.sequence(name, value, dim, "numbers") if checks.several(value) else [value] * dim


def _kept_lines(pilot: QuasiStatic, keep: Any) -> dict[str, list[float]]:
    """Coordinates of lines that stay, by axis: planes of supports, and what the script says."""
    grid = pilot.initial_grid
    names = "xyz"[: grid.dim]
    out: dict[str, list[float]] = {name: [] for name in names}
    for support in pilot.supports:
        where = support.where
        if isinstance(where, Plane):
            out[names[where.axis]].append(grid.plane(where.axis, where.index))
    if keep is not None and not (isinstance(keep, Mapping) and set(keep) <= set(names)):
        raise checks.refuse("keep", keep, f"coordinates by the names of axes, {', '.join(names)}")
    for name, values in (keep or {}).items():
        a, axis = np.atleast_1d(checks.numeric(f"keep {name}", values)), names.index(name)
        low, high = grid.lower[axis], grid.upper[axis]
        if a.ndim != 1 or not np.all((a >= low) & (a <= high)):
            raise checks.refuse(f"keep {name}", values, f"coordinates (m) from {low:g} to {high:g}")
        out[name] += map(float, a)
    return out


def _lines_along(
    grid: Grid, axis: int, value: np.ndarray, kept: list[float], cells: int, fine: float, growth: float
) -> np.ndarray:
    coordinates = grid.lines[axis]
    size, length = np.diff(coordinates), coordinates[-1] - coordinates[0]
    ends = [coordinates[0], coordinates[-1]]
    for place in kept:
        if min(abs(place - e) for e in ends) > 1e-9 * length:
            ends.append(place)
    around = np.maximum(value[1:], value[:-1])  # of the pilot's cells
    root = np.sqrt(np.maximum(around, _FLAT * max(around.max(), np.finfo(float).tiny)))
    x = np.concatenate(
        [
            [coordinates[0]],
            (coordinates[:-1, None] + size[:, None] * np.arange(1, _PARTS + 1) / _PARTS).ravel(),
        ]
    )
    x[-1] = coordinates[-1]
    for shrink in range(200):
        for steepness in STEEPNESS:
            slope = steepness * math.log(growth)
            h = _sizes(x, root, cells, fine, slope, length) * 0.95**shrink
            made = spread(np.sort(ends), [None] * (len(ends) - 1), x, h, growth)
            if made is not None:
                return made
    raise InputError(f"keep: lines along {'xyz'[axis]} are too near to each other for growth = {growth:g}")


def _sizes(
    x: np.ndarray, root: np.ndarray, cells: int, fine: float, slope: float, length: float
) -> np.ndarray:
    """Sizes (m) at places x that make about so many cells."""
    low, high = fine * root.min(), length * root.max() + fine * root.max()
    for _ in range(60):
        scale = math.sqrt(low * high)
        h = _limited(x, np.clip(scale / root, fine, length), slope)
        if number_between(x, h, x[0], x[-1]) > cells:
            low = scale
        else:
            high = scale
    return h


def _limited(x: np.ndarray, size: np.ndarray, slope: float) -> np.ndarray:
    """Sizes of the pilot's cells at places x, which grow by no more than a slope from one place to others."""
    h = np.full(len(x), np.inf)
    per = np.repeat(size, _PARTS)
    h[:-1], h[1:] = np.minimum(h[:-1], per), np.minimum(h[1:], per)
    h[:-1] = np.minimum(h[:-1], per)
    for k in range(1, len(x)):
        h[k] = min(h[k], h[k - 1] + slope * (x[k] - x[k - 1]))
    for k in range(len(x) - 2, -1, -1):
        h[k] = min(h[k], h[k + 1] + slope * (x[k + 1] - x[k]))
    return h
