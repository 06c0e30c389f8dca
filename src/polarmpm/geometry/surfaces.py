"""Surfaces that don't follow the grid, as points with areas and normals: lines, rectangles, any shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError
from ..tools import checks
from ..tools.machine import check_memory

_BYTES = 200  # that a point needs until it carries something


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
        found = checks.numeric("Surface: x", x, "positions")
        if found.ndim != 2 or found.shape[1] not in (2, 3) or not len(found):
            raise InputError(f"Surface: x has the shape {found.shape}; (n, 2) or (n, 3) is needed")
        n, dim = found.shape
        self.x = checks.array("Surface: x", found, (n, dim), "positions")
        self.area = checks.array("Surface: area", area, (n,), "one for each point")
        self.normal = checks.array("Surface: normal", normal, (n, dim), "one for each point")
        if np.any(self.area <= 0):
            raise InputError(f"Surface: area = {self.area.min():g} is not positive")
        length = np.linalg.norm(np.clip(self.normal, -1e3, 1e3), axis=1)
        worst = int(np.argmax(np.abs(length - 1)))
        if abs(length[worst] - 1) > 1e-6:
            raise InputError(
                f"Surface: normal {worst} = {checks.shown(self.normal[worst].tolist())}: its length must be 1"
            )

    def __repr__(self) -> str:
        unit = "m" if self.dim == 2 else "m^2"
        return f"<Surface: {len(self)} point(s), {self.area.sum():.6g} {unit}>"

    @property
    def dim(self) -> int:
        return int(self.x.shape[1])

    def __len__(self) -> int:
        return len(self.x)

    def joined(self, other: Surface) -> Surface:
        """Both surfaces as one."""
        parts = ((getattr(s, name) for s in (self, other)) for name in ("x", "area", "normal"))
        return Surface(*(np.concatenate(list(pair)) for pair in parts))

    @classmethod
    def line(cls, a: Sequence[float], b: Sequence[float], points: int) -> Surface:
        """The line from a to b (m) in the plane, cut in equal parts with a point in the middle of each.

        The normal points to the right of the way from a to b: outward when the body is on the left.
        """
        start, end = (checks.vector(f"Surface.line: {k}", v, 2) for k, v in (("a", a), ("b", b)))
        length = _length("Surface.line: b", b, end - start)
        if length == 0.0:
            raise checks.refuse("Surface.line: b", b, "the same point as a")
        n = checks.whole("Surface.line: points", points, least=1)
        check_memory("Surface.line: points", points, n * _BYTES)
        along = (end - start) / length
        x = start + (np.arange(n)[:, None] + 0.5) / n * (end - start)
        return cls(x, np.full(n, length / n), np.tile([along[1], -along[0]], (n, 1)))

    @classmethod
    def arc(
        cls,
        centre: Sequence[float],
        radius: float,
        points: int,
        *,
        start: float = 0.0,
        end: float = 2 * math.pi,
    ) -> Surface:
        """The arc about a centre (m) in the plane from an angle to a larger one (rad, from the x-axis to the
        y-axis), by default a circle, cut in equal parts with a point in the middle of each. The normal points
        outward: the body is inside."""
        middle = checks.vector("Surface.arc: centre", centre, 2)
        r = checks.number("Surface.arc: radius", radius, above=0.0)
        first, last = (checks.number(f"Surface.arc: {k}", v) for k, v in (("start", start), ("end", end)))
        if not first < last <= first + 2 * math.pi * (1 + 1e-12):
            raise checks.refuse(
                "Surface.arc: end", end, f"it lies above start = {first:g}, by a turn at most"
            )
        n = checks.whole("Surface.arc: points", points, least=1)
        check_memory("Surface.arc: points", points, n * _BYTES)
        angle = first + (np.arange(n) + 0.5) / n * (last - first)
        normal = np.column_stack([np.cos(angle), np.sin(angle)])
        return cls(middle + r * normal, np.full(n, r * (last - first) / n), normal)

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
            checks.vector(f"Surface.rectangle: {name}", v, 3)
            for name, v in (("corner", corner), ("edge1", edge1), ("edge2", edge2))
        )
        lengths = [
            _length(f"Surface.rectangle: {name}", v, e)
            for name, v, e in (("edge1", edge1, first), ("edge2", edge2, second))
        ]
        if 0.0 in lengths:
            raise checks.refuse(f"Surface.rectangle: edge{1 + lengths.index(0.0)}", 0, "an edge has a length")
        across = np.cross(first, second)
        area = float(np.linalg.norm(across))
        if not area > 1e-12 * lengths[0] * lengths[1]:
            raise checks.refuse(
                "Surface.rectangle: edge2", edge2, f"parallel to edge1 = {checks.shown(edge1)}"
            )
        several = checks.several(points)
        pair = checks.sequence("Surface.rectangle: points", points, 2) if several else (points, points)
        n1, n2 = (checks.whole("Surface.rectangle: points", n, least=1) for n in pair)
        check_memory("Surface.rectangle: points", points, n1 * n2 * _BYTES)
        s, t = np.meshgrid((np.arange(n1) + 0.5) / n1, (np.arange(n2) + 0.5) / n2, indexing="ij")
        x = origin + s.reshape(-1, 1) * first + t.reshape(-1, 1) * second
        return cls(x, np.full(len(x), area / len(x)), np.tile(across / area, (len(x), 1)))


def _length(name: str, value: Any, edge: np.ndarray) -> float:
    """Length (m) of an edge, whose square must be a number, too."""
    most = float(np.abs(edge).max())
    if most > 1e100 or 0 < most < 1e-100:
        raise checks.refuse(name, value, "lengths from 1e-100 to 1e100 m are allowed")
    return float(np.linalg.norm(edge))
