"""What ParaView shows of a body of finite elements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.elements import Elements
from .paraview import padded

_KINDS = {
    ("triangle", 1): "triangle",
    ("triangle", 2): "triangle6",
    ("quadrilateral", 1): "quad",
    ("quadrilateral", 2): "quad9",
    ("tetrahedron", 1): "tetra",
    ("tetrahedron", 2): "tetra10",
    ("hexahedron", 1): "hexahedron",
    ("hexahedron", 2): "hexahedron27",
}
_CORNERS = {"triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}
NODAL = ("displacement", "rotation")


OF_CELLS = ("id", "material", "volume")  # which have no values at nodes


def mesh_piece(
    elements: Elements,
    names: Sequence[str],
    at_points: dict[str, np.ndarray],
    at_nodes: dict[str, np.ndarray],
) -> dict[str, Any]:
    """This rank's own cells, undeformed, with nodal fields and cells' means, for `Collection.add`. Cells of
    degree 3 are those of degree 1: through their corners.

    Args:
        names: of all fields.
        at_points: values at the quadrature points (np, ...) of the fields that aren't nodal.
        at_nodes: values at the local nodes (nodes, ...) of fields that are to be so.
    """
    own, cell = elements.live_nodes, elements.body.cell
    degree = elements.degree if elements.degree < 3 else 1
    if degree != elements.degree:
        own = own[:, : _CORNERS[cell]]  # the first nodes
    nodes, cells = np.unique(own, return_inverse=True)
    nodal = {}
    if "displacement" in names:
        nodal["displacement"] = padded(elements.displacement[nodes])
    if "rotation" in names:
        nodal["rotation"] = elements.rotation_vector[nodes]
    nodal |= {name: a[nodes] for name, a in at_nodes.items()}
    return {
        "x": elements.nodes.position[nodes],
        "cells": cells.reshape(own.shape),
        "kind": _KINDS[cell, degree],
        "point_data": nodal,
        "cell_data": {name: _of_cells(elements, name, a) for name, a in at_points.items()},
    }


def _of_cells(elements: Elements, name: str, values: np.ndarray) -> np.ndarray:
    shape = len(elements.live), len(elements.reference_points)
    each = values.reshape(*shape, *values.shape[1:])
    if name == "id":
        numbers: np.ndarray = elements.body.original_cells[elements.live]
        return numbers
    if name == "material":
        return each[:, 0]
    return each.sum(axis=1) if name == "volume" else elements.cell_mean(values)
