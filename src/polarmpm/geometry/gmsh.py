"""Meshes and physical groups from gmsh."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..errors import InputError


def read_gmsh(path: str, dim: int, comm: Any) -> Any:
    """The dolfinx mesh of a gmsh file. Collective.

    Raises:
        InputError: no such file, no gmsh, or no cells of this dimension in a physical group.
    """
    return read_gmsh_groups(path, dim, comm)[0]


def read_gmsh_groups(source: Any, dim: int, comm: Any) -> tuple[Any, Any, Any, dict[tuple[int, str], int]]:
    """Mesh, cell tags, facet tags and physical names {(dimension, name): tag} of a gmsh file or model.
    Collective; the model counts on rank 0.

    Args:
        dim: dimension of the cells; 0 means the highest one of a physical group.

    Raises:
        InputError: as `read_gmsh`; cells of an unknown type, of several types or in several groups, or on a
            curved or inclined surface.
    """
    label = repr(source) if isinstance(source, str) else "the gmsh model"
    with contextlib.ExitStack() as stack:
        error, model, names = None, None, {}
        if comm.rank == 0:
            try:
                model = stack.enter_context(_gmsh_model(source)) if isinstance(source, str) else source
                dim, error = _check_gmsh(model, dim)
                for d, tag in model.getPhysicalGroups():
                    names[d, model.getPhysicalName(d, tag) or f"{tag}"] = tag
            except Exception as e:  # gmsh raises bare Exceptions
                error = str(e).strip() or type(e).__name__
        error, dim, names = comm.bcast((error, dim, names), root=0)
        if error:
            raise InputError(f"mesh = {label} can't be read: {error}")
        data = _model_to_mesh()(model, comm, 0, gdim=dim)
        parts = data if isinstance(data, tuple) else (data.mesh, data.cell_tags, data.facet_tags)
        return (*parts[:3], names)


_GMSH_CELLS = (2, 3, 4, 5, 9, 10, 11, 12)  # triangles, quadrilaterals, tetrahedra, hexahedra; complete ones


def _check_gmsh(model: Any, dim: int) -> tuple[int, str | None]:
    """Dimension of the cells, and what is wrong with them."""
    groups = model.getPhysicalGroups(dim) if dim else model.getPhysicalGroups()
    dim = dim or max((d for d, _ in groups), default=0)
    if dim < 2 or not any(d == dim for d, _ in groups):
        what = f"{dim} dimensions" if dim else "two or three dimensions"
        return dim, f"it has no cells of {what} in a physical group"
    kinds: set[int] = set()
    owner: dict[tuple[int, int], int] = {}
    for d, tag in groups:
        for entity in model.getEntitiesForPhysicalGroup(d, tag) if d >= dim - 1 else ():
            other = owner.setdefault((d, entity), tag)
            if other != tag:
                both = " and ".join(repr(model.getPhysicalName(d, t) or t) for t in (other, tag))
                return dim, (
                    f"the physical groups {both} share the {('curve', 'surface', 'volume')[d - 1]} {entity}; "
                    "one group can be given to each"
                )
            if d == dim:
                kinds |= set(model.mesh.getElementTypes(d, entity))
    if not kinds:
        return dim, "its physical groups have no cells; generate the mesh first"
    titles = [model.mesh.getElementProperties(k)[0] for k in sorted(kinds)]
    if len(kinds) > 1 or not kinds <= set(_GMSH_CELLS):
        return dim, (
            f"its cells are {' and '.join(titles)}; one of triangles, quadrilaterals, tetrahedra and "
            "hexahedra (with all nodes of their degree) is allowed"
        )
    z = [model.mesh.getNodesForPhysicalGroup(2, tag)[1][2::3] for d, tag in groups if d == dim == 2]
    if z and np.ptp(np.concatenate(z)) > 1e-6 * _extent(model):
        return dim, "its surface is not a plane z = constant; a body in space needs volumes"
    return dim, None


def _extent(model: Any) -> float:
    x = model.mesh.getNodes()[1].reshape(-1, 3)
    return float(np.ptp(x, axis=0).max())


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
