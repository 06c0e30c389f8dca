"""Grid lines that aren't equidistant: where they are, and which cell a coordinate is in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..tools import checks

_EQUAL = 1e-8  # of a cell: lines that near to equidistant ones are these
_ROUNDING = 4e-16  # of a coordinate
_LEAST = 1e-12  # smallest size of a cell over its distance from the origin of coordinates
STEEP = 3.0  # sizes of neighbours beyond which errors of the larger one are felt in the smaller one


def checked_lines(name: str, lines: Any) -> np.ndarray:
    """Coordinates (m) of grid lines along an axis.

    Raises:
        InputError: fewer than two numbers, one that isn't finite or doesn't exceed the one before by more
            than rounding; the message names that line.
    """
    what = "increasing coordinates (m) of two or more grid lines"
    a = checks.numeric(name, lines, what) + 0.0  # no negative zero
    if a.ndim != 1 or len(a) < 2 or not np.all(np.isfinite(a)):
        raise checks.refuse(name, lines, what)
    far = float(np.abs(a).max())
    with np.errstate(over="ignore"):
        steps = np.diff(a)
    if not np.all(np.isfinite(steps)):
        raise checks.refuse(name, lines, what)
    bad = np.flatnonzero(~(steps > 0.0))
    if len(bad):
        k = int(bad[0])
        raise InputError(
            f"{name}: line {k + 1} at {a[k + 1]:.9g} doesn't exceed line {k} at {a[k]:.9g}; {what}"
        )
    if float(steps.min()) < _LEAST * far:
        k = int(np.argmin(steps))
        raise InputError(
            f"{name}: line {k + 1} at {a[k + 1]:.16g} is too near to line {k} at {a[k]:.16g}: at "
            f"{far / steps[k]:.3g} cells from the origin rounding moves points in them"
        )
    return a


def equal_size(a: np.ndarray) -> float | None:
    """The size (m) of the cells between lines that are equidistant but for rounding; None: they aren't."""
    n = len(a) - 1
    size = float((a[-1] - a[0]) / n)
    off = float(np.abs(np.diff(a) - size).max())
    return size if off <= _EQUAL * size + _ROUNDING * float(np.abs(a).max()) else None


def evened(a: np.ndarray) -> np.ndarray:
    """The lines; equidistant ones without the rounding that they came with."""
    size = equal_size(a)
    if size is None:
        return a
    even: np.ndarray = a[0] + size * np.arange(len(a))
    even[-1] = a[-1]
    return even


def steepest(a: np.ndarray) -> tuple[float, int]:
    """The largest ratio of sizes of two neighbours, and the number of the line between them."""
    size = np.diff(a)
    if len(size) < 2:
        return 1.0, 0
    ratio = np.maximum(size[1:] / size[:-1], size[:-1] / size[1:])
    k = int(np.argmax(ratio))
    return float(ratio[k]), k + 1


class Axes:
    """Lines along each axis of a lattice, and `margin` more beyond each wall.

    The cells beyond a wall are those before it, mirrored, so that nodes beyond a plane of symmetry are where
    those are that they mirror.
    """

    def __init__(self, lines: Sequence[Sequence[float]], margin: int):
        self.margin = margin
        self.planes: list[np.ndarray] = []
        self.sizes_of: list[np.ndarray] = []
        for axis in lines:
            a = np.array(axis, dtype=float)
            size = equal_size(a) if len(a) > 1 else 0.0
            own = np.diff(a) if size is None else np.full(max(len(a) - 1, 1), size)
            inside = np.minimum(np.arange(margin), len(own) - 1)
            below, above = own[inside][::-1], own[::-1][inside]
            start, end = a[0] - np.cumsum(below[::-1])[::-1], a[-1] + np.cumsum(above)
            self.planes.append(np.concatenate([start, a, end]))
            self.sizes_of.append(np.concatenate([below, own, above]) if len(a) > 1 else np.r_[below, above])

    def sizes(self, index: np.ndarray) -> np.ndarray:
        """Sizes (m) of the cells of lattice index (..., d)."""
        return self._of(self.sizes_of, index)

    def corners(self, index: np.ndarray) -> np.ndarray:
        """Lower corners (m) of the cells of lattice index (..., d)."""
        return self._of(self.planes, index)

    def _of(self, values: list[np.ndarray], index: np.ndarray) -> np.ndarray:
        index = np.asarray(index)
        out = np.empty(index.shape)
        for i, v in enumerate(values):
            out[..., i] = v[np.clip(index[..., i] + self.margin, 0, len(v) - 1)]
        return out

    def position(self, xi: np.ndarray) -> np.ndarray:
        """Coordinates (m) of lattice coordinates (..., d); beyond the last lines the cells there go on."""
        xi, out = np.asarray(xi, dtype=float), np.empty(np.shape(xi))
        for i, (plane, size) in enumerate(zip(self.planes, self.sizes_of, strict=True)):
            k = np.clip(np.floor(xi[..., i]) + self.margin, 0, len(size) - 1).astype(np.int64)
            out[..., i] = plane[k] + (xi[..., i] - (k - self.margin)) * size[k]
        return out

    def local(self, x: np.ndarray) -> np.ndarray:
        """Lattice coordinates of positions (..., d) (m); the inverse of `position`."""
        x, out = np.asarray(x, dtype=float), np.empty(np.shape(x))
        for i, (plane, size) in enumerate(zip(self.planes, self.sizes_of, strict=True)):
            k = np.clip(np.searchsorted(plane, x[..., i], side="right") - 1, 0, len(size) - 1)
            out[..., i] = (k - self.margin) + (x[..., i] - plane[k]) / size[k]
        return out
