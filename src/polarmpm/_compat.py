"""All that depends on the version of dolfinx, ufl and basix. Features are tested, not version numbers."""

from __future__ import annotations

from typing import Any

import ufl

try:  # dolfinx >= 0.8
    import basix.ufl as _basix_ufl

    _HAS_BASIX_ELEMENTS = hasattr(_basix_ufl, "quadrature_element")
except ImportError:
    _HAS_BASIX_ELEMENTS = False

_CELLS = {(2, "box"): "quadrilateral", (3, "box"): "hexahedron"}


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

    return compute_expression_signature(expr, terminals)
