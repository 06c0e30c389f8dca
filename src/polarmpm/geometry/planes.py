"""Planes of the grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks
from .grid import Grid


class Located(Protocol):
    """Points of this rank."""

    comm: MPI.Comm
    x: np.ndarray


@dataclass
class Plane:
    """Nodes on a grid plane and, at walls, those beyond it on the side without the body, which points'
    domains overlap (T 2.3.2).

    Attributes:
        axis, value: the plane x_axis = value (m).
        side: -1: nodes at and below, +1: at and above, 0: only on the plane.
        size: (m) of the smallest cell along the axis, which tells what rounding is.
        index: lattice index of the plane along its axis.
    """

    axis: int
    value: float
    side: int
    size: float
    index: int

    def __repr__(self) -> str:
        beyond = {-1: " and the nodes below", 0: "", 1: " and the nodes above"}[self.side]
        return f"<plane {'xyz'[self.axis]} = {self.value:g} m of a grid, number {self.index}{beyond}>"

    def follow(self, grid: Grid) -> None:
        """Take the place of the plane of this index in a grid that has been stretched."""
        self.size = grid.smallest[self.axis]
        self.value = grid.plane(self.axis, self.index)

    def __call__(self, position: np.ndarray) -> np.ndarray:
        distance = position[:, self.axis] - self.value
        on = np.abs(distance) < 1e-6 * self.size
        return on | (distance * self.side > 0)


@dataclass(frozen=True)
class PlaneSpec:
    """A plane as the user writes it; see `plane`."""

    axis: int
    value: float
    beyond: str
    moving: bool | None = None

    def __post_init__(self) -> None:
        checks.choice("axis", self.axis, (0, 1, 2))
        object.__setattr__(self, "value", checks.number("xyz"[self.axis], self.value))
        checks.choice("beyond", self.beyond, ("auto", "below", "above", "none"))
        if self.moving is not None:
            object.__setattr__(self, "moving", checks.flag("moving", self.moving, or_none=True))

    def __repr__(self) -> str:
        beyond = "" if self.beyond == "auto" else f", nodes beyond it: {self.beyond}"
        moving = {None: "", True: ", moving", False: ", not moving"}[self.moving]
        return f"<plane {self.name} m{beyond}{moving}>"

    @property
    def name(self) -> str:
        """For messages, such as x = 0."""
        return f"{'xyz'[self.axis]} = {self.value:g}"

    def is_wall(self, grid: Grid) -> bool:
        """Whether it is a boundary plane of the grid."""
        walls = grid.lower[self.axis], grid.upper[self.axis]
        return min(abs(self.value - wall) for wall in walls) <= 1e-6 * grid.smallest[self.axis]

    def resolve(self, grid: Grid, points: Located, now: Grid | None = None) -> Plane:
        """Check the plane against the grid and find which side the body is on; `now` is the same grid as it
        has been stretched since. Collective."""
        if self.axis >= grid.dim:
            raise InputError(f"plane {'xyz'[self.axis]}: the grid has {grid.dim} dimensions")
        with np.errstate(over="ignore"):
            at = float(np.clip(grid.local(np.full(grid.dim, self.value))[self.axis], -1e18, 1e18))
        if abs(at - round(at)) > 1e-6 or not -0.5 < at < grid.shape[self.axis] + 0.5:
            raise InputError(
                f"plane {'xyz'[self.axis]} = {self.value:g} is not a plane of the grid, whose planes are "
                f"{grid.planes_of(self.axis)}"
            )
        found = Plane(self.axis, self.value, 0, grid.smallest[self.axis], round(at))
        if now is not None and now is not grid:
            found.follow(now)
        side = {"below": -1, "above": 1, "none": 0}.get(self.beyond)
        if side is None:
            low = points.comm.allreduce(points.x[:, self.axis].min(initial=np.inf), op=MPI.MIN)
            high = points.comm.allreduce(points.x[:, self.axis].max(initial=-np.inf), op=MPI.MAX)
            side = -1 if low >= found.value else (1 if high <= found.value else 0)
        found.side = side
        return found


def plane(*, beyond: str = "auto", moving: bool | None = None, **coordinate: float) -> PlaneSpec:
    """A grid plane such as `plane(x=0.0)`, for `fix`.

    Args:
        beyond: "below" or "above" adds the nodes on that side of the plane, "none" adds none; "auto" adds
            the side on which the body has no point.
        moving: the plane follows the displacement that is prescribed on it, as the face of a platen: at every
            reset the grid is stretched along the plane's axis so that the plane is where the platen is (T
            2.2.4). The grid's wall on the other side stays; it is the place for a support that holds the body
            against the platen. A mesh of finite elements moves anyway. None (default): where that is
            possible, with a displacement along the axis that is even and was prescribed before the first load
            step. False: never; a body that has left the plane at a reset is an error (`SupportLost`).
        **coordinate: one of x, y, z with the coordinate (m) of the plane.

    Raises:
        InputError: not exactly one coordinate, one that isn't a finite number, or another argument that isn't
            as above.
    """
    if len(coordinate) != 1 or next(iter(coordinate)) not in ("x", "y", "z"):
        raise InputError(f"plane({checks.shown(coordinate)}): exactly one of x, y, z")
    name, value = next(iter(coordinate.items()))
    return PlaneSpec("xyz".index(name), value, beyond, moving)
