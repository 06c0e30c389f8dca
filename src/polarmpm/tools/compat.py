"""All that depends on the version of dolfinx, ufl and basix. Features are tested, not version numbers."""

from __future__ import annotations

import inspect
import math
import sysconfig
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

import basix
import numpy as np
import ufl

from ..errors import KernelError
from . import cache, quiet
from .parallel import ranks_at_corners

try:  # dolfinx >= 0.8
    import basix.ufl as _basix_ufl

    _HAS_BASIX_ELEMENTS = hasattr(_basix_ufl, "quadrature_element")
except ImportError:
    _HAS_BASIX_ELEMENTS = False

quiet.watch_imports()


def coordinate_element(cell: str, gdim: int, degree: int = 1) -> Any:
    """Lagrange element of the mesh geometry, by default linear (multilinear on boxes)."""
    if _HAS_BASIX_ELEMENTS:
        return _basix_ufl.element("Lagrange", cell, degree, shape=(gdim,))
    # with the variant that FFCx adds when it compiles a form: later forms keep their names in the cache
    kind = ufl.Cell(cell, geometric_dimension=gdim)
    return ufl.VectorElement("Lagrange", kind, degree, dim=gdim, variant="equispaced")


def quadrature_element(cell: str, size: int, degree: int = 1) -> Any:
    """Vector-valued quadrature element: `size` values at every quadrature point of a cell."""
    if _HAS_BASIX_ELEMENTS:
        return _basix_ufl.quadrature_element(cell, value_shape=(size,), degree=degree, scheme="default")
    return ufl.VectorElement("Quadrature", cell, degree=degree, dim=size, quad_scheme="default")


def point_domain() -> Any:
    """Abstract UFL domain whose cells stand for material points: one quadrature point each."""
    return ufl.Mesh(coordinate_element("interval", 1))


def expression_signature(expr: Any, terminals: dict[Any, int]) -> str:
    """Signature of an expression that does not depend on running numbers of UFL objects."""
    from ufl.algorithms.signature import compute_expression_signature
    from ufl.corealg.traversal import traverse_unique_terminals

    numbers = dict(terminals)
    if (
        _HAS_BASIX_ELEMENTS
    ):  # newer UFL takes labels of variables by their running numbers unless it's told others
        labels = (t for t in traverse_unique_terminals(expr) if isinstance(t, ufl.classes.Label))
        numbers.update({t: k for k, t in enumerate(labels)})
    try:
        signature: str = compute_expression_signature(expr, numbers)
        return signature
    except KeyError as e:
        raise KernelError(f"{e.args[0]} is not an input of this kernel") from None


def create_mesh(
    comm: Any,
    cells: Any,
    positions: Any,
    cell: str,
    sharing: np.ndarray | None = None,
    degree: int = 1,
    ghosts: bool = False,
) -> Any:
    """A dolfinx mesh. Collective.

    Args:
        cells: global node numbers of this rank's cells (m, nodes of a cell).
        positions: coordinates (n, dim) of the nodes that this rank gives, in the order of their numbers.
        cell: "triangle", "quadrilateral", "tetrahedron" or "hexahedron".
        degree: of the geometry, 1 or 2.
        sharing: ranks that have a node of each cell (m, any number), -1 stands for none; cells then stay on
            their ranks. Default: dolfinx distributes them. ghosts: ranks know others' cells behind faces.
    """
    from dolfinx import mesh

    domain = ufl.Mesh(coordinate_element(cell, positions.shape[1], degree))
    parameters = list(inspect.signature(mesh.create_mesh).parameters)
    cells = np.ascontiguousarray(cells, dtype=np.int64)
    arguments = (positions, domain) if parameters[2] == "x" else (domain, positions)
    old, shared = _by_ghosts(), mesh.GhostMode.shared_facet  # dolfinx 0.5 has ghosts by default
    if sharing is None:
        options = {"partitioner": mesh.create_cell_partitioner(shared)} if ghosts and not old else {}
        return mesh.create_mesh(comm, cells, *arguments, **options)
    # dolfinx 0.5 finds out by ghost cells which ranks share a vertex, and its own partitions only have those
    # across facets: cells on two ranks that touch at a corner would be apart. It drops the ghosts later.
    destinations = _destinations(comm.rank, sharing if old else sharing[:, :0])
    options = {"ghost_mode": shared if ghosts else mesh.GhostMode.none} if old else {}
    return mesh.create_mesh(comm, cells, *arguments, **options, partitioner=lambda *_: destinations)


def _by_ghosts() -> bool:
    """Whether ranks know of shared vertices by ghost cells alone."""
    from dolfinx import mesh

    return "ghost_mode" in inspect.signature(mesh.create_mesh).parameters


def distribute_mesh(
    comm: Any, cells: np.ndarray, positions: np.ndarray, cell: str, degree: int, ghosts: bool = False
) -> tuple[Any, np.ndarray]:
    """A dolfinx mesh, see `create_mesh`, of which rank 0 gives all cells and nodes; and the number that each
    cell was given with (m,), by dolfinx' `original_cell_index`. Collective."""
    number = comm.bcast(len(cells), root=0)
    if comm.size == 1 or not _by_ghosts():
        return create_mesh(comm, cells, positions, cell, degree=degree, ghosts=ghosts), np.arange(number)
    # the partition is dolfinx' own, but its ranks know of all shared vertices, not of those of facets alone:
    # a body that hangs together at a corner or has a crack would come apart, or wait for ever
    from dolfinx import graph, mesh

    corners = np.ascontiguousarray(cells[:, : 1 + max(map(max, facet_corners(cell)))], dtype=np.int64)
    ends = (np.arange(len(cells) + 1) * corners.shape[1]).astype(np.int32)
    listed = graph.create_adjacencylist(corners.ravel(), ends), mesh.GhostMode.none
    found = mesh.create_cell_partitioner()(comm, comm.size, positions.shape[1], *listed)
    owners = np.asarray(found.array)[: len(cells)]
    shared, parts = ranks_at_corners(owners, corners, comm.size), None
    if comm.rank == 0:
        rows = [np.flatnonzero(owners == rank) for rank in range(comm.size)]
        parts = [(cells[at], shared[at], at) for at in rows]
    cells, shared, at = comm.scatter(parts, root=0)
    made = create_mesh(comm, cells, positions, cell, sharing=shared, degree=degree, ghosts=ghosts)
    return made, np.concatenate(comm.allgather(at))


def _destinations(rank: int, others: np.ndarray) -> Any:
    """For each cell its owner, this rank, then the other ranks named in its row (m, any number)."""
    from dolfinx import graph

    rows = [sorted(set(row) - {rank, -1}) for row in others.tolist()]
    ends = np.cumsum([0] + [1 + len(row) for row in rows]).astype(np.int32)
    flat = np.array([r for row in rows for r in (rank, *row)], dtype=np.int32)
    create = graph.adjacencylist if hasattr(graph, "adjacencylist") else graph.create_adjacencylist
    made = create(flat, ends)
    return getattr(made, "_cpp_object", made)


def mesh_quadrature(mesh: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and volumes (n,) of the quadrature points of this rank's own cells."""
    xi, weight = quadrature(cell_name(mesh), degree)
    x, jacobian = mesh_geometry(mesh, xi)
    return x.reshape(-1, x.shape[2]), (np.abs(np.linalg.det(jacobian)) * weight).ravel()


def gmsh_order(cell: str, nodes: int) -> np.ndarray:
    """Which of gmsh's nodes of a cell is each of dolfinx' (nodes,)."""
    from dolfinx import cpp, mesh

    return np.asarray(cpp.io.perm_gmsh(getattr(mesh.CellType, cell), nodes))


def mesh_geometry(
    mesh: Any, xi: np.ndarray, cells: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (m, q, d) and Jacobians dx/dxi (m, q, d, d) at positions xi (q, d) of the reference cell, in
    local cells (m,), by default this rank's own; of the geometry's own degree."""
    dim = mesh.topology.dim
    if cells is None:
        cells = np.arange(mesh.topology.index_map(dim).size_local)
    if not len(cells):
        return np.zeros((0, len(xi), dim)), np.zeros((0, len(xi), dim, dim))
    table = tabulate(cell_name(mesh), geometry_degree(mesh), xi)
    nodes = mesh.geometry.x[cell_geometry(mesh)[cells]][:, :, :dim]
    return np.einsum("pn,cnd->cpd", table[0], nodes), np.einsum("jpn,cni->cpij", table[1:], nodes)


def geometry_degree(mesh: Any) -> int:
    """Degree of the mesh's geometry."""
    return int(mesh.geometry.cmap.degree)


def facet_corners(cell: str) -> list[list[int]]:
    """The corners of each facet of a reference cell."""
    sides = basix.topology(getattr(basix.CellType, cell))
    return [list(corners) for corners in sides[-2]]


def tabulate(cell: str, degree: int, xi: np.ndarray) -> np.ndarray:
    """Lagrange functions and derivatives (1 + d, q, nodes) at positions (q, d) of the reference cell."""
    kind = getattr(basix.CellType, cell)
    element = basix.create_element(basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.equispaced)
    return np.asarray(element.tabulate(1, xi))[:, :, :, 0]


def cell_geometry(mesh: Any) -> np.ndarray:
    """Rows of `mesh.geometry.x` of this rank's cells, ghosts included, (cells, nodes)."""
    listed = mesh.geometry.dofmap
    table = np.asarray(listed.array if hasattr(listed, "array") else listed)
    topology = mesh.topology
    cells = topology.index_map(topology.dim)
    return table.reshape(cells.size_local + cells.num_ghosts, -1) if table.size else table.reshape(0, 1)


def facet_quadrature(
    cell: str, facet: int, rule: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rule of the reference facet (see `facet_rule`) on a facet of the reference cell: positions (q, d) and
    weights (q,); the facet's outward normal (d,), as long as the size that the weights are relative to."""
    kind = getattr(basix.CellType, cell)
    corners, dim = np.asarray(basix.geometry(kind)), len(basix.topology(kind)) - 1
    own = corners[basix.topology(kind)[dim - 1][facet]]
    edges = own[1:dim] - own[0]
    xi, weight = rule
    normal = np.array([edges[0][1], -edges[0][0]]) if dim == 2 else np.cross(*edges)
    outward = np.sign(normal @ (own.mean(axis=0) - corners.mean(axis=0)))
    return own[0] + xi @ edges, weight, outward * normal


def facet_rule(cell: str, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (q, d - 1) and weights (q,) of a rule on the reference facet of a cell."""
    names = {"triangle": "interval", "quadrilateral": "interval", "tetrahedron": "triangle"}
    return quadrature(names.get(cell, "quadrilateral"), degree)


# finite elements --------------------------------------------------------------------------------
def name_variant(mesh: Any) -> None:
    """Give the mesh's element the variant that ffcx 0.5 gives it while it compiles a form.

    Signatures tell the variant: forms built after a compilation would be compiled once more in the next
    process, which finds the first one in the cache.
    """
    element: Any = getattr(mesh.ufl_domain(), "_ufl_coordinate_element", None)
    scalar: Any = getattr(element, "_sub_element", None)
    if not _HAS_BASIX_ELEMENTS and getattr(scalar, "_variant", "") is None:
        named = scalar.reconstruct(variant="equispaced")
        mesh.ufl_domain()._ufl_coordinate_element = ufl.VectorElement(named, dim=element.num_sub_elements())


def topology_of(tags: Any) -> Any:
    """The topology to which tags of dolfinx belong."""
    return tags.mesh.topology if hasattr(tags, "mesh") else tags.topology


def cell_name(mesh: Any) -> str:
    """triangle, quadrilateral, tetrahedron, hexahedron, ..."""
    name = mesh.ufl_cell().cellname
    return str(name() if callable(name) else name)


def function_space(mesh: Any, size: int, degree: int) -> Any:
    """Continuous Lagrange space of `size` components; its functions are scalars when that is 1, as
    dolfinx 0.5 can't tell where the nodes of vectors of one component are. Nodes have equal distances, as in
    `tabulate`; up to degree 2 they do by default."""
    if _HAS_BASIX_ELEMENTS:
        shape = (size,) if size > 1 else None
        more: dict[str, Any] = {"lagrange_variant": basix.LagrangeVariant.equispaced} if degree > 2 else {}
        element = _basix_ufl.element("Lagrange", cell_name(mesh), degree, shape=shape, **more)
    else:
        variant = "equispaced" if degree > 2 else None
        element = ufl.FiniteElement("Lagrange", mesh.ufl_cell(), degree, variant=variant)
        element = element if size == 1 else ufl.VectorElement(element, dim=size)
    return _space(mesh, element)


def quadrature_space(mesh: Any, size: int, degree: int) -> Any:
    """Space of `size` values at every quadrature point."""
    return _space(mesh, quadrature_element(cell_name(mesh), size, degree))


def _space(mesh: Any, element: Any) -> Any:
    from dolfinx import fem

    with _own_cache():  # dolfinx 0.5 compiles elements
        return (fem.functionspace if hasattr(fem, "functionspace") else fem.FunctionSpace)(mesh, element)


def cell_dofs(space: Any) -> np.ndarray:
    """Blocked degrees of freedom (cells, k) of this rank's cells, ghosts included."""
    listed = space.dofmap.list
    listed = listed.array if hasattr(listed, "array") else listed
    return np.asarray(listed).reshape(-1, space.dofmap.dof_layout.num_dofs)


def quadrature_positions(cell: str, degree: int) -> np.ndarray:
    """Positions (n, d) of a rule in the reference cell, in the order of quadrature functions."""
    return quadrature(cell, degree)[0]


def quadrature_weights(cell: str, degree: int) -> np.ndarray:
    """Weights (n,) of a rule in the reference cell."""
    return quadrature(cell, degree)[1]


def quadrature(cell: str, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and weights (n,) of a rule in the reference cell."""
    kind = getattr(basix.CellType, cell)
    try:
        rule = basix.make_quadrature(kind, degree)
    except TypeError:  # basix 0.5 wants the rule first
        rule = basix.make_quadrature(basix.QuadratureType.Default, kind, degree)
    return np.asarray(rule[0]), np.asarray(rule[1])


_compiled: dict[str, tuple[Path, Any]] = {}  # by key: checked once a process
_replaced = threading.RLock()  # dolfinx' function, by ours


@contextmanager
def _own_cache() -> Iterator[None]:
    """Let dolfinx compile into the cache of our kernels.

    Its own one takes a file that a killed process has left for another's compiler at work, and loads what it
    finds. Its function is replaced for our calls only; scripts' own forms go their usual way.
    """
    from dolfinx import jit

    with _replaced:
        own = jit.ffcx_jit
        jit.ffcx_jit = partial(_compile, own)
        try:
            yield
        finally:
            jit.ffcx_jit = own


def _option(module: Any, given: dict[str, Any] | None) -> str:
    """All options of dolfinx' or ffcx' compiler, in a fixed order, without those of waiting."""
    get = module.get_options if hasattr(module, "get_options") else module.get_parameters
    return str(sorted((k, str(v)) for k, v in get(given).items() if k not in ("cache_dir", "timeout")))


def _compile(own: Callable[..., Any], comm: MPI.Comm, thing: Any, **options: dict[str, Any]) -> Any:
    """What `dolfinx.jit.ffcx_jit` returns for a form, an expression or an element. Collective.

    Raises:
        KernelError: it can't be compiled.
    """
    kind = next((k for k in options if k.startswith("jit_")), "jit_options")
    given = options.get(kind) or {}
    arguments = [*given.get("cffi_extra_compile_args", ["-O2", "-g0"]), "-w"]
    options = {**options, kind: {**given, "cffi_extra_compile_args": arguments}}

    def call(folder: Path) -> Any:
        with quiet.compiler():
            of_folder = {**options[kind], "cache_dir": str(folder)}
            compiled, module, _ = own(MPI.COMM_SELF, thing, **{**options, kind: of_folder})
        return compiled, module, (None, None)  # as of a form that is found, without its code

    def build(work: Path) -> tuple[Path, Any]:
        (work / "made").mkdir()
        built = call(work / "made")
        for file in (work / "made").glob("*.o"):
            file.unlink()
        return work / "made", built

    def get(near: Path | None, announced: bool) -> tuple[Path, Any]:
        with quiet.compiler():
            key = _key(thing, options)
        if key not in _compiled:
            _compiled[key] = cache.obtain(key, key, call, build, near, announced)
        return _compiled[key]

    return cache.on_all_ranks(comm, get)


def _key(thing: Any, options: dict[str, dict[str, Any]]) -> str:
    """Name of a form, an expression or an element in the cache, with the options of its compilation."""
    import ffcx.naming
    from dolfinx import jit

    by_kind = {k.rpartition("_")[0]: v for k, v in options.items()}
    told = [_option(jit, by_kind.get("jit")), _option(ffcx, by_kind.get("form_compiler"))]
    tag = "\0".join([*told, str(sysconfig.get_config_var("SOABI")), cache.machine()])
    return f"dolfinx-{ffcx.naming.compute_signature([thing], tag)}"


def compile_form(form: Any, optimisation: str = "-O2") -> Any:
    """Compile a UFL form. Collective.

    Raises:
        KernelError: it can't be compiled.
    """
    from dolfinx import fem

    key = "jit_options" if "jit_options" in inspect.signature(fem.form).parameters else "jit_params"
    with _own_cache():
        return fem.form(form, **{key: {"cffi_extra_compile_args": [optimisation]}})


class Evaluator:
    """Values of a UFL expression at the same reference positions of all cells."""

    def __init__(self, mesh: Any, expression: Any, positions: np.ndarray):
        from dolfinx import fem

        parameters = inspect.signature(fem.Expression.__init__).parameters
        key = "jit_options" if "jit_options" in parameters else "jit_params"
        self._mesh, self._shape = mesh, (len(positions), math.prod(expression.ufl_shape))
        with _own_cache():
            self._expression = fem.Expression(
                expression, positions, **{key: {"cffi_extra_compile_args": ["-O2"]}}
            )

    def __call__(self, cells: np.ndarray) -> np.ndarray:
        """(cells, positions, size)."""
        by_mesh = next(iter(inspect.signature(self._expression.eval).parameters)) == "mesh"
        values = self._expression.eval(*([self._mesh] if by_mesh else []), cells)
        return np.asarray(values).reshape(len(cells), *self._shape)


def add_reverse(function: Any) -> None:
    """Add ghosts' values of a function to their owners'. Collective."""
    from dolfinx import la

    mode = la.ScatterMode if hasattr(la, "ScatterMode") else la.InsertMode
    function.x.scatter_reverse(mode.add)


def assemble_vector(form: Any, nodes: int) -> np.ndarray:
    """Nodal values of a linear form, flattened; ghosts hold this rank's part."""
    from dolfinx import fem

    space = form.function_spaces[0]
    out = np.zeros(nodes * space.dofmap.bs)
    fem.assemble_vector(out, form)
    return out


def add_to_matrix(matrix: Any, form: Any) -> None:
    """Add a bilinear form to a PETSc matrix, without the exchange between ranks."""
    from dolfinx.fem import petsc

    petsc.assemble_matrix(matrix, form)


def create_matrix(form: Any) -> Any:
    """PETSc matrix of dense node blocks with the pattern of a bilinear form. Collective."""
    from dolfinx.fem import petsc

    return petsc.create_matrix(form, "baij")  # a third less time than "aij" for the same assembly
