"""What the ranks of a problem have to do alike: steps, what observers are told, what acts on the body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import numpy as np

from ..conditions.amplitudes import Amplitude
from ..conditions.prescribed import Prescribed
from ..errors import InputError
from ..geometry.nodes import Nodes
from ..tools.alike import told
from ..tools.meetings import together
from ..tools.parallel import errors_on_all_ranks

_ROUNDING = 1e-9  # of the largest value: so far values of two ranks may be apart


@contextmanager
def step(problem: Any, call: str, factor: float) -> Iterator[None]:
    """A load step. All ranks have to try the same one with the same settings; in the first one after
    conditions have been given, their functions are compared at a load factor. Collective."""
    settings = ""
    if problem.comm.size > 1:
        limit = getattr(problem, "rotation_limit", None)
        settings = told((problem.controls, limit, len(problem.observers), sorted(problem.rows)))
    with together(problem.comm, call, settings):
        if problem._unasked:
            check_alike(problem.comm, problem._unasked, factor, problem.points.X)
            problem._unasked = []
        yield


def tell(problem: Any, what: str, *news: Any) -> None:
    """Call a method of the observers, whose errors are raised on all ranks. Collective."""
    if problem.observers:
        with errors_on_all_ranks(problem.comm, "an observer"):
            for observer in problem.observers:
                getattr(observer, what)(problem, *news)


def check_alike(comm: MPI.Comm, amplitudes: Sequence[Amplitude], factor: float, places: np.ndarray) -> None:
    """Refuse functions that give one thing on one rank and another on others, at a place of the lowest rank
    that has one. Those that can't be asked for a single place are trusted. Collective.

    Args:
        places: of this rank (n, d) (m).
    """
    functions = [a for a in amplitudes if a.function is not None]
    if comm.size == 1 or not functions:
        return
    first = next((p for p in comm.allgather(places[0].tolist() if len(places) else None) if p), None)
    if first is None:
        return
    for amplitude in functions:
        try:
            with errors_on_all_ranks(comm):
                own = amplitude.at(factor, np.array([first]))[0]
        except Exception:  # it may want all of the rank's positions; its errors show where it's needed
            continue
        values = np.array(comm.allgather(own))
        apart = np.abs(values - values[0]).max(axis=1) > _ROUNDING * np.abs(values).max()
        if np.any(apart):
            other = int(np.argmax(apart))
            at = f" and {tuple(round(c, 9) for c in first)}" if amplitude.field else ""
            raise InputError(
                f"{amplitude.name} is {values[0].tolist()} on rank 0 and {values[other].tolist()} on rank "
                f"{other} at load factor {factor:g}{at}; a function has to give the same on every rank"
            )


def check_masks(prescribed: Prescribed, nodes: Nodes) -> None:
    """Refuse supports that hold a node on one of the ranks that share it, and not on another. Collective."""
    comm = prescribed.comm
    if comm.size == 1 or not prescribed.supports:
        return
    owners = prescribed.fixed.astype(float)
    nodes.update_ghosts(owners)
    apart = np.argwhere(owners != prescribed.fixed)
    with errors_on_all_ranks(comm):
        if len(apart):
            node, column = apart[0]
            where = tuple(float(round(c, 9)) for c in nodes.position[node])
            which = [s.name for s in prescribed.supports if column in s.columns]
            raise InputError(
                f"{' or '.join(which)}: the node at {where} is held on one of the ranks that share it (among "
                f"them rank {comm.rank}), but not on all; a predicate has to say the same on every rank"
            )
