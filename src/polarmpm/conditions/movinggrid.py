"""A grid that is stretched at its resets so that a plane of it follows a platen, T 2.2.4 and 4.5.1.

Nodes move with the body until the grid is reset; a fixed grid then has no plane at a platen's face any more.
The stretched grid follows from the load factor at the last reset alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.planes import Plane, PlaneSpec
from .amplitudes import Amplitude
from .supports import Support

_NEAR = 1e-6  # of a cell: planes that near are the same


@dataclass(frozen=True)
class MovingPlane:
    """A plane of the grid that follows a prescribed displacement along its axis.

    Attributes:
        support: name of the support that prescribes it.
        axis, index: the plane's lattice index along its axis.
        amplitude, component: of the displacement along the axis.
        asked: the script has said `moving=True`; otherwise it is followed where that is possible.
        total: what is prescribed counts from the undeformed body, not from load factor 0.
        stays: its displacement (m) since its support was released; None: it hasn't been.
        before: its displacement (m) when the grid was made anew last; it stands there in that grid.
    """

    support: str
    axis: int
    index: int
    amplitude: Amplitude
    component: int
    asked: bool = True
    total: bool = True
    stays: float | None = None
    before: float = 0.0

    @classmethod
    def if_possible(cls, spec: PlaneSpec, support: Support) -> MovingPlane | None:
        """A plane for which the script hasn't said whether it moves; None where nothing is to be followed."""
        if spec.axis not in support.columns or not isinstance(support.where, Plane):
            return None
        amplitude, k = support.columns[spec.axis]
        if (
            amplitude.field
            or not support.where.side
            or (not amplitude.function and not amplitude.constant[k])
        ):
            return None
        return cls(support.name, spec.axis, support.where.index, amplitude, k, False, support.total)

    @classmethod
    def of(cls, spec: PlaneSpec, support: Support) -> MovingPlane:
        """Check a support on a moving plane.

        Raises:
            InputError: it doesn't prescribe the displacement along the plane's axis, or not evenly.
        """
        component = "u" + "xyz"[spec.axis]
        if spec.axis not in support.columns:
            raise InputError(f"{support.name}: moving = True: {component} is to be prescribed on the plane")
        amplitude, k = support.columns[spec.axis]
        if amplitude.field:
            raise InputError(
                f"{support.name}: moving = True: {component} depends on the position; a number or a function "
                "of the load factor alone is allowed"
            )
        assert isinstance(support.where, Plane)
        return cls(support.name, spec.axis, support.where.index, amplitude, k, total=support.total)

    def released(self, factor: float) -> MovingPlane:
        """The plane once its support has been released at a load factor: it stays where it is."""
        return replace(self, stays=self.displacement(factor))

    def anchor(self, grid: Grid) -> int:
        """Lattice index of the plane that stays: the lower wall, or the upper one if the lower one moves."""
        return 0 if self.index else grid.shape[self.axis]

    def displacement(self, factor: float) -> float:
        """How far the plane has moved (m) at a load factor that has been reached."""
        if self.stays is not None:
            return self.stays
        now, start = (float(self.amplitude.at(f, np.zeros((1, 1)))[0, self.component]) for f in (factor, 0.0))
        return now if self.total else now - start

    def stretched(self, grid: Grid, factor: float) -> Grid:
        """The grid whose plane stands where its support has moved it at a load factor.

        Raises:
            InputError: the plane has passed the wall that stays.
        """
        moved = self.displacement(factor) - self.before
        if moved == 0.0:
            return grid
        at = grid.plane(self.axis, self.index) + moved
        try:
            return grid.stretched(self.axis, self.index, self.anchor(grid), at)
        except InputError as e:
            raise InputError(f"{self.support} at load factor {factor:g}: {e}") from None


def check(planes: Sequence[MovingPlane], supports: Sequence[Support], grid: Grid) -> None:
    """Raise InputError for planes that can't be followed together with the other supports."""
    first: dict[int, MovingPlane] = {}
    for plane in planes:
        other = first.setdefault(plane.axis, plane)
        if other is not plane and {plane.index, other.index} != {0, grid.shape[plane.axis]}:
            raise InputError(
                f"{plane.support}: moving = True: {other.support} moves the grid along "
                f"{'xyz'[plane.axis]} already"
            )
    for plane in planes:
        name, anchor = "xyz"[plane.axis], plane.anchor(grid)
        for support in supports:
            where = support.where
            if (
                isinstance(where, Plane)
                and where.axis == plane.axis
                and where.axis in support.columns
                and where.index not in (plane.index, anchor)
            ):
                wall = grid.plane(plane.axis, anchor)
                raise InputError(
                    f"{support.name} prescribes u{name}, but its plane would be shifted: {plane.support} "
                    f"stretches the grid from its wall {name} = {wall:g}, which is the place for it"
                )


def followed(planes: Sequence[MovingPlane], supports: Sequence[Support], grid: Grid) -> list[MovingPlane]:
    """The planes that are followed: those that the script has asked for, and of the others those that can be.

    Raises:
        InputError: planes that were asked for can't be followed.
    """
    found = [plane for plane in planes if plane.asked]
    check(found, supports, grid)
    for axis in range(grid.dim):
        more = [plane for plane in planes if not plane.asked and plane.axis == axis]
        try:
            check([*found, *more], supports, grid)
        except InputError:
            continue
        found += more
    return found


class MovingGrid:
    """A grid and the planes that it follows.

    Attributes:
        initial: the grid that was given, or that was made in its place last.
        since: load factor at which that was; None: before the first step.
    """

    def __init__(self, initial: Grid):
        self.initial = initial
        self.since: float | None = None
        self._planes: list[MovingPlane] = []  # those that could be followed

    def admit(self, spec: Any, support: Support, others: Sequence[Support], late: bool) -> None:
        """Take note of a support on `spec`, if that is a plane; `late`: in mid-run.

        Raises:
            InputError: it can't be followed as was asked for, or goes against one that is followed.
        """
        planes = list(self._planes)
        if isinstance(spec, PlaneSpec) and spec.moving:
            if late:
                raise InputError(f"{support.name}: moving = True: allowed before the first load step only")
            planes.append(MovingPlane.of(spec, support))
        elif isinstance(spec, PlaneSpec) and spec.moving is None and not late:
            possible = MovingPlane.if_possible(spec, support)
            planes += [] if possible is None else [possible]
        followed(planes, [*others, support], self.initial)
        self._planes = planes

    def dismiss(self, support: Support, factor: float | None) -> None:
        """A support has been released at a load factor (None: before the first step): its plane stays."""
        same = [plane for plane in self._planes if plane.support == support.name]
        self._planes = [plane for plane in self._planes if plane not in same]
        if factor is not None:
            self._planes += [plane.released(factor) for plane in same]

    def at(self, factor: float | None, supports: Sequence[Support]) -> Grid:
        """The grid of a reset at a load factor; None: before the first step."""
        grid = self.initial
        if factor is not None:
            for plane in followed(self._planes, supports, self.initial):
                grid = plane.stretched(grid, factor)
        return grid

    def follows(self, axis: int) -> bool:
        """Whether planes across an axis move, or have moved."""
        return any(plane.axis == axis for plane in self._planes)

    def lines_to_keep(self, axis: int, grid: Grid, supports: Sequence[Support]) -> list[float]:
        """Coordinates (m) of planes of supports, and of planes that move, across an axis of a grid."""
        planes = [s.where for s in supports if isinstance(s.where, Plane)]
        found = [plane.index for plane in planes if plane.axis == axis]
        found += [plane.index for plane in self._planes if plane.axis == axis]
        return [grid.plane(axis, index) for index in dict.fromkeys(found)]

    def renew(self, grid: Grid, factor: float | None, supports: Sequence[Support]) -> None:
        """Go on from a load factor (None: before the first step) with another grid, which has the planes of
        all supports among its own.

        Raises:
            InputError: it doesn't.
        """
        now = self.at(factor, supports)

        def index(axis: int, old: int, name: str) -> int:
            at = now.plane(axis, old)
            lines = grid.lines[axis]
            found = int(np.argmin(np.abs(lines - at)))
            if abs(lines[found] - at) > _NEAR * min(grid.smallest[axis], now.smallest[axis]):
                raise InputError(
                    f"regrid: {name} acts on the plane {'xyz'[axis]} = {at:.9g}, which the new grid hasn't"
                )
            return found

        moved = [0.0 if factor is None else plane.displacement(factor) for plane in self._planes]
        self._planes = [
            replace(plane, index=index(plane.axis, plane.index, plane.support), before=by)
            for plane, by in zip(self._planes, moved, strict=True)
        ]
        for support in supports:
            where = support.where
            if isinstance(where, Plane):
                if support.mirror is not None:
                    there = index(where.axis, support.mirror.index, support.name)
                    support.mirror = replace(support.mirror, index=there)
                where.index = index(where.axis, where.index, support.name)
            support.met = None  # of other nodes
        self.initial, self.since = grid, factor
