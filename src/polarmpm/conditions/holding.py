"""Whether supports hold the body: at nodes that it doesn't reach they would hold nothing, in silence."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from ..errors import InputError, SupportLost, TrustWarning
from ..geometry.planes import Plane
from ..tools.parallel import reduce_in_place, reduced, warn_on_one_rank
from .prescribed import Prescribed
from .supports import Support

_NOTHING = 1e-9  # of the largest volume at a node: nodes with less have points on a face of theirs only
_MORE = 2.0  # times as much of the body as at first that a predicate may hold before it's told
_LEAST = 0.25  # share of the nodes, and of the volume at one of them, that a support must keep


def check_held(prescribed: Prescribed, volume: np.ndarray, step: int, leaves: bool = False) -> None:
    """Raise an error for a support that holds nothing of the body, or hardly anything any more; warn, once,
    of one whose region more of the body has come into. Collective.

    A body in motion may leave its supports (heaps collapse, blocks fly off): its inertia holds what is left.

    Args:
        volume: current volume of the body at each node (nodes,), in cells; complete on owned rows.
        step: number of the last converged step.
        leaves: a support that the body leaves is told once instead.

    Raises:
        InputError: a new support at whose nodes there is nothing of the body.
        SupportLost: the body has left a support.
    """
    comm, own = prescribed.comm, len(volume)
    most = reduced(comm, float(np.abs(volume).max(initial=0.0)), MPI.MAX)
    weights = np.where(volume > _NOTHING * most, volume, 0.0)
    sums = np.zeros((len(prescribed.supports), 2))
    for k, mask in enumerate(prescribed.masks):
        held = weights[mask[:own]]
        sums[k] = held.sum(), held @ held
    reduce_in_place(comm, sums)
    for support, (first, second) in zip(prescribed.supports, sums.tolist(), strict=True):
        if not first:
            if support.met is None:
                raise InputError(_nothing(prescribed, support, weights))
            if not leaves:
                raise SupportLost(_lost(support, step, "has left all of its nodes"))
            _tell_left(comm, support, step, "all of its nodes")
            continue
        # so many nodes of equal volumes have the same sums: nodes that are hardly reached count little
        now = first**2 / second, second / first
        if support.met is None:
            support.met = now
        share = min(a / b for a, b in zip(now, support.met, strict=True))
        if share < _LEAST:
            if not leaves:
                raise SupportLost(
                    _lost(support, step, f"is leaving its nodes; at them there is {share:.0%} of it left")
                )
            _tell_left(comm, support, step, f"most of its nodes; at them there is {share:.0%} of it left")
        growth = first / (support.met[0] * support.met[1])
        told = support.swollen or isinstance(support.where, Plane) or growth <= _MORE
        if not told:  # the same on all ranks
            warn_on_one_rank(comm, _more(support, step, growth), TrustWarning)
        support.swollen |= growth > _MORE


def _tell_left(comm: MPI.Comm, support: Support, step: int, what: str) -> None:
    """Warn, once, of a support that a body in motion has left. Collective."""
    if not support.left:
        support.left = True
        text = f"{support.name}: by the reset after step {step} the body has left {what}"
        warn_on_one_rank(comm, text, TrustWarning)


def _more(support: Support, step: int, growth: float) -> str:
    return (
        f"{support.name} holds {growth:.2g} times as much of the body since the reset after step {step} as "
        "at first: nodes are held wherever its predicate is true, so that what has moved into that region "
        "is held, too. If that isn't meant, hold a Surface, which the body carries, or let the predicate ask "
        "for less"
    )


def _nothing(prescribed: Prescribed, support: Support, weights: np.ndarray) -> str:
    """Message about a support that meets nothing, with the places of the nodes of the body. Collective."""
    comm, position = prescribed.comm, prescribed.nodes.position[: len(weights)][weights > 0]
    places = []
    for axis, name in enumerate("xyz"[: prescribed.nodes.position.shape[1]]):
        found = np.concatenate(comm.allgather(np.unique(position[:, axis].round(9))))
        places.append(f"{name} = {_listed(np.unique(found))}")
    return (
        f"{support.name} holds nothing: there is no node of the body where it is meant to act. Its nodes are "
        f"at {'; '.join(places)} (with splines at the middle of cells and on the grid's walls)"
    )


def _listed(values: Sequence[float]) -> str:
    shown = [f"{v:g}" for v in values]
    return ", ".join(shown if len(shown) <= 8 else [*shown[:5], "...", *shown[-2:]])


def _lost(support: Support, step: int, what: str) -> str:
    where = support.where
    cure = (
        "hold a Surface, which the body carries (springs), or release the support; with fewer resets it "
        "holds longer"
    )
    if isinstance(where, Plane) and where.axis in support.columns:
        name = f"{'xyz'[where.axis]}={where.value:g}"
        cure = f"let the plane follow the body from the start, plane({name}, moving=True), or {cure}"
    return (
        f"{support.name}: at the reset of the grid after step {step} the body {what}. The last converged "
        f"state is intact. To go on: {cure}"
    )
