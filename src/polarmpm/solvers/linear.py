"""What a linear solver is made of, and what it has to offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from mpi4py import MPI
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
class LatticeRows:
    """The rows of a tangent on a lattice, for multigrid that works on them.

    Attributes:
        block: unknowns of a node.
        half: of a symmetric tangent, the upper triangle.
        nodes: lattice indices (owned nodes, d), ascending; global numbers of a rank follow those of the rank
            before.
        lines: coordinates (m) of the lines across each axis, for all nodes of all ranks.
        between: nodes stand in the middle between two lines, not on them.
        reach: largest lattice distance of two nodes that are coupled.
        offsets, columns: block rows of the owned nodes; columns are global, ascending.
        entries: how many the owned rows have.
        row_start: where block column 0 of each row is in `values`, whether it is stored or not.
        values: the entries.
        weak: owned nodes at which there is hardly any of the body (owned nodes,), bool. Collective.
        as_force: by which factors (block,) the residual's components count as forces.
        put: gives PETSc's matrix the entries. Collective.
        comm: of the ranks.
    """

    block: int
    half: bool
    nodes: np.ndarray
    lines: tuple[np.ndarray, ...]
    between: bool
    reach: int
    offsets: np.ndarray
    columns: np.ndarray
    entries: int
    row_start: np.ndarray
    values: np.ndarray
    weak: Callable[[], np.ndarray]
    as_force: np.ndarray
    put: Callable[[], None]
    comm: MPI.Comm

    @property
    def equal(self) -> bool:
        """Whether cells have the same size along each axis."""
        sizes = [np.diff(a) for a in self.lines]
        return all(bool(np.ptp(h) <= 1e-6 * h[0]) for h in sizes if len(h))


@dataclass(frozen=True)
class Rows:
    """The rows of a tangent on one rank, whose pattern is symmetric.

    Attributes:
        block: unknowns of a node.
        indptr: where scalar rows begin, in symmetric tangents of the upper triangle.
        columns: gives their columns.
        values: the entries.
        put: gives PETSc's matrix the entries.
    """

    block: int
    indptr: np.ndarray
    columns: Callable[[], np.ndarray]
    values: np.ndarray
    put: Callable[[], None]

    @cached_property
    def indices(self) -> np.ndarray:
        """Columns of the scalar rows."""
        return self.columns()


@dataclass(frozen=True)
class Tangent:
    """A matrix whose entries change, while its pattern stays.

    Attributes:
        make: makes the matrix; collective.
        symmetric: the matrix is symmetric.
        far_from_symmetric: its symmetric part is no help (plastic flow).
        large: a factor would take more time than multigrid, see `choice.is_large`.
        near_null_space: what the matrix hardly resists, as it is now. Collective.
        stored: the entries that the matrix uses, and where those of the diagonal are; None: it has its own.
        lattice: its rows, where nodes stand on a lattice; None: they don't. Collective.
        rows: its rows, on one rank; None: they aren't at hand.
    """

    make: Callable[[], PETSc.Mat]
    symmetric: bool
    near_null_space: Callable[[], NearNullSpace]
    far_from_symmetric: bool = False
    large: bool = False
    stored: tuple[np.ndarray, np.ndarray] | None = None
    lattice: Callable[[], LatticeRows] | None = None
    rows: Rows | None = None

    @cached_property
    def matrix(self) -> PETSc.Mat:
        """Of PETSc, made when it is asked for first; it belongs to the solver from then on. Of a symmetric
        one the entries may be its upper triangle only (types sbaij). Collective."""
        return self.make()


class LinearSolver(Protocol):
    """Solves with a tangent whose entries change now and then. All methods are collective."""

    @property
    def matrix(self) -> PETSc.Mat:
        """Of the tangent, which the solver has taken over."""

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
