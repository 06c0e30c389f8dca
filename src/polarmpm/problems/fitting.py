"""Whether a grid, points, a basis and settings go together."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..basis.base import Basis
from ..basis.registry import names
from ..bodies.points import Points
from ..bodies.seeding import check_inside
from ..bodies.validity import check_state
from ..errors import InputError
from ..geometry.grid import Grid
from ..tools import checks

ASSEMBLIES = ("direct", "projection")
_AT_AXIS = 1.0 + 1e-6  # of a half width: where the ring nearest to the axis is


def check_assembly(assembly: str, basis: Basis) -> str:
    if not isinstance(assembly, str) or assembly not in ASSEMBLIES:
        raise checks.refuse("assembly", assembly, f"allowed are {', '.join(ASSEMBLIES)}")
    if assembly == "projection" and basis.no_projection:
        raise InputError(
            f"assembly = 'projection': basis = {basis.name!r}, allowed is "
            f"{names(lambda b: not b.no_projection)}: {basis.no_projection}"
        )
    return assembly


def check_boxes(boxes: bool | None, basis: Basis) -> bool:
    if boxes is not None and not isinstance(boxes, bool | np.bool_):
        raise checks.refuse("boxes", boxes, "allowed are True, False and None")
    if boxes and not basis.fills_boxes:
        allowed = names(lambda b: b.fills_boxes)
        raise InputError(
            f"boxes = True: basis = {basis.name!r} has no second derivatives; allowed are {allowed}"
        )
    return basis.fills_boxes if boxes is None else bool(boxes)


def check_second_gradients(points: Points, basis: Basis) -> None:
    """Raise InputError unless the functions have the square integrable second derivatives that materials
    ask for.
    """

    def smooth(b: Basis) -> bool:
        return b.fills_boxes and b.degree > 1 and not b.gradients_jump

    if points.second_gradient and not smooth(basis):
        kind = next(type(m).__name__ for m in points.materials if m.second_gradient)
        raise InputError(
            f"basis = {basis.name!r}: the energy of {kind} takes second gradients, and these functions' "
            f"gradients jump from cell to cell; allowed are {names(smooth)}"
        )


def check_bodies(points: Points, assembly: str) -> None:
    """Raise InputError for an assembly that has one field for all bodies."""
    if points.bodies > 1 and assembly != "direct":
        raise InputError(
            f"assembly = {assembly!r}: of points that are {points.bodies} bodies 'direct' is allowed"
        )


def check_revolution(grid: Grid, points: Points, assembly: str) -> None:
    """Raise InputError for a grid or a setting that a body of revolution can't have."""
    if not points.axisymmetric:
        return
    if grid.lower[0] < 0.0:
        raise InputError(
            f"grid: it begins at x = {grid.lower[0]:g}; that of a body of revolution begins at the axis, "
            "x = 0, or beyond it"
        )
    if assembly != "direct":
        raise InputError(f"assembly = {assembly!r}: of a body of revolution 'direct' is allowed")


def touches_axis(points: Points) -> bool:
    """Whether a body of revolution reaches its axis. Collective."""
    with np.errstate(divide="ignore"):
        nearest = np.min(points.X[:, 0] / points.half_length0[:, 0], initial=np.inf)
    return bool(points.comm.allreduce(float(nearest), op=MPI.MIN) < _AT_AXIS)


def check_body(grid: Grid, points: Points) -> None:
    """Raise an error unless points lie in a grid. Collective."""
    checks.instance("grid", grid, Grid, "a background grid, such as Grid.box makes, is")
    checks.instance("points", points, Points, "material points, such as seed makes, are")
    if points.dim != grid.dim:
        raise InputError(f"points have {points.dim} dimensions, the grid has {grid.dim}")
    if MPI.Comm.Compare(points.comm, grid.comm) not in (MPI.IDENT, MPI.CONGRUENT):
        raise InputError("points: are on other ranks than the grid; give both the same comm")
    if not points.total:
        raise InputError("points: there is no point")
    check_state(points)
    check_inside(grid, points)
