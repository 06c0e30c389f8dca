"""Regions of a mesh, physical groups of its cells: their materials, and which points are in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.meshes import BodyMesh
from ..kinematics.layout import Layout
from ..materials.base import Material, check_material
from ..tools.parallel import raise_on_all_ranks


def materials_of(body: BodyMesh, material: Any) -> tuple[tuple[Material, ...], np.ndarray]:
    """Materials, and the row for each own cell, of one material or one for each region. Collective.

    Raises:
        InputError: no such region, one given twice, cells without a material, materials that can't be mixed.
    """
    own = len(body.owned_cells)
    if not isinstance(material, Mapping):
        return (check_material(material, body.dim),), np.zeros(own, dtype=np.int32)
    if not material:
        raise InputError("material: no region is given")
    of_cell: np.ndarray = np.full(own, -1, dtype=np.int32)
    tags: dict[int, Any] = {}
    for row, (region, one) in enumerate(material.items()):
        check_material(one, body.dim)
        tag = body.group(region, body.dim)
        if tag in tags:
            raise InputError(f"material: {tags[tag]!r} and {region!r} are the same region")
        tags[tag] = region
        of_cell[body.tags_of_cells == tag] = row
    missing, error = np.flatnonzero(of_cell < 0), None
    if len(missing):
        numbers = ", ".join(map(str, np.sort(body.original_cells[missing])[:10]))
        names = {tag: name for (d, name), tag in body.names.items() if d == body.dim}
        left = sorted({repr(names.get(t, t)) for t in body.tags_of_cells[missing].tolist()})
        error = InputError(
            f"material: no region has the cells {numbers} (of {', '.join(left)}); every cell needs a material"
        )
    raise_on_all_ranks(body.mesh.comm, error)
    materials = tuple(material.values())
    if len({Layout.of(m, body.dim) for m in materials}) > 1:
        raise InputError("material: micropolar and classical materials can't be mixed in one body")
    return materials, of_cell


@dataclass(frozen=True)
class Regions:
    """In which region of a mesh points have been seeded; their ids tell.

    Attributes:
        first: id of the first point of the first cell.
        parts: points of each cell, whose ids follow on.
        tags: of the cells, in the order of the mesh's input; all of them on every rank.
        names: {name: tag}.
    """

    first: int
    parts: int
    tags: np.ndarray
    names: dict[str, int]

    @classmethod
    def of(cls, body: BodyMesh, parts: int) -> Regions | None:
        """Those of a mesh, None if it has none. Collective."""
        comm = body.mesh.comm
        if body.cells is None:
            return None
        gathered = comm.allgather((body.original_cells, body.tags_of_cells))
        tags: np.ndarray = np.empty(sum(len(n) for n, _ in gathered), dtype=np.int32)
        for numbers, of_cells in gathered:
            tags[numbers] = of_cells
        return cls(0, parts, tags, {name: tag for (d, name), tag in body.names.items() if d == body.dim})

    def joined(self, first: int) -> Regions:
        """The same after the points' ids have grown by `first`."""
        return replace(self, first=self.first + first)

    def mask(self, ids: np.ndarray, region: str | int) -> np.ndarray | None:
        """Which points (n,) are in a region; None: there is no such region."""
        tag = self.names.get(region) if isinstance(region, str) else int(region)
        if tag is None or not np.any(self.tags == tag):
            return None
        cell = (ids - self.first) // self.parts
        there = (cell >= 0) & (cell < len(self.tags))
        inside: np.ndarray = there & (self.tags[np.where(there, cell, 0)] == tag)
        return inside

    @property
    def known(self) -> list[str]:
        """Names of the regions, of those without a name their tag."""
        names = {tag: name for name, tag in self.names.items()}
        return [repr(names.get(tag, tag)) for tag in np.unique(self.tags).tolist()]
