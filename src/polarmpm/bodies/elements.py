"""A body meshed with finite elements: its nodes, quadrature points, regions and groups of facets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl

from ..errors import InputError, TrustWarning
from ..geometry.meshes import BodyMesh
from ..geometry.planes import PlaneSpec
from ..geometry.spacenodes import SpaceNodes
from ..kinematics import rotations
from ..kinematics.layout import Layout
from ..materials.base import Material
from ..tools import checks, compat
from ..tools.caller import warn
from ..tools.checks import number, numeric, refuse, vector, whole
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, raise_on_all_ranks, warn_on_one_rank
from .facets import Facets, FacetSurface
from .points import Points
from .regions import Regions, materials_of
from .revolution import check_section, turned
from .stagedmesh import StagedMesh

# exact for the stiffness of undistorted elements: degree + 1 Gauss points a direction on boxes
_QUADRATURE = {"tensor": (3, 5, 7), "simplex": (2, 4, 6)}


class Elements(StagedMesh):
    """A body meshed with finite elements; `QuasiStaticFEM` solves for it. Collective.

    Args:
        mesh: dolfinx mesh of triangles, quadrilaterals, tetrahedra or hexahedra; path of a .msh file; or a
            gmsh model (on rank 0, None elsewhere).
        material: of all cells, or for each region (physical name or tag of cells) its own.
        degree: of displacements and microrotations, 1, 2 or 3; 2 or 3 where a material has second
            gradients.
        quadrature_degree: of the integration rule; default: 3, 5 and 7 on boxes (2, 3 and 4 Gauss
            points a direction), 2, 4 and 6 on simplices.
        cells, facets: tags (dolfinx MeshTags) of a dolfinx mesh.
        axisymmetric: the body is one of revolution about the axis x = 0, of which the mesh is the section, at
            x >= 0; volumes, areas and loads are those of whole turns.
        comm: of the ranks that share the body; default: the mesh's, of files and models all ranks.

    Attributes:
        points: state of the quadrature points; ids count them along the cells in the order of the mesh's
            input.
        displacement: of the nodes (m), (n, d), in total or since `problem.zero_displacements()`.
        moved: how far the nodes are from those of the mesh (m), (n, d), whatever displacements count from.
        counted_from: `moved` at which displacements are zero; None: that of the mesh.
        q: microrotation of the nodes, unit quaternions (n, 4), for output.

    Raises:
        InputError: a mesh, degree, region or material that is not allowed; see `geometry.meshes.BodyMesh`.
    """

    @collective("Elements", comm=lambda self, mesh, *, comm=MPI.COMM_WORLD, **options: comm)
    def __init__(
        self,
        mesh: Any,
        *,
        material: Material | Mapping[str | int, Material],
        degree: int = 1,
        quadrature_degree: int | None = None,
        cells: Any = None,
        facets: Any = None,
        comm: MPI.Comm | None = None,
        axisymmetric: bool = False,
    ):
        given = material.values() if isinstance(material, Mapping) else [material]
        gradient = any(getattr(m, "second_gradient", False) is True for m in given)
        self.body = BodyMesh.of(mesh, comm, cells=cells, facets=facets, ghosts=gradient)
        self.mesh, self.comm, self.dim = self.body.mesh, self.body.mesh.comm, self.body.dim
        _warn_of_cracks(self.body)
        degree = whole("degree", degree, least=1, most=3, allowed="allowed are 1, 2 and 3")
        if gradient and degree < 2:
            raise InputError(
                "degree = 1: materials with second gradients need degree = 2 or 3, as functions of degree 1 "
                "have hardly any second derivatives"
            )
        shape = "simplex" if self.body.cell in ("triangle", "tetrahedron") else "tensor"
        rule = _QUADRATURE[shape][degree - 1] if quadrature_degree is None else quadrature_degree
        rule = whole("quadrature_degree", rule, least=1, most=20, allowed="a whole number from 1 to 20")
        self.degree, self.quadrature_degree = degree, rule
        materials, of_cell = materials_of(self.body, material)
        self.axisymmetric = checks.flag("axisymmetric", axisymmetric)
        if self.axisymmetric:
            with errors_on_all_ranks(self.comm):
                check_section(self.mesh.geometry.x[:, : self.dim], materials)
        self.layout = Layout.of(materials[0], self.dim, self.axisymmetric)
        self.space = compat.function_space(self.mesh, self.layout.block, degree)
        self.nodes = SpaceNodes(self.space, self.dim)
        self.cell_nodes = compat.cell_dofs(self.space)
        self.live = self.body.owned_cells.astype(np.int64)
        self.points = self._quadrature_points(materials, of_cell)
        self.moved: np.ndarray = np.zeros((len(self.nodes), self.dim))
        self.counted_from: np.ndarray | None = None
        self.q: np.ndarray = rotations.identity(len(self.nodes))

    # quadrature points ----------------------------------------------------------------------------
    @property
    def reference_points(self) -> np.ndarray:
        """Quadrature positions in the reference cell (nq, d)."""
        return compat.quadrature_positions(self.body.cell, self.quadrature_degree)

    def _quadrature_points(self, materials: tuple[Material, ...], of_cell: np.ndarray) -> Points:
        own, xi = self.body.owned_cells, self.reference_points
        weight = compat.quadrature_weights(self.body.cell, self.quadrature_degree)
        position, determinant = ufl.SpatialCoordinate(self.mesh), ufl.JacobianDeterminant(self.mesh)
        geometry = ufl.as_vector([*(position[i] for i in range(self.dim)), determinant])
        values = compat.Evaluator(self.mesh, geometry, xi)(own)
        area = volume = (np.abs(values[:, :, -1]) * weight).ravel()
        error = None
        if len(volume) and not volume.min() > 0:
            error = InputError(
                f"quadrature_degree = {self.quadrature_degree}: the rule has weights that are not positive"
            )
        raise_on_all_ranks(self.comm, error)
        half = np.tile(0.5 * area[:, None] ** (1 / self.dim), (1, self.dim))
        x = values[:, :, : self.dim].reshape(-1, self.dim)
        if self.axisymmetric:
            volume = turned(area, x)
        points = Points(x, volume, half, materials[0], self.comm, axisymmetric=self.axisymmetric)
        points.put_materials(materials, np.repeat(of_cell, len(xi)))
        points._mesh = self.mesh
        points.id = (self.body.original_cells[:, None] * len(xi) + np.arange(len(xi))).ravel()
        points.regions = tuple(r for r in (Regions.of(self.body, len(xi)),) if r is not None)
        return points

    @property
    def turn(self) -> Any:
        """Length of a whole turn in a body of revolution, in UFL; else 1."""
        return 2 * np.pi * ufl.SpatialCoordinate(self.mesh)[0] if self.axisymmetric else 1

    @property
    def cell_size(self) -> float:
        """Typical edge (m): mean volume of a cell to the power of 1/d. Collective."""
        p = self.points
        volume = p.volume0 / (2 * np.pi * p.X[:, 0]) if self.axisymmetric else p.volume0
        sums = self.comm.allreduce(np.array([volume.sum(), len(self.live)]))
        return float((sums[0] / sums[1]) ** (1 / self.dim))

    # groups of facets -----------------------------------------------------------------------------
    @collective("facets", compare=True)
    def facets(self, where: Any) -> Facets:
        """Boundary facets of a physical group (name or tag), on a plane, or all of whose corners fulfil a
        predicate of positions (n, d) -> (n,) bool. Collective.

        Raises:
            InputError: no such group, or a group without facets.
        """
        from dolfinx import mesh as dmesh

        if isinstance(where, Facets):
            if where.body is not self.body or len(where.nodes) != len(self.nodes):
                raise InputError(f"facets: {where.name} are of another body; make them of these elements")
            return where
        dim = self.dim - 1
        self.mesh.topology.create_connectivity(dim, self.dim)
        if isinstance(where, str | int | np.integer) and not isinstance(where, bool):
            tag = self.body.group(where if isinstance(where, str) else int(where), dim)
            name, tags = f"facets {where!r}", self.body.facets
            tagged = np.asarray(tags.indices)[np.asarray(tags.values) == tag]
            found = np.intersect1d(tagged, np.asarray(dmesh.exterior_facet_indices(self.mesh.topology)))
            _warn_of_inner_facets(name, self.comm, len(tagged) - len(found))
        else:
            if isinstance(where, PlaneSpec):
                predicate, name = self.on_plane(where), where.name
            else:
                what = "a physical group, a plane or a predicate of positions (n, d) is"
                predicate = checks.function("facets", where, what, takes=("positions",))
                name = getattr(where, "__name__", "predicate")

            def marker(x: np.ndarray) -> np.ndarray:
                return checks.mask("facets: the predicate", predicate(x[: self.dim].T), x.shape[1])

            with errors_on_all_ranks(self.comm):
                found = dmesh.locate_entities_boundary(self.mesh, dim, marker)
        return self._group(name, self.live_facets(np.sort(np.asarray(found, dtype=np.int32))))

    def on_plane(self, spec: PlaneSpec) -> Callable[[np.ndarray], np.ndarray]:
        """Predicate of positions on a plane x_axis = value."""
        if spec.axis >= self.dim:
            raise InputError(f"plane {'xyz'[spec.axis]}: the mesh has {self.dim} dimensions")
        near = 1e-6 * self.cell_size
        return lambda x: np.abs(x[:, spec.axis] - spec.value) < near

    @collective("farthest", compare=True)
    def farthest(self, direction: Sequence[float], tolerance: float | None = None) -> Facets:
        """Boundary facets farthest in a direction, within `tolerance` (m; default 1e-6 of a cell).
        Collective."""
        n = vector("direction", direction, self.dim, f"{self.dim} numbers, not all zero")
        if not np.linalg.norm(n) > 0:
            raise InputError(f"direction = {direction!r}: {self.dim} numbers, not all zero")
        n = n / np.linalg.norm(n)
        if tolerance is not None:
            tolerance = number("tolerance", tolerance, least=0.0)
        place = self.nodes.position[self.reached()] if self.staged else self.nodes.position
        most = self.comm.allreduce((place @ n).max(initial=-np.inf), op=MPI.MAX)
        limit = most - (1e-6 * self.cell_size if tolerance is None else tolerance)

        def farthest(x: np.ndarray) -> np.ndarray:
            return np.asarray(x @ n >= limit)

        return self.facets(farthest)

    @collective("surface", compare=True)
    def surface(self, where: Any) -> FacetSurface:
        """The quadrature points of boundary facets as a surface, for terms that act on one; `where` as of
        `facets`. Collective."""
        return FacetSurface(self, self.facets(where))

    def _group(self, name: str, facets: np.ndarray) -> Facets:
        weights = self._integrals(facets)
        self.nodes.add_to_owners(weights)
        area = float(self.comm.allreduce(weights[: self.nodes.owned, 0].sum()))
        if not area > 0:
            raise InputError(f"{name}: the group has no facet on the boundary of the mesh")
        return Facets(name, facets, weights[:, 0].copy(), area, self._nodes_on(facets), self.body)

    def _nodes_on(self, facets: np.ndarray) -> np.ndarray:
        from dolfinx import fem

        mask = np.zeros((len(self.nodes), self.layout.block))
        mask[fem.locate_dofs_topological(self.space, self.dim - 1, facets)] = 1.0
        self.nodes.add_to_owners(mask)
        self.nodes.update_ghosts(mask)
        return mask[:, 0] > 0

    def _integrals(self, facets: np.ndarray) -> np.ndarray:
        """Integrals of the shape functions over facets, in column 0 of (nodes, block); ghosts' part apart."""
        v = ufl.TestFunction(self.space)
        form = compat.compile_form(v[0] * self.turn * self.surface_measure(facets))
        return compat.assemble_vector(form, len(self.nodes)).reshape(-1, self.layout.block)

    def surface_measure(self, facets: np.ndarray) -> Any:
        """UFL measure of boundary facets."""
        from dolfinx import mesh as dmesh

        tags = dmesh.meshtags(self.mesh, self.dim - 1, facets, np.ones(len(facets), dtype=np.int32))
        degree = {"quadrature_degree": self.quadrature_degree}
        return ufl.Measure("ds", domain=self.mesh, subdomain_data=tags, metadata=degree)(1)

    def region_tags(self) -> Any:
        """Cell tags of the materials' rows, counted from 1."""
        from dolfinx import mesh as dmesh

        own, nq = self.live.astype(np.int32), len(self.reference_points)
        return dmesh.meshtags(self.mesh, self.dim, own, self.points.material[::nq].astype(np.int32) + 1)

    def node_volumes(self) -> np.ndarray:
        """An equal share of its volume for each node of an element (nodes,), positive for all degrees; summed
        over this rank's elements."""
        nodes = self.live_nodes
        of_cells = self.points.volume0.reshape(-1, len(self.reference_points)).sum(axis=1)
        share = np.repeat(of_cells / nodes.shape[1], nodes.shape[1])
        sums = np.bincount(nodes.ravel(), share, minlength=len(self.nodes))
        return sums.astype(float)  # without any elements they are integers

    def _volumes(self) -> np.ndarray:
        """Integrals of the shape functions over the body (nodes,); ghosts' part is with their owners."""
        nodes, shape = self.live_nodes, compat.tabulate(self.body.cell, self.degree, self.reference_points)[0]
        of_cells = self.points.volume0.reshape(-1, len(shape)) @ shape
        weights = np.zeros((len(self.nodes), self.layout.block))
        weights[:, 0] = np.bincount(nodes.ravel(), of_cells.ravel(), minlength=len(self.nodes))
        self.nodes.add_to_owners(weights)
        return weights[:, 0]

    # results --------------------------------------------------------------------------------------
    @property
    def rotation_vector(self) -> np.ndarray:
        """Microrotation vectors of the nodes (rad), (n, 3); for output only."""
        return rotations.to_vector(self.q)

    @collective("mean")
    def mean(self, values: np.ndarray, facets: Facets | None = None) -> np.ndarray:
        """Mean of nodal values (n, ...) over facets, weighted by their area; without facets over the body,
        weighted by its volume. Collective.

        Raises:
            InputError: values without a row for each node.
        """
        own, values = self.nodes.owned, numeric("values", values)
        error = None
        if values.ndim == 0 or len(values) != len(self.nodes):
            error = refuse("values", values, f"one row for each of the {len(self.nodes)} nodes is needed")
        raise_on_all_ranks(self.comm, error)
        weights = self._volumes() if facets is None else self.facets(facets).weights
        total = self.comm.allreduce(weights[:own].sum())
        return np.asarray(self.comm.allreduce(np.tensordot(weights[:own], values[:own], 1)) / total)

    def cell_mean(self, values: np.ndarray) -> np.ndarray:
        """Means over each own cell (cells, ...), weighted by reference volume, of values at the quadrature
        points (np, ...)."""
        shape = len(self.live), len(self.reference_points)
        weights = self.points.volume0.reshape(shape)
        weights = weights / weights.sum(axis=1, keepdims=True)
        values = checks.numeric("values", values)
        if values.shape[:1] != (shape[0] * shape[1],):
            allowed = f"one row for each of the {len(self.points)} quadrature points of this rank is needed"
            raise checks.refuse("values", values, allowed)
        means: np.ndarray = np.einsum("cq,cq...->c...", weights, values.reshape(*shape, *values.shape[1:]))
        return means

    @property
    def displacement(self) -> np.ndarray:
        return self.moved if self.counted_from is None else self.moved - self.counted_from

    @displacement.setter
    def displacement(self, values: np.ndarray) -> None:
        self.moved = values if self.counted_from is None else values + self.counted_from

    @collective("mean_displacement")
    def mean_displacement(self, facets: Facets | None = None) -> np.ndarray:
        """Mean displacement (m) over facets, without them over the body, shape (d,). Collective."""
        return self.mean(self.displacement, facets)


def _warn_of_cracks(body: BodyMesh) -> None:
    """Parts that are drawn side by side, or meshed differently, aren't joined."""
    number, place = body.cracks()
    with errors_on_all_ranks(body.mesh.comm):  # of warnings a script may make errors
        if number and body.mesh.comm.rank == 0:
            where = tuple(float(round(c, 9)) for c in place)
            warn(
                f"mesh: at {number} places of the boundary, such as {where}, there are several nodes, or one "
                "in the middle of another cell's side: the body comes apart there. If that isn't meant, join "
                "the parts in gmsh: occ.fragment, or mesh.removeDuplicateNodes",
                TrustWarning,
            )


def _warn_of_inner_facets(name: str, comm: MPI.Comm, inner: int) -> None:
    """Those between two cells are on no boundary. Collective."""
    inner = comm.allreduce(inner)
    if inner:
        warn_on_one_rank(
            comm,
            f"{name}: some of the group's facets lie inside of the body, between two cells; those on its "
            "boundary count alone",
            TrustWarning,
        )
