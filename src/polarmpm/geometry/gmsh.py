"""Meshes and physical groups of gmsh: of files, and of a model in memory."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from ..errors import InputError
from .groupedmesh import GroupedMesh, grouped
from .mshfile import KINDS, Block, Listed, NotAMesh, read_msh


def read_grouped(source: Any, comm: Any) -> GroupedMesh:
    """The body in a .msh file or a gmsh model, which rank 0 reads. Collective.

    Returns:
        On rank 0 all of it; elsewhere without nodes, cells and facets.

    Raises:
        InputError: on every rank, naming the file and what is wrong with it.
    """
    found, error, path = None, None, isinstance(source, str | os.PathLike)
    if comm.rank == 0:
        try:
            found = grouped(read_msh(os.fspath(source)) if path else list_model(source))
        except NotAMesh as e:
            error = str(e)
        except FileNotFoundError:
            error = "no such file"
        except OSError as e:
            error = e.strerror or str(e)
        except Exception as e:  # gmsh raises bare Exceptions
            error = str(e).strip() or type(e).__name__
    head = (
        None
        if found is None
        else (found.kind, found.degree, found.names, found.cells.shape[1], found.x.shape[1])
    )
    error, head = comm.bcast((error, head), root=0)
    if error:
        raise InputError(
            f"mesh = {repr(os.fspath(source)) if path else 'the gmsh model'} can't be read: {error}"
        )
    if found is not None:
        return found
    cell, degree, names, nodes, dim = head
    none = np.zeros(0, dtype=np.int32)
    rows = np.zeros((0, nodes), dtype=np.int64)
    return GroupedMesh(cell, degree, np.zeros((0, dim)), rows, none, rows[:, :0], none, names)


def list_model(model: Any) -> Listed:
    """What a gmsh model has in physical groups; this rank alone."""
    tags, x, _ = model.mesh.getNodes()
    found = Listed(np.asarray(tags, dtype=np.int64), np.asarray(x, dtype=float).reshape(-1, 3))
    groups: dict[tuple[int, int], list[int]] = {}
    for dim, tag in model.getPhysicalGroups():
        found.names[dim, tag] = model.getPhysicalName(dim, tag) or f"{tag}"
        for entity in model.getEntitiesForPhysicalGroup(dim, tag):
            groups.setdefault((dim, int(entity)), []).append(tag)
    for (dim, entity), of_entity in groups.items():
        kinds, _, nodes = model.mesh.getElements(dim, entity)
        for kind, flat in zip(kinds, nodes, strict=True):
            if kind not in KINDS:
                title = model.mesh.getElementProperties(kind)[0]
                raise NotAMesh(f"it has cells of the type {title}, which can't be used")
            table = np.asarray(flat, dtype=np.int64).reshape(-1, KINDS[kind][3])
            found.blocks.append(Block(int(kind), entity, tuple(of_entity), table))
    return found
