"""Solids of any shape as obstacles: surfaces of triangles, whose distance is sampled on a lattice."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import ufl

from ..errors import InputError
from ..tools import checks
from .grid import box_indices
from .shapes import Shape

_MARGIN = 3  # cells of the lattice around the solid
_CELLS = 32  # of it along the solid's longest side, by default
_BAND = 4  # cells around a triangle in which distances from it are taken
_BESIDE = 1.6180e-4, 2.7183e-4  # of a cell
_MOST = 2e7  # nodes of the lattice


class Solid(Shape):
    """A solid in space by its closed surface of triangles, as an STL file or as arrays.

    Its distance is sampled on a lattice, and interpolated by quadratic B-splines: edges are rounded over
    about a cell of it, smooth surfaces are met to its third order. The normal is continuous.

    Args:
        surface: name of an STL file (text or binary), or positions (n, 3) (m) and triangles (m, 3).
        spacing: of the lattice (m); default: 1/32 of the longest side.
        scale: lengths of the file in metres (0.001 for millimetres).
        hollow: the body is inside.

    Raises:
        InputError: a file that can't be read, no triangles, a surface that isn't closed, a spacing that isn't
            positive or far too small.
    """

    dim = 3

    def __init__(
        self,
        surface: str | os.PathLike[str] | tuple[Any, Any],
        *,
        spacing: float | None = None,
        scale: float = 1.0,
        hollow: bool = False,
    ):
        scale = checks.number("Solid: scale", scale, above=0.0)
        self.hollow = checks.flag("Solid: hollow", hollow)
        corners = _triangles(surface) * scale
        self.low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        longest = float((high - self.low).max())
        _check_closed(corners, longest)
        size = longest / _CELLS if spacing is None else checks.number("Solid: spacing", spacing, above=0.0)
        counts = np.ceil((high - self.low) / size).astype(np.int64) + 1 + 2 * _MARGIN
        if float(np.prod(counts.astype(float))) > _MOST:
            raise checks.refuse("Solid: spacing", spacing, f"the lattice would have {counts.tolist()} nodes")
        self.spacing, self.count = size, len(corners)
        self.origin = self.low - _MARGIN * size
        self.values = _sharpened(_distances(self.origin, size, counts, corners))

    @property
    def kind(self) -> str:
        return f"Solid of {self.count} triangles"

    def __repr__(self) -> str:
        return f"{self.kind}{', hollow' if self.hollow else ''}"

    def numbers(self) -> np.ndarray:
        """27 coefficients of a cell's functions, its middle (m), the spacing (m); see `at` for a place's."""
        return np.zeros(31)

    def at(self, x: np.ndarray) -> np.ndarray:
        last = np.array(self.values.shape) - 2
        inside = np.clip(x, self.origin + self.spacing, self.origin + self.spacing * last)
        middle = np.clip(np.rint((inside - self.origin) / self.spacing).astype(np.int64), 1, last)
        at = middle[:, None] + box_indices((3, 3, 3)) - 1
        coefficients = self.values[tuple(np.moveaxis(at, -1, 0))]
        centre = self.origin + self.spacing * middle
        beyond = np.linalg.norm(x - inside, axis=1)
        far = beyond > self.spacing  # there the distance from the lattice is added, as a linear function
        direction = (x[far] - inside[far]) / beyond[far, None]
        nodes = self.origin + self.spacing * at[far]
        along = np.einsum("nkj,nj->nk", nodes - x[far, None], direction)
        coefficients[far] = coefficients[far, 13][:, None] + beyond[far, None] + along
        return np.hstack([coefficients, centre, np.full((len(x), 1), self.spacing)])

    def distance(self, x: Any, p: Any) -> Any:
        weights = []
        for i in range(3):
            t = (x[i] - p[27 + i]) / p[30]
            weights.append((0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2))
        terms = [
            p[k] * weights[0][a] * weights[1][b] * weights[2][c]
            for k, (a, b, c) in enumerate(np.ndindex(3, 3, 3))
        ]
        return ufl.as_ufl(sum(terms))


def _triangles(surface: Any) -> np.ndarray:
    """Corners (m, 3, 3) of triangles."""
    if isinstance(surface, tuple):
        x, cells = checks.sequence("Solid: surface", surface, 2, "arrays, positions and triangles,")
        points = checks.array("Solid: surface: positions", x, (None, 3))
        found = checks.numeric("Solid: surface: triangles", cells, "numbers of positions", kinds="iu")
        good = found.ndim == 2 and found.shape[1:] == (3,) and len(found)
        if not good or found.min() < 0 or found.max() >= len(points):
            raise InputError(
                f"Solid: surface: triangles of shape {found.shape}: rows of three numbers of positions, from "
                f"0 to {len(points) - 1}, are needed"
            )
        corners: np.ndarray = points[found.astype(np.int64)]
        return corners
    path = checks.path("Solid: surface", surface, "the name of an STL file, or positions and triangles,")
    import meshio  # lazy import: it takes a third of a second

    try:
        mesh = meshio.read(path, file_format="stl")
        found = mesh.cells_dict.get("triangle", np.zeros((0, 3), dtype=int))
    except (Exception, SystemExit) as e:  # meshio ends the process where it can't read
        raise InputError(f"Solid: surface = {str(path)!r}: no STL file that can be read: {e}") from None
    if not len(found):
        raise InputError(f"Solid: surface = {str(path)!r}: it has no triangles")
    of_file: np.ndarray = checks.array("Solid: positions", mesh.points, (None, 3))[found]
    return of_file


def _check_closed(corners: np.ndarray, longest: float) -> None:
    """Raise InputError unless each edge of the triangles is one of two."""
    bins = np.rint(corners.reshape(-1, 3) / (1e-6 * longest)).astype(np.int64)
    _, number = np.unique(bins, axis=0, return_inverse=True)
    faces = number.reshape(-1, 3)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, count = np.unique(edges, axis=0, return_counts=True)
    if np.any(count % 2):
        raise InputError(
            f"Solid: its surface isn't closed: {int(np.sum(count % 2))} edge(s) belong to one triangle only"
        )


def _distances(origin: np.ndarray, size: float, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances (m) of the nodes of a lattice from the surface, negative inside: exact in a band around it,
    from there on along the lattice."""
    out = np.full(counts, np.inf)
    for triangle in corners:
        low = np.maximum(np.floor((triangle.min(axis=0) - origin) / size).astype(int) - _BAND, 0)
        high = np.minimum(np.ceil((triangle.max(axis=0) - origin) / size).astype(int) + _BAND + 1, counts)
        part = tuple(slice(int(i), int(j)) for i, j in zip(low, high, strict=True))
        x = origin + size * (low + box_indices(tuple(int(n) for n in high - low)))
        squares = _squares(triangle - x[:, None]).reshape(high - low)
        out[part] = np.minimum(out[part], np.sqrt(squares))
    _carry_on(out, size)
    return np.where(_inside(origin, size, counts, corners), -out, out)


def _carry_on(distance: np.ndarray, size: float) -> None:
    """Distances where none is known yet: of a neighbour, and the way from it."""
    steps = [step for step in box_indices((3, 3, 3)) - 1 if np.any(step)]
    unknown = ~np.isfinite(distance)
    while not np.all(np.isfinite(distance)):
        before = np.pad(distance, 1, constant_values=np.inf)
        for step in steps:
            part = tuple(slice(1 + s, n + 1 + s) for s, n in zip(step, distance.shape, strict=True))
            way = before[part] + size * float(np.linalg.norm(step))
            distance[unknown] = np.minimum(distance, way)[unknown]


def _inside(origin: np.ndarray, size: float, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Which nodes are inside: those with an odd number of triangles above them. Lines upward are beside the
    nodes, so that they don't meet edges."""
    line = [origin[k] + size * (np.arange(counts[k]) + _BESIDE[k]) for k in range(2)]
    height = origin[2] + size * np.arange(counts[2])
    above = np.zeros(counts, dtype=np.int64)
    for a, b, c in corners:
        low, high = (f(f(a, b), c)[:2] for f in (np.minimum, np.maximum))
        i, j = (np.flatnonzero((line[k] >= low[k]) & (line[k] <= high[k])) for k in range(2))
        normal = np.cross(b - a, c - a)
        if not len(i) or not len(j) or normal[2] == 0.0:
            continue
        x, y = np.meshgrid(line[0][i], line[1][j], indexing="ij")
        sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        hit = np.all(np.array(sides) * np.sign(normal[2]) > 0.0, axis=0)
        z = a[2] - (normal[0] * (x - a[0]) + normal[1] * (y - a[1])) / normal[2]
        above[np.ix_(i, j)] += hit[:, :, None] & (height < z[:, :, None])
    odd: np.ndarray = above % 2 == 1
    return odd


def _squares(r: np.ndarray) -> np.ndarray:
    """Squared distances (n,) of the origin from triangles (n, 3 corners, 3)."""
    a, b, c = (r[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.sum(normal**2, axis=1)
    ends = [(a, b), (b, c), (c, a)]
    inner = np.stack([np.sum(np.cross(q - p, -p) * normal, axis=1) for p, q in ends]).min(axis=0) >= 0.0
    plane = np.sum(a * normal, axis=1) ** 2 / np.where(size > 0.0, size, 1.0)
    sides = []
    for p, q in ends:
        along = q - p
        length = np.sum(along**2, axis=1)
        s = np.clip(-np.sum(p * along, axis=1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
        sides.append(np.sum((p + s[:, None] * along) ** 2, axis=1))
    squares: np.ndarray = np.where(inner & (size > 0.0), plane, np.min(sides, axis=0))
    return squares


def _sharpened(values: np.ndarray) -> np.ndarray:
    """Coefficients of quadratic B-splines that reproduce quadratic functions of which these are values."""
    out: np.ndarray = values.copy()
    for axis in range(3):
        moved = np.moveaxis(values, axis, 0)
        bend = moved[2:] - 2 * moved[1:-1] + moved[:-2]
        np.moveaxis(out, axis, 0)[1:-1] -= bend / 8.0
    return out
