"""Supports: prescribed components on nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..basis.base import Basis
from ..errors import InputError
from ..geometry.nodes import Positioned
from ..kinematics.layout import Layout
from ..tools import checks
from .amplitudes import Amplitude


def component_names(layout: Layout) -> list[str]:
    """Names of a node's unknowns in order."""
    names = ["ux", "uy", "uz"][: layout.dim]
    if layout.rotations == 1:
        return [*names, "theta"]
    return names + [f"theta_{a}" for a in "xyz"[: layout.rotations]]


@dataclass(frozen=True)
class Mirror:
    """What a support says of slopes on its plane, which ties nodes to others (`ties`).

    Attributes:
        axis, index: lattice index of the plane along its axis.
        side: where the body isn't, -1 below the plane, 1 above.
        even: of columns of unknowns: their slope vanishes; False: they change sign beyond the plane.
    """

    basis: Basis
    axis: int
    index: int
    side: int
    even: dict[int, bool]


@dataclass(eq=False)
class Support:
    """Prescribed components on the nodes of a plane or predicate.

    Attributes:
        columns: amplitude and its component of each prescribed unknown.
        total: in its first step the body is moved to where it prescribes; False: what it prescribes counts
            from then on.
        committed: it has taken part in a converged step; from then on the two are the same.
        met: how many nodes of the body it held at first, and the body's mean volume at one of them (m^3);
            None before.
        mirror: what it says of slopes; None: nothing.
        on_facets: it holds slopes on facets of finite elements.
        swollen: it has been told that it holds much more of the body than at first.
        left: it has been told that the body has left it.
        body: number of the body whose nodes it holds; None: those of all.
    """

    name: str
    where: Callable[[np.ndarray], np.ndarray]
    columns: dict[int, tuple[Amplitude, int]]
    total: bool = True
    committed: bool = False
    met: tuple[float, float] | None = None
    mirror: Mirror | None = None
    on_facets: bool = False
    swollen: bool = False
    left: bool = False
    body: int | None = None

    def __repr__(self) -> str:
        prescribed = dict.fromkeys(a.name.split(", ")[-1] for a, _ in self.columns.values())
        if self.on_facets:
            prescribed["slopes"] = None
        if self.mirror is not None:
            prescribed["slopes" if all(self.mirror.even.values()) else "symmetry"] = None
        return f"Support({self.name!r}: {', '.join(prescribed)})"

    def mask(self, nodes: Positioned) -> np.ndarray:
        """Which nodes are meant, (n,) bool."""
        found = checks.mask(f"{self.name}: the predicate", self.where(nodes.position.copy()), len(nodes))
        if self.body is None:
            return found
        of_body: np.ndarray = found & (nodes.body == self.body)  # type: ignore[attr-defined]
        return of_body


def make_support(
    where: Callable[[np.ndarray], np.ndarray],
    label: str,
    components: dict[str, Any],
    layout: Layout,
    number: int,
    total: bool = True,
    slopes: bool = False,
) -> Support:
    """Check a user's support; `where` is a predicate of node positions. `number` 0: `label` is its name.
    `slopes`: it holds some, and maybe no component."""
    name = f"support {number} ({label})" if number else label
    if not components and not slopes:
        raise InputError("fix: names no component; for example u=0, ux=0, theta=0, slope=0")
    names, columns = component_names(layout), {}
    for key, value in components.items():
        group = {"u": names[: layout.dim], "theta": names[layout.dim :]}.get(key, [key])
        if not group or any(g not in names for g in group):
            hint = (
                "; the material has no microrotation"
                if key.startswith("theta") and not layout.rotations
                else ""
            )
            if key.startswith("slope"):
                single = ", ".join(f"slope_{name[1:]}" for name in names[: layout.dim])
                hint = f"; slopes of nodes on a plane are slope, {single}"
            raise InputError(
                f"fix: unknown component {key!r}; allowed are u, theta, {', '.join(names)}{hint}"
            )
        amplitude = Amplitude(f"{name}, {key}", value, len(group))
        for i, g in enumerate(group):
            if names.index(g) in columns:
                raise InputError(f"fix: component {g!r} is given twice")
            columns[names.index(g)] = (amplitude, i)
    return Support(name, where, columns, total)
