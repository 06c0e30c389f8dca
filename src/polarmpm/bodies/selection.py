"""Sets of points by their permanent ids, and by what a body is known from which they were made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks

Predicate = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Selection:
    """A set of points by permanent ids (the same on every rank).

    Attributes:
        ids: whole numbers, ascending, each once.
        body: fingerprint of the body from whose points it was made; None: ids given by hand.
        predicate: of positions, by which it was made; None: otherwise. Copies and pickles do without.

    Raises:
        InputError: ids that aren't so.
    """

    ids: np.ndarray
    body: int | None = None
    predicate: Predicate | None = field(default=None, repr=False, kw_only=True)
    alike: ClassVar = ("ids", "body")  # on all ranks

    def __post_init__(self) -> None:
        try:
            ids = np.asarray(self.ids)
        except Exception:  # rows of several lengths, say
            ids = np.zeros((0, 0))
        if ids.ndim != 1 or (len(ids) and ids.dtype.kind not in "iu"):
            raise InputError(
                f"Selection: ids of shape {ids.shape} and type {ids.dtype}; a list of ids is needed, not "
                f"{checks.shown(self.ids)}"
            )
        if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < 2**62:
            raise InputError(f"Selection: ids from {ids.min()} to {ids.max()}; points have ids from 0 on")
        if np.any(ids[1:] <= ids[:-1]):
            raise InputError("Selection: ids are to be in ascending order, each once: np.unique(ids)")
        if self.body is not None:
            object.__setattr__(self, "body", checks.whole("Selection: body", self.body))
        object.__setattr__(self, "ids", ids.astype(np.int64))

    def __len__(self) -> int:
        return len(self.ids)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "predicate": None}

    def __repr__(self) -> str:
        ids = ", ".join(map(str, self.ids[:4])) + (", ..." if len(self) > 4 else "")
        by = ", given by hand" if self.body is None else ""
        return f"<Selection: {len(self)} point(s){by}, ids {ids}>" if len(self) else "<Selection: no point>"


def check_selection(value: Any) -> Selection:
    """Raise InputError unless it is a selection."""
    what = "a Selection, as points.where, farthest or nearest give it, is"
    return checks.instance("selection", value, Selection, what)


def fingerprint(comm: MPI.Intracomm, ids: np.ndarray, X: np.ndarray) -> int:
    """A number that follows from all ids (np,) and initial positions (np, d), the same on any number of
    ranks. Collective."""
    mixed = _mixed(ids.astype(np.uint64))
    for column in np.ascontiguousarray(X + 0.0).view(np.uint64).T:
        mixed = _mixed(mixed ^ column)
    found = np.array([np.bitwise_xor.reduce(mixed), mixed.sum(dtype=np.uint64)], dtype=np.uint64)
    every = np.array(comm.allgather(found))
    ends = np.bitwise_xor.reduce(every[:, 0]), every[:, 1].sum(dtype=np.uint64)
    return int(_mixed(np.array(ends))[0] ^ ends[1])


def _mixed(numbers: np.ndarray) -> np.ndarray:
    """Numbers of 64 bits (n,) whose bits have been mixed well (splitmix64)."""
    z = numbers + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
