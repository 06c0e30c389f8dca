"""Contact with rigid bodies that move freely: obstacles that go with them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..forms.contact import CONSTANTS
from ..forms.rigidcontact import RigidContactForm, motions
from ..kinematics import rotations
from ..kinematics.layout import Layout
from .obstaclepieces import SitePiece
from .obstacles import Obstacle
from .rigid import RigidBody
from .surfaceterms import undeformed_area


class RigidPiece(SitePiece):
    """Sites that may touch a rigid body."""

    term: RigidObstacle

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.mover = self.term.body
        self.symmetric = not (self.near and (self.term.law.friction or self.term.law.turning))

    def pushing(self, x: np.ndarray) -> Any:
        """What the sites at increments (m, n, b) do to the body: a function of its unknowns (k,) that gives
        forces (k,), their derivative (k, k), and their sizes (k,)."""
        k = motions(self.term.layout.dim)
        if not self.near:
            return lambda q: (np.zeros(k), np.zeros((k, k)), np.zeros(k))
        y = self._y(x)
        return lambda q: self.term.pushing(y, self.rows, self._area)

    def coupling(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the nodes' forces by the body's unknowns, and of the forces on it by the nodes'
        increments, each (k, m, n, b)."""
        k, (m, n, b) = motions(self.term.layout.dim), x.shape
        if not self.near:
            return np.zeros((k, m, n, b)), np.zeros((k, m, n, b))
        moduli = self.term.whole_moduli(self._y(x), self.rows) * self._area[:, None, None]
        by_body, by_nodes = moduli[:, :b, b:].transpose(2, 0, 1), moduli[:, b:, :b].transpose(1, 0, 2)
        return by_body[:, :, None] * self._value[:, :, None], by_nodes[:, :, None] * self._value[:, :, None]


class RigidObstacle(Obstacle):
    """The surface of a rigid body (`RigidBody`)."""

    piece = RigidPiece

    def __init__(self, *arguments: Any, body: RigidBody, **options: Any):
        super().__init__(*arguments, **options)
        self.body = body

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:
        if self.timed:
            raise InputError(f"{self.name}: phi depends on t: a rigid body keeps its shape")
        super().attach(layout, comm)
        self._about = self.body._first
        # at which a moment on the body counts as a force
        arms = np.linalg.norm(self.surface.x - self.body.centre, axis=1)
        self.body.lever = max(float(arms.min()) if len(arms) else 0.0, self._size)
        stiffness = self._constants[CONSTANTS.index("stiffness")]
        self.body.stiffness = float(stiffness * undeformed_area(self.surface, layout).sum()) or 1.0

    def make_form(self) -> RigidContactForm:
        return RigidContactForm(self.layout, self.shape, self.law)

    def _pose(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        return self.body.centre, self.body.rotation

    def set_factor(self, factor: float, carrying: bool = False) -> None:
        super().set_factor(factor, carrying)
        self.body.unsettle()

    def put_multipliers(self) -> None:
        super().put_multipliers()
        self.body.unsettle()

    def _columns(self, y: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        place, pose, *rest, _ = (a[rows] for a in self._data)
        d, q = self.layout.dim, self.body.moved
        centre, about, turn = self._pose_parts(pose)
        now = rotations.to_tensor(rotations.from_vector(rotations.in_space(q[None, d:])))[0, :d, :d] @ turn
        seen = np.einsum("ni,nij->nj", place + y[:, :d] - centre - q[:d], now) + about
        numbers = self.shape.at(seen)
        whole = np.hstack([y, np.tile(q, (len(rows), 1))])
        return [whole, place, pose, *rest, numbers if numbers.shape[1] else np.zeros((len(rows), 1))]

    def whole_moduli(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Derivatives (m, size, size) per area, by the body's unknowns, too."""
        size = self.form.size
        found: np.ndarray = self.evaluate(y, rows)[:, size:].reshape(len(rows), size, size)
        return found

    def moduli(self, y: np.ndarray, rows: np.ndarray) -> np.ndarray:
        b = self.layout.block
        found: np.ndarray = self.whole_moduli(y, rows)[:, :b, :b].reshape(len(rows), b * b)
        return found

    def pushing(
        self, y: np.ndarray, rows: np.ndarray, area: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What sites `rows` at increments y do to the body, see `RigidPiece.pushing`."""
        size, b, d = self.form.size, self.layout.block, self.layout.dim
        values = self.evaluate(y, rows) * area[:, None]
        forces, moduli = values[:, b:size], values[:, size:].reshape(-1, size, size)[:, b:, b:]
        pushed = np.linalg.norm(forces[:, :d], axis=1)
        centre = self._pose_parts(self._data[1][rows])[0] + self.body.moved[:d]
        arm = np.linalg.norm(self._data[0][rows] + y[:, :d] - centre, axis=1)
        turned = float((arm * pushed).sum() + np.abs(forces[:, d:]).sum())
        sizes = np.repeat([float(pushed.sum()), turned], [d, size - b - d])
        return forces.sum(axis=0), moduli.sum(axis=0), sizes

    def _in_balance(self, told: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        if not self.body.frozen:
            return super()._in_balance(told)
        end, self.body.moved = self.body.moved, self.body.at_balance
        try:
            return super()._in_balance(told)
        finally:
            self.body.moved = end
