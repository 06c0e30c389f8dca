"""What contact of bodies contributes to the nodal system until increments count anew."""

from __future__ import annotations

from typing import Any

import numpy as np

from .base import Boxes, BoxPairs, Carried, Piece
from .obstaclepieces import some_boxes


class FacingPiece(Piece):
    """Sites on this rank that face another body.

    Args:
        at: which of the carried places these are, bool.
        boxes: nodes of what they face.
    """

    external = True
    refines = True
    kinked = True
    boxes: BoxPairs

    def __init__(self, term: Any, carried: Carried, at: np.ndarray, boxes: Boxes):
        self.term, self.name, self.rows = term, term.name, carried.rows[at]
        self.boxes = BoxPairs((some_boxes(carried.boxes, at), boxes))
        self.symmetric, self.carried, d = term.form.symmetric, term.carried, term.layout.dim
        self.pairs = np.stack(np.divmod(np.arange(d * d), d), axis=1)
        self._value = carried.table[at, 0]
        self._place = (term.surface.x + term.displacement)[self.rows]
        count = sum(int(np.prod(part.count)) for part in self.boxes.parts)
        self._put(np.zeros((len(self.rows), count, term.layout.block)))

    def _put(self, x: np.ndarray) -> None:
        """The step begins at increments x (m, n, b), with the partners that sites have now."""
        (m, n), d = self._value.shape, self.term.layout.dim
        facing, table = self.term.table(self.rows, x[:, n:, :d])
        self._map = np.zeros((m, self.term.form.size, x.shape[1], d))  # from nodal increments to y
        for k, (_, component, axes) in enumerate(self.term.form.slots.slots):
            if axes:
                self._map[:, k, n:, component] = table[:, 1 + axes[0]]
            else:
                self._map[:, k, :n, component] = self._value
                self._map[:, k, n:, component] = -table[:, 0]
        self._map = self._map.reshape(m, self.term.form.size, x.shape[1] * d)
        self._start = self._place - facing
        self._before = self._y(x)

    def _y(self, x: np.ndarray) -> np.ndarray:
        moved = x[:, :, : self.term.layout.dim].reshape(len(x), self._map.shape[2])
        y: np.ndarray = np.einsum("myk,mk->my", self._map, moved)
        return y

    def _columns(self, x: np.ndarray) -> list[np.ndarray]:
        columns: list[np.ndarray] = self.term.columns(self.rows, self._start, self._y(x), self._before)
        return columns

    def _evaluated(self, x: np.ndarray) -> np.ndarray:
        values: np.ndarray = self.term.evaluated(self._columns(x)) * self.term.area[self.rows, None]
        return values

    def forces(self, x: np.ndarray) -> np.ndarray:
        d, residual = self.term.layout.dim, self._evaluated(x)[:, : self._map.shape[1]]
        out = np.zeros_like(x)
        out[:, :, :d] = np.einsum("myk,my->mk", self._map, residual).reshape(len(x), x.shape[1], d)
        return out

    def matrices(self, x: np.ndarray) -> np.ndarray:
        (m, n, _), d, size = x.shape, self.term.layout.dim, self._map.shape[1]
        moduli = self._evaluated(x)[:, size:].reshape(m, size, size)
        dense = np.swapaxes(self._map, 1, 2) @ moduli @ self._map
        blocks: np.ndarray = dense.reshape(m, n, d, n, d).transpose(0, 1, 3, 2, 4).reshape(m, n, n, d * d)
        return blocks

    def starts(self, x: np.ndarray) -> None:
        self._put(x)

    def balanced(self, x: np.ndarray) -> None:
        self.term.balance(self.term.tell(self._columns(x)), self.rows)

    def refine(self, x: np.ndarray) -> bool:
        return bool(self.term.improve(self.term.tell(self._columns(x)), self.rows))

    def commit(self, x: np.ndarray) -> None:
        self.term.commit_told(self.term.tell(self._columns(x)), self.rows)


class MovedPiece(Piece):
    """All sites on this rank: they move with their bodies, and nothing acts on them here."""

    external = False
    refines = True
    linear = True

    def __init__(self, term: Any, carried: Carried):
        self.term, self.name, self.carried = term, term.name, term.carried
        self.rows, self.boxes, self._table = carried.rows, carried.boxes, carried.table
        self.pairs = np.zeros((0, 2), dtype=int)

    def forces(self, x: np.ndarray) -> np.ndarray:
        return np.zeros_like(x)

    def matrices(self, x: np.ndarray) -> np.ndarray:
        return np.zeros((len(x), x.shape[1], x.shape[1], 0))

    def _moved(self, x: np.ndarray) -> np.ndarray:
        """Displacements and their gradients (m, d + d^2)."""
        d = self.term.layout.dim
        moved = np.einsum("mn,mnj->mj", self._table[:, 0], x[:, :, :d])
        gradient = np.einsum("min,mnj->mji", self._table[:, 1:], x[:, :, :d])
        return np.hstack([moved, gradient.reshape(len(x), d * d)])

    def refine(self, x: np.ndarray) -> bool:
        """Collective, unlike others'."""
        self.term.check_way(self._moved(x), self.rows)
        return False

    def commit(self, x: np.ndarray) -> None:
        self.term.finish(self._moved(x), self.rows)
