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

from ..bodies.points import Points
from ..errors import InputError
from ..geometry.grid import Grid, box_indices
from ..geometry.nodes import ActiveNodes
from ..geometry.surfaces import Surface
from ..kinematics.layout import Layout
from ..kinematics.timesteps import TimeStep
from ..tools.checks import ordinary, refuse, shown, whole
from ..tools.parallel import errors_on_all_ranks


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

    Raises:
        InputError: not one positive count for each direction, or numbers that aren't whole.
    """

    count: tuple[int, ...]
    lowest: np.ndarray

    def __post_init__(self) -> None:
        count = self.count if isinstance(self.count, Sequence) else ()
        if len(count) not in (2, 3):
            raise refuse("Boxes: count", self.count, "two or three numbers of nodes are needed")
        object.__setattr__(self, "count", tuple(whole("Boxes: count", n, least=1) for n in count))
        lowest = _array(self.lowest)
        if lowest.ndim != 1 or (lowest.size and lowest.dtype.kind not in "iu"):
            raise refuse("Boxes: lowest", self.lowest, "lattice numbers (m,), whole numbers, are needed")
        object.__setattr__(self, "lowest", lowest.astype(np.int64, copy=False))

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


@dataclass(frozen=True)
class BoxPairs:
    """Sets of nodes that are two boxes of lattice nodes each, in different bodies.

    Attributes:
        parts: the first boxes of all sets, and the second ones.
    """

    parts: tuple[Boxes, Boxes]

    def rows(self, nodes: ActiveNodes) -> np.ndarray:
        """Local rows of the nodes (m, n), those of the first boxes first."""
        return np.hstack([part.rows(nodes) for part in self.parts])


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
        guarded: there are increments at which it has no forces, see `admits`; the same on all ranks.
        refines: it has to be asked by `refine`; the same on all ranks.
        kinked: its tangent jumps, so that iterations need a line search; the same on all ranks.
        mover: a rigid body (`terms.rigid`) on which its forces depend; the same on all ranks.
    """

    name: str
    boxes: NodeSets
    pairs: np.ndarray
    symmetric: bool = True
    linear: bool = False
    external: bool = False
    carried: bool = True
    fresh: bool = False
    guarded: bool = False
    refines: bool = False
    kinked: bool = False
    of: Term | None = None
    mover: Any = None

    @abstractmethod
    def forces(self, x: np.ndarray) -> np.ndarray:
        """Residual forces (m, n, b) at increments (m, n, b)."""

    @abstractmethod
    def matrices(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of the forces' components i by increments' components j, (m or 1, n, n, k)."""

    def commit(self, x: np.ndarray) -> None:  # noqa: B027
        """Take note of the increments (m, n, b) of a converged step. Collective."""

    def starts(self, x: np.ndarray) -> None:  # noqa: B027
        """A step begins at increments (m, n, b). Local."""

    def balanced(self, x: np.ndarray) -> None:  # noqa: B027
        """In dynamics: forces are in balance at increments (m, n, b), before the step ends. Local."""

    def admits(self, x: np.ndarray) -> bool:
        """Whether it has forces at increments (m, n, b). Local."""
        return True

    def refine(self, x: np.ndarray) -> bool:
        """After iterations have converged at increments (m, n, b): whether its forces are to be improved, so
        that iterations go on. Local.

        Raises:
            LocalFailure: the solution can't be taken.
        """
        return False

    def refined(self) -> None:  # noqa: B027
        """Some piece has something to improve: take what `refine` has found. Local."""


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
        points: the body; of a mesh its quadrature points.
    """

    layout: Layout
    comm: MPI.Comm
    points: Points

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
        regroup: its pieces don't act on the right nodes any more: the next step is to begin with new ones,
            without a reset; the same on all ranks.
        renew: its pieces don't fit the present state any more: the next step is to begin with a reset; the
            same
            on all ranks.
        rows: arrays (np, ...) with one row for each local point of the body, by name. They move with the
            points to other ranks and into restart files.
    """

    name: str = "term"
    carried: bool = True
    proportional: bool = True
    committed: bool = False
    taken: bool = False
    renew: bool = False
    regroup: bool = False
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

    def end_at(self, factor: float) -> None:  # noqa: B027
        """The step ends at a load factor, or time; forces were in balance at that of `set_factor`."""

    def finished(self) -> None:  # noqa: B027
        """A step has converged, and all pieces have been told."""

    def integrate(self, step: TimeStep) -> None:  # noqa: B027
        """A step in time begins, for terms that have an inertia of their own; in dynamic problems."""

    def begin_step(self, duration: float) -> None:  # noqa: B027
        """A step in time begins (s), to the state in which its forces are in balance; in dynamic problems."""

    def state(self) -> dict[str, np.ndarray]:
        """All else that a restart needs, the same on every rank, by name."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:  # noqa: B027
        """Put in what `state` gave.

        Raises:
            InputError: it is of another term.
        """


def pieces_of(term: Term, setting: Setting) -> list[Piece]:
    """A term's pieces from now on. Collective.

    Raises:
        InputError: it gives something else.
    """
    with errors_on_all_ranks(setting.comm, term.name):
        made = term.pieces(setting)
        if not isinstance(made, Sequence) or not all(isinstance(piece, Piece) for piece in made):
            raise InputError(f"{term.name}: pieces returned {shown(made)}; a list of Piece is needed")
        for piece in made:
            _check_piece(term.name, piece, setting.layout.block)
    for piece in made:
        piece.of = term
    return list(made)


def _check_piece(name: str, piece: Piece, block: int) -> None:
    for what in ("name", "boxes", "pairs"):
        if not hasattr(piece, what):
            raise InputError(f"{name}: its {type(piece).__name__} has no {what}")
    pairs = _array(piece.pairs)
    good = pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype.kind in "iu"
    if not good or np.any((pairs < 0) | (pairs >= block)):
        allowed = f"components from 0 to {block - 1}, whole numbers (k, 2), are needed"
        raise refuse(f"{name}: pairs", piece.pairs, allowed)
    if not callable(getattr(piece.boxes, "rows", None)):
        raise refuse(f"{name}: boxes", piece.boxes, "sets of nodes, such as Boxes, are needed")


def forces_of(piece: Piece, x: np.ndarray) -> np.ndarray:
    """Residual forces (m, n, b) of a piece at increments (m, n, b).

    Raises:
        InputError: they have another shape.
    """
    forces = _array(piece.forces(x))
    if forces.shape != x.shape or forces.dtype.kind not in "fiu":
        raise InputError(
            f"{piece.name}: its forces are of type {forces.dtype} and shape {forces.shape}; numbers of shape "
            f"{x.shape}, that of the increments, are needed"
        )
    return forces


def matrices_of(piece: Piece, x: np.ndarray) -> np.ndarray:
    """Derivatives (m or 1, n, n, k) of a piece's forces at increments (m, n, b).

    Raises:
        InputError: they have another shape.
    """
    matrices, (m, n, _) = _array(piece.matrices(x)), x.shape
    rest = n, n, len(piece.pairs)
    if matrices.shape not in ((m, *rest), (1, *rest)) or matrices.dtype.kind not in "fiu":
        raise InputError(
            f"{piece.name}: its matrices are of type {matrices.dtype} and shape {matrices.shape}; numbers of "
            f"shape {(m, *rest)} are needed"
        )
    return matrices


def _array(value: Any) -> np.ndarray:
    """What a script gives as an array, if it is one; else something that is no number."""
    try:
        return np.asarray(value)
    except Exception as e:  # rows of several lengths, say, and a script's class may do anything
        if not ordinary(e):
            raise
        return np.array(None)


def multiply(pairs: np.ndarray, matrices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products (m, n, b) of matrices (m or 1, n, n, k) and values (m, n, b)."""
    parts = np.einsum("maqk,mqk->mak", matrices, x[:, :, pairs[:, 1]])
    out = np.zeros_like(x)
    for k, i in enumerate(pairs[:, 0]):
        out[:, :, i] += parts[:, :, k]
    return out
