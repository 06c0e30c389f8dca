"""Dead loads on points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..bodies.points import Points
from ..bodies.selection import Selection
from ..errors import InputError
from ..kinematics.layout import Layout
from ..tools.checks import shown
from .amplitudes import Amplitude, Fade


@dataclass(eq=False)
class Load:
    """Dead force or couple on points: a density per reference volume, or a total over that of a selection.

    Attributes:
        share: what a unit of reference volume gets of the value: 1 of a density, 1/V of a total.
    """

    name: str
    amplitude: Amplitude
    couple: bool
    selection: Selection | None
    density: bool = False
    share: float = 1.0

    def __repr__(self) -> str:
        unit = ("N m", "N/m^2") if self.couple else ("N", "N/m^3")
        of = "all points" if self.selection is None else f"{len(self.selection)} point(s)"
        value = "a function" if self.amplitude.function is not None else f"{self.amplitude.constant.tolist()}"
        return f"Load({self.name!r}: {value} {unit[self.density]} on {of})"

    def add_to(self, out: np.ndarray, points: Points, factor: float) -> None:
        """Add this load's values (np, size) at the local points."""
        rows = points.rows(self.selection)
        values = self.amplitude.at(factor, points.X[rows]) * self.share
        out[rows] += values * points.volume0[rows, None]


@dataclass(eq=False)
class HandedOver:
    """The reaction of a support that was released, as dead forces or couples on the points, which fade.

    Attributes:
        values: of each local point at first (np, size); these rows follow the points.
    """

    name: str
    couple: bool
    fade: Fade
    values: np.ndarray

    def __repr__(self) -> str:
        what, fade = "couples (N m)" if self.couple else "forces (N)", self.fade
        return f"HandedOver({self.name!r}: {what}, fading from load factor {fade.begin:g} to {fade.end:g})"

    def add_to(self, out: np.ndarray, points: Points, factor: float) -> None:
        """Add this load's values (np, size) at the local points."""
        out += self.values * self.fade.share(factor)


AnyLoad = Load | HandedOver


@dataclass(frozen=True)
class Applied:
    """What a script has given in one call; for `release`.

    Attributes:
        parts: a load for each of force and couple.
    """

    name: str
    parts: tuple[Any, ...]

    def __repr__(self) -> str:
        return f"Applied({self.name!r}: {', '.join(map(repr, self.parts))})"


def no_microrotation(name: str, couple: Any) -> InputError:
    """The error of a couple on a body that can't take it."""
    return InputError(f"{name}: couple = {shown(couple)}, but the material has no microrotation")


def make_loads(
    name: str,
    selection: Selection | None,
    force: Any,
    couple: Any,
    layout: Layout,
    density: bool,
    share: float,
) -> list[Load]:
    """Check a user's force and couple; one Load for each that is given."""
    if force is None and couple is None:
        raise InputError(f"{name}: neither force nor couple is given")
    if selection is not None and len(selection) == 0:
        raise InputError(f"{name}: the selection contains no point")
    if couple is not None and not layout.rotations:
        raise no_microrotation(name, couple)
    loads = []
    for value, is_couple, size in ((force, False, layout.dim), (couple, True, layout.rotations)):
        if value is not None:
            what = f"{name}, {'couple' if is_couple else 'force'}"
            loads.append(Load(what, Amplitude(what, value, size), is_couple, selection, density, share))
    return loads


def point_loads(
    loads: Sequence[AnyLoad], points: Points, layout: Layout, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (np, d) and couples (np, r) at the local points at a load factor."""
    forces = np.zeros((len(points), layout.dim))
    couples = np.zeros((len(points), layout.rotations))
    for load in loads:
        load.add_to(couples if load.couple else forces, points, factor)
    return forces, couples
