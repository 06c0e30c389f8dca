"""Terms on surfaces that the body carries: by an energy in UFL, and what tractions and supports share.

At each converged step a surface's points move with the interpolated increments, and so do the deformation
gradient and the rotation there. Between two resets their weighting functions stay: those of the cell behind
the point.

A surface has few points: every rank has all of their state, and each point's forces are summed on one rank.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.amplitudes import Amplitude, Fade
from ..errors import InputError
from ..forms.surfaceenergy import SurfaceEnergyForm, SurfacePoint
from ..forms.surfaces import SurfaceForm
from ..geometry.surfaces import Surface
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..tools import checks
from .base import Carried, Piece, Setting, Term


def undeformed_area(surface: Surface, layout: Layout) -> np.ndarray:
    """What the points of a surface stand for (n,): of a body of revolution bands around the axis (m^2)."""
    return 2.0 * np.pi * surface.x[:, 0] * surface.area if layout.axial else surface.area


class SurfacePiece(Piece):
    """Forces of a surface's points on this rank between two resets."""

    def __init__(self, term: SurfaceCondition, carried: Carried):
        self.term, self.rows, self.boxes = term, carried.rows, carried.boxes
        layout, self.name, self.carried, self.external = term.layout, term.name, term.carried, term.external
        self.symmetric, self.linear = term.form.symmetric, term.linear
        b, table = layout.block, carried.table
        self.pairs = np.stack(np.divmod(np.arange(b * b), b), axis=1)
        m, _, n = table.shape
        self._map = np.zeros((m, term.form.size, n, b))  # from nodal increments to y
        slots = term.form.slots
        for k, (field, component, axes) in enumerate(slots.slots):
            self._map[:, k, :, slots.rows(field)[component]] = table[:, 1 + axes[0] if axes else 0]
        self._map = self._map.reshape(m, term.form.size, n * b)
        self._area = term.area[self.rows]

    def _y(self, x: np.ndarray) -> np.ndarray:
        y: np.ndarray = np.einsum("myk,mk->my", self._map, x.reshape(len(x), self._map.shape[2]))
        return y

    def forces(self, x: np.ndarray) -> np.ndarray:
        values = self.term.evaluate(self._y(x), self.rows)
        residual = values[:, : self._map.shape[1]] * self._area[:, None]
        forces: np.ndarray = np.einsum("myk,my->mk", self._map, residual).reshape(x.shape)
        return forces

    def matrices(self, x: np.ndarray) -> np.ndarray:
        m, n, b = x.shape
        size = self._map.shape[1]
        moduli = self.term.moduli(self._y(x), self.rows).reshape(m, size, size)
        moduli = moduli * self._area[:, None, None]
        dense = np.swapaxes(self._map, 1, 2) @ moduli @ self._map
        blocks: np.ndarray = dense.reshape(m, n, b, n, b).transpose(0, 1, 3, 2, 4).reshape(m, n, n, b * b)
        return blocks

    def commit(self, x: np.ndarray) -> None:
        self.term.commit(self._y(x), self.rows)


class SurfaceCondition(Term):
    """What acts on a surface, and how the body has carried it.

    Attributes:
        u: displacement (m), (n, d); F: deformation gradient (n, d, d); theta: sum of the rotation increments
            (rad), (n, r); q: rotation (n, 4), of the last converged state.
        external: its forces count as loads.
        linear: its tangent doesn't change between two resets.
    """

    linear: bool = True
    external: bool = True
    moved: tuple[str, ...] = ("u", "F", "theta", "q")  # what a converged step moves on
    form: SurfaceForm
    u: np.ndarray
    F: np.ndarray
    theta: np.ndarray
    q: np.ndarray

    def __init__(self, name: str, surface: Surface):
        self.name = checks.text("name", name)
        self.surface = checks.instance(f"{name}: surface", surface, Surface, "a polarmpm.Surface is")
        self._carrying = False
        self._kernel: Kernel | None = None
        self._at: dict[str, np.ndarray] = {}  # u, F, theta and q at the last reset or rotation base
        self._data: list[np.ndarray] = []

    def __repr__(self) -> str:
        unit = "m^2" if self.surface.dim == 3 else "m"
        on = f"{len(self.surface)} point(s), {self.surface.area.sum():.6g} {unit}"
        return f"{type(self).__name__}({self.name!r}: {on})"

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        if not hasattr(self, "surface"):
            raise InputError(f"{type(self).__name__}: its __init__ has to call that of SurfaceTerm")
        surface = self.surface
        if surface.dim != layout.dim:
            raise InputError(
                f"{self.name}: the surface has {surface.dim} dimensions, the grid has {layout.dim}"
            )
        if layout.axial and not surface.x[:, 0].min() > 0.0:
            raise InputError(
                f"{self.name}: the surface has a point at the radius x = {surface.x[:, 0].min():g}; in a "
                "body of revolution all of them are at x > 0"
            )
        self.layout, self.comm = layout, comm
        self.form = self.make_form()
        n, d = len(surface), layout.dim
        self.u, self.F = np.zeros((n, d)), np.tile(np.eye(d), (n, 1, 1))
        self.theta, self.q = np.zeros((n, layout.rotations)), rotations.identity(n)
        self._at = {name: getattr(self, name).copy() for name in self.moved}

    def start_from(self, u: np.ndarray, F: np.ndarray) -> None:
        """The body has carried the surface already when it is added: displacements (n, d) (m), deformation
        gradients (n, d, d)."""
        self.u, self.F = u, F
        self._at["u"], self._at["F"] = u.copy(), F.copy()

    def begin_at(self, factor: float, counts: str | None) -> None:
        for amplitude in self.amplitudes():
            amplitude.begin(factor, counts)

    def fade(self, begin: float, end: float) -> None:
        if not self.amplitudes():
            super().fade(begin, end)
        for amplitude in self.amplitudes():
            amplitude.fade = Fade(begin, end)

    def end_at(self, factor: float) -> None:
        for amplitude in self.amplitudes():
            if amplitude.fade is not None:
                amplitude.fade = amplitude.fade.after(factor)

    @property
    def area(self) -> np.ndarray:
        """Undeformed areas (n,), see `undeformed_area`."""
        return undeformed_area(self.surface, self.layout)

    def hoop(self) -> list[np.ndarray]:
        """Of a body of revolution, the stretch along the hoop when increments began to count, and 1 / R, (n,
        2); else nothing."""
        radius = self.surface.x[:, 0]
        return [np.stack([1.0 + self._at["u"][:, 0] / radius, 1.0 / radius], axis=1)] * self.layout.axial

    # what conditions differ in ------------------------------------------------------------------------
    def amplitudes(self) -> list[Amplitude]:
        """What follows the load factor."""
        return []

    @abstractmethod
    def make_form(self) -> SurfaceForm:
        """The virtual work at a point."""

    @abstractmethod
    def values(self, factor: float) -> list[np.ndarray]:
        """The form's data at all points, each (n, size), at a load factor."""

    def converged(self, y: np.ndarray) -> None:
        """A step has converged with increments y (n, size)."""

    # between two resets -------------------------------------------------------------------------------
    @property
    def displacement(self) -> np.ndarray:
        """Displacement (m) when increments began to count, (n, d)."""
        return self._at["u"]

    @property
    def deformation(self) -> np.ndarray:
        """Deformation gradient then, (n, d, d)."""
        return self._at["F"]

    def begin(self) -> None:
        self.rebase_rotations()
        self._at["u"], self._at["F"] = self.u.copy(), self.F.copy()

    def rebase_rotations(self) -> None:
        self._at["theta"], self._at["q"] = self.theta.copy(), self.q.copy()

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        self._carrying = carrying
        self._data = self.values(factor)

    def evaluate(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Residual and tangent (m, size + size^2) per area of points `rows`."""
        assert self._kernel is not None
        return self._kernel(y, *(d[rows] for d in self._data)) if len(rows) else np.zeros((0, self._outputs))

    def moduli(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """What iterations take for the tangent (m, size^2) per area of points `rows`."""
        return self.evaluate(y, rows)[:, self.form.size :]

    @property
    def _outputs(self) -> int:
        return self.form.size * (1 + self.form.size)

    def pieces(self, setting: Setting) -> list[Piece]:
        """Raises InputError where a point lies outside of the body, naming it."""
        if self._kernel is None:
            self._kernel = self.form.compile(self.comm)
        return [SurfacePiece(self, setting.carry(self))]

    def commit(self, y: np.ndarray, rows: np.ndarray) -> None:
        """Move the points with the increments y (m, size) of those on this rank. Collective."""
        n, d, slots = len(self.surface), self.layout.dim, self.form.slots
        every = np.zeros((n, self.form.size))
        every[rows] = y
        self.comm.Allreduce(MPI.IN_PLACE, every)
        w = slots.part(every, "rotation")
        self.u = self._at["u"] + slots.part(every, "displacement")
        self.F = (np.eye(d) + slots.part(every, "displacement", 1)) @ self._at["F"]
        self.theta = self._at["theta"] + w
        self.q = rotations.turned(self._at["q"], w)
        self.converged(every)

    # restart ------------------------------------------------------------------------------------------
    def state(self) -> dict[str, np.ndarray]:
        now = {name: getattr(self, name) for name in self.moved}
        return {**now, **{f"{name}_at": a for name, a in self._at.items()}}

    def check_saved(self, arrays: dict[str, np.ndarray]) -> None:
        """Raise InputError unless arrays that were saved have the shapes of the present ones."""
        for name, old in self.state().items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != old.shape:
                raise InputError(
                    f"{self.name}: the saved {name} has the shape {found}; {old.shape} is needed"
                )

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.check_saved(arrays)
        for name in self.moved:
            setattr(self, name, np.array(arrays[name], dtype=float))
            self._at[name] = np.array(arrays[f"{name}_at"], dtype=float)


class SurfaceTerm(SurfaceCondition):
    """A contribution of one's own on a surface, by an energy per undeformed area in UFL; for `problem.add`.

    Derive from it and give `energy`, or `virtual_work` where there is no energy; residual and tangent are
    derived. It acts on a `Surface` of material points, with both assemblies, and on `elements.surface(...)`.

        class Winkler(pm.SurfaceTerm):
            def energy(self, at, p):
                return p.k / 2 * ufl.dot(at.u, at.normal) ** 2

        problem.add(Winkler("foundation", surface, {"k": 1e6}))  # Pa/m

    Args:
        name: for messages.
        surface: where it acts.
        numbers: the p.name of the energy: numbers, or arrays (n,) with one for each of the surface's points.
            Changing them compiles nothing.

    Raises:
        InputError: not a surface; a number that isn't finite or an array of another length. When it is added:
            a surface of another dimension; an energy that isn't a scalar.
    """

    linear = False
    external = True

    def __init__(self, name: str, surface: Surface, numbers: Mapping[str, Any] | None = None):
        super().__init__(name, surface)
        if numbers is not None and not isinstance(numbers, Mapping):
            raise checks.refuse(f"{name}: numbers", numbers, 'numbers by name are needed: {"k": 1e6}')
        self.numbers = dict(numbers or {})
        self._check_numbers()

    def _check_numbers(self) -> None:
        what = f"a number, or one for each of the surface's {len(self.surface)} points"
        for key, value in self.numbers.items():
            if not isinstance(key, str) or not key.isidentifier():
                raise checks.refuse(f"{self.name}: numbers", key, "names such as k, for p.k, are needed")
            array = checks.numeric(f"{self.name}: {key}", value, what)
            if array.shape not in ((), (len(self.surface),)) or not np.all(np.isfinite(array)):
                allowed = f"{what} is needed, finite" + (
                    f"; its shape is {array.shape}" if array.ndim else ""
                )
                raise checks.refuse(f"{self.name}: {key}", value, allowed)

    def energy(self, at: SurfacePoint, p: Any) -> Any:
        """Energy per undeformed area (J/m^2) in UFL, of the point `at` and the numbers p.name."""
        raise NotImplementedError

    def virtual_work(self, at: SurfacePoint, p: Any) -> Any:
        """What it adds to the internal virtual work per undeformed area, linear in `at.variation`."""
        raise NotImplementedError

    def make_form(self) -> SurfaceForm:
        kind = type(self)
        conservative = kind.energy is not SurfaceTerm.energy
        if conservative == (kind.virtual_work is not SurfaceTerm.virtual_work):
            raise InputError(f"{self.name}: {kind.__name__} needs one of energy and virtual_work")
        function = self.energy if conservative else self.virtual_work
        with checks.evaluating(f"{self.name}: {kind.__name__}.{function.__name__}"):
            return SurfaceEnergyForm(self.layout, function, list(self.numbers), conservative)

    def values(self, factor: float) -> list[np.ndarray]:
        n = len(self.surface)
        theta = self._at["theta"] if self.layout.rotations else np.zeros((n, 1))
        numbers = [np.broadcast_to(np.asarray(v, dtype=float), (n,)) for v in self.numbers.values()]
        columns = np.column_stack(numbers) if numbers else np.zeros((n, 1))
        before = self._at["F"].reshape(n, -1)
        return [self.surface.x, self.surface.normal, self._at["u"], before, theta, columns]
