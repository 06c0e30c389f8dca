"""Displacements and rotations of a body at given places, as cameras see them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..bodies.elements import Elements
from ..bodies.points import Points
from ..bodies.recovery import Around, NodeSites
from ..errors import InputError
from ..tools import checks
from ..tools.meetings import collective


class Places:
    """Places in the undeformed body, at which its displacements are interpolated. Collective.

    At each place a polynomial of degree 2 is fitted to the nearest points, or nodes, weighted by their
    distance in the undeformed body; where these don't span one, what they span of it (`bodies.recovery`).
    Linear displacement fields are met exactly, others to the third power of the distance between points.
    Where points have been split, or taken out, those that are left serve. All results are the same on all
    ranks.

    Args:
        body: material points, or a meshed body.
        X: places (n, d) in the undeformed body (m).

    Raises:
        InputError: a place that isn't in the body; the message tells the first one.
    """

    def __init__(self, body: Points | Elements, X: Any):
        kinds = (Points, Elements)
        self.body: Any = checks.instance("body", body, kinds, "material points or a meshed body are")
        self.X = checks.array("X", X, (None, body.dim), f"places in the body, {body.dim} coordinates each")
        self.comm = body.comm
        self._around, self._nodes = _made(self)

    def __len__(self) -> int:
        return len(self.X)

    def displacement(self) -> np.ndarray:
        """Displacements (n, d) at the places (m). Collective."""
        return self._at(self.body.displacement)

    def rotation(self) -> np.ndarray:
        """Vectors of the microrotation (n, 3) at the places (rad). Collective."""
        return self._at(np.asarray(self.body.rotation_vector))

    def values(self, values: Any) -> np.ndarray:
        """Other values of this rank's points, or of its own nodes (n, ...), at the places. Collective."""
        return _interpolated(
            self, checks.numeric("values", values, "one row for each local point, or own node")
        )

    def _at(self, values: np.ndarray) -> np.ndarray:
        return _interpolated(self, values if self._nodes is None else values[: len(self._nodes)])


@collective("Places")
def _made(places: Places) -> tuple[Around, NodeSites | None]:
    body = places.body
    nodes = None if isinstance(body, Points) else NodeSites(body)
    sites = body if nodes is None else nodes
    return Around(sites, places.X, argument="X", one_material=False), nodes


@collective("displacement at places")
def _interpolated(places: Places, own: np.ndarray) -> np.ndarray:
    sites = places.body if places._nodes is None else places._nodes
    if len(own) != len(sites):
        raise InputError(
            f"values: {len(sites)} rows are needed, one for each local point or own node, not {len(own)}"
        )
    return places._around(sites, own)
