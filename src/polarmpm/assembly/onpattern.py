"""Solutions of systems whose tangent is summed into the rows of a pattern."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..solvers.linear import LinearSolver
from .sparsity import Pattern
from .system import NodalSystem


class OnPattern(NodalSystem):
    """What systems of points and of elements share.

    Attributes:
        pattern: holds the tangent's entries.
    """

    pattern: Pattern
    solver: LinearSolver

    @property
    def tangent(self) -> Any:
        return self.solver.matrix

    def diagonal(self) -> np.ndarray:
        diagonal: np.ndarray = self.pattern.values[self.pattern.diagonal].reshape(-1, self.layout.block)
        return diagonal

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        if fresh:
            values, diagonal = self.pattern.values, self.pattern.diagonal
            # prescribed unknowns, and nodes that points on a plane or a corner touch without any weight
            values[diagonal[values[diagonal] == 0.0]] = 1.0
            if self.diagonal_shift:
                values[diagonal] *= 1.0 + self.diagonal_shift
            with self.timer("factor"):
                self.pattern.put(self.solver.matrix)
                self.solver.factor()
        with self.timer("solve"):
            return self.solver.solve(right.ravel(), accuracy).reshape(right.shape)
