"""Solutions of systems whose tangent is summed into the rows of a pattern."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..solvers.linear import LinearSolver
from .inertia import Inertia, MassSets
from .sparsity import Pattern
from .system import NodalSystem


class OnPattern(NodalSystem):
    """What systems of points and of elements share.

    Attributes:
        pattern: holds the tangent's entries.
    """

    pattern: Pattern
    solver: LinearSolver

    @abstractmethod
    def mass_sets(self, mass: np.ndarray) -> Iterator[MassSets]:
        """Sums of the masses (np, 2) of this rank's points, for displacements and for rotations."""

    @property
    @abstractmethod
    def batches(self) -> int:
        """In how many lots, by material, the points are."""

    @abstractmethod
    def unknowns(self, k: int) -> np.ndarray:
        """z (n, nz) of the points of lot k at the present increments, in the kernel's frame."""

    @abstractmethod
    def elastic_tangent(self, k: int) -> tuple[np.ndarray, int]:
        """Residual and upper triangle of the elastic tangent of lot k's points at the present increments, and
        nz. Collective."""

    @abstractmethod
    def add_given(
        self, k: int, blocks: np.ndarray, tangent: bool, internal: np.ndarray, lifted: np.ndarray | None
    ) -> None:
        """Add given stresses and moduli of lot k's points, on this rank."""

    def viscous_forces(self) -> np.ndarray:
        out = np.zeros_like(self.x)
        self._add_viscosity(False, out, None)
        self.nodes.add_to_owners(out)
        return out

    def _add_viscosity(self, tangent: bool, internal: np.ndarray, lifted: np.ndarray | None) -> None:
        if self.viscosity is not None:
            for k in range(self.batches):
                blocks = self.viscosity.blocks(self, k, tangent)
                self.add_given(k, blocks, tangent, internal, lifted)

    def add_inertia(
        self,
        inertia: Inertia,
        tangent: bool,
        lift: np.ndarray | None,
        internal: np.ndarray,
        lifted: np.ndarray | None,
    ) -> None:
        """Add the points' inertia to sums that are complete on owned rows, with `tangent` to those of the
        matrix, whose rows of ghosts are still to be collected. Collective."""
        internal += inertia.forces(self)
        if tangent:
            inertia.add_tangent(self)
        if lift is not None and lifted is not None:
            lifted += inertia.products(self, lift)

    @property
    def tangent(self) -> Any:
        if self._in_place:
            self.pattern.put(self.solver.matrix)
        return self.solver.matrix

    @property
    def _in_place(self) -> bool:
        """Whether the solver takes the entries from the pattern, and PETSc's matrix isn't needed."""
        return bool(getattr(self.solver, "in_place", False))

    def diagonal(self) -> np.ndarray:
        diagonal: np.ndarray = self.pattern.values[self.pattern.diagonal].reshape(-1, self.layout.block)
        return diagonal

    def solve_again(self, right: np.ndarray) -> np.ndarray:
        """Solve with the factor at hand for (owned nodes, block), and leave all as it is. Collective.

        Raises:
            SingularTangent: there is none; no solution.
        """
        solver: Any = self.solver
        with self.timer("solve"):
            again = getattr(solver, "solve_again", solver.solve)  # a script's own may have no other
            found: np.ndarray = again(right.ravel())
            return found.reshape(right.shape)

    def solve(self, right: np.ndarray, fresh: bool, accuracy: float) -> np.ndarray:
        if fresh:
            values, diagonal = self.pattern.values, self.pattern.diagonal
            # prescribed unknowns, and nodes that points on a plane or a corner touch without any weight
            values[diagonal[values[diagonal] == 0.0]] = 1.0
            if self.diagonal_shift:
                values[diagonal] *= 1.0 + self.diagonal_shift
            with self.timer("factor"):
                if not self._in_place:
                    self.pattern.put(self.solver.matrix)
                self.solver.factor()
        with self.timer("solve"):
            return self.solver.solve(right.ravel(), accuracy).reshape(right.shape)
