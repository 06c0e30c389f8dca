"""All that depends on the version of dolfinx, ufl and basix. Features are tested, not version numbers."""

from __future__ import annotations

import contextlib
import inspect
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import ufl

from .errors import InputError, KernelError

try:  # dolfinx >= 0.8
    import basix.ufl as _basix_ufl

    _HAS_BASIX_ELEMENTS = hasattr(_basix_ufl, "quadrature_element")
except ImportError:
    _HAS_BASIX_ELEMENTS = False


def coordinate_element(cell: str, gdim: int) -> Any:
    """Linear (multilinear on boxes) Lagrange element of the mesh geometry."""
    if _HAS_BASIX_ELEMENTS:
        return _basix_ufl.element("Lagrange", cell, 1, shape=(gdim,))
    return ufl.VectorElement("Lagrange", ufl.Cell(cell, geometric_dimension=gdim), 1, dim=gdim)


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

    try:
        return compute_expression_signature(expr, terminals)
    except KeyError as e:
        raise KernelError(f"{e.args[0]} is not an input of this kernel") from None


def create_mesh(comm: Any, cells: Any, positions: Any, cell: str) -> Any:
    """A dolfinx mesh of linear cells.

    Args:
        cells: global node numbers of this rank's cells (m, nodes of a cell).
        positions: coordinates (n, dim) of the nodes that this rank gives, in the order of their numbers.
        cell: "quadrilateral" or "hexahedron".
    """
    from dolfinx import mesh

    domain = ufl.Mesh(coordinate_element(cell, positions.shape[1]))
    names = list(inspect.signature(mesh.create_mesh).parameters)
    order = (positions, domain) if names[2] == "x" else (domain, positions)
    return mesh.create_mesh(comm, cells, *order)


def mesh_quadrature(mesh: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, d) and volumes (n,) of the quadrature points of this rank's own cells.

    The geometry is linear (simplices, quadrilaterals, hexahedra).
    """
    import basix

    dim = mesh.topology.dim
    name = mesh.ufl_cell().cellname()
    kind = getattr(basix.CellType, name)
    try:
        xi, weight = basix.make_quadrature(kind, degree)[:2]
    except TypeError:  # basix 0.5 wants the rule first
        xi, weight = basix.make_quadrature(basix.QuadratureType.Default, kind, degree)[:2]
    geometry = basix.create_element(basix.ElementFamily.P, kind, 1, basix.LagrangeVariant.equispaced)
    table = np.asarray(geometry.tabulate(1, np.asarray(xi)))[:, :, :, 0]  # [value, d/dxi_1, ...][point][node]
    own = mesh.topology.index_map(dim).size_local
    dofmap = mesh.geometry.dofmap
    nodes = np.asarray(dofmap.array if hasattr(dofmap, "array") else dofmap).reshape(-1, table.shape[2])[:own]
    corner = mesh.geometry.x[nodes][:, :, :dim]
    x = np.einsum("pn,cnd->cpd", table[0], corner)
    jacobian = np.einsum("jpn,cni->cpij", table[1:], corner)
    volume = np.abs(np.linalg.det(jacobian)) * np.asarray(weight)
    return x.reshape(-1, dim), volume.ravel()


def read_gmsh(path: str, dim: int, comm: Any) -> Any:
    """The dolfinx mesh of a gmsh file. Collective.

    Raises:
        InputError: no such file, no gmsh, or no cells of this dimension in a physical group.
    """
    with contextlib.ExitStack() as stack:
        error, model = None, None
        if comm.rank == 0:
            try:
                model = stack.enter_context(_gmsh_model(path))
                if not model.getPhysicalGroups(dim):
                    error = f"it has no cells of {dim} dimensions in a physical group"
            except Exception as e:  # gmsh raises bare Exceptions
                error = str(e).strip() or type(e).__name__
        error = comm.bcast(error, root=0)
        if error:
            raise InputError(f"mesh = {path!r} can't be read: {error}")
        return _model_to_mesh()(model, comm, 0, gdim=dim)[0]


@contextlib.contextmanager
def _gmsh_model(path: str) -> Iterator[Any]:
    """The model of a gmsh file; a caller's own session goes on (gmsh 4.8 can't tell that there is one)."""
    import gmsh

    if not os.path.isfile(path):
        raise FileNotFoundError("no such file")
    running = hasattr(gmsh, "isInitialized") and bool(gmsh.isInitialized())
    if not running:
        gmsh.initialize()
        gmsh.option.setNumber("General.Terminal", 0)
    try:
        gmsh.open(path)
        yield gmsh.model
    finally:
        if running:
            gmsh.model.remove()
        else:
            gmsh.finalize()


def _model_to_mesh() -> Any:
    try:
        from dolfinx.io.gmshio import model_to_mesh
    except ImportError:  # dolfinx 0.10 renames the module
        from dolfinx.io.gmsh import model_to_mesh
    return model_to_mesh
