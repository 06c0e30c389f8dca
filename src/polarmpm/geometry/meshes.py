"""Meshes of bodies: where they come from, their named groups, and what they must fulfil."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import compat
from ..tools.checks import communicator, refuse, shown, whole
from ..tools.parallel import Route, raise_on_all_ranks
from .gmsh import read_grouped
from .groupedmesh import GroupedMesh, distorted, labels, not_positive, places, reference_corners

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


@dataclass
class BodyMesh:
    """A dolfinx mesh with its groups.

    Attributes:
        mesh: of triangles, quadrilaterals, tetrahedra or hexahedra.
        cells, facets: tags (dolfinx' MeshTags) or None.
        names: physical names, {(dimension, name): tag}.
        given: number of each cell in its file or model, by dolfinx' `original_cell_index`; None: the same.
    """

    mesh: Any
    cells: Any = None
    facets: Any = None
    names: dict[tuple[int, str], int] = field(default_factory=dict)
    given: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        source: Any,
        comm: MPI.Comm | None = None,
        *,
        cells: Any = None,
        facets: Any = None,
        ghosts: bool = False,
    ) -> BodyMesh:
        """From a dolfinx mesh, the path of a .msh file or a gmsh model. Collective.

        Args:
            comm: of the ranks that share the body; default: the mesh's, of files and models all ranks.
            ghosts: ranks are to know the cells of others behind faces, of a mesh that is distributed here.

        Raises:
            InputError: it can't be read, is of the wrong kind, or has a cell that can't be used.
        """
        if comm is not None:
            communicator("comm", comm)
        if isinstance(source, BodyMesh):
            body = source
        elif hasattr(source, "topology") and hasattr(source, "geometry"):
            body = cls(source, cells, facets)
        else:
            _agree(source, comm or MPI.COMM_WORLD)
            if cells is not None or facets is not None:
                name, value = ("facets", facets) if cells is None else ("cells", cells)
                raise refuse(
                    name, value, "tags belong to a dolfinx mesh; a file or a model has physical groups"
                )
            found = read_grouped(source, comm or MPI.COMM_WORLD)
            body = cls._distributed(found, comm or MPI.COMM_WORLD, ghosts)
        theirs = body.mesh.comm
        if comm is not None and MPI.Comm.Compare(theirs, comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise InputError(
                f"mesh: it is shared by {theirs.size} rank(s) and the rest of the body by {comm.size}; "
                "make it on the same communicator"
            )
        compat.name_variant(body.mesh)
        body.check()
        return body

    @classmethod
    def _distributed(cls, found: GroupedMesh, comm: MPI.Comm, ghosts: bool) -> BodyMesh:
        """The dolfinx mesh, with tags, of a body that rank 0 has. Collective."""
        mesh, given = compat.distribute_mesh(comm, found.cells, found.x, found.kind, found.degree, ghosts)
        tags, facets, facet_tags = comm.bcast((found.tags, found.facets, found.facet_tags), root=0)
        dim, body = mesh.topology.dim, cls(mesh, names=found.names, given=given)
        of_cells = tags[given[np.asarray(mesh.topology.original_cell_index, dtype=np.int64)]]
        body.cells = _mesh_tags(mesh, dim, np.arange(len(of_cells), dtype=np.int32), of_cells)
        # facets are found by the numbers in the input of their corners
        mesh.topology.create_entities(dim - 1)
        mesh.topology.create_connectivity(dim, dim - 1)
        numbers = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
        corners = compat.facet_corners(found.kind)
        nodes = compat.cell_geometry(mesh)
        rows = numbers[nodes[:, corners]] if len(nodes) else np.zeros((0, *np.shape(corners)), dtype=np.int64)
        here = np.sort(rows, axis=2).reshape(-1, rows.shape[2])
        listed = mesh.topology.connectivity(dim, dim - 1)
        entities = np.asarray(listed.array)[: len(here)]
        label = labels(np.vstack([here, facets.reshape(-1, rows.shape[2])]))
        known, at = np.unique(label[len(here) :], return_index=True)
        place = np.minimum(np.searchsorted(known, label[: len(here)]), max(len(known) - 1, 0))
        found_here = known[place] == label[: len(here)] if len(known) else np.zeros(len(here), dtype=bool)
        entities, first = np.unique(entities[found_here], return_index=True)
        values = facet_tags[at[place[found_here]][first]] if len(known) else facet_tags[:0]
        body.facets = _mesh_tags(mesh, dim - 1, entities, values)
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
        return self.original_local_cells[: len(self.owned_cells)]

    @property
    def original_local_cells(self) -> np.ndarray:
        """The same of the own cells and, after them, of ghosts."""
        numbers = np.asarray(self.mesh.topology.original_cell_index, dtype=np.int64)
        return numbers if self.given is None else self.given[numbers]

    @property
    def tags_of_cells(self) -> np.ndarray:
        """Tags (m,) of the own cells; -1 where there is none."""
        own = len(self.owned_cells)
        found: np.ndarray = np.full(own, -1, dtype=np.int32)
        if self.cells is not None:
            at = np.asarray(self.cells.indices)
            found[at[at < own]] = np.asarray(self.cells.values)[at < own]
        return found

    @property
    def degree(self) -> int:
        """Degree of the geometry: 2 of curved cells."""
        return compat.geometry_degree(self.mesh)

    def check(self) -> None:
        """Raise InputError, on every rank, for a mesh that the body can't be built on."""
        if self.cell not in CELLS:
            raise InputError(f"mesh: its cells are of the type {self.cell}; allowed are {', '.join(CELLS)}")
        if self.mesh.geometry.dim != self.dim:
            raise InputError(
                f"mesh: its cells have {self.dim} dimensions and its nodes {self.mesh.geometry.dim} "
                f"coordinates; a {self.mesh.geometry.dim}-dimensional body needs cells of as many dimensions"
            )
        if self.degree > 2:
            raise InputError(f"mesh: its geometry has the degree {self.degree}; 1 and 2 are allowed")
        if not self.mesh.topology.index_map(self.dim).size_global:
            raise InputError("mesh: it has no cells")
        raise_on_all_ranks(self.mesh.comm, self._bad_geometry())
        self._check_twice()
        for name, tags, dim in (("cells", self.cells, self.dim), ("facets", self.facets, self.dim - 1)):
            raise_on_all_ranks(self.mesh.comm, self._bad_tags(name, tags, dim))

    def _bad_tags(self, name: str, tags: Any, dim: int) -> InputError | None:
        if tags is None:
            return None
        if not all(hasattr(tags, a) for a in ("indices", "values", "dim")):
            return refuse(
                name, tags, "tags of dolfinx are needed: dolfinx.mesh.meshtags(mesh, dim, entities, values)"
            )
        if tags.dim != dim:
            return InputError(f"{name}: its tags are of {tags.dim} dimensions; those of {name} are of {dim}")
        self.mesh.topology.create_entities(dim)
        there = self.mesh.topology.index_map(dim)
        beyond = len(tags.indices) and np.max(tags.indices) >= there.size_local + there.num_ghosts
        theirs = np.asarray(compat.topology_of(tags).original_cell_index)
        if beyond or not np.array_equal(theirs, np.asarray(self.mesh.topology.original_cell_index)):
            return InputError(f"{name}: its tags are of another mesh")
        return None

    def _bad_geometry(self) -> InputError | None:
        """What is wrong with this rank's nodes or cells."""
        x = self.mesh.geometry.x
        bad = ~np.isfinite(x).all(axis=1)
        if bad.any():
            return InputError(f"mesh: {bad.sum()} of its nodes have coordinates that aren't finite")
        own = self.owned_cells
        if not len(own):
            return None
        bad = distorted(self.cell, self.degree, x[compat.cell_geometry(self.mesh)[own]][:, :, : self.dim])
        if not bad.any():
            return None
        middle = self.midpoints(own[bad][:1])[0]
        return InputError(f"mesh: {not_positive(self.original_cells[bad], middle)}")

    def _check_twice(self) -> None:
        """No two cells have the same corners."""
        topology = self.mesh.topology
        topology.create_connectivity(self.dim, 0)
        own = len(self.owned_cells)
        flat = np.asarray(topology.connectivity(self.dim, 0).array, dtype=np.int32)
        corners = flat.reshape(-1, len(reference_corners(self.cell)))[:own]
        numbers = np.asarray(topology.index_map(0).local_to_global(corners.ravel().astype(np.int32)))
        key = _mixed(np.sort(numbers.reshape(corners.shape).astype(np.int64), axis=1))
        route = Route(self.mesh.comm, key % self.mesh.comm.size)
        count = np.unique(route.forward(key), return_counts=True)[1]
        twice = self.mesh.comm.allreduce(int((count - 1).sum()))
        if twice:
            raise InputError(f"mesh: {twice} of its cells are listed twice (the same corners)")

    def cracks(self) -> tuple[int, np.ndarray]:
        """How many places on the boundary have several nodes, or one in the middle of another cell's side,
        which leave the body apart there; one of them (d,). Collective."""
        from dolfinx import mesh as dmesh

        topology = self.mesh.topology
        topology.create_connectivity(self.dim - 1, self.dim)
        topology.create_connectivity(self.dim - 1, 0)
        outer = np.asarray(dmesh.exterior_facet_indices(topology))
        listed = np.asarray(topology.connectivity(self.dim - 1, 0).array)
        corners = len(compat.facet_corners(self.cell)[0])
        sides = listed.reshape(-1, corners)[outer]
        vertices = np.unique(sides).astype(np.int32)
        numbers = np.asarray(topology.index_map(0).local_to_global(vertices))
        x = np.empty((topology.index_map(0).size_local + topology.index_map(0).num_ghosts, self.dim))
        cells = np.asarray(topology.connectivity(self.dim, 0).array)
        nodes = compat.cell_geometry(self.mesh)[:, : len(reference_corners(self.cell))]
        x[cells] = self.mesh.geometry.x[nodes.ravel()[: len(cells)], : self.dim]
        edges = {2: [(0, 1)], 3: [(0, 1), (0, 2), (1, 2)], 4: [(0, 1), (0, 2), (1, 3), (2, 3)]}[corners]
        middle = x[sides[:, np.array(edges)]].mean(axis=2).reshape(-1, self.dim)
        gathered = self.mesh.comm.allgather((numbers, x[vertices], middle))
        numbers, first = np.unique(np.concatenate([n for n, *_ in gathered]), return_index=True)
        every = np.concatenate([x for _, x, _ in gathered])[first]
        place = places(np.concatenate([every, *(m for *_, m in gathered)]))
        here, halves = place[: len(every)], place[len(every) :]
        bad = np.flatnonzero((np.bincount(here)[here] > 1) | np.isin(here, halves))
        return len(np.unique(here[bad])), every[bad[0]] if len(bad) else np.zeros(self.dim)

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
        tags, what = self.cells if dim == self.dim else self.facets, "region" if dim == self.dim else "facets"
        if not isinstance(name, str):
            name = whole(what, name, allowed="the name or the number of a physical group is needed")
        here = [] if tags is None else np.unique(np.asarray(tags.values)).tolist()
        all_tags = set().union(*self.mesh.comm.allgather(here))
        found = self.names.get((dim, name)) if isinstance(name, str) else name
        if found is not None and found in all_tags:
            return found
        named = {tag: n for (d, n), tag in self.names.items() if d == dim}
        if found in named:
            raise InputError(f"{what}: the physical group {name!r} is empty")
        known = [named.get(tag, str(tag)) for tag in sorted({*named, *all_tags})]
        raise InputError(
            f"{what}: the mesh has no physical group {name!r} of {dim} dimensions; it has "
            f"{', '.join(known) if known else 'none'}"
        )


def _agree(source: Any, comm: MPI.Comm) -> None:
    """Raise InputError unless rank 0 has a file or a model and the others the same or, of a model, None."""
    kind = "other"
    if isinstance(source, str | os.PathLike):
        kind = "file"
    elif hasattr(source, "getPhysicalGroups"):
        kind = "model"
    elif source is None and comm.rank:
        kind = "none"
    kinds = comm.allgather((kind, shown(source)))
    allowed = {"file": ("file",), "model": ("model", "none")}.get(kinds[0][0], ())
    for rank, (one, value) in enumerate(kinds):
        if one not in allowed:
            where = f" on rank {rank}" if rank else ""
            raise InputError(
                f"mesh = {value}{where}: a dolfinx mesh, the path of a .msh file or a gmsh model (on rank 0, "
                "None elsewhere) is needed"
            )


def _mesh_tags(mesh: Any, dim: int, entities: np.ndarray, values: np.ndarray) -> Any:
    from dolfinx import mesh as dmesh

    return dmesh.meshtags(mesh, dim, entities.astype(np.int32), values.astype(np.int32))


def _mixed(rows: np.ndarray) -> np.ndarray:
    """A number, not negative, for each row (n, k): practically never the same for different ones."""
    found: np.ndarray = np.zeros(len(rows), dtype=np.uint64)
    for column in rows.astype(np.uint64).T:
        found = (found ^ column) * np.uint64(0x9E3779B97F4A7C15)
        found ^= found >> np.uint64(29)
    return (found >> np.uint64(1)).astype(np.int64)
