"""What a linear solver is made of, and what it has to offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

import numpy as np

from ..errors import PolarMPMError

ACCURACY = 1e-8  # residual of a linear system relative to its right-hand side, unless told otherwise


class SingularTangent(PolarMPMError, ArithmeticError):
    """The tangent could not be factored, or the system not be solved; the step is cut."""


@dataclass(frozen=True)
class NearNullSpace:
    """What a tangent hardly resists, for multigrid.

    Attributes:
        motions: rigid motions of the body as it is now (k, owned nodes, block), zero at prescribed unknowns.
        weak: owned nodes at which there is hardly any of the body (owned nodes,), bool.
        as_force: by which factors (block,) the residual's components count as forces.
    """

    motions: np.ndarray
    weak: np.ndarray
    as_force: np.ndarray


@dataclass(frozen=True)
class Tangent:
    """A matrix whose entries change, while its pattern stays.

    Attributes:
        matrix: of PETSc; it belongs to the solver from now on. Of a symmetric one the entries may be its
            upper triangle only (types sbaij).
        symmetric: the matrix is symmetric.
        far_from_symmetric: its symmetric part is no help (plastic flow).
        large: a factor would take more time than multigrid, see `choice.is_large`.
        near_null_space: what the matrix hardly resists, as it is now. Collective.
        stored: the entries that the matrix uses, and where those of the diagonal are; None: it has its own.
    """

    matrix: PETSc.Mat
    symmetric: bool
    near_null_space: Callable[[], NearNullSpace]
    far_from_symmetric: bool = False
    large: bool = False
    stored: tuple[np.ndarray, np.ndarray] | None = None


class LinearSolver(Protocol):
    """Solves with a tangent whose entries change now and then. All methods are collective.

    Attributes:
        matrix: of the tangent, which the solver has taken over.
    """

    matrix: PETSc.Mat

    def factor(self) -> None:
        """The matrix has new entries.

        Raises:
            SingularTangent: no solutions with it are possible.
        """

    def solve(self, rhs: np.ndarray, accuracy: float = ACCURACY) -> np.ndarray:
        """Solution (n,) for the owned unknowns (n,), with a residual of at most `accuracy` times the
        right-hand side.

        Raises:
            SingularTangent: there is none.
        """

    def destroy(self) -> None:
        """Release PETSc's objects, the matrix too."""
