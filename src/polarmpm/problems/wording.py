"""How a diagnosis names places, points and elements, and finds the first few of them on all ranks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

_SHOWN = 5  # places and points of a finding


def smallest(comm: MPI.Comm, keys: np.ndarray, rows: np.ndarray, number: int = _SHOWN) -> np.ndarray:
    """Rows (n, c) with the smallest keys (n,) on all ranks, in order. Collective."""
    order = np.argsort(keys, kind="stable")[:number]
    mine = np.hstack([keys[order, None], rows[order]])
    every = np.concatenate(comm.allgather(mine))
    out: np.ndarray = every[np.argsort(every[:, 0], kind="stable")][:number]
    return out


def place(x: Any) -> str:
    """Coordinates for a message."""
    rounding = 1e-9 * max(abs(float(c)) for c in x)
    return "(" + ", ".join(f"{float(c) if abs(c) > rounding else 0.0:.4g}" for c in x) + ")"


def own_ids(problem: Any) -> np.ndarray:
    """Ids of the local points (np,); of quadrature points the numbers of their elements."""
    elements = getattr(problem, "elements", None)
    ids: np.ndarray = problem.points.id
    return ids if elements is None else ids // len(elements.reference_points)


def names_of(problem: Any, ids: Sequence[int]) -> str:
    """In words."""
    if not ids:
        return ""
    kind = "point" if getattr(problem, "elements", None) is None else "element"
    return f"{kind}{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def counted(problem: Any, points: int) -> str:
    """So many points, or the elements whose quadrature points they are."""
    elements = getattr(problem, "elements", None)
    if elements is None:
        return f"{points} point(s)"
    return f"{points // len(elements.reference_points)} element(s)"
