"""Derivatives of short smooth functions in a direction, by differences far from rounding.

For what is no kernel and has no UFL: packing a state, tables of weighting functions, plastic states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

_SHARE = 1e-3  # of the values: the fourth power is rounding


def along(
    function: Callable[..., Any],
    at: Sequence[np.ndarray],
    change: Sequence[np.ndarray],
    sizes: Any = None,
    comm: MPI.Comm | None = None,
) -> np.ndarray:
    """Derivative of a function of arrays as they change; of fourth order in steps of a thousandth.

    Args:
        sizes: of what each array may be taken to be, default: its largest value.
        comm: of a function that is collective, and then this is, too.
    """
    largest = [np.abs(a).max(initial=0.0) for a in at] if sizes is None else sizes
    most = max(
        (np.abs(c).max(initial=0.0) / (s or 1.0) for c, s in zip(change, largest, strict=True)), default=0.0
    )
    if comm is not None:
        most = comm.allreduce(most, op=MPI.MAX)
    if most == 0.0:
        return np.zeros_like(function(*at))
    h = _SHARE / most

    def moved(steps: int) -> np.ndarray:
        found: np.ndarray = function(*(a + steps * h * c for a, c in zip(at, change, strict=True)))
        return found

    slope: np.ndarray = (8.0 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12.0 * h)
    return slope
