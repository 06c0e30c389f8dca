"""What multigrid on the lattice has to know of a tangent."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from ..geometry.nodes import ActiveNodes
from ..solvers.linear import LatticeRows
from .sparsity import Pattern


def on_lattice(
    pattern: Pattern,
    nodes: ActiveNodes,
    matrix: Callable[[], PETSc.Mat],
    weak: Callable[[], np.ndarray],
    as_force: np.ndarray,
) -> LatticeRows:
    """The rows of a pattern. Collective.

    Args:
        matrix: what `Pattern.petsc_matrix` has made.
        weak: owned nodes at which there is hardly any of the body (owned nodes,), bool. Collective.
        as_force: by which factors (block,) the residual's components count as forces.
    """
    grid, own = nodes.grid, nodes.owned
    index = grid.node_index(nodes.lattice[:own]).reshape(-1, grid.dim)
    away = np.abs(grid.local(nodes.position[:own]) - index)  # of splines half a cell, or at walls none
    far = np.iinfo(np.int64).max
    ends = np.stack([-index.min(axis=0, initial=far), index.max(axis=0, initial=-far)])
    halves = np.full((1, grid.dim), int(np.any(np.abs(away - 0.5) < 0.25)))
    found = np.concatenate([ends, halves])
    nodes.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
    between = bool(found[2, 0])
    lowest, count = -found[0] - between, int((found[0] + found[1]).max()) + 2 + between
    steps = np.arange(count)[:, None] + lowest
    at = grid.position(steps.astype(float))
    number = found[0] + found[1] + 1 + between
    lines = tuple(np.ascontiguousarray(at[: number[a], a]) for a in range(grid.dim))

    def put() -> None:
        pattern.put(matrix())

    return LatticeRows(
        pattern.block,
        pattern.symmetric,
        index + found[0],
        lines,
        between,
        int(pattern.matrix.reach),
        pattern.offsets,
        pattern.columns,
        pattern.owned_entries,
        pattern.matrix.kept["row_start"][: own * pattern.block],
        pattern.values,
        weak,
        np.asarray(as_force, dtype=float),
        put,
        nodes.comm,
    )
