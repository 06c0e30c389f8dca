"""Loads on facets of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..conditions.amplitudes import Amplitude
from ..terms.settings import MeshNodes, MeshSetting
from ..terms.surfaceterms import SurfaceCondition


@dataclass(eq=False)
class SurfaceLoad:
    """A traction, couple traction or pressure on facets.

    Attributes:
        amplitude: its values; a total when `share` is 1 / area.
        kind: "force", "couple" or "pressure".
        follows: it turns with the surface.
    """

    facets: Facets
    amplitude: Amplitude
    kind: str
    follows: bool
    share: float
    function: Any = None  # its nodal values, made when the system is built
    rows: Any = None  # the nodes of the facets
    position: Any = None  # where they are (n, d) (m)

    def __repr__(self) -> str:
        area = f"{self.facets.area:.6g} {'m^2' if self.facets.body.dim == 3 else 'm'}"
        return f"SurfaceLoad({self.amplitude.name!r} on {area}{', follows' if self.follows else ''})"


@dataclass
class Varying:
    """Compiled forms of loads that depend on the unknowns: virtual work, and minus its derivative."""

    residual: Any
    tangent: Any


def carried_so_far(elements: Elements, term: SurfaceCondition) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (n, d) and deformation gradients (n, d, d) at a surface's points. Collective."""
    carried, n, d = MeshSetting(elements).carry(term), len(term.surface), elements.dim
    assert isinstance(carried.boxes, MeshNodes)
    nodal = elements.moved[carried.boxes.table]
    found = np.zeros((n, 1 + d, d))
    found[carried.rows] = np.einsum("mkn,mni->mki", carried.table, nodal)
    elements.comm.Allreduce(MPI.IN_PLACE, found)
    return found[:, 0], np.eye(d) + np.swapaxes(found[:, 1:], 1, 2)
