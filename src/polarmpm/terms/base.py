"""Contributions to the nodal system that don't come from the stresses of a body: where one adds physics.

A `Term` is what a script adds to a problem: `problem.add(term)`. Whenever increments begin to count afresh,
it makes `Piece`s: these act on sets of nodes, all of the same size, and belong to the time until the next
such moment (a reset of the grid, a converged step of elements). A piece's forces depend on the increments of
a set's nodes, and its tangent is a dense matrix for each set, whose node pairs are coupled in the sparse
matrix. A set is on one rank.

Shapes: m sets on this rank, n nodes in a set, b unknowns of a node, k coupled pairs of components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..geometry.nodes import ActiveNodes
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout


class NodeSets(Protocol):
    """Sets of nodes, of the same size each."""

    def rows(self, nodes: ActiveNodes) -> np.ndarray:
        """Local rows of the nodes (m, n)."""


@dataclass(frozen=True)
class Boxes:
    """Boxes of lattice nodes; the last axis runs fastest.

    Attributes:
        count: nodes in each direction.
        lowest: lattice number of each box's lowest node (m,).
    """

    count: tuple[int, ...]
    lowest: np.ndarray

    @cached_property
    def offsets(self) -> np.ndarray:
        """Lattice distance of a box's nodes from its lowest one, (n, d)."""
        return box_indices(self.count)

    def numbers(self, grid: Grid) -> np.ndarray:
        """Lattice numbers of the nodes (m, n)."""
        numbers: np.ndarray = self.lowest[:, None] + self.offsets @ grid.strides
        return numbers

    def rows(self, nodes: ActiveNodes) -> np.ndarray:
        """Local rows of the nodes (m, n)."""
        numbers = self.numbers(nodes.grid)
        return nodes.local(numbers.ravel()).reshape(numbers.shape)


class Piece(ABC):
    """What a term contributes until increments begin to count afresh.

    Attributes:
        name: under which its work is summed.
        boxes: where it acts.
        pairs: components (i, j) that it couples, (k, 2).
        symmetric: its tangent is symmetric.
        linear: its tangent doesn't change.
        external: a load or a support; its forces count as such in the convergence measure.
        carried: see `Term`.
        of: its term; the problem sees to it.
        fresh: its term has not taken part in a converged step yet: nothing of it is carried along.
    """

    name: str
    boxes: NodeSets
    pairs: np.ndarray
    symmetric: bool = True
    linear: bool = False
    external: bool = False
    carried: bool = True
    fresh: bool = False
    of: Term | None = None

    @abstractmethod
    def forces(self, x: np.ndarray) -> np.ndarray:
        """Residual forces (m, n, b) at increments (m, n, b)."""

    @abstractmethod
    def matrices(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of the forces' components i by increments' components j, (m or 1, n, n, k)."""

    def commit(self, x: np.ndarray) -> None:  # noqa: B027
        """Take note of the increments (m, n, b) of a converged step. Collective."""


@dataclass
class Carried:
    """Places that the body carries, and the functions that move them; m of them on this rank.

    Attributes:
        rows: which of the places these are (m,).
        boxes: the nodes of each.
        table: values and gradients (1/m) of the nodes' functions at them, (m, 1 + d, n); gradients with
            respect to the state from which increments count.
    """

    rows: np.ndarray
    boxes: NodeSets
    table: np.ndarray


class Setting(ABC):
    """What a term is handed when increments begin to count.

    Attributes:
        layout: unknowns of a node.
        comm: the ranks that take part.
    """

    layout: Layout
    comm: MPI.Comm

    @abstractmethod
    def carry(self, places: Places) -> Carried:
        """The functions that carry places with the body. Collective.

        Raises:
            InputError: a place lies outside of the body, naming it.
        """

    @abstractmethod
    def alone(self, nodes: np.ndarray) -> NodeSets:
        """Sets of one node each, of nodes as `node_volumes` names them."""

    @abstractmethod
    def node_volumes(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (lattice numbers; of a mesh local rows) and this rank's share of the body's volume (m^3) at
        each; complete when summed over the ranks."""


class Places(Protocol):
    """Points of a surface that the body carries.

    Attributes:
        name: for messages.
        surface: where they are in the undeformed body.
        displacement: what they have moved since (m), (n, d).
        deformation: deformation gradient at them (n, d, d).
        committed: they have taken part in a converged step.
    """

    name: str
    surface: Surface

    @property
    def displacement(self) -> np.ndarray: ...

    @property
    def deformation(self) -> np.ndarray: ...

    @property
    def committed(self) -> bool: ...


class Term(ABC):
    """A contribution to the nodal system, for `problem.add`; lives as long as the problem.

    Attributes:
        name: for messages, and under which its work is summed.
        carried: a balanced reset, and a new base of the rotations, may carry its forces along. False for
            terms that keep them in a state of their own, such as inertia.
        proportional: at given increments its forces are linear in the load factor, and what grows with the
            factor doesn't depend on the increments: the arc-length method can take it.
        committed: it has taken part in a converged step; the problem sees to it.
        taken: it belongs to a problem.
        rows: arrays (np, ...) with one row for each local point of the body, by name. They move with the
            points to other ranks and into restart files.
    """

    name: str = "term"
    carried: bool = True
    proportional: bool = True
    committed: bool = False
    taken: bool = False
    rows: dict[str, np.ndarray]

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        """Whatever a subclass' own `__init__` does, it has rows."""
        term = super().__new__(cls)
        term.rows = {}
        return term

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r})"

    def attach(self, layout: Layout, comm: MPI.Comm) -> None:  # noqa: B027
        """The problem that takes it has these unknowns and ranks.

        Raises:
            InputError: they don't go together; the problem stays as it was.
        """

    def begin_at(self, factor: float, counts: str | None) -> None:  # noqa: B027
        """It is added at a load factor; `counts` as of `problem.add`."""

    def fade(self, begin: float, end: float) -> None:
        """It is released: it shall vanish evenly from one load factor to another.

        Raises:
            InputError: it can only be released at once.
        """
        raise InputError(f"{self.name}: can be released at once only, without over and until")

    @abstractmethod
    def pieces(self, setting: Setting) -> Sequence[Piece]:
        """Its pieces from now on. Collective."""

    def begin(self) -> None:  # noqa: B027
        """Increments begin to count from the present state."""

    def rebase_rotations(self) -> None:  # noqa: B027
        """Rotation increments begin to count from the present rotations."""

    def set_factor(self, factor: float, carrying: bool = False) -> None:  # noqa: B027
        """Put the values of a load factor in. `carrying`: those with which the last step has converged, for
        forces that are to be carried along."""

    def state(self) -> dict[str, np.ndarray]:
        """All else that a restart needs, the same on every rank, by name."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:  # noqa: B027
        """Put in what `state` gave.

        Raises:
            InputError: it is of another term.
        """


def multiply(pairs: np.ndarray, matrices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products (m, n, b) of matrices (m or 1, n, n, k) and values (m, n, b)."""
    parts = np.einsum("maqk,mqk->mak", matrices, x[:, :, pairs[:, 1]])
    out = np.zeros_like(x)
    for k, i in enumerate(pairs[:, 0]):
        out[:, :, i] += parts[:, :, k]
    return out
