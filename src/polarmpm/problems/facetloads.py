"""Loads on facets of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..bodies.elements import Elements
from ..bodies.facets import Facets
from ..conditions.amplitudes import Amplitude
from ..terms.settings import MeshNodes, MeshSetting
from ..terms.surfaceterms import SurfaceCondition
from ..tools import compat


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


def forms_of_loads(
    elements: Elements, forms: Any, loads: Sequence[SurfaceLoad], block: int, body_varies: bool, couples: bool
) -> tuple[list[Any], list[Varying], Any]:
    """Compiled forms of dead loads; those of loads whose work depends on the displacements, with their
    tangents; and the densities of body loads at the quadrature points, None without. Collective.

    Args:
        forms: of the elements; weak forms of loads.
        block: unknowns of a node, 0: there are no body loads.
        body_varies: body loads have couples in space, whose work depends on the rotation.
        couples: couples on facets do likewise.
    """
    from dolfinx import fem

    dead: list[Any] = []
    varying: list[Varying] = []
    body = None

    def add(form: Any, changes: bool) -> None:
        compiled = compat.compile_form(form)
        if changes:
            tangent = compat.compile_form(-ufl.derivative(form, forms.x, forms.trial))
            varying.append(Varying(compiled, tangent))
        else:
            dead.append(compiled)

    if block:
        body = fem.Function(compat.quadrature_space(elements.mesh, block, elements.quadrature_degree))
        add(forms.body_work(body), body_varies)
    for load in loads:
        space = compat.function_space(elements.mesh, load.amplitude.size, elements.degree)
        load.function = fem.Function(space)
        load.rows = fem.locate_dofs_topological(space, elements.dim - 1, load.facets.facets)
        load.position = space.tabulate_dof_coordinates()[load.rows, : elements.dim]
        if load.kind == "pressure":
            add(forms.pressure_work(load.facets, load.function), True)
        else:
            couple = load.kind == "couple"
            changes = load.follows or (couple and couples)
            add(forms.traction_work(load.facets, load.function, couple, load.follows), changes)
    return dead, varying, body
