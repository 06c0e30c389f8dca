"""Nodes of a Lagrange space."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..tools import compat


class SpaceNodes:
    """Nodes of a Lagrange space of this rank, owned ones first; implements `geometry.nodes.Nodes`.

    Attributes:
        position: coordinates (m), (n, d).
        number: global numbers (n,); contiguous over the ranks.
        owner: ranks that own them (n,).
        block: unknowns of a node; columns of what is exchanged.
        start: global number of the first owned node.
    """

    def __init__(self, space: Any, dim: int):
        from dolfinx import fem

        index_map = space.dofmap.index_map
        self.owned, self.total = int(index_map.size_local), int(index_map.size_global)
        every = np.arange(self.owned + index_map.num_ghosts, dtype=np.int32)
        self.comm = space.mesh.comm
        self.number = np.asarray(index_map.local_to_global(every), dtype=np.int64)
        self.start = int(index_map.local_range[0])
        self.owner = np.full(len(every), self.comm.rank, dtype=np.int64)
        self.owner[self.owned :] = index_map.owners
        self.position = space.tabulate_dof_coordinates()[:, :dim].copy()
        self._work = fem.Function(space)
        self.block = int(space.dofmap.index_map_bs)

    def __len__(self) -> int:
        return len(self.position)

    def add_to_owners(self, values: np.ndarray) -> None:
        """Add ghosts' rows of values (n, block) to their owners'; ghost rows keep their part. Collective."""
        self._work.x.array[:] = values.ravel()
        compat.add_reverse(self._work)
        values[: self.owned] = self._work.x.array.reshape(-1, self.block)[: self.owned]

    def update_ghosts(self, values: np.ndarray) -> None:
        """Overwrite ghosts' rows of values (n, block) with their owners'. Collective."""
        self._work.x.array[:] = values.ravel()
        self._work.x.scatter_forward()
        values[self.owned :] = self._work.x.array.reshape(-1, self.block)[self.owned :]
