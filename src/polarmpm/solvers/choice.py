"""The choice of a linear solver, by its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..tools import checks
from .direct import DirectSolver
from .linear import LinearSolver, Tangent

# Nodes in a layer across the body from which on multigrid takes less time in space: their power 1.5 measures
# the operations of a factor by nested dissection for each entry of the matrix. Several ranks bring a factor
# little, multigrid nearly all they have.
_LARGE, _LARGE_ON_RANKS = 250, 150  # on a mesh
_ON_LATTICE, _ON_LATTICE_ON_RANKS = 60, 40
_IN_PLANE, _ROW = 30_000, 40  # on a lattice in the plane: unknowns, and nodes in a row across the body


@dataclass(frozen=True)
class Solver:
    """A way to solve linear systems.

    Attributes:
        make: makes a solver of a tangent. Collective.
        whole_rows: it wants both triangles of symmetric matrices, where several ranks share them.
    """

    make: Callable[[Tangent], LinearSolver]
    whole_rows: bool = False


def _direct(tangent: Tangent) -> LinearSolver:
    return DirectSolver(
        tangent.make,
        tangent.symmetric,
        tangent.far_from_symmetric,
        stored=tangent.stored,
        compact=tangent.large,
        rows=tangent.rows,
    )


def _multigrid(tangent: Tangent) -> LinearSolver:
    if tangent.lattice is not None:
        from .lattice import LatticeSolver  # lazy import: small problems need no multigrid

        return LatticeSolver(tangent.make, tangent.symmetric, tangent.lattice(), tangent.far_from_symmetric)
    return algebraic(tangent)


def algebraic(tangent: Tangent) -> LinearSolver:
    """Multigrid that needs no lattice. Collective."""
    from .algebraic import AlgebraicSolver  # lazy import: small problems need no multigrid

    return AlgebraicSolver(
        tangent.matrix, tangent.symmetric, tangent.near_null_space, tangent.far_from_symmetric
    )


SOLVERS: dict[str, Solver] = {"direct": Solver(_direct), "multigrid": Solver(_multigrid, whole_rows=True)}


def register_solver(name: str, make: Callable[[Tangent], LinearSolver], *, whole_rows: bool = False) -> None:
    """Make a linear solver known by a name, which `QuasiStatic` and `QuasiStaticFEM` take as `solver`.

    Args:
        make: makes a `LinearSolver` of a `Tangent`; collective.
        whole_rows: it wants both triangles of symmetric matrices, where several ranks share them.

    Raises:
        InputError: the name is taken, or make is not a function.
    """
    taken = f"a name other than auto, {', '.join(SOLVERS)}"
    if checks.text("solver", name, taken) == "auto" or name in SOLVERS:
        raise checks.refuse("solver", name, taken)
    checks.function(f"solver {name!r}: make", make, "a function of a Tangent is", takes=("tangent",))
    SOLVERS[name] = Solver(make, checks.flag("whole_rows", whole_rows))


def check_solver(solver: str) -> str:
    """Raise InputError unless it is "auto" or a known solver's name."""
    if not isinstance(solver, str) or (solver != "auto" and solver not in SOLVERS):
        raise checks.refuse("solver", solver, f"allowed are auto, {', '.join(SOLVERS)}")
    return solver


def is_large(dim: int, layer: float, ranks: int, lattice: bool = False, unknowns: int = 0) -> bool:
    """Whether multigrid takes less time than a factor.

    Args:
        layer: mean number of nodes in a layer, one cell thick, across the body's longest direction; a slender
            body's factor is cheap, however large it is.
        lattice: nodes are on one.
        unknowns: of all ranks; they count in the plane.
    """
    if not lattice:
        return dim == 3 and layer >= (_LARGE if ranks == 1 else _LARGE_ON_RANKS)
    if dim == 3:
        return layer >= (_ON_LATTICE if ranks == 1 else _ON_LATTICE_ON_RANKS)
    return layer >= _ROW and unknowns >= _IN_PLANE


def solver_of(name: str, large: bool) -> Solver:
    """The solver of a name; "auto" takes multigrid where the body `is_large`."""
    return SOLVERS[("multigrid" if large else "direct") if name == "auto" else name]


def make_solver(name: str, tangent: Tangent) -> LinearSolver:
    """A solver of a tangent. Collective."""
    return solver_of(name, tangent.large).make(tangent)
