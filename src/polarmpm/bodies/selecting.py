"""Selections of a body's points, and means over them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import chain
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.surfaces import Surface
from ..tools import checks
from ..tools.checks import refuse, whole
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks
from .lineage import Lineage
from .regions import Regions
from .selection import Predicate, Selection, check_selection


class Selecting(ABC):
    """What `Points` has of selections; its attributes are described there."""

    comm: MPI.Intracomm
    dim: int
    id: np.ndarray
    x: np.ndarray
    X: np.ndarray
    half_length0: np.ndarray
    volume0: np.ndarray
    regions: tuple[Regions, ...]
    surfaces: dict[str | int, Surface]
    lattices: tuple[tuple[Grid, np.ndarray], ...]
    lineage: Lineage | None = None  # of points that have been split; None: none has

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    @abstractmethod
    def displacement(self) -> np.ndarray: ...

    @abstractmethod
    def fingerprints(self) -> tuple[int, ...]: ...

    def check(self, selection: Selection) -> None:
        """Raise InputError unless a selection is one of these points. Collective."""
        check_selection(selection)
        if selection.body is not None and selection.body not in self.fingerprints():
            raise InputError(
                "selection: of another body (other points, or seeded otherwise); make it of these points"
            )
        here, number = self.comm.allreduce(len(self.rows(selection))), len(self._present(selection))
        if here != number:
            raise InputError(f"selection: {number - here} of its {number} ids aren't of this body")

    def _present(self, selection: Selection) -> np.ndarray:
        """Ids of a selection's points, or of their parts."""
        return selection.ids if self.lineage is None else self.lineage.descendants(selection.ids)[0]

    def _select(self, mask: np.ndarray, predicate: Predicate | None = None) -> Selection:
        ids = np.concatenate(self.comm.allgather(self.id[mask]))
        return Selection(np.sort(ids), self.fingerprints()[0], predicate=predicate)

    @collective("where")
    def where(self, predicate: Predicate) -> Selection:
        """Points whose current position fulfils a predicate of x (n, d) -> (n,) bool; there may be none, on
        which nothing can act. Positions are those of the centres of the points' boxes. Collective.

        Raises:
            InputError: not a predicate, or it returns something else. What it raises itself is raised on its
                rank, and as `ErrorOnAnotherRank` on the others.
        """
        with errors_on_all_ranks(self.comm):
            checks.function("predicate", predicate, "a predicate of positions is", takes=("x",))
            mask = checks.mask("predicate", predicate(self.x.copy()), len(self))  # it may change what it gets
        return self._select(mask, predicate)

    def region(self, name: str | int) -> Selection:
        """Points seeded in a region of a mesh, a physical group of its cells, by its name or tag, wherever
        they are now. Collective.

        Raises:
            InputError: no such region, or points that don't come from a mesh with regions.
        """
        if not isinstance(name, str):
            name = whole("region", name, allowed="the name or the number of a physical group is needed")
        ids = self.id if self.lineage is None else self.lineage.roots(self.id)[0]
        masks = [m for m in (r.mask(ids, name) for r in self.regions) if m is not None]
        if not masks:
            raise refuse("region", name, _among([k for r in self.regions for k in r.known], "regions"))
        return self._select(np.any(masks, axis=0))

    def surface(self, name: str | int) -> Surface:
        """The boundary of the undeformed body in a physical group of facets of the mesh that it was seeded
        from, by its name or tag: for `fix`, `load`, `traction` and `pressure`, as `Elements.surface`.

        Raises:
            InputError: no such group on the boundary, or points that don't come from a mesh with groups.
        """
        if not isinstance(name, str):
            name = whole("surface", name, allowed="the name or the number of a physical group is needed")
        if name not in self.surfaces:
            raise refuse("surface", name, _among(list(map(repr, self.surfaces)), "groups of boundary facets"))
        return self.surfaces[name]

    @collective("farthest", compare=True)
    def farthest(self, direction: Sequence[float], tolerance: float | None = None) -> Selection:
        """The layer of points farthest in a direction, within `tolerance` (m). Collective.

        Default tolerance: what a whole box, with the largest half lengths that the points were seeded with
        (on a graded grid, those of the layer), reaches from its centre in this direction. That takes all
        points whose boxes an end face across the direction touches or cuts, and no second layer of a body
        along the grid.

        Raises:
            InputError: a direction or a tolerance that isn't so.
        """
        with errors_on_all_ranks(self.comm):
            n = checks.vector("direction", direction, self.dim)
            if not np.any(n):
                raise checks.refuse("direction", direction, f"{self.dim} numbers, not all zero")
            if tolerance is not None:
                tolerance = checks.number("tolerance", tolerance, least=0)
        n = n / np.abs(n).max()
        n = n / np.linalg.norm(n)
        along = self.x @ n
        most = self.comm.allreduce(along.max(initial=-np.inf), op=MPI.MAX)
        if tolerance is None:
            tolerance = self._reach_of_layer(along, most, np.abs(n))
        return self._select(along >= most - tolerance)

    def _reach_of_layer(self, along: np.ndarray, most: float, n: np.ndarray) -> float:
        """What whole boxes of the layer of points farthest along a direction reach along it (m). Collective.

        Args:
            along, most: coordinates of the points (np,) along the direction, and the largest of all.
            n: sizes of the direction's components (d,).
        """
        half: np.ndarray = np.max(self.half_length0, axis=0, initial=0.0)
        self.comm.Allreduce(MPI.IN_PLACE, half, op=MPI.MAX)
        # a layer next to one that is hardly there is a little more than that away
        tolerance = (1.0 - 1e-6) * float(half @ n)
        if not self.lattices and self.lineage is None:
            return tolerance
        reach = self.half_length0 @ n
        whole = self.lineage is None or self.lineage.roots(self.id)[1] == 1.0
        for grid, per_cell in self.lattices:
            seeded = (0.5 * grid.sizes(grid.cells_of(self.X)) / per_cell) @ n
            reach = np.where(whole, np.maximum(reach, seeded), reach)
        while True:  # larger boxes farther inside don't count
            near = reach[along >= most - tolerance].max(initial=0.0)
            now = (1.0 - 1e-6) * float(self.comm.allreduce(near, op=MPI.MAX))
            if not now < tolerance * (1.0 - 1e-9):
                return tolerance
            tolerance = now

    @collective("nearest", compare=True)
    def nearest(self, position: Sequence[float], count: int = 1) -> Selection:
        """The `count` points nearest to a position (m); ties go to the lower ids. All points where there are
        fewer. Collective.

        Raises:
            InputError: a position that isn't one, or a count below one.
        """
        with errors_on_all_ranks(self.comm):
            x = checks.vector("position", position, self.dim)
            count = checks.whole("count", count, least=1)
        scale = 1.0 if np.abs(x).max() < 1e100 else 2.0**-500  # its square must be a number
        distance = np.linalg.norm((self.x - x) * scale, axis=1)
        order = np.lexsort((self.id, distance))[:count]
        found = self.comm.allgather((distance[order], self.id[order]))
        far, ids = (np.concatenate([f[k] for f in found]) for k in (0, 1))
        return Selection(np.sort(ids[np.lexsort((ids, far))[:count]]), self.fingerprints()[0])

    def rows(self, selection: Selection | None) -> np.ndarray:
        """Local rows of a selection's points on this rank (all for None); none of ids that aren't here."""
        if selection is None:
            return np.arange(len(self))
        check_selection(selection)
        if len(selection) == 0:
            return np.zeros(0, dtype=np.int64)
        ids = self._present(selection)
        at = np.minimum(np.searchsorted(ids, self.id), len(ids) - 1)
        return np.flatnonzero(ids[at] == self.id)

    def shares(self) -> np.ndarray:
        """Which share (np,) of a seeded point each local point is: 1, or less of parts of one that has been
        split."""
        found = np.ones(len(self)) if self.lineage is None else self.lineage.roots(self.id)[1]
        return np.asarray(found)

    def volume_of(self, selection: Selection | None = None) -> float:
        """Reference volume (m^3) of a selection's points, to the same digits on any number of ranks.
        Collective."""
        return math.fsum(chain(*self.comm.allgather(self.volume0[self.rows(selection)].tolist())))

    @collective("mean")
    def mean(self, values: np.ndarray, selection: Selection | None = None) -> Any:
        """Mean over a selection of values given for the local points (np, ...), weighted by reference volume,
        so that points that the body's surface cuts count for what they are. Collective.

        Raises:
            InputError: values that aren't a row for each local point, or a selection without points.
        """
        with errors_on_all_ranks(self.comm):
            # the mean of booleans is a share
            found = checks.numeric("values", values, "one row for each local point", "biuf")
            if found.ndim == 0 or len(found) != len(self):
                what = f"a row for each of the {len(self)} local points is needed"
                raise checks.refuse("values", values, f"{what}; the shape is {found.shape}")
        if selection is not None:
            self.check(selection)
        rows = self.rows(selection)
        volume = self.volume0[rows]
        whole = self.comm.allreduce(float(volume.sum()))
        if not whole:
            raise InputError("selection: contains no point")
        return self.comm.allreduce(np.tensordot(volume, found[rows], axes=1)) / whole

    def mean_displacement(self, selection: Selection | None = None) -> np.ndarray:
        """Mean displacement (m) of a selection, shape (d,), see `mean`. Collective."""
        mean: np.ndarray = self.mean(self.displacement, selection)
        return mean


def _among(known: list[str], what: str) -> str:
    if not known:
        return f"these points have no {what}; pm.seed_mesh keeps those of a mesh with physical groups"
    return f"the {what} are {', '.join(dict.fromkeys(known))}"
