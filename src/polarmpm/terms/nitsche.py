"""Supports on surfaces by the material's own tractions: Nitsche's method."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..forms.nitsche import ConsistentForm
from ..geometry.surfaces import Surface
from ..kernels.kernel import Kernel
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..kinematics.motion import Motion
from ..materials.base import Material
from .base import Piece, Setting
from .surfaces import METHODS, SurfaceSupport


@dataclass
class Behind:
    """What of the body is behind the points of a surface when it is added.

    Attributes:
        materials: those of the body.
        material: the row of each point's (n,).
        F, q, wryness: deformation gradients (n, 3, 3), rotations (n, 4) and wrynesses (n, 3, 3) that the body
            has in the surface's reference; none in the undeformed body.
    """

    materials: tuple[Material, ...]
    material: np.ndarray
    F: np.ndarray
    q: np.ndarray
    wryness: np.ndarray


class ConsistentSupport(SurfaceSupport):
    """A support that takes up the stresses of the body behind it, so that little is left to its springs.

    Args:
        behind: the body at the surface's points.
        symmetric: see `forms.nitsche.ConsistentForm`.

    Attributes:
        wryness: of the last converged state (n, 3, 3).
    """

    linear = False

    def __init__(self, name: str, surface: Surface, *, behind: Behind, symmetric: bool, **options: Any):
        super().__init__(name, surface, **options)
        self._behind, self._symmetric = behind, symmetric
        self.method = METHODS[1] if symmetric else METHODS[2]
        if behind.materials[0].micropolar:
            self.moved = (*self.moved, "wryness")

    def take(self, materials: Sequence[Material]) -> None:
        """Go on with materials of the same forms and other numbers."""
        for form, material in zip(self._forms, materials, strict=True):
            form.material = material

    @property
    def faded(self) -> bool:
        """It has been released, and forces fade in its place."""
        return self._faded is not None

    def also_held(self, x: np.ndarray, columns: Collection[int], *, now: bool) -> bool:
        """Whether it holds one of these components of a surface, with points (n, d) (m) as they are now or in
        the undeformed body."""
        own = set(range(self.layout.dim)) if self._normal is not None else set(self._columns)
        here = self.surface.x + self.u * now
        if not own & set(columns) or here.shape != x.shape:
            return False
        return bool(np.abs(here - x).max() <= 1e-9 * np.abs(here).max())

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        self.wryness: np.ndarray = self._behind.wryness
        self._forms = [ConsistentForm(layout, m, symmetric=self._symmetric) for m in self._behind.materials]
        self._kernels: list[Kernel] = []
        super().attach(layout, comm)
        self._held = self._on_held(1.0, 1.0)
        n = len(self.surface)
        # y of the last converged state since increments count, and by how much it had missed its aim
        self._before: np.ndarray = np.zeros((n, self.form.size))
        self._miss: np.ndarray = np.zeros((n, layout.block))

    def begin_at(self, factor: float, counts: str | None) -> None:
        super().begin_at(factor, counts)
        # what the prescribed values do depends on the stresses, and so on the displacements
        self.proportional = all(a.function is None and not np.any(a.constant) for a in self.amplitudes())

    def make_form(self) -> ConsistentForm:
        return self._forms[0]

    def pieces(self, setting: Setting) -> list[Piece]:
        if not self._kernels:
            used = np.unique(self._behind.material)
            self._motion = Motion(self.layout, self.comm)
            made = {row: self._forms[row].compile(self.comm) for row in used}
            self._kernels = [made.get(row, made[used[0]]) for row in range(len(self._forms))]
            self._kernel = self._kernels[0]
        return super().pieces(setting)

    # between two resets -------------------------------------------------------------------------------
    def begin(self) -> None:
        super().begin()
        self._before = np.zeros_like(self._before)

    def rebase_rotations(self) -> None:
        super().rebase_rotations()
        self._at["wryness"] = self.wryness.copy()
        self._before = self._before.copy()
        self._before[:, self.form.slots.where("rotation")] = 0.0
        self._before[:, self.form.slots.where("rotation", 1)] = 0.0

    def _state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(F, q, wryness) of the material when increments began to count, in space."""
        d, behind = self.layout.dim, self._behind
        F = np.tile(np.eye(3), (len(self.surface), 1, 1))
        F[:, :d, :d] = self._at["F"]
        wryness = self._at.get("wryness", self.wryness)
        return F @ behind.F, rotations.multiply(self._at["q"], behind.q), wryness

    def values(self, factor: float) -> list[np.ndarray]:
        springs, target, force = super().values(factor)
        n, d = len(self.surface), self.layout.dim
        held = np.zeros_like(springs) if self._faded is not None else self._held.reshape(n, -1)
        F, q, wryness = self._state()
        state = self.layout.state().pack(F, wryness, q)
        # per area of the surface's reference: N dA of the undeformed body is F^T n da / J
        normal = np.linalg.solve(np.swapaxes(self._at["F"], 1, 2), self.surface.normal[:, :, None])[:, :, 0]
        normal /= rotations.determinant(self._behind.F[:, :d, :d])[:, None]
        return [state, normal, held, springs, target, force]

    @property
    def _aim(self) -> np.ndarray:
        return self._data[4]

    def moduli(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """At the start of a step, without what stresses would do on the gap that prescribed values open: the
        first correction closes it."""
        data, closed = self._data, self._values(self._before)
        opened = np.abs(closed - self._aim - self._miss).max() > np.abs(self._miss).max()
        if not opened or not np.array_equal(y, self._before[rows]):
            return super().moduli(y, rows)
        self._data = [*data[:4], closed, *data[5:]]
        try:
            return super().moduli(y, rows)
        finally:
            self._data = data

    def _values(self, y: np.ndarray) -> np.ndarray:
        """Displacements and rotations (n, b) of y."""
        slots = self.form.slots
        return np.hstack([slots.part(y, field) for field in ("displacement", "rotation")])

    def evaluate(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        out, material = np.zeros((len(rows), self._outputs)), self._behind.material[rows]
        for k in np.unique(material):
            mine = np.flatnonzero(material == k)
            numbers = np.tile(self._forms[k].numbers(), (len(mine), 1))
            out[mine] = self._kernels[k](y[mine], *(d[rows[mine]] for d in self._data), numbers)
        return out

    def converged(self, y: np.ndarray) -> None:
        self._before, self._miss = y, self._values(y) - self._aim
        if "wryness" in self.moved:
            slots, n = self.form.slots, len(y)
            parts = [("displacement", 1), ("rotation", 0), ("rotation", 1)]
            z = np.concatenate([slots.part(y, *part).reshape(n, -1) for part in parts], axis=1)
            self.wryness = self._motion(self._state(), z)[2]
        super().converged(y)

    def _moment_of_gradients(self, y: np.ndarray) -> np.ndarray:
        slots, d = self.form.slots, self.layout.dim
        work = self.evaluate(y, np.arange(len(y)))[:, slots.where("displacement", 1)].reshape(-1, d, d)
        now = np.eye(d) + slots.part(y, "displacement", 1)
        turning = np.einsum("n,nij,nkj->ik", -self.surface.area, work, now)
        axes = [(1, 0)] if d == 2 else [(2, 1), (0, 2), (1, 0)]
        return np.array([turning[i, k] - turning[k, i] for i, k in axes])

    # restart ------------------------------------------------------------------------------------------
    def state(self) -> dict[str, np.ndarray]:
        b = self._behind
        of_body = np.hstack([b.F.reshape(-1, 9), b.q, b.material[:, None]])
        return {**super().state(), "behind": of_body, "before": self._before, "miss": self._miss}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._before, self._miss = (np.array(arrays[name], dtype=float) for name in ("before", "miss"))
        row = np.array(arrays["behind"], dtype=float)
        b = self._behind
        b.F, b.q, b.material = row[:, :9].reshape(-1, 3, 3), row[:, 9:13], row[:, 13].astype(np.int64)
        self._kernels = []
