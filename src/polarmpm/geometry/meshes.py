"""Meshes of bodies: where they come from, their named groups, and what they must fulfil."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError
from ..tools import compat
from ..tools.parallel import raise_on_all_ranks
from .cells import unit_corners
from .gmsh import read_gmsh_groups

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


@dataclass
class BodyMesh:
    """A dolfinx mesh with its groups.

    Attributes:
        mesh: of triangles, quadrilaterals, tetrahedra or hexahedra.
        cells, facets: tags (dolfinx' MeshTags) or None.
        names: physical names, {(dimension, name): tag}.
    """

    mesh: Any
    cells: Any = None
    facets: Any = None
    names: dict[tuple[int, str], int] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Any, comm: MPI.Comm, *, cells: Any = None, facets: Any = None) -> BodyMesh:
        """From a dolfinx mesh, the path of a .msh file or a gmsh model. Collective.

        Raises:
            InputError: it can't be read, is of the wrong kind, or has a distorted cell.
        """
        if isinstance(source, BodyMesh):
            body = source
        elif hasattr(source, "topology") and hasattr(source, "geometry"):
            body = cls(source, cells, facets)
        elif isinstance(source, str | os.PathLike):
            body = cls(*read_gmsh_groups(os.fspath(source), 0, comm))
        elif hasattr(source, "getPhysicalGroups") or (source is None and comm.rank > 0):
            body = cls(*read_gmsh_groups(source, 0, comm))
        else:
            raise InputError(
                f"mesh = {source!r}: a dolfinx mesh, the path of a .msh file or a gmsh model is needed"
            )
        compat.name_variant(body.mesh)
        body.check()
        return body

    @property
    def dim(self) -> int:
        return int(self.mesh.topology.dim)

    @property
    def cell(self) -> str:
        """Name of the cells' type."""
        return compat.cell_name(self.mesh)

    @property
    def owned_cells(self) -> np.ndarray:
        """Local numbers of this rank's own cells."""
        return np.arange(self.mesh.topology.index_map(self.dim).size_local, dtype=np.int32)

    @property
    def original_cells(self) -> np.ndarray:
        """Numbers of the own cells in the order of their input, the same on any number of ranks."""
        numbers = np.asarray(self.mesh.topology.original_cell_index, dtype=np.int64)
        return numbers[: len(self.owned_cells)]

    def check(self) -> None:
        """Raise InputError, on every rank, for a mesh that the elements can't be built on."""
        if self.cell not in CELLS:
            raise InputError(f"mesh: its cells are of the type {self.cell}; allowed are {', '.join(CELLS)}")
        if self.mesh.geometry.dim != self.dim:
            raise InputError(
                f"mesh: its cells have {self.dim} dimensions and its nodes {self.mesh.geometry.dim} "
                f"coordinates; a {self.mesh.geometry.dim}-dimensional body needs cells of as many dimensions"
            )
        own = self.owned_cells
        determinant = ufl.JacobianDeterminant(self.mesh)
        positions = np.vstack([compat.quadrature_positions(self.cell, 3), _corners(self.cell)])
        values = compat.Evaluator(self.mesh, determinant, positions)(own)[:, :, 0]
        size = np.abs(values).max(axis=1, initial=0.0)
        # the sign itself tells nothing: it depends on the order in which a cell's nodes are given
        bad = np.any(values * np.sign(values[:, :1]) <= 1e-10 * size[:, None], axis=1)
        error = None
        if np.any(bad):
            numbers = np.sort(self.original_cells[bad])
            middle = self.midpoints(own[bad][:1])[0]
            error = InputError(
                f"mesh: the Jacobian of {len(numbers)} cell(s) is not positive everywhere: numbers "
                f"{', '.join(map(str, numbers[:10]))}, one at {tuple(float(round(c, 9)) for c in middle)}"
            )
        raise_on_all_ranks(self.mesh.comm, error)

    def midpoints(self, cells: np.ndarray) -> np.ndarray:
        """Mean of the nodes (n, d) of local cells."""
        nodes = compat.cell_geometry(self.mesh)[cells]
        centre: np.ndarray = self.mesh.geometry.x[nodes][:, :, : self.dim].mean(axis=1)
        return centre

    def group(self, name: str | int, dim: int) -> int:
        """Tag of a physical group of `dim` dimensions.

        Raises:
            InputError: no such group; the message lists those that exist.
        """
        tags = self.cells if dim == self.dim else self.facets
        here = [] if tags is None else np.unique(np.asarray(tags.values)).tolist()
        all_tags = set().union(*self.mesh.comm.allgather(here))
        if isinstance(name, str):
            found = self.names.get((dim, name))
            if found is not None:
                return found
        elif int(name) in all_tags:
            return int(name)
        named = {tag: n for (d, n), tag in self.names.items() if d == dim}
        known = [named.get(tag, str(tag)) for tag in sorted({*named, *all_tags})]
        what = "region" if dim == self.dim else "facets"
        raise InputError(
            f"{what}: the mesh has no physical group {name!r} of {dim} dimensions; it has "
            f"{', '.join(known) if known else 'none'}"
        )


def _corners(cell: str) -> np.ndarray:
    dim = 2 if cell in ("triangle", "quadrilateral") else 3
    if cell in ("triangle", "tetrahedron"):
        return np.vstack([np.zeros(dim), np.eye(dim)])
    return unit_corners(dim).astype(float)
