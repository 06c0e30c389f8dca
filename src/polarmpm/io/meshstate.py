"""What a restart file holds of finite elements.

Rows are found by numbers that don't depend on the ranks: of a quadrature point its id, of a cell its number
in the mesh's input. Nodes have no such number, so a cell's row has the values of all of its nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..bodies.pointfields import COUNTED_FIELDS, MOTION_FIELDS, PLASTIC_FIELDS
from ..bodies.points import Points
from ..errors import InputError
from ..problems.elements import QuasiStaticFEM
from ..tools.parallel import raise_on_all_ranks, values_by_number

_OF_POINTS = ("X", "x", "F", "q", "wryness", "material")
_OF_CELLS = ("X", "displacement", "q")
_MORE = ("counted_from", "carried")  # of nodes, in some states
_STAGED = ("placed", "volume0")  # of points of a body from which elements have been taken
_NEAR = 1e-10  # of a cell; farther apart, two positions aren't the same


def header(problem: QuasiStaticFEM) -> dict[str, Any]:
    """What has to agree between the file and the problem."""
    e = problem.elements
    return {
        "cell": e.body.cell,
        "degree": e.degree,
        "quadrature_degree": e.quadrature_degree,
        "cells": int(e.mesh.topology.index_map(e.dim).size_global),
        "nodes": e.nodes.total,
    }


def arrays(problem: QuasiStaticFEM) -> dict[str, np.ndarray]:
    """This rank's rows by name."""
    e = problem.elements
    nodes = e.cell_nodes[: len(e.body.owned_cells)]  # those in the body, and others
    names = [name for name in ("id", *_names(e.points)) if hasattr(e.points, name)]
    out = {f"points/{name}": getattr(e.points, name) for name in names}
    if e.staged:
        placed = np.tile(np.eye(e.dim), (len(e.points), 1, 1)) if e.placed is None else e.placed
        out |= {"points/placed": placed, "points/volume0": e.points.volume0}
    out["cells/id"] = e.body.original_cells
    kept = {f"kept/{name}": a for name, a in problem.kept().items()}
    if kept:
        out |= {"kept/id": e.points.id, **kept}
    nodal = {"X": e.nodes.position, "displacement": e.moved, "q": e.q}
    nodal |= _more(problem)
    nodal |= {name: held.base for name, held in _slopes(problem).items()}
    return out | {f"cells/{name}": values[nodes] for name, values in nodal.items()}


@dataclass
class Found:
    """A state's rows in the order of this rank's quadrature points and cells (with their nodes)."""

    of_points: dict[str, np.ndarray]
    of_cells: dict[str, np.ndarray]
    kept: dict[str, np.ndarray]


def find(problem: QuasiStaticFEM, rows: dict[str, np.ndarray], path: Any) -> Found:
    """Bring the rows of a state, of which each rank has some, to where they are needed. Collective.

    Raises:
        InputError: the rows belong to another mesh, or to other regions.
    """
    e, p = problem.elements, problem.points
    given = {name.partition("/")[2] for name in rows if name.startswith("points/")}
    of_points, has_points = _find(
        problem, rows, "points", tuple(name for name in (*_names(p), *_STAGED) if name in given), p.id
    )
    _check_stage(problem, rows, path, has_points)
    names = tuple(name[5:] for name in rows if name.startswith("kept/") and name != "kept/id")
    kept, has_kept = _find(problem, rows, "kept", names, p.id) if names else ({}, True)
    numbers = e.body.original_local_cells
    slopes = tuple(name for name in _slopes(problem) if f"cells/{name}" in rows)
    more = tuple(name for name in _MORE if f"cells/{name}" in rows)
    of_cells, has_cells = _find(problem, rows, "cells", (*_OF_CELLS, *slopes, *more), numbers)
    near, error = _NEAR * e.cell_size, None
    if not (
        has_points
        and has_cells
        and has_kept
        and ("placed" in given or np.all(np.abs(of_points["X"] - p.X) <= near))
        and np.all(np.abs(of_cells["X"] - e.nodes.position[e.cell_nodes]) <= near)
    ):
        error = InputError(f"restart file {path}: another mesh; its cells aren't where they were")
    elif np.any(of_points["material"] != p.material):
        error = InputError(f"restart file {path}: other regions; its cells have other materials")
    raise_on_all_ranks(problem.comm, error)
    return Found(of_points, of_cells, kept)


def _check_stage(problem: QuasiStaticFEM, rows: dict[str, np.ndarray], path: Any, all_there: bool) -> None:
    """Refuse a state of other elements of the mesh. Collective."""
    comm, count = problem.comm, len(problem.elements.reference_points)
    saved, here = comm.allreduce(np.array([len(rows["points/id"]), len(problem.points)])) // count
    if saved != here or ("points/placed" in rows and not comm.allreduce(int(all_there)) == comm.size):
        raise InputError(
            f"restart file {path}: its body has {saved} elements, this one {here}, or others: the script is "
            "to remove and add the same ones before it reads the file"
        )


def put(problem: QuasiStaticFEM, found: Found) -> None:
    """Put a state into the elements."""
    e, p, of_cells = problem.elements, problem.points, found.of_cells
    for name in set(COUNTED_FIELDS) & set(vars(p)):
        delattr(p, name)  # displacements count as in the file
    own = {"material", *_STAGED} | (set() if "placed" in found.of_points else {"X"})
    for name in set(found.of_points) - own:
        setattr(p, name, found.of_points[name])
    e.restore_stage(*(found.of_points.get(name) for name in _STAGED))
    problem.keep(found.kept)
    e.moved, e.q = np.zeros_like(e.moved), np.zeros_like(e.q)
    # backwards, so that a node gets what this rank's own cells say, which come first
    back = e.cell_nodes[::-1]
    e.moved[back], e.q[back] = of_cells["displacement"][::-1], of_cells["q"][::-1]
    _put_more(problem, {name: (back, of_cells[name][::-1]) for name in _MORE if name in of_cells})
    for name, held in _slopes(problem).items():
        base = e.moved.copy()  # of what the file doesn't know: from now on
        if name in of_cells:
            base[back] = of_cells[name][::-1]
        held.count_from(base)


def _more(problem: QuasiStaticFEM) -> dict[str, np.ndarray]:
    """What only some states have at the nodes: from where displacements count, and what holds an initial
    stress. Collective."""
    found, e = {}, problem.elements
    if e.counted_from is not None:
        found["counted_from"] = e.counted_from
    if problem.carried_at_rest is not None:
        found["carried"] = problem.carried_at_rest.copy()
        e.nodes.update_ghosts(found["carried"])
    return found


def _put_more(problem: QuasiStaticFEM, found: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    e, made = problem.elements, {}
    for name, (at, values) in found.items():
        made[name] = np.zeros((len(e.nodes), values.shape[2]))
        made[name][at] = values
    e.counted_from, problem.carried_at_rest = made.get("counted_from"), made.get("carried")


def _slopes(problem: QuasiStaticFEM) -> dict[str, Any]:
    """What holds slopes, by the name of the array of the displacement from which it counts."""
    return {f"slope, {s.name}".replace("/", "|"): held for s, held in problem.held_slopes.items()}


def _names(points: Points) -> tuple[str, ...]:
    of_state = (*_OF_POINTS, *(PLASTIC_FIELDS if points.plastic else ()), *COUNTED_FIELDS)
    return (*of_state, *MOTION_FIELDS) if points.moving else of_state


def _find(
    problem: QuasiStaticFEM,
    rows: dict[str, np.ndarray],
    group: str,
    names: tuple[str, ...],
    wanted: np.ndarray,
) -> tuple[dict[str, np.ndarray], bool]:
    """Rows of the wanted numbers by name, and whether there are all of them. Collective."""
    saved = [rows[f"{group}/{name}"] for name in names]
    number = rows[f"{group}/id"]
    flat = [a.reshape(len(number), int(np.prod(a.shape[1:], dtype=int))) for a in saved]
    table = np.concatenate([np.ones((len(number), 1)), *flat], axis=1)
    found = values_by_number(problem.comm, number, table, wanted)
    ends = np.cumsum([1, *(a.shape[1] for a in flat)])
    values = [
        np.ascontiguousarray(found[:, start:end]).reshape(len(wanted), *a.shape[1:])
        for start, end, a in zip(ends[:-1], ends[1:], saved, strict=True)
    ]
    return dict(zip(names, values, strict=True)), bool(np.all(found[:, 0] == 1))
