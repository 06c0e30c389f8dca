"""Selections by a predicate whose limit cuts boxes: points go by their centres, and stand for another volume
than the one in which the predicate holds."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import TrustWarning
from ..geometry.grid import box_indices
from ..tools.parallel import warn_on_one_rank
from .selection import Predicate, Selection

_MOST = 0.05  # of the volume, or of what is left of the body: layers bend with its third power
_PARTS = {2: 8, 3: 6}  # samples a direction of a box that the limit cuts
_PULL = 1.0 - 1e-9  # corners lie just inside, whichever side the predicate counts a face to
_BLOCK = 20_000  # points at once


def warn_of_misfit(
    points: Any,
    selection: Selection,
    remedy: str = "seed the parts apart and join them, as in points.join(pm.seed(grid, part, material=...))",
) -> None:
    """Warn where the points of a selection stand for a volume that is more than a twentieth off that of the
    undeformed body in which its predicate holds. Collective.

    Args:
        remedy: what to do instead.
    """
    test, comm = selection.predicate, points.comm
    if test is None or points._mesh is not None:  # at quadrature points of elements there are no boxes
        return
    taken = np.zeros(len(points))
    taken[points.rows(selection)] = 1.0
    shares = None if points.displacement.any() else _shares(points, taken, test)
    if not comm.allreduce(shares is not None, op=MPI.LAND):
        return
    volume = points.volume0
    here, meant, body = comm.allreduce(np.array([volume @ taken, volume @ shares, volume.sum()]))
    less = min(meant, body - meant)
    if less > 0 and abs(here - meant) > _MOST * less:
        word = "more" if here > meant else "less"
        warn_on_one_rank(
            comm,
            f"selection: its points, which go by their centres, stand for {abs(here / meant - 1):.0%} {word} "
            f"volume than the part of the body in which the predicate holds, because its limit cuts their "
            f"boxes; {remedy} (docs/accuracy.md)",
            TrustWarning,
        )


def _shares(points: Any, taken: np.ndarray, test: Predicate) -> np.ndarray | None:
    """Shares (np,) of the points' boxes in which a predicate holds; None of one that can't be asked about
    other places than the points'."""
    d, n = points.dim, _PARTS[points.dim]
    corners = _PULL * (2.0 * box_indices((2,) * d) - 1.0)
    samples = (2.0 * box_indices((n,) * d) + 1.0) / n - 1.0
    shares = taken.copy()
    try:
        for begin in range(0, len(points), _BLOCK):
            rows = np.arange(begin, min(begin + _BLOCK, len(points)))
            held = _ask(points, rows, corners, test)
            cut = rows[np.any(held != (taken[rows] > 0)[:, None], axis=1)]
            for some in np.array_split(cut, 1 + len(cut) * len(samples) // (8 * _BLOCK)):
                shares[some] = _ask(points, some, samples, test).mean(axis=1)
    except Exception:  # it is a script's own function, which needn't know of any other place
        return None
    return shares


def _ask(points: Any, rows: np.ndarray, at: np.ndarray, test: Predicate) -> np.ndarray:
    """Whether a predicate holds (n, s) at places (s, d) of the boxes, from -1 to 1, of some points."""
    if not len(rows):
        return np.zeros((0, len(at)), dtype=bool)
    x = points.X[rows, None] + np.einsum("pij,sj->psi", points.half_axes0[rows], at)
    held = np.asarray(test(x.reshape(-1, points.dim)))
    if held.dtype != bool:
        raise TypeError("not a predicate")
    return held.reshape(len(rows), len(at))
