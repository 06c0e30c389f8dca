"""Supports and loads as functions of the load factor."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..bodies.points import Points, Selection
from ..errors import InputError
from ..forms.points import Layout
from ..geometry.grid import Grid
from ..kinematics import rotations

Value = float | Sequence[float] | Callable[..., Any]


class Amplitude:
    """A number or vector that follows the load factor.

    A number (or sequence) is ramped: value times load factor. A function of one argument gives the value at
    a load factor; a function of two, (factor, positions (n, d)), gives a value for each position.

    Raises:
        InputError: wrong size, or a value that is not finite, naming the condition and the factor.
    """

    def __init__(self, name: str, value: Value, size: int):
        self.name, self.size = name, size
        self.function: Callable[..., Any] | None = value if callable(value) else None
        self.field = False
        if self.function is not None:
            self.field = _positional(self.function) >= 2
            if not self.field:
                self.at(1.0, np.zeros((1, 1)))
        else:
            try:
                constant = np.asarray(value, float)
            except (TypeError, ValueError):
                raise InputError(f"{name} = {value!r}: a number, a sequence or a function") from None
            if constant.shape not in ((), (size,)):
                raise InputError(f"{name} = {value!r}: one number or {size} of them")
            self.constant = np.broadcast_to(constant, (size,)).astype(float)
            self._check(self.constant, 1.0)

    def _check(self, values: np.ndarray, factor: float) -> None:
        if not np.all(np.isfinite(values)):
            bad = values[~np.isfinite(values)].flat[0]
            raise InputError(f"{self.name} is {bad} at load factor {factor:g}; finite numbers are allowed")

    def at(self, factor: float, positions: np.ndarray) -> np.ndarray:
        """Values (n, size) at positions (n, d)."""
        n = len(positions)
        if self.function is None:
            return np.broadcast_to(factor * self.constant, (n, self.size))
        raw = self.function(factor, positions) if self.field else self.function(factor)
        try:
            values = np.asarray(raw, float)
            if self.field and values.shape == (n,):
                values = values[:, None]
            values = np.broadcast_to(values, (n, self.size))
        except (TypeError, ValueError):
            raise InputError(
                f"{self.name} returned {raw!r} at load factor {factor:g}; {self.size} number(s) are needed"
            ) from None
        self._check(values, factor)
        return values


def _positional(function: Callable[..., Any]) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is inspect.Parameter.empty for p in parameters)


# supports ---------------------------------------------------------------------------------------
@dataclass
class Plane:
    """Nodes on a grid plane, and those beyond it where the body isn't (walls: T 2.3.2's domains overlap
    them).

    Attributes:
        axis, value: the plane x_axis = value (m).
        side: -1: nodes at and below, +1: at and above, 0: only on the plane.
        cell: cell size (m), which tells what rounding is.
        index: lattice index of the plane along its axis.
    """

    axis: int
    value: float
    side: int
    cell: float
    index: int

    def follow(self, grid: Grid) -> None:
        """Stand where the plane of this index is in a grid that has been stretched."""
        self.cell = grid.cell[self.axis]
        self.value = grid.origin[self.axis] + self.index * self.cell

    def __call__(self, position: np.ndarray) -> np.ndarray:
        distance = position[:, self.axis] - self.value
        on = np.abs(distance) < 1e-6 * self.cell
        return on | (distance * self.side > 0)


@dataclass(frozen=True)
class PlaneSpec:
    """A plane as the user writes it; see `plane`."""

    axis: int
    value: float
    beyond: str
    moving: bool = False

    @property
    def name(self) -> str:
        """For messages, such as x = 0."""
        return f"{'xyz'[self.axis]} = {self.value:g}"

    def check_basis(self, basis: str, grid: Grid) -> None:
        """Raise InputError for a plane on which this basis can't prescribe values.

        B-splines only have functions of their own on the boundary planes of the grid.
        """
        if basis != "bspline" or self.axis >= grid.dim:
            return
        walls, cell = (grid.origin[self.axis], grid.upper[self.axis]), grid.cell[self.axis]
        if min(abs(self.value - wall) for wall in walls) > 1e-6 * cell:
            raise InputError(
                f"plane {'xyz'[self.axis]} = {self.value:g} is not a boundary plane of the grid; with "
                f"basis = 'bspline' allowed are {walls[0]:g} and {walls[1]:g}"
            )

    def resolve(self, grid: Grid, points: Points, now: Grid | None = None) -> Plane:
        """Check the plane against the grid and find which side the body is on; `now` is the same grid as it
        has been stretched since. Collective."""
        if self.axis >= grid.dim:
            raise InputError(f"plane {'xyz'[self.axis]}: the grid has {grid.dim} dimensions")
        at = (self.value - grid.origin[self.axis]) / grid.cell[self.axis]
        if abs(at - round(at)) > 1e-6 or not -0.5 < at < grid.shape[self.axis] + 0.5:
            raise InputError(
                f"plane {'xyz'[self.axis]} = {self.value:g} is not a plane of the grid, whose planes are "
                f"{grid.origin[self.axis]:g} + k {grid.cell[self.axis]:g} up to {grid.upper[self.axis]:g}"
            )
        found = Plane(self.axis, self.value, 0, grid.cell[self.axis], round(at))
        if now is not None and now is not grid:
            found.follow(now)
        side = {"below": -1, "above": 1, "none": 0}.get(self.beyond)
        if side is None:
            low = points.comm.allreduce(points.x[:, self.axis].min(initial=np.inf), op=MPI.MIN)
            high = points.comm.allreduce(points.x[:, self.axis].max(initial=-np.inf), op=MPI.MAX)
            side = -1 if low >= found.value else (1 if high <= found.value else 0)
        found.side = side
        return found


def plane(*, beyond: str = "auto", moving: bool = False, **coordinate: float) -> PlaneSpec:
    """A grid plane such as `plane(x=0.0)`, for `fix`.

    Args:
        beyond: "below" or "above" adds the nodes on that side of the plane, "none" adds none; "auto" adds
            the side on which the body has no point.
        moving: the plane follows the displacement that is prescribed on it, as the face of a platen: at
            every reset the grid is stretched along the plane's axis so that it stands where the platen is
            (T 2.2.4). The grid's wall on the other side stays; it is the place for a support that holds the
            body against the platen. A mesh of finite elements moves anyway.
    """
    if len(coordinate) != 1 or next(iter(coordinate)) not in ("x", "y", "z"):
        raise InputError(f"plane({coordinate!r}): exactly one of x, y, z")
    if beyond not in ("auto", "below", "above", "none"):
        raise InputError(f"beyond = {beyond!r}: allowed are auto, below, above, none")
    if not isinstance(moving, bool):
        raise InputError(f"moving = {moving!r}: True or False")
    name, value = next(iter(coordinate.items()))
    return PlaneSpec("xyz".index(name), float(value), beyond, moving)


def component_names(layout: Layout) -> list[str]:
    """Names of a node's unknowns in order."""
    names = ["ux", "uy", "uz"][: layout.dim]
    if layout.rotations == 1:
        return [*names, "theta"]
    return names + [f"theta_{a}" for a in "xyz"[: layout.rotations]]


class Positioned(Protocol):
    """Nodes of this rank."""

    @property
    def position(self) -> np.ndarray: ...

    def __len__(self) -> int: ...


@dataclass
class Support:
    """Prescribed components on the nodes of a plane or predicate."""

    name: str
    where: Callable[[np.ndarray], np.ndarray]
    columns: dict[int, tuple[Amplitude, int]]  # unknown -> amplitude and its component

    def mask(self, nodes: Positioned) -> np.ndarray:
        """Which nodes are meant, (n,) bool."""
        mask = np.asarray(self.where(nodes.position))
        if mask.shape != (len(nodes),) or mask.dtype != bool:
            raise InputError(
                f"{self.name}: the predicate returned {mask.dtype} {mask.shape}; "
                "a bool for each node is needed"
            )
        return mask


def make_support(
    where: Callable[[np.ndarray], np.ndarray],
    label: str,
    components: dict[str, Any],
    layout: Layout,
    number: int,
) -> Support:
    """Check a user's support; `where` is a predicate of node positions."""
    if not components:
        raise InputError("fix: names no component; for example u=0, ux=0, theta=0")
    names, columns = component_names(layout), {}
    for key, value in components.items():
        group = {"u": names[: layout.dim], "theta": names[layout.dim :]}.get(key, [key])
        if not group or any(g not in names for g in group):
            hint = (
                "; the material has no microrotation"
                if key.startswith("theta") and not layout.rotations
                else ""
            )
            raise InputError(
                f"fix: unknown component {key!r}; allowed are u, theta, {', '.join(names)}{hint}"
            )
        amplitude = Amplitude(f"support {number} ({label}), {key}", value, len(group))
        for i, g in enumerate(group):
            if names.index(g) in columns:
                raise InputError(f"fix: component {g!r} is given twice")
            columns[names.index(g)] = (amplitude, i)
    return Support(f"support {number} ({label})", where, columns)


class Prescribed:
    """Prescribed nodal increments between two resets. Collective.

    Attributes:
        fixed: (nodes, block) bool.
    """

    def __init__(self, nodes: Positioned, supports: Sequence[Support], layout: Layout):
        self.nodes, self.supports, self.layout = nodes, supports, layout
        self.masks = [s.mask(nodes) for s in supports]
        self.fixed = np.zeros((len(nodes), layout.block), dtype=bool)
        for support, mask in zip(supports, self.masks, strict=True):
            for column in support.columns:
                self.fixed[mask, column] = True

    def totals(self, factor: float) -> np.ndarray:
        """Prescribed totals (nodes, block) at a load factor; zero where free.

        Raises:
            InputError: two supports contradict each other.
        """
        values = np.zeros(self.fixed.shape)
        owner = np.full(self.fixed.shape, -1)
        for number, (support, mask) in enumerate(zip(self.supports, self.masks, strict=True)):
            position = self.nodes.position[mask]
            for column, (amplitude, component) in support.columns.items():
                new = amplitude.at(factor, position)[:, component]
                old, taken = values[mask, column], owner[mask, column] >= 0
                clash = taken & (np.abs(new - old) > 1e-12 * np.maximum(np.abs(new), np.abs(old)))
                if np.any(clash):
                    at = int(np.argmax(clash))
                    other = self.supports[owner[mask, column][at]].name
                    where = tuple(float(round(c, 9)) for c in position[at])
                    raise InputError(
                        f"{support.name} contradicts {other}: {component_names(self.layout)[column]} of the "
                        f"node at {where} is {new[at]:g} and {old[at]:g}"
                    )
                values[mask, column], owner[mask, column] = new, number
        return values

    def increments(self, factor: float, reset: float, rotation_base: float) -> np.ndarray:
        """Prescribed increments since the last reset (rotations: since their last base), (nodes, block)."""
        d, now = self.layout.dim, self.totals(factor)
        before = self.totals(reset)
        out = now - before
        if self.layout.rotations:
            base = before if rotation_base == reset else self.totals(rotation_base)
            out[:, d:] = now[:, d:] - base[:, d:]
            whole = np.all(self.fixed[:, d:], axis=1)
            if self.layout.rotations == 3:
                out[whole, d:] = rotations.relative_vector(now[whole, d:], base[whole, d:])
        return out


# loads ------------------------------------------------------------------------------------------
@dataclass
class Load:
    """Dead force or couple on points: a total shared by a selection, or a density per reference volume."""

    name: str
    amplitude: Amplitude
    couple: bool
    selection: Selection | None
    density: bool = False
    share: float = 1.0

    def add_to(self, out: np.ndarray, points: Points, factor: float) -> None:
        """Add this load's values (np, size) at the local points."""
        rows = points.rows(self.selection)
        values = self.amplitude.at(factor, points.X[rows]) * self.share
        out[rows] += values * points.volume0[rows, None] if self.density else values


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
        raise InputError(f"{name}: couple = {couple!r}, but the material has no microrotation")
    loads = []
    for value, is_couple, size in ((force, False, layout.dim), (couple, True, layout.rotations)):
        if value is not None:
            what = f"{name}, {'couple' if is_couple else 'force'}"
            loads.append(Load(what, Amplitude(what, value, size), is_couple, selection, density, share))
    return loads


def point_loads(
    loads: Sequence[Load], points: Points, layout: Layout, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (np, d) and couples (np, r) at the local points at a load factor."""
    forces = np.zeros((len(points), layout.dim))
    couples = np.zeros((len(points), layout.rotations))
    for load in loads:
        load.add_to(couples if load.couple else forces, points, factor)
    return forces, couples
