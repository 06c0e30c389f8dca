"""Terms of conditions on surfaces that don't follow the grid.

A surface's points are carried by the body: at each converged step they move with the interpolated increments,
and so do the deformation gradient and the rotation there. Between two resets their weighting functions stay:
the standard ones (or the splines) of the cell behind the point.

A surface has few points: every rank has all of their state, and each point's forces are summed on one rank.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from ..basis.lattice import cell_weights
from ..errors import InputError
from ..forms.surfaces import SurfaceForm
from ..geometry.grid import Grid
from ..geometry.surfaces import Surface
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from .base import Boxes, Term

_INWARD = 1e-6  # cells: a point on a plane of the grid belongs to the cell behind it, against its normal
_AHEAD = (
    0.5,
    1.0,
)  # cells by which a face may lie ahead of those that material points reach: at first, later
_HISTORY = ("u", "F", "theta", "q")


class SurfaceTerm:
    """Forces of a condition's points on this rank between two resets; implements `nodalterms.Term`."""

    external = True

    def __init__(self, condition: SurfaceCondition, rows: np.ndarray, boxes: Boxes, table: np.ndarray):
        """table: values and gradients (1/m) of the weighting functions at the points, (m, 1 + d, n)."""
        self.condition, self.rows, self.boxes = condition, rows, boxes
        layout, self.name = condition.layout, condition.name
        self.symmetric, self.linear = condition.form.symmetric, condition.linear
        b = layout.block
        self.pairs = np.stack(np.divmod(np.arange(b * b), b), axis=1)
        m, _, n = table.shape
        self._map = np.zeros((m, condition.form.size, n, b))  # from nodal increments to y
        slots = condition.form.slots
        for k, (field, component, axes) in enumerate(slots.slots):
            self._map[:, k, :, slots.rows(field)[component]] = table[:, 1 + axes[0] if axes else 0]
        self._map = self._map.reshape(m, condition.form.size, n * b)
        self._area = condition.surface.area[rows]

    def _y(self, x: np.ndarray) -> np.ndarray:
        return np.einsum("myk,mk->my", self._map, x.reshape(len(x), self._map.shape[2]))

    def _blocks(self, x: np.ndarray) -> np.ndarray:
        return self.condition.evaluate(self._y(x), self.rows) * self._area[:, None]

    def forces(self, x: np.ndarray) -> np.ndarray:
        residual = self._blocks(x)[:, : self._map.shape[1]]
        return np.einsum("myk,my->mk", self._map, residual).reshape(x.shape)

    def matrices(self, x: np.ndarray) -> np.ndarray:
        m, n, b = x.shape
        size = self._map.shape[1]
        moduli = self._blocks(x)[:, size:].reshape(m, size, size)
        dense = np.swapaxes(self._map, 1, 2) @ moduli @ self._map
        return dense.reshape(m, n, b, n, b).transpose(0, 1, 3, 2, 4).reshape(m, n, n, b * b)

    def commit(self, x: np.ndarray) -> None:
        """Take note of a converged step's increments (m, n, b). Collective."""
        self.condition.commit(self._y(x), self.rows)


class SurfaceCondition:
    """A traction or a support on a surface, and how the body has carried it; makes terms at resets.

    Attributes:
        u: displacement (m), (n, d); F: deformation gradient (n, d, d); theta: sum of the rotation increments
            (rad), (n, r); q: rotation (n, 4), of the last converged state.
        committed: it has taken part in a converged step.
    """

    linear = True

    def __init__(self, name: str, surface: Surface, layout: Layout, basis: str, comm: MPI.Comm):
        if not isinstance(surface, Surface):
            raise InputError(f"{name}: surface = {surface!r} is not a Surface")
        if surface.dim != layout.dim:
            raise InputError(f"{name}: the surface has {surface.dim} dimensions, the grid has {layout.dim}")
        self.name, self.surface, self.layout, self.comm = name, surface, layout, comm
        self.basis = "bspline" if basis == "bspline" else "mpm"
        self.form = self.make_form()
        self._kernel: Kernel | None = None
        n, d = len(surface), layout.dim
        self.u, self.F = np.zeros((n, d)), np.tile(np.eye(d), (n, 1, 1))
        self.theta, self.q = np.zeros((n, layout.rotations)), rotations.identity(n)
        # at the last reset or rotation base
        self._at = {name: getattr(self, name).copy() for name in _HISTORY}
        self.committed, self._released, self._carrying = False, False, False

    # what conditions differ in ------------------------------------------------------------------------
    def make_form(self) -> SurfaceForm:
        """The virtual work at a point."""
        raise NotImplementedError

    def values(self, factor: float) -> list[np.ndarray]:
        """The form's data at all points, each (n, size), at a load factor."""
        raise NotImplementedError

    def converged(self, y: np.ndarray) -> None:
        """A step has converged with increments y (n, size)."""

    # between two resets -------------------------------------------------------------------------------
    def begin(self) -> None:
        """A reset: increments count from the present state."""
        self.rebase_rotations()
        self._at["u"], self._at["F"] = self.u.copy(), self.F.copy()

    def rebase_rotations(self) -> None:
        """Rotation increments count from the present rotations."""
        self._at["theta"], self._at["q"] = self.theta.copy(), self.q.copy()

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        """Put the values of a load factor in; `carrying`: for forces to be carried along, to which what
        hasn't taken part in a converged step doesn't belong."""
        self._carrying, self._released = carrying, carrying and not self.committed
        self._data = self.values(factor)

    def evaluate(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Residual and tangent (m, size + size^2) per area of points `rows`."""
        assert self._kernel is not None
        out = self._kernel(y, *(d[rows] for d in self._data)) if len(rows) else np.zeros((0, self._outputs))
        return np.zeros_like(out) if self._released else out

    @property
    def _outputs(self) -> int:
        return self.form.size * (1 + self.form.size)

    def terms(self, grid: Grid, reached: np.ndarray) -> list[Term]:
        """See `nodalterms.TermSource`.

        Raises:
            InputError: a point lies outside of the body, naming it.
        """
        if self._kernel is None:
            self._kernel = self.form.compile(self.comm)
        x = self.surface.x + self._at["u"]
        owner, cells = self._find(grid, x, reached)
        rows = np.flatnonzero(owner == self.comm.rank)
        table = cell_weights(self.basis, grid, x[rows], cells[rows])
        count = (3 if self.basis == "bspline" else 2,) * grid.dim
        return [SurfaceTerm(self, rows, Boxes(count, grid.node_number(cells[rows])), table)]

    def _find(self, grid: Grid, x: np.ndarray, reached: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rank (n,) and lattice index (n, d) of the cell that weights each point at x: the nearest of those
        that material points reach."""
        turned = np.linalg.solve(np.swapaxes(self._at["F"], 1, 2), self.surface.normal[:, :, None])[:, :, 0]
        normal = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        size = self.comm.size
        xi = grid.local(x) - _INWARD * normal
        around = np.stack(np.unravel_index(np.arange(3**grid.dim), (3,) * grid.dim), axis=-1) - 1
        index = np.floor(xi).astype(np.int64)[:, None] + around
        inside = np.all((index >= 0) & (index < np.array(grid.shape)), axis=2)
        here = inside & np.isin(grid.cell_number(index), reached)
        lowest = np.where(here, self.comm.rank, size)
        self.comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        beyond = np.maximum(np.maximum(index - xi[:, None], xi[:, None] - index - 1), 0.0)
        distance = np.where(lowest < size, np.linalg.norm(beyond, axis=2), np.inf)
        nearest = np.argmin(distance, axis=1)
        every = np.arange(len(x))
        owner, cells = lowest[every, nearest], index[every, nearest]
        limit = _AHEAD[self.committed]
        owner[distance[every, nearest] > limit] = size
        if np.any(owner == size):
            at = int(np.argmax(owner == size))
            raise InputError(
                f"{self.name}: surface point {at} at {tuple(float(round(c, 9)) for c in x[at])} lies outside "
                f"of the body ({np.sum(owner == size)} in all): no material point reaches a cell that is "
                f"less than {limit:g} cells away"
            )
        return owner, cells

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
        self.committed = True
        self.converged(every)

    # restart ------------------------------------------------------------------------------------------
    def state(self) -> dict[str, np.ndarray]:
        """All that a restart needs, the same on every rank."""
        now = {name: getattr(self, name) for name in _HISTORY}
        return {**now, **{f"{name}_at": a for name, a in self._at.items()}}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Put in what `state` gave.

        Raises:
            InputError: it is of another surface.
        """
        for name, old in self.state().items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != old.shape:
                raise InputError(
                    f"{self.name}: the saved {name} has the shape {found}; {old.shape} is needed"
                )
        for name in _HISTORY:
            setattr(self, name, np.array(arrays[name], dtype=float))
            self._at[name] = np.array(arrays[f"{name}_at"], dtype=float)
        self.committed = True
