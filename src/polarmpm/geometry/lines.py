"""Lines for `Grid.graded`: fine where it matters, growing smoothly from there, with lines at given places."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks
from .axes import equal_size

GROWTH = 1.15  # sizes of neighbours, by default: what a smooth solution hardly feels (docs/grids.md)
_MOST = 1_000_000  # cells along an axis
STEEPNESS = (0.97, 0.85, 0.65, 0.4)  # shares of the growth to try, as numbers of cells are whole
_SMALLER = 0.6  # by which the largest cells are made smaller until they fit between kept lines
_SAME = 1e-9  # of a cell
_NEAR = 1e-3  # of a cell: ends of zones that near beyond a line are on it
_SHORT = 3  # cells between kept lines up to which these tell the size of the cells around


def lines(
    start: float,
    stop: float,
    *,
    fine: float,
    where: Any = None,
    growth: float = GROWTH,
    keep: Sequence[float] = (),
    coarse: float | None = None,
) -> np.ndarray:
    """Coordinates (m) of grid lines from `start` to `stop`: fine in some intervals, coarser beyond them.

    Args:
        start, stop: the walls (m).
        fine: largest size (m) of cells in the intervals; a little less where these are no multiples of it.
        where: an interval (from, to) (m), a place, or several of them; its ends are lines. Default: all.
        growth: largest ratio of the sizes of two neighbours.
        keep: coordinates (m) that are to be lines, such as those of supports and edges. Cells on both sides
            are about as large.
        coarse: largest size (m) of cells; default: none.

    Returns:
        Increasing coordinates (cells + 1,).

    Raises:
        InputError: an argument that isn't so, or more than a million cells.
    """
    start = checks.number("start", start)
    stop = checks.number("stop", stop, above=start)
    fine = checks.number("fine", fine, above=0.0)
    growth = checks.number("growth", growth, above=1.0)
    coarse = math.inf if coarse is None else checks.number("coarse", coarse, least=fine)
    zones = _zones(where, start, stop)
    kept = _kept(keep, start, stop)
    return _fitting(start, stop, kept, zones, fine, growth, min(coarse, stop - start))


def refined(
    base: np.ndarray,
    zones: Sequence[tuple[float, float]],
    fine: float,
    growth: float = GROWTH,
    keep: Sequence[float] = (),
) -> np.ndarray:
    """Lines between the walls of others, (n,), about as fine as these everywhere, and `fine` in zones (from,
    to) (m), which are extended to lines of theirs; sizes grow by at most `growth` beyond them. See `lines`.
    """
    sizes = np.diff(base)
    widened = []
    slack = _NEAR * float(sizes.min())
    for a, b in zones:
        low = max(0, int(np.searchsorted(base, a + slack, side="right")) - 1)
        high = min(len(base) - 1, int(np.searchsorted(base, b - slack)))
        widened.append((float(base[low]), float(base[max(high, low + 1)])))
    start, stop = float(base[0]), float(base[-1])
    around: list[tuple[float, float, float]] = []
    if equal_size(base) is None:  # what is as fine already stays so
        around = [(float(a), float(b), float(b - a)) for a, b in itertools.pairwise(base)]
        fine = min([fine, *(b - a for a, b, _ in around if any(p < b and a < q for p, q in widened))])
    merged = _zones(widened, start, stop)
    kept = [v for v in keep if start <= v <= stop]
    return _fitting(start, stop, kept, merged, fine, growth, max(fine, float(sizes.max())), around)


def _fitting(
    start: float,
    stop: float,
    kept: list[float],
    zones: list[tuple[float, float]],
    fine: float,
    growth: float,
    coarse: float,
    around: Sequence[tuple[float, float, float]] = (),
) -> np.ndarray:
    """Lines that are fine in zones; the finer they are, the better they fit between kept ones. `around`:
    largest sizes in other intervals (from, to, size)."""
    while True:  # kept lines divide fine zones, and pieces between, into cells that may not go together
        ends, pieces = _pieces(start, stop, kept, zones, fine)
        most = coarse if _even(pieces, growth) else 0.0
        while most >= fine:
            made = _grown(ends, pieces, [a for a, b in zones if a == b], fine, growth, most, around)
            if made is not None:
                return made
            most *= _SMALLER
        fine *= 0.93  # the smaller they are, the better they fit
        coarse = max(coarse, fine)


def _grown(
    ends: np.ndarray,
    pieces: list[tuple[float, float, float | None]],
    places: list[float],
    fine: float,
    growth: float,
    coarse: float,
    around: Sequence[tuple[float, float, float]] = (),
) -> np.ndarray | None:
    """Lines through all ends of pieces; None where none grow slowly enough."""
    even = [*around] + [(a, b, size) for a, b, size in pieces if size is not None]
    for steepness in STEEPNESS:
        slope = steepness * math.log(growth)
        at_places = fine * slope / math.expm1(slope)  # of which cells grow at once
        sources = even + [(a, a, at_places) for a in places]
        short = _short(ends, sources, slope, coarse)
        x, size = size_function(ends[0], ends[-1], [*sources, *short], slope, coarse)
        made = spread(ends, [size for *_, size in pieces], x, size, growth)
        if made is not None:
            return made
    return None


# sizes ----------------------------------------------------------------------------------------------
def size_function(
    start: float, stop: float, sources: Sequence[tuple[float, float, float]], slope: float, coarse: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sizes (m) of cells that are given in intervals (from, to, size) and grow beyond them with a slope, as a
    piecewise linear function: places and sizes there."""

    def at(x: np.ndarray) -> np.ndarray:
        found = np.full(x.shape, coarse)
        for a, b, size in sources:
            found = np.minimum(found, size + slope * np.maximum(np.maximum(a - x, x - b), 0.0))
        return found

    places = [start, stop]
    branches = []  # lines size + slope * (x - x0)
    for a, b, size in sources:
        places += [a, b]
        branches += [(a, size, -slope), (b, size, slope), (a, size, 0.0)]
    branches.append((start, coarse, 0.0))
    p, s, k = np.array(branches).T
    i, j = np.triu_indices(len(p), 1)
    differ = k[i] != k[j]
    i, j = i[differ], j[differ]
    meet = (s[j] - s[i] + k[i] * p[i] - k[j] * p[j]) / (k[i] - k[j])
    x = np.unique(np.clip(np.concatenate([places, meet]), start, stop))
    return x, at(x)


def _short(
    ends: np.ndarray, sources: list[tuple[float, float, float]], slope: float, coarse: float
) -> list[tuple[float, float, float]]:
    """More sources: between kept lines that are only a few cells apart, cells have the sizes that fit in."""
    found: dict[int, tuple[float, float, float]] = {}
    for _ in range(20):
        x, size = size_function(ends[0], ends[-1], [*sources, *found.values()], slope, coarse)
        more = {}
        for k, (a, b) in enumerate(itertools.pairwise(ends)):
            cells = number_between(x, size, a, b)
            fit = (b - a) / max(1, math.ceil(cells - _SAME))
            middle = np.interp(0.5 * (a + b), x, size)
            if cells <= _SHORT and fit < middle * (1 - 1e-6) and len(ends) > 2:
                more[k] = (a, b, fit)
        if not any(more[k] != found.get(k) for k in more):
            break
        found |= more
    return list(found.values())


def _numbers(
    x: np.ndarray, size: np.ndarray, a: float, b: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places between which a size function is linear, its values, and the numbers of cells from a on."""
    nodes = np.concatenate([[a], x[(x > a) & (x < b)], [b]])
    h = np.interp(nodes, x, size)
    ratio = h[1:] / h[:-1]
    even = np.abs(ratio - 1.0) < 1e-9
    mean = np.where(even, h[:-1], (h[1:] - h[:-1]) / np.log(np.where(even, np.e, ratio)))
    return nodes, h, np.concatenate([[0.0], np.cumsum(np.diff(nodes) / mean)])


def number_between(x: np.ndarray, size: np.ndarray, a: float, b: float) -> float:
    """How many cells with a piecewise linear size function lie between a and b."""
    return float(_numbers(x, size, a, b)[2][-1])


def _divided(x: np.ndarray, size: np.ndarray, a: float, b: float, n: int) -> np.ndarray:
    """Sizes of n cells between a and b in the ratio of a size function."""
    nodes, h, number = _numbers(x, size, a, b)
    at = np.linspace(0.0, number[-1], n + 1)
    k = np.clip(np.searchsorted(number, at, side="right") - 1, 0, len(h) - 2)
    slope = (h[k + 1] - h[k]) / (nodes[k + 1] - nodes[k])
    beyond = slope * (at - number[k])
    away = h[k] * (at - number[k])
    place = nodes[k] + np.where(
        np.abs(beyond) < 1e-9, away, h[k] * np.expm1(beyond) / np.where(slope, slope, 1.0)
    )
    cells: np.ndarray = np.diff(place)
    return cells


# cells ----------------------------------------------------------------------------------------------
def spread(
    ends: np.ndarray, fixed: list[float | None], x: np.ndarray, size: np.ndarray, growth: float
) -> np.ndarray | None:
    """Lines with about the sizes of a piecewise linear function, through all ends of pieces (m + 1,); None:
    its sizes are too large for that.

    Args:
        fixed: sizes of cells of the pieces that are divided evenly, None of others; changed.
        growth: largest ratio of neighbours.

    Raises:
        InputError: more than a million cells.
    """
    wanted = [number_between(x, size, a, b) for a, b in itertools.pairwise(ends)]
    _check_number(sum(wanted))
    numbers = [
        max(1, math.ceil(w - 1e-6) if f is None else round((b - a) / f))
        for w, f, a, b in zip(wanted, fixed, ends[:-1], ends[1:], strict=True)
    ]
    limits = [math.inf if f is None else f * (1 + 1e-9) for f in fixed]
    while True:
        cells = [_cells(k, ends, fixed, numbers, wanted, x, size) for k in range(len(numbers))]
        of = np.repeat(np.arange(len(cells)), numbers)
        sizes = np.concatenate(cells)
        ratio = np.maximum(sizes[1:] / sizes[:-1], sizes[:-1] / sizes[1:])
        steep = np.flatnonzero(ratio > growth * (1 + 1e-9))
        larger = {int(of[i + (sizes[i + 1] > sizes[i])]) for i in steep}
        larger |= {k for k, c in enumerate(cells) if c.max() > limits[k] and fixed[k] is None}
        if not larger:
            made = [ends[0] * 1.0]
            for k, c in enumerate(cells):
                made += [*(ends[k] + np.cumsum(c[:-1])), ends[k + 1]]
            return np.array(made)
        if not any(fixed[k] is not None for k in larger):
            return None
        for k in larger:  # a fine zone next to lines that are closer isn't divided evenly
            fixed[k] = None


def _check_number(cells: float) -> None:
    if not cells <= _MOST:
        raise InputError(f"fine, growth: {cells:.3g} cells along an axis; at most {_MOST:.0e} are allowed")


def _cells(
    k: int,
    ends: np.ndarray,
    fixed: Sequence[float | None],
    numbers: Sequence[int],
    wanted: Sequence[float],
    x: np.ndarray,
    size: np.ndarray,
) -> np.ndarray:
    """Sizes of the cells of a piece: those of the function times a factor, whose logarithm leads from what
    both ends share with the pieces beside to what the length of the piece asks for."""
    n, length = numbers[k], float(ends[k + 1] - ends[k])
    if fixed[k] is not None:
        return np.full(n, length / n)
    plain = _divided(x, size, ends[k], ends[k + 1], n)
    own = math.log(wanted[k] / n)  # of a factor that is the same everywhere

    def shared(j: int) -> float:
        return 0.0 if fixed[j] is not None else 0.5 * (own + math.log(wanted[j] / numbers[j]))

    t = (np.arange(n) + 0.5) / n
    lowest, highest = k == 0, k == len(numbers) - 1
    below, above = 0.0 if lowest else shared(k - 1), 0.0 if highest else shared(k + 1)
    free: np.ndarray
    if lowest and highest:
        free = np.ones(n)
    elif lowest or highest:  # the factor at the wall is free
        free = 1 - t if lowest else t
    else:
        free = 4 * t * (1 - t)
    return _fitted(plain * np.exp((1 - t) * below + t * above), free, length)


def _fitted(plain: np.ndarray, free: np.ndarray, length: float) -> np.ndarray:
    """plain exp(s free), where s makes the sum a length: by Newton's method for the logarithm of the sum,
    which is convex and grows with s."""
    s, made = 0.0, plain
    for _ in range(50):
        total = float(made.sum())
        step = math.log(length / total) * total / float(made @ free)
        s += max(-2.0, min(2.0, step))
        made = plain * np.exp(s * free)
        if abs(step) < 1e-14:
            break
    fitted: np.ndarray = made * (length / made.sum())
    return fitted


# arguments ------------------------------------------------------------------------------------------
def _zones(where: Any, start: float, stop: float) -> list[tuple[float, float]]:
    """Intervals (from, to) in the grid; those that overlap are one."""
    if where is None:
        return [(start, stop)]
    allowed = "an interval (from, to), a place, or several of them, between start and stop"
    several = checks.several(where)
    given = list(where) if several else [where]
    if several and len(given) == 2 and not any(checks.several(w) for w in given):
        given = [tuple(given)]
    zones = []
    for one in given:
        a, b = (
            checks.vector("where", one, 2, allowed)
            if checks.several(one)
            else (checks.number("where", one, allowed=allowed),) * 2
        )
        if not (start <= a <= b <= stop):
            raise checks.refuse("where", where, allowed)
        zones.append((float(a), float(b)))
    if not zones:
        raise checks.refuse("where", where, allowed)
    merged: list[tuple[float, float]] = []
    for a, b in sorted(zones):
        if merged and a <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(b, merged[-1][1]))
        else:
            merged.append((a, b))
    return merged


def _kept(keep: Any, start: float, stop: float) -> list[float]:
    allowed = "coordinates (m) between start and stop"
    found = np.atleast_1d(checks.numeric("keep", keep, allowed)) if np.size(keep) else np.zeros(0)
    slack = _SAME * (stop - start)
    good = found.ndim == 1 and np.all(np.isfinite(found))
    if not good or np.any((found < start - slack) | (found > stop + slack)):
        raise checks.refuse("keep", keep, allowed)
    return [float(v) for v in found]


def _pieces(
    start: float, stop: float, kept: list[float], zones: list[tuple[float, float]], fine: float
) -> tuple[np.ndarray, list[tuple[float, float, float | None]]]:
    """Places that are lines, and the pieces between them, with the size of cells in fine zones."""
    near = _SAME * (stop - start)
    ends = [start, stop]
    for place in [*kept, *(v for zone in zones for v in zone)]:
        if min(abs(place - e) for e in ends) > near:
            ends.append(place)
    ends.sort()
    pieces: list[tuple[float, float, float | None]] = []
    for a, b in itertools.pairwise(ends):
        middle = 0.5 * (a + b)
        inside = any(p < middle < q for p, q in zones)
        pieces.append((a, b, (b - a) / max(1, math.ceil((b - a) / fine * (1 - _SAME))) if inside else None))
    return np.array(ends), pieces


def _even(pieces: list[tuple[float, float, float | None]], growth: float) -> bool:
    """Whether neighbours in fine zones go together."""
    _check_number(sum((b - a) / size for a, b, size in pieces if size is not None))
    sizes = [size for *_, size in pieces]
    return all(p is None or q is None or max(p / q, q / p) <= growth for p, q in itertools.pairwise(sizes))
