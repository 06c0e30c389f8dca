"""The choice of a linear solver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from petsc4py import PETSc

import numpy as np

from ..errors import InputError
from .direct import ACCURACY, DirectSolver

SOLVERS = ("auto", "direct", "multigrid")
# Nodes in a layer across the body from which on multigrid takes less time in space: their power 1.5 measures
# the operations of a factor by nested dissection for each entry of the matrix. Several ranks bring a factor
# little, multigrid nearly all they have.
_LARGE, _LARGE_ON_RANKS = 250, 150


class LinearSolver(Protocol):
    """Solves with a matrix that changes its entries now and then."""

    matrix: PETSc.Mat
    symmetric: bool

    def factor(self) -> None: ...

    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray: ...

    def destroy(self) -> None: ...


def check_solver(solver: str) -> str:
    """Raise InputError unless it is one of `SOLVERS`."""
    if solver not in SOLVERS:
        raise InputError(f"solver = {solver!r}: allowed are {', '.join(SOLVERS)}")
    return solver


def is_large(dim: int, layer: float, ranks: int) -> bool:
    """Whether multigrid takes less time than a factor. `layer`: mean number of nodes in a layer, one cell
    thick, across the body's longest direction; a factor of a slender body is cheap, however many unknowns
    it has."""
    return dim == 3 and layer >= (_LARGE if ranks == 1 else _LARGE_ON_RANKS)


def takes_multigrid(solver: str, large: bool) -> bool:
    """Whether a solver's name stands for multigrid in a system that `is_large` or isn't."""
    return solver == "multigrid" or (solver == "auto" and large)


def make_solver(
    solver: str,
    large: bool,
    matrix: PETSc.Mat,
    symmetric: bool,
    far_from_symmetric: bool,
    hints: Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]],
    stored: tuple[np.ndarray, np.ndarray] | None = None,
) -> LinearSolver:
    """The solver of a name; "auto" takes multigrid where the body `is_large`. Arguments as of
    `multigrid.MultigridSolver` and `DirectSolver`. Collective."""
    if not takes_multigrid(solver, large):
        return DirectSolver(matrix, symmetric, far_from_symmetric, stored=stored)
    from .multigrid import MultigridSolver  # small problems don't know of it

    return MultigridSolver(matrix, symmetric, hints, far_from_symmetric)
