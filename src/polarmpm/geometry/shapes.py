"""Shapes of rigid obstacles: distances from their surfaces (m), positive outside, in UFL.

A shape says what its distance is at a place `x`, a UFL vector. Its numbers are coefficients of the compiled
code: another radius compiles nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
import ufl

from ..errors import InputError
from ..tools import checks

_TINY = 1e-200  # below the square of any length: keeps roots and their derivatives finite
_MOST_CORNERS = 200  # of a polygon, of which the code has each one


class Shape(ABC):
    """A rigid obstacle's shape.

    Attributes:
        dim: dimensions of space (None: either).
        hollow: the body is inside of it: a box becomes a container.
    """

    dim: int | None = None
    hollow: bool = False

    @abstractmethod
    def distance(self, x: Any, p: Any) -> Any:
        """Distance (m) from the surface in UFL, negative inside; `p` are UFL symbols of `numbers`."""

    @abstractmethod
    def numbers(self) -> np.ndarray:
        """Numbers (k,) that `distance` needs."""

    def at(self, x: np.ndarray) -> np.ndarray:
        """The numbers (n, k) at places x (n, d) (m)."""
        return np.broadcast_to(self.numbers(), (len(x), len(self.numbers())))

    @property
    def kind(self) -> str:
        return type(self).__name__

    def __repr__(self) -> str:
        inside = ", hollow" if self.hollow else ""
        return f"{self.kind}({', '.join(f'{v:g}' for v in self.numbers()[:12])}{inside})"


def _place(name: str, value: Any, what: str = "a place (m)") -> np.ndarray:
    """Two or three finite numbers."""
    found = checks.numeric(name, value, what)
    if found.shape not in ((2,), (3,)):
        raise checks.refuse(name, value, f"{what}, two or three numbers, is needed")
    return checks.array(name, found, found.shape, what)


def _direction(name: str, value: Any, dim: int) -> np.ndarray:
    found = checks.vector(name, value, dim, f"a direction, {dim} numbers,")
    largest = float(np.abs(found).max())
    if largest == 0.0:
        raise checks.refuse(name, value, "a direction isn't zero")
    found = found / largest
    out: np.ndarray = found / np.linalg.norm(found)
    return out


def _vector(p: Any, start: int, size: int) -> Any:
    return ufl.as_vector([p[start + i] for i in range(size)])


def _length(v: Any) -> Any:
    return ufl.sqrt(ufl.dot(v, v) + _TINY)


def _positive(v: Any) -> Any:
    return ufl.conditional(ufl.gt(v, 0.0), v, 0.0)


def _size(v: Any) -> Any:
    """Absolute value, with derivatives that the kernels know."""
    return ufl.conditional(ufl.gt(v, 0.0), v, -v)


def _largest(values: Sequence[Any]) -> Any:
    return reduce(lambda a, b: ufl.conditional(ufl.gt(a, b), a, b), values)


def _of_box(beyond: Sequence[Any]) -> Any:
    """Distance from a box by how far a place is beyond each pair of its sides."""
    outside = ufl.sqrt(sum(_positive(q) ** 2 for q in beyond) + _TINY)
    most = _largest(beyond)
    return ufl.conditional(ufl.gt(most, 0.0), outside, most)


class HalfSpace(Shape):
    """All behind a plane (in the plane: a line) through a point (m); the normal points out of it.

    Raises:
        InputError: not a point and a direction of as many components.
    """

    def __init__(self, point: Sequence[float], normal: Sequence[float]):
        self.point = _place("HalfSpace: point", point)
        self.dim = len(self.point)
        self.normal = _direction("HalfSpace: normal", normal, self.dim)

    def numbers(self) -> np.ndarray:
        return np.concatenate([self.point, self.normal])

    def distance(self, x: Any, p: Any) -> Any:
        d = int(self.dim or 0)
        return ufl.dot(x - _vector(p, 0, d), _vector(p, d, d))


class Sphere(Shape):
    """A sphere, in the plane a disc, of a radius (m) about a centre (m); hollow: the body is inside.

    Raises:
        InputError: not a place, or a radius that isn't positive.
    """

    def __init__(self, centre: Sequence[float], radius: float, *, hollow: bool = False):
        self.centre = _place("Sphere: centre", centre)
        self.dim = len(self.centre)
        self.radius = checks.number("Sphere: radius", radius, above=0.0)
        self.hollow = checks.flag("Sphere: hollow", hollow)

    def numbers(self) -> np.ndarray:
        return np.append(self.centre, self.radius)

    def distance(self, x: Any, p: Any) -> Any:
        d = int(self.dim or 0)
        return _length(x - _vector(p, 0, d)) - p[d]


class Cylinder(Shape):
    """A cylinder in space about an axis through a point (m), of a radius (m); endless, or of a length (m)
    with the point in its middle. Hollow: the body is inside, as in a pipe or a tin.

    Raises:
        InputError: not a point and a direction in space; a radius or a length that isn't positive.
    """

    dim = 3

    def __init__(
        self,
        point: Sequence[float],
        axis: Sequence[float],
        radius: float,
        *,
        length: float | None = None,
        hollow: bool = False,
    ):
        self.point = checks.vector("Cylinder: point", point, 3)
        self.axis = _direction("Cylinder: axis", axis, 3)
        self.radius = checks.number("Cylinder: radius", radius, above=0.0)
        self.length = None if length is None else checks.number("Cylinder: length", length, above=0.0)
        self.hollow = checks.flag("Cylinder: hollow", hollow)

    @property
    def kind(self) -> str:
        return "Cylinder" if self.length is None else "Cylinder with ends"

    def numbers(self) -> np.ndarray:
        ends = [] if self.length is None else [self.length / 2]
        return np.concatenate([self.point, self.axis, [self.radius], ends])

    def distance(self, x: Any, p: Any) -> Any:
        axis, r = _vector(p, 3, 3), x - _vector(p, 0, 3)
        along = ufl.dot(r, axis)
        beside = _length(r - along * axis) - p[6]
        return beside if self.length is None else _of_box([beside, _size(along) - p[7]])


class Box(Shape):
    """A box (rectangle) along the axes between two corners (m); turn it with `rotation` of
    `problem.obstacle`.
    Hollow: the body is inside.

    Raises:
        InputError: corners of other numbers of components, or an upper one that isn't above the lower one.
    """

    def __init__(self, lower: Sequence[float], upper: Sequence[float], *, hollow: bool = False):
        self.lower = _place("Box: lower", lower)
        self.dim = len(self.lower)
        self.upper = checks.vector("Box: upper", upper, self.dim)
        if not np.all(self.upper > self.lower):
            raise checks.refuse("Box: upper", upper, f"it has to lie above lower = {checks.shown(lower)}")
        self.hollow = checks.flag("Box: hollow", hollow)

    def numbers(self) -> np.ndarray:
        return np.concatenate([(self.lower + self.upper) / 2, (self.upper - self.lower) / 2])

    def distance(self, x: Any, p: Any) -> Any:
        d = int(self.dim or 0)
        return _of_box([_size(x[i] - p[i]) - p[d + i] for i in range(d)])


class Polygon(Shape):
    """A polygon in the plane by its corners (m), (n, 2), in either sense; it needn't be convex, but its sides
    must not cross. Hollow: the body is inside.

    Raises:
        InputError: fewer than three corners or more than 200, sides without a length, sides that cross.
    """

    dim = 2

    def __init__(self, corners: Any, *, hollow: bool = False):
        found = checks.numeric("Polygon: corners", corners, "corners")
        if found.ndim != 2 or found.shape[1] != 2 or not 3 <= len(found) <= _MOST_CORNERS:
            raise InputError(
                f"Polygon: corners has the shape {found.shape}; (n, 2) with n from 3 to "
                f"{_MOST_CORNERS} is needed"
            )
        x = checks.array("Polygon: corners", found, (len(found), 2), "corners")
        sides = np.roll(x, -1, axis=0) - x
        if not np.all(np.hypot(*sides.T) > 1e-12 * np.ptp(x, axis=0).max()):
            raise InputError(
                f"Polygon: corners = {checks.shown(corners)}: two that follow each other are the same"
            )
        _check_sides(x, sides)
        area = np.sum(_cross(x - x[0], np.roll(x, -1, axis=0) - x[0]))
        if not abs(area) > 1e-12 * np.ptp(x, axis=0).max() ** 2:
            raise checks.refuse("Polygon: corners", corners, "they lie on a line")
        self.corners = x if area > 0 else x[::-1].copy()
        self.hollow = checks.flag("Polygon: hollow", hollow)

    @property
    def kind(self) -> str:
        return f"Polygon of {len(self.corners)} corners"

    def numbers(self) -> np.ndarray:
        """Corners; of the sides that begin there direction and length; 1 where the corner points outward."""
        x = self.corners
        side = np.roll(x, -1, axis=0) - x
        length = np.hypot(*side.T)[:, None]
        turn = _cross(np.roll(side, 1, axis=0), side)
        outward = np.where(turn >= 0, 1.0, -1.0)[:, None]
        return np.hstack([x, side / length, length, outward]).ravel()

    def distance(self, x: Any, p: Any) -> Any:
        """Of the nearest side, or corner; before a corner that points outward one is outside."""
        nearest, distance = None, None
        for k in range(len(self.corners)):
            first, along = _vector(p, 6 * k, 2), _vector(p, 6 * k + 2, 2)
            r = x - first
            s, across = ufl.dot(r, along), r[0] * along[1] - r[1] * along[0]
            of_corner = ufl.dot(r, r)
            beside = ufl.And(ufl.gt(s, 0.0), ufl.lt(s, p[6 * k + 4]))
            square = ufl.conditional(beside, across * across, of_corner)
            # rounding doesn't make a corner nearer than the side that it ends
            value = ufl.conditional(beside, across, p[6 * k + 5] * ufl.sqrt(of_corner + _TINY))
            if nearest is None:
                nearest, distance = square, value
                continue
            nearer = ufl.lt(square, nearest)
            nearest, distance = (
                ufl.conditional(nearer, square, nearest),
                ufl.conditional(nearer, value, distance),
            )
        return distance


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out: np.ndarray = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _check_sides(x: np.ndarray, sides: np.ndarray) -> None:
    """Raise InputError where sides of a polygon cross."""
    n = len(x)
    for i in range(n):
        for j in range(i + 2, n - (i == 0)):
            between = x[j] - x[i]
            det = _cross(sides[i], sides[j])
            if det == 0.0:
                continue
            s, t = _cross(between, sides[j]) / det, _cross(between, sides[i]) / det
            if 0 <= s <= 1 and 0 <= t <= 1:
                raise InputError(f"Polygon: the sides from corner {i} and from corner {j} cross")


class Level(Shape):
    """A level set of a script's: a function (place) or (place, t) -> UFL scalar, positive outside of the
    obstacle; t is the load factor or time. What it gives needn't be a distance: it is divided by the size
    of its gradient."""

    def __init__(self, function: Any, timed: bool):
        self.function, self.timed = function, timed

    def numbers(self) -> np.ndarray:
        return np.zeros(0)

    def distance(self, x: Any, p: Any) -> Any:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"level set {getattr(self.function, '__name__', 'of a script')}"


def shape_of(name: str, value: Any) -> Shape:
    """What a script gives as an obstacle's shape.

    Raises:
        InputError: neither a shape nor a function of a place, or of a place and t.
    """
    if isinstance(value, Shape):
        return value
    allowed = (
        "a shape (HalfSpace, Sphere, Cylinder, Box, Polygon, Solid), or a function (x) or (x, t) of the "
        "place (m) that gives a UFL scalar, is"
    )
    if isinstance(value, type) or not callable(value):
        raise checks.refuse(name, value, f"{allowed} needed")
    try:
        checks.function(name, value, allowed, takes=("x", "t"))
        return Level(value, timed=True)
    except InputError:
        checks.function(name, value, allowed, takes=("x",))
        return Level(value, timed=False)
