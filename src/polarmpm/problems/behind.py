"""What of a body is behind a surface that is to be held: its materials, their state, their stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..bodies.facets import FacetSurface
from ..bodies.nearby import of_nearest
from ..bodies.points import Points
from ..errors import InputError, TrustWarning
from ..forms.rest import stiffness_across
from ..geometry.surfaces import Surface
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..materials.base import Material
from ..terms.nitsche import Behind
from ..tools.parallel import warn_on_one_rank
from .state import Progress

# the same where a surface cuts cells, the symmetric method down to a thousandth of one
_CUT = {"nitsche": 1e3, "nitsche-unsymmetric": 60.0}
_SPRINGS = 1e3  # default of springs alone: a layer of a thousandth of a cell, of the body's stiffness
_APART = 0.7  # cells between points, from which supports give way between them by more than 3 %
_SHORT = 12.0  # cells: length of a surface up to which its edges may count by a tenth (docs/accuracy.md)
_OUTSIDE = 0.1  # cells beyond the body, over which a support gives way by a tenth and more
_FEW = 0.05  # share of a surface: corners, where sides can't be told
_THIN = 0.02  # of the points' size: how far the nearest one is inside
_COERCIVE = 20.0  # the same beside the material's own tractions: enough for both methods (docs/theory.md)


class Body(Protocol):
    """A problem, as far as it is asked here."""

    comm: MPI.Comm
    layout: Layout
    points: Points
    progress: Progress
    knows_undeformed: bool

    @property
    def cell_size(self) -> float: ...


@dataclass
class Found:
    """The body behind a surface.

    Attributes:
        no_stress: why its tractions can't be told; "": they can.
        fitted: the surface is made of faces of elements. One that cuts cells of a grid may leave slivers of
            them.
    """

    behind: Behind
    no_stress: str
    fitted: bool


def find_behind(problem: Body, surface: Surface) -> Found:
    """The body behind a surface that is given as it is now; of elements, as it was at first. Collective."""
    points, comm = problem.points, problem.comm
    late = problem.progress.step > 0
    now = late and not problem.knows_undeformed
    place, size = _places(problem)
    columns = [size, points.material]
    if late:
        columns += [points.F.reshape(-1, 9), points.q, points.wryness.reshape(-1, 9)]
    values = np.column_stack([np.asarray(c, dtype=float) for c in columns])
    _, found = of_nearest(comm, place, values, surface.x)
    material, n = np.rint(found[:, 1]).astype(np.int64), len(surface)
    F, q, wryness = np.tile(np.eye(3), (n, 1, 1)), rotations.identity(n), np.zeros((n, 3, 3))
    if late:
        q, wryness = found[:, 11:15], found[:, 15:].reshape(-1, 3, 3)
    if now:
        F = found[:, 2:11].reshape(-1, 3, 3)
    beyond, fitted = 0.0, isinstance(surface, FacetSurface)
    if isinstance(surface, FacetSurface):
        material = _of_cells(comm, points, surface)
    else:
        beyond = float(np.mean(_inside(comm, place, surface, found[:, :1])))
    behind = Behind(points.materials, material, F, q, wryness)
    return Found(behind, _why_not(points.materials, material, beyond), fitted)


def _of_cells(comm: MPI.Comm, points: Points, surface: FacetSurface) -> np.ndarray:
    """Rows of the materials of the elements behind each point of a surface (n,). Collective."""
    material = np.zeros(len(surface), dtype=np.int64)
    live = surface.elements.live
    in_cell = len(points) // max(1, len(live))
    material[surface.rows] = points.material[np.searchsorted(live, surface.cells) * in_cell]
    comm.Allreduce(MPI.IN_PLACE, material)
    return material


def inward(problem: Body, surface: Surface) -> np.ndarray:
    """Which points (n,) of a surface that is given as it is now have the body on the side of their normals,
    and not on the other one. Collective."""
    if isinstance(surface, FacetSurface) or surface.dim != problem.points.dim:
        return np.zeros(len(surface), dtype=bool)  # facets know which side the body is on
    place, size = _places(problem)
    _, found = of_nearest(problem.comm, place, np.column_stack([size, place]), surface.x)
    other = Surface(surface.x, surface.area, -surface.normal)
    ahead, back = (_inside(problem.comm, place, one, found[:, :1]) for one in (surface, other))
    # of bodies much thinner than a cell the nearest point tells
    near = np.sum((found[:, 1:] - surface.x) * surface.normal, axis=1) > _THIN * found[:, 0]
    return np.asarray(~back & (ahead | near))


def check_outward(problem: Body, name: str, surface: Surface) -> None:
    """Raise InputError where normals of a surface that is given as it is now point into the body.
    Collective."""
    wrong = inward(problem, surface)
    if np.count_nonzero(wrong) > _FEW * len(surface):
        where = tuple(float(round(c, 9)) for c in surface.x[np.argmax(wrong)])
        raise InputError(
            f"{name}: the surface's normals point into the body, such as at {where}; they have to point "
            "outward from it. A line from a to b has the body on its left: exchange its ends"
        )


def warn_of_resolution(problem: Body, name: str, surface: Surface) -> None:
    """Warn where a surface that is given as it is now lies outside of the body that it holds, holds it by too
    few points, or on a few cells of the grid beside which the body goes on. Collective."""
    if isinstance(surface, FacetSurface):
        return
    outside = _outside(problem, surface)
    spacing = surface.area ** (1.0 / (surface.dim - 1)) / _cells(problem, surface.x)
    length = _shortest(problem, surface) / problem.cell_size
    if (apart := float(np.median(spacing))) > _APART:
        text = (
            f"its points are {apart:.2g} cells apart: the body may be far too soft there; give two points a "
            "cell, or more"
        )
    elif outside > _OUTSIDE:
        text = (
            f"it lies {outside:.2g} cells outside of the body, which is held by what is between and may be "
            "far too soft there; give the body's own boundary"
        )
    elif length < _SHORT * (1.0 + 1e-6):
        text = (
            f"it is {length:.2g} cells long, and the body goes on beside it: the grid holds half a cell "
            "around it, too, and the body may be too stiff, by up to a tenth with 12 cells and a quarter "
            "with 4; take smaller cells"
        )
    else:
        return
    warn_on_one_rank(problem.comm, f"{name}: {text} (docs/accuracy.md)", TrustWarning)


def _outside(problem: Body, surface: Surface) -> float:
    """How far (cells) a surface lies outside of the nearest points' boxes, half of it farther. Collective."""
    points, d = problem.points, surface.dim
    place, _ = _places(problem)
    axes = points.half_axes0
    if problem.progress.step > 0 and not problem.knows_undeformed:
        axes = points.F[:, :d, :d] @ axes
    values = np.column_stack([place, axes.reshape(-1, d * d)])
    _, found = of_nearest(problem.comm, place, values, surface.x)
    away = np.abs(np.sum((surface.x - found[:, :d]) * surface.normal, axis=1))
    reach = np.abs(np.einsum("ni,nij->nj", surface.normal, found[:, d:].reshape(-1, d, d))).sum(axis=1)
    return float(np.median((away - reach) / _cells(problem, surface.x)))


def _cells(problem: Body, x: np.ndarray) -> np.ndarray:
    """Sizes (m) (n,) of the cells at places x (n, d)."""
    found = [grid.sizes(grid.cells_of(x)).max(axis=1) for grid, _ in problem.points.lattices]
    return np.max(found, axis=0) if found else np.full(len(x), problem.cell_size)


def _shortest(problem: Body, surface: Surface) -> float:
    """Length (m) of a surface, the shortest one in a direction in which the body goes on beside it; infinite
    where it doesn't. Collective."""
    place, size = _places(problem)
    middle, d, shortest = surface.x.mean(axis=0), surface.dim, np.inf
    x, n = surface.x - middle, surface.normal.mean(axis=0)
    n = n / max(float(np.linalg.norm(n)), 1e-3)
    spacing = float(np.median(surface.area)) ** (1.0 / (d - 1))
    _, found = of_nearest(problem.comm, place, size[:, None], surface.x)
    step = float(np.median(found))
    for t in np.linalg.svd(x - np.outer(x @ n, n), full_matrices=False)[2][: d - 1]:
        beside = _beyond_ends(surface, x, t, spacing, step)
        if len(beside) and np.any(of_nearest(problem.comm, place, place, beside)[0] < 0.75 * step):
            shortest = min(shortest, float(np.ptp(x @ t)) + spacing)
    return shortest


def _beyond_ends(surface: Surface, x: np.ndarray, t: np.ndarray, spacing: float, step: float) -> np.ndarray:
    """Places (k, d) beside the ends of a surface in a direction t (d,), in the body if that goes on there.

    Args:
        x: the surface's points (n, d) from its middle, `spacing` (m) apart.
        step: distance (m) of the body's points.
    """
    places = []
    across = np.linalg.norm(x - np.outer(x @ t, t), axis=1)
    for way in (-t, t):
        along = x @ way
        edge = np.flatnonzero(along > along.max() - 0.5 * spacing)
        end = edge[np.argmin(across[edge])]
        normal = surface.normal[end]
        onwards = way - (way @ normal) * normal
        if (size := float(np.linalg.norm(onwards))) > 0.5:  # else it bends back, as a whole circle does
            beyond = (0.5 * spacing + step) / size * onwards
            places.append(surface.x[end] + beyond - 0.5 * step * normal)
    return np.array(places).reshape(-1, surface.dim)


def _places(problem: Body) -> tuple[np.ndarray, np.ndarray]:
    """Where the points are, as surfaces that are given now are meant, and their sizes (n,) (m)."""
    points = problem.points
    now = problem.progress.step > 0 and not problem.knows_undeformed
    place, volume = (points.x, points.volume) if now else (points.X, points.volume0)
    return place, np.maximum(volume ** (1.0 / points.dim), 2.0 * points.half_length0.max(axis=1, initial=0.0))


def _inside(comm: MPI.Comm, place: np.ndarray, surface: Surface, size: np.ndarray) -> np.ndarray:
    """Which of a surface's points have the body on the side of their normals: of its points, spaced by a size
    (n, 1) (m), the next one on that side is ahead. Collective."""
    ahead = surface.x + 0.75 * size * surface.normal
    distance, nearest = of_nearest(comm, place, place, ahead)
    along = np.sum((nearest - surface.x) * surface.normal, axis=1)
    found: np.ndarray = (along > 0.2 * size[:, 0]) & (distance < size[:, 0])
    return found


def _why_not(materials: tuple[Material, ...], rows: np.ndarray, beyond: float) -> str:
    for row in np.unique(rows):
        material, kind = materials[row], type(materials[row]).__name__
        if material.never_yields:
            return "the stress at the surface of a body with an initial stress isn't known there"
        if material.plastic:
            return f"the stress at the surface of a plastic body ({kind}) isn't known without its flow there"
        if material.second_gradient:
            return f"the traction of {kind} has derivatives of the double stresses in it, which aren't known"
    if beyond > 0.5:
        return (
            "the body is on the side of the normals, too: the tractions are known on its boundary only, "
            "with normals outward from it"
        )
    return ""


def default_stiffness(
    problem: Body,
    surface: Surface,
    name: str,
    found: Found,
    given: dict[str, float | None],
    method: str,
) -> dict[str, Any]:
    """Springs (Pa/m, N/m) of a surface: numbers that are given, else multiples of the body's own stiffness.
    Collective.

    Args:
        given: by name; what isn't in it isn't needed.
    """
    out: dict[str, Any] = {"stiffness": 0.0, "rotation_stiffness": 0.0}
    own: dict[str, Any] = {}
    if all(value is not None for value in given.values()):
        own = given
    elif method == "penalty":
        own = _springs(problem, name)
    else:
        times = _COERCIVE if found.fitted else _CUT[method]
        own = _beside_tractions(problem, surface, found.behind, times)
    for key, value in given.items():
        out[key] = own[key] if value is None else value
        if value is None and not np.all(out[key] > 0.0):
            kinds = ", ".join(dict.fromkeys(type(m).__name__ for m in found.behind.materials))
            raise InputError(
                f"{name}: {key}: {kinds} has no stiffness in the undeformed state from which to take it; "
                f"give {key}"
            )
    return out


def _springs(problem: Body, name: str) -> dict[str, float]:
    """A thousand times the stiffest material over a cell: the clamp gives way like a thousandth of it."""
    size, dim = problem.cell_size, problem.layout.dim
    own: np.ndarray = np.zeros(2)
    for material in problem.points.materials:
        p = material.moduli("lam", "mu", "gamma")
        if len(p) == 3 or (len(p) == 2 and not material.micropolar):
            found = p["lam"] + 2 * p["mu"], p.get("gamma", 0.0) / size + p["mu"] * size
        elif material.second_gradient:
            kind = type(material).__name__
            raise InputError(f"{name}: stiffness: {kind} has no parameters named lam and mu; give stiffness")
        else:
            stretched, bent = stiffness_across(material, dim, np.eye(dim), problem.comm)
            found = stretched.max(), bent.max() / size + stretched.max() * size
        own = np.maximum(own, _SPRINGS * np.array(found))
    return {"stiffness": own[0] / size, "rotation_stiffness": own[1]}


def _beside_tractions(problem: Body, surface: Surface, behind: Behind, times: float) -> dict[str, np.ndarray]:
    """A multiple of the material's stiffness against gradients across the surface over a cell, (n,)."""
    own = np.zeros((2, len(surface)))
    for row in np.unique(behind.material):
        rows = behind.material == row
        normal = surface.normal[rows]
        own[:, rows] = stiffness_across(behind.materials[row], problem.layout.dim, normal, problem.comm)
    own *= times / problem.cell_size
    return {"stiffness": own[0], "rotation_stiffness": own[1]}
