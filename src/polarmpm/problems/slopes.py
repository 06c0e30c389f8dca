"""What a script says of slopes on planes: slopes that are held, and planes of symmetry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..basis.base import Basis
from ..basis.registry import names
from ..conditions.supports import Mirror, Support
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.planes import Plane, PlaneSpec
from ..kinematics.layout import Layout
from ..tools import checks
from ..tools.checks import shown

_ZERO = "0 is allowed: slopes can be held, not prescribed"


def take_slopes(
    where: Any, components: dict[str, Any], layout: Layout, on_facets: bool = False
) -> tuple[dict[int, bool], dict[str, Any]]:
    """The columns whose slopes are to vanish, of `fix`, and its other components.

    Raises:
        InputError: a slope that isn't zero, or not on a plane.
    """
    axes = "xyz"[: layout.dim]
    found: dict[int, bool] = {}
    of_slopes = {"slope": list(range(layout.dim))} | {f"slope_{a}": [k] for k, a in enumerate(axes)}
    for name, value in components.items():
        if name not in of_slopes:
            continue
        if checks.number(f"fix: {name}", value, allowed=_ZERO) != 0.0:
            raise checks.refuse(f"fix: {name}", value, _ZERO)
        if not on_facets and not isinstance(where, PlaneSpec):
            raise InputError(
                f"fix: {name} = 0: a slope is held on a plane of the grid, such as plane(x=0.0); "
                f"where = {shown(where)}"
            )
        found |= dict.fromkeys(of_slopes[name], True)
    return found, {name: value for name, value in components.items() if name not in of_slopes}


def symmetric(axis: int, where: Any, layout: Layout) -> tuple[dict[str, Any], dict[int, bool]]:
    """Components that vanish on a plane of symmetry, and which columns are even across it.

    A displacement is mirrored as a vector; a rotation, an axial one, the other way round.

    Args:
        axis: normal to it.

    Raises:
        InputError: it is beside the plane strain body's own plane.
    """
    if axis >= layout.dim:
        raise InputError(f"symmetry: plane {where.name}: the body has {layout.dim} dimensions")
    axes, d = "xyz"[: layout.dim], layout.dim
    even = {column: column != axis for column in range(d)}
    if layout.rotations == 1:
        even[d] = False
    elif layout.rotations:
        even |= {d + column: column == axis for column in range(d)}
    zero = {f"u{axes[axis]}": 0}
    zero |= {"theta" if layout.rotations == 1 else f"theta_{axes[c - d]}": 0
             for c, same in even.items() if c >= d and not same}  # fmt: skip
    return zero, even


def axis_of_plane(where: Any) -> int:
    """The axis across a plane of the grid.

    Raises:
        InputError: not a plane.
    """
    if not isinstance(where, PlaneSpec):
        raise checks.refuse("symmetry: where", where, "a plane, such as plane(x=0.0), is needed")
    return where.axis


def check_slopes(basis: Basis) -> None:
    """Raise InputError for a basis that can't hold slopes on planes."""
    if basis.no_slope:
        allowed = names(lambda b: not b.no_slope)
        raise InputError(f"slope = 0: basis = {basis.name!r}, allowed is {allowed}: {basis.no_slope}")


def tie(support: Support, even: dict[int, bool], basis: Basis, grid: Grid) -> None:
    """Let a support on a plane of a grid tie what is mirrored there."""
    where = support.where
    assert isinstance(where, Plane)
    support.mirror = Mirror(basis, where.axis, where.index, where.side, even)
    odd = [c for c in support.columns if not even.get(c, True)]
    if odd and basis.mirror(grid, where.axis, where.index, where.side, False):
        support.where = replace(where, side=0)  # beyond the plane nodes follow


def beside(where: PlaneSpec, grid: Grid, points: Any, now: Grid) -> PlaneSpec:
    """A plane of symmetry of a grid, with the side on which the body isn't; `now` is the grid as it has been
    stretched since. Collective.

    Raises:
        InputError: the body is on both.
    """
    spec = replace(where, beyond="auto")
    if not spec.resolve(grid, points, now).side:
        raise InputError(
            f"symmetry: plane {where.name}: the body has points on both sides of it; of a symmetric body the "
            "half on one side is computed"
        )
    return spec
