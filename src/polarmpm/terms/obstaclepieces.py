"""What an obstacle contributes to the nodal system until increments count anew."""

from __future__ import annotations

from typing import Any

import numpy as np

from .base import Carried, Piece


class SitePiece(Piece):
    """Sites on this rank that share a number of nodes.

    Args:
        at: which of the carried places these are (m,), bool.
        near: they may touch the obstacle; others are only moved, and couple nothing.

    Attributes:
        guarded: there may be no forces at some increments (`admits`).
    """

    def __init__(self, term: Any, carried: Carried, at: np.ndarray, near: bool):
        self.term, self.near, self.name = term, near, term.name
        self.rows, self.boxes = carried.rows[at], some_boxes(carried.boxes, at)
        self.carried, self.external = term.carried, term.external
        self.symmetric, self.linear = term.form.symmetric or not near, not near
        self.guarded, self.refines, self.kinked = near and term.law.barrier, True, True
        b = term.layout.block
        self.pairs = np.zeros((0, 2), dtype=int)
        if near:
            held = b if term.law.turning else term.layout.dim
            self.pairs = np.stack(np.divmod(np.arange(held * held), held), axis=1)
        self._value, self._gradient = carried.table[at, 0], carried.table[at, 1:]

    @property
    def _area(self) -> np.ndarray:
        area: np.ndarray = self.term.area_now[self.rows]
        return area

    def _y(self, x: np.ndarray) -> np.ndarray:
        y: np.ndarray = np.einsum("mn,mnb->mb", self._value, x)
        return y

    def forces(self, x: np.ndarray) -> np.ndarray:
        if not self.near:
            return np.zeros_like(x)
        y = self._y(x)
        residual = self.term.evaluate(y, self.rows)[:, : y.shape[1]] * self._area[:, None]
        forces: np.ndarray = self._value[:, :, None] * residual[:, None]
        return forces

    def matrices(self, x: np.ndarray) -> np.ndarray:
        m, n, b = x.shape
        if not self.near:
            return np.zeros((m, n, n, 0))
        moduli = self.term.moduli(self._y(x), self.rows).reshape(m, b, b) * self._area[:, None, None]
        some = moduli[:, self.pairs[:, 0], self.pairs[:, 1]]
        weights = self._value[:, :, None] * self._value[:, None]
        blocks: np.ndarray = weights[..., None] * some[:, None, None]
        return blocks

    def commit(self, x: np.ndarray) -> None:
        d = self.term.layout.dim
        gradient = np.einsum("min,mnj->mji", self._gradient, x[:, :, :d])
        self.term.commit(np.hstack([self._y(x), gradient.reshape(len(x), d * d)]), self.rows)
        if not self.near:
            self.term.finish()

    def balanced(self, x: np.ndarray) -> None:
        if self.near:
            self.term.balance(self._y(x), self.rows)

    def admits(self, x: np.ndarray) -> bool:
        return bool(self.term.admits(self._y(x), self.rows))

    def refine(self, x: np.ndarray) -> bool:
        return bool(self.term.refine(self._y(x), self.rows, self.near))

    def refined(self) -> None:
        self.term.put_multipliers()


def some_boxes(boxes: Any, at: np.ndarray) -> Any:
    """Some of the sets of nodes."""
    if hasattr(boxes, "lowest"):
        return type(boxes)(boxes.count, boxes.lowest[at])
    return type(boxes)(boxes.table[at])
