"""Meshes and finite element problems that several test modules share."""

from __future__ import annotations

from typing import Any

import numpy as np

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR

DIMENSION = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}


def box(cell: str, cells: Any, size: Any = None, *, distort: float = 0.0, comm: Any = COMM) -> Any:
    """A box of cells in its own corner; `distort` shifts all nodes, on straight faces too, by a share of a
    cell, so that cells are no parallelepipeds."""
    from dolfinx import mesh

    dim = DIMENSION[cell]
    size = np.ones(dim) if size is None else np.asarray(size, float)
    corners, kind = [np.zeros(dim), size], getattr(mesh.CellType, cell)
    make = mesh.create_rectangle if dim == 2 else mesh.create_box
    made = make(comm, corners, list(cells), kind)
    if distort:
        share = made.geometry.x[:, :dim] / size  # a shift of positions is the same on every rank
        wave = np.stack([np.sin(5 * share @ np.roll([1.0, 2.3, 1.7][:dim], k) + k) for k in range(dim)], 1)
        made.geometry.x[:, :dim] += distort * wave * size / np.asarray(cells)
    return made


def everywhere(x: np.ndarray) -> np.ndarray:
    return np.ones(len(x), dtype=bool)


def cantilever(
    cell: str = "quadrilateral",
    material: pm.Material = MICROPOLAR,
    *,
    degree: int = 1,
    cells: Any = None,
    controls: pm.Controls | None = None,
    **options: Any,
) -> pm.QuasiStaticFEM:
    """A bar of 4 x 1 (x 1), held at x = 0, without a load."""
    dim = DIMENSION[cell]
    mesh = box(cell, cells or (4, 1, 1)[:dim], (4.0, 1.0, 1.0)[:dim], **options)
    problem = pm.QuasiStaticFEM(pm.Elements(mesh, material=material, degree=degree), controls=controls)
    problem.fix(pm.plane(x=0.0), u=0, **({"theta": 0} if material.micropolar else {}))
    return problem


def at_nodes(elements: pm.Elements, values: np.ndarray) -> np.ndarray:
    """Values of all ranks' own nodes in the order of their positions. Collective."""
    own = elements.nodes.owned
    x = np.concatenate(COMM.allgather(elements.nodes.position[:own]))
    order = np.lexsort(np.round(x / elements.cell_size, 6).T)
    return np.concatenate(COMM.allgather(np.asarray(values)[:own]))[order]


def own_rows(problem: pm.QuasiStaticFEM, nodal: np.ndarray) -> np.ndarray:
    """Owned rows of all ranks as one vector, in the order of the matrix. Collective."""
    own = problem.elements.nodes.owned
    return np.concatenate(COMM.allgather(nodal[:own])).ravel()


def prepared(problem: pm.QuasiStaticFEM, factor: float = 1.0) -> Any:
    """The system with the loads of a load factor. Collective."""
    system = problem.system_at(factor)
    return system


def put(problem: pm.QuasiStaticFEM, system: Any, x: np.ndarray) -> None:
    """Set the increments from a vector of all ranks' own rows. Collective."""
    block, nodes = problem.layout.block, problem.elements.nodes
    first = COMM.exscan(nodes.owned) or 0
    system.x[: nodes.owned] = x.reshape(-1, block)[first : first + nodes.owned]
    nodes.update_ghosts(system.x)


def residual_at(problem: pm.QuasiStaticFEM, system: Any, x: np.ndarray) -> np.ndarray:
    put(problem, system, x)
    system.evaluate(False)
    return own_rows(problem, system.residual)


def tangent_at(problem: pm.QuasiStaticFEM, system: Any, x: np.ndarray) -> np.ndarray:
    """The assembled matrix, dense; without supports all of its entries are there. Collective."""
    put(problem, system, x)
    system.evaluate(True)
    return dense(problem, system)


def dense(problem: pm.QuasiStaticFEM, system: Any) -> np.ndarray:
    """The system's matrix as it has been assembled last, dense. Collective."""
    if hasattr(system, "pattern"):
        system.pattern.put(system.tangent)
    matrix = system.tangent
    first, last = matrix.getOwnershipRange()
    columns = np.arange(matrix.size[1], dtype=np.int32)
    if "sbaij" in matrix.getType():
        matrix.setOption(matrix.Option.GETROW_UPPERTRIANGULAR, True)
    rows = np.zeros((last - first, len(columns)))
    for k, row in enumerate(range(first, last)):
        at, values = matrix.getRow(row)
        rows[k, at] = values
    k = np.concatenate(COMM.allgather(rows))
    return np.triu(k) + np.triu(k, 1).T if "sbaij" in matrix.getType() else k
