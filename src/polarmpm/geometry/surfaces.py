"""Surfaces that don't follow the grid, as points with areas and normals: lines, rectangles, any shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError


class Surface:
    """Points on a surface of the undeformed body, which carry tractions or supports.

    Every rank gives the whole surface.

    Args:
        x: positions (n, d) (m).
        area: what each point stands for (n,) (m^2; m in plane strain).
        normal: unit normals (n, d), outward from the body.

    Raises:
        InputError: shapes that don't go together, an area that isn't positive, a normal that isn't of unit
            length, a number that isn't finite.
    """

    alike: ClassVar = ("x", "area", "normal")  # on all ranks

    def __init__(self, x: Any, area: Any, normal: Any):
        self.x, self.area = _numbers("x", x), _numbers("area", area)
        self.normal = _numbers("normal", normal)
        n = len(self.x) if self.x.ndim else 0
        if self.x.ndim != 2 or self.x.shape[1] not in (2, 3) or not n:
            raise InputError(f"Surface: x has the shape {self.x.shape}; (n, 2) or (n, 3) is needed")
        for name, shape in (("area", (n,)), ("normal", self.x.shape)):
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"Surface: {name} has the shape {getattr(self, name).shape}; {shape} is needed"
                )
        if np.any(self.area <= 0):
            raise InputError(f"Surface: area = {self.area.min():g} is not positive")
        length = np.linalg.norm(self.normal, axis=1)
        worst = int(np.argmax(np.abs(length - 1)))
        if abs(length[worst] - 1) > 1e-6:
            raise InputError(f"Surface: normal {worst} has the length {length[worst]:g}; 1 is needed")

    @property
    def dim(self) -> int:
        return int(self.x.shape[1])

    def __len__(self) -> int:
        return len(self.x)

    @classmethod
    def line(cls, a: Sequence[float], b: Sequence[float], points: int) -> Surface:
        """The line from a to b (m) in the plane, cut in equal parts with a point in the middle of each.

        The normal points to the right of the way from a to b: outward when the body is on the left.
        """
        start, end = _numbers("a", a), _numbers("b", b)
        if start.shape != (2,) or end.shape != (2,):
            raise InputError(f"Surface.line: a = {a!r}, b = {b!r}: two coordinates each")
        length = float(np.linalg.norm(end - start))
        if length == 0.0:
            raise InputError(f"Surface.line: b = {b!r} is the same point as a")
        n = _count("Surface.line: points", points)
        along = (end - start) / length
        x = start + (np.arange(n)[:, None] + 0.5) / n * (end - start)
        return cls(x, np.full(n, length / n), np.tile([along[1], -along[0]], (n, 1)))

    @classmethod
    def rectangle(
        cls,
        corner: Sequence[float],
        edge1: Sequence[float],
        edge2: Sequence[float],
        points: int | tuple[int, int],
    ) -> Surface:
        """The rectangle (or parallelogram) at a corner with two edges (m), cut in equal parts with a point in
        the middle of each: `points` along each edge, or a pair of numbers. The normal is along edge1 x edge2.
        """
        origin, first, second = (
            _numbers(name, v)
            for name, v in zip(("corner", "edge1", "edge2"), (corner, edge1, edge2), strict=True)
        )
        if any(v.shape != (3,) for v in (origin, first, second)):
            raise InputError(
                f"Surface.rectangle: corner = {corner!r}, edge1 = {edge1!r}, edge2 = {edge2!r}: "
                "three coordinates each"
            )
        across = np.cross(first, second)
        area = float(np.linalg.norm(across))
        if area <= 1e-12 * np.linalg.norm(first) * np.linalg.norm(second):
            raise InputError(f"Surface.rectangle: edge2 = {edge2!r} is parallel to edge1 = {edge1!r}")
        pair = points if isinstance(points, tuple) else (points, points)
        if len(pair) != 2:
            raise InputError(f"Surface.rectangle: points = {points!r}: a number or a pair of them")
        n1, n2 = (_count("Surface.rectangle: points", n) for n in pair)
        s, t = np.meshgrid((np.arange(n1) + 0.5) / n1, (np.arange(n2) + 0.5) / n2, indexing="ij")
        x = origin + s.reshape(-1, 1) * first + t.reshape(-1, 1) * second
        return cls(x, np.full(len(x), area / len(x)), np.tile(across / area, (len(x), 1)))


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"Surface: {name} = {value!r} is not an array of numbers") from None
    if not np.all(np.isfinite(out)):
        raise InputError(
            f"Surface: {name} has the value {out[~np.isfinite(out)][0]}; finite numbers are allowed"
        )
    return out


def _count(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name} = {value!r}: a whole number from 1 on")
    return int(value)
