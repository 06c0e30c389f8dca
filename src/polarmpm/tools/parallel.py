"""Sending rows of arrays, and errors, between ranks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from .alike import told
from .caller import warn
from .meetings import Word, of

_TAG = 7361  # of messages between ranks


@dataclass
class Traffic:
    """What this rank has sent to others so far."""

    messages: int = 0
    bytes: int = 0


traffic = Traffic()


class Route:
    """Sends row i of an array to rank `destination[i]`, and answers back. Collective.

    `forward` returns the received rows ordered by source rank; `backward` returns rows that answer the
    received ones to where they came from, in the original order. Ranks that have nothing for each other
    exchange nothing but one number, when the route is made.
    """

    def __init__(self, comm: MPI.Comm, destination: np.ndarray):
        self.comm = comm
        self.order = np.argsort(destination, kind="stable")
        self.sent = np.bincount(destination, minlength=comm.size).astype(np.int32)
        self.received = np.empty(comm.size, dtype=np.int32)
        comm.Alltoall(self.sent, self.received)

    def _exchange(self, rows: np.ndarray, sent: np.ndarray, received: np.ndarray) -> np.ndarray:
        comm, rows = self.comm, np.ascontiguousarray(rows)
        out = np.empty((int(received.sum()), *rows.shape[1:]), dtype=rows.dtype)
        width = int(np.prod(rows.shape[1:], dtype=int)) * rows.itemsize
        if width == 0:
            return out
        parts, places = (np.concatenate([[0], np.cumsum(c)]) for c in (sent, received))
        row, requests = MPI.BYTE.Create_contiguous(width).Commit(), []
        try:
            for rank in np.flatnonzero(received):
                part = out[places[rank] : places[rank + 1]]
                if rank == comm.rank:
                    part[...] = rows[parts[rank] : parts[rank + 1]]
                else:
                    requests.append(comm.Irecv([part, len(part), row], int(rank), _TAG))
            for rank in np.flatnonzero(sent):
                if rank != comm.rank:
                    part = rows[parts[rank] : parts[rank + 1]]
                    requests.append(comm.Isend([part, len(part), row], int(rank), _TAG))
                    traffic.messages += 1
                    traffic.bytes += part.nbytes
            MPI.Request.Waitall(requests)
        finally:
            row.Free()
        return out

    def forward(self, rows: np.ndarray) -> np.ndarray:
        return self._exchange(rows[self.order], self.sent, self.received)

    def backward(self, answers: np.ndarray) -> np.ndarray:
        back = self._exchange(answers, self.received, self.sent)
        out = np.empty_like(back)
        out[self.order] = back
        return out


def values_by_number(
    comm: MPI.Comm, numbers: np.ndarray, values: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """Values (m, c) that ranks hold under numbers (m,), each on one rank, for the wanted numbers. Collective.

    Numbers that no rank holds get zeros. A number's remainder modulo the number of ranks is the rank at which
    holders and askers of it meet.
    """
    home = Route(comm, numbers % comm.size)
    known = np.append(home.forward(numbers), -1)
    rows = np.vstack([home.forward(values), np.zeros((1, values.shape[1]))])
    order = np.argsort(known)
    ask = Route(comm, wanted % comm.size)
    asked = ask.forward(wanted)
    at = order[np.searchsorted(known, asked, sorter=order, side="right") - 1]
    return ask.backward(np.where((known[at] == asked)[:, None], rows[at], 0.0))


def sums_by_number(comm: MPI.Comm, numbers: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums (m, c) over the ranks of values (m, c) that ranks have under numbers (m,), all different on a
    rank. Collective."""
    if comm.size == 1:
        return values
    home = Route(comm, numbers % comm.size)
    known, at = np.unique(home.forward(numbers), return_inverse=True)
    sums = np.zeros((len(known), values.shape[1]))
    np.add.at(sums, at, home.forward(values))
    return home.backward(sums[at])


def known_anywhere(comm: MPI.Comm, numbers: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Which of the wanted numbers (m,) any rank has among its own (n,). Collective."""
    if comm.size == 1:
        return np.isin(wanted, numbers)
    held = np.unique(Route(comm, numbers % comm.size).forward(numbers))
    ask = Route(comm, wanted % comm.size)
    return ask.backward(np.isin(ask.forward(wanted), held).astype(float)) > 0


def lowest_ranks(comm: MPI.Comm, numbers: np.ndarray, priorities: np.ndarray | None = None) -> np.ndarray:
    """The lowest rank that holds each of the numbers (n,), all different on a rank. Collective.

    With priorities (n,), whole numbers, the lowest of those whose priority is the largest.
    """
    route = Route(comm, numbers % comm.size)
    asked = route.forward(numbers)
    source = np.repeat(np.arange(comm.size), route.received)
    unique, inverse = np.unique(asked, return_inverse=True)
    if priorities is not None:
        asking = route.forward(priorities)
        most = np.zeros(len(unique), dtype=np.int64)
        np.maximum.at(most, inverse, asking)
        source = np.where(asking == most[inverse], source, comm.size)
    lowest = np.full(len(unique), comm.size, dtype=np.int64)
    np.minimum.at(lowest, inverse, source)
    return route.backward(lowest[inverse])


def sharing_ranks(comm: MPI.Comm, numbers: np.ndarray, most: int) -> np.ndarray:
    """All ranks that hold each of the numbers (n,), all different on a rank. Collective.

    Returns:
        Ranks (n, most), ascending; -1 where there are fewer.
    """
    route = Route(comm, numbers % comm.size)
    asked = route.forward(numbers)
    source = np.repeat(np.arange(comm.size), route.received)
    order = np.argsort(asked, kind="stable")
    offsets = np.searchsorted(asked[order], asked)  # where the number's entries begin
    place = np.empty(len(asked), dtype=np.int64)
    place[order] = np.arange(len(asked)) - offsets[order]
    table = np.full((len(asked), most), -1, dtype=np.int64)
    table[offsets, place] = source
    return route.backward(table[offsets])


def ranks_at_corners(owners: np.ndarray, corners: np.ndarray, ranks: int) -> np.ndarray:
    """The ranks that have a corner of each cell (m, any number), -1 stands for none, from the cells' owners
    (m,) and corners (m, k)."""
    if not len(owners):
        return np.zeros((0, 0), dtype=np.int64)
    held = np.unique(corners.ravel() * ranks + np.repeat(owners, corners.shape[1]))
    begin, end = (np.searchsorted(held // ranks, corners, side=side) for side in ("left", "right"))
    at = begin[:, :, None] + np.arange(int((end - begin).max()))
    found = np.where(at < end[:, :, None], held[np.minimum(at, len(held) - 1)] % ranks, -1)
    return np.asarray(found.reshape(len(owners), -1))


def name_of(comm: MPI.Comm) -> str:
    """What a communicator is called in pickles, where it can't be itself.

    Raises:
        InputError: it is neither COMM_WORLD nor COMM_SELF.
    """
    for name in ("COMM_WORLD", "COMM_SELF"):
        if comm == getattr(MPI, name):
            return name
    raise InputError(
        f"comm: an object on a communicator of {comm.size} rank(s) of its own can't be pickled; COMM_WORLD "
        "and COMM_SELF are allowed"
    )


def communicator_named(name: str) -> MPI.Intracomm:
    """The communicator of a name from `name_of`, of the process that asks."""
    found: MPI.Intracomm = getattr(MPI, name)
    return found


def raise_on_all_ranks(comm: MPI.Comm, error: BaseException | None, what: str = "") -> None:
    """Raise on every rank what any rank has found wrong. Collective.

    Our own errors are the same everywhere, the lowest rank's. Others, such as those of a script's function,
    are raised as they are where they have happened, and as `ErrorOnAnotherRank` elsewhere.

    Args:
        what: this rank has done, for messages about ranks that are elsewhere.
    """
    if comm.size > 1:
        meetings = of(comm)
        meetings.meet(Word(what or f"within {meetings.inside or 'a call'}"), error)
    elif error is not None:
        raise error


def reduced(comm: MPI.Comm, value: Any, op: MPI.Op = MPI.SUM) -> Any:
    """A number of all ranks, which one rank alone has already. Collective."""
    return value if comm.size == 1 else comm.allreduce(value, op=op)


def reduce_in_place(comm: MPI.Comm, values: np.ndarray, op: MPI.Op = MPI.SUM) -> None:
    """Make an array's numbers those of all ranks. Collective."""
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, values, op=op)


class Answer:
    """What local work has found, where that has to be the same on all ranks; see `errors_on_all_ranks`."""

    def __init__(self) -> None:
        self.alike: Any = None


@contextmanager
def errors_on_all_ranks(comm: MPI.Comm, what: str = "a function of the script") -> Iterator[Answer]:
    """Local work, or a call of the script's functions, whose errors are raised on every rank, so that none
    waits in vain. Collective itself.

    What is inside may make collective calls that are the script's own affair: public ones meet by
    themselves, so that a rank that fails before one tells those that are in it. It must make no others.
    `Answer.alike` is compared over the ranks.

    Args:
        what: this is, for messages about ranks that are elsewhere.
    """
    answer = Answer()
    if comm.size == 1:
        yield answer
        return
    meetings, error = of(comm), None
    outer, meetings.inside = meetings.inside, ""
    try:
        yield answer
    except (Exception, KeyboardInterrupt, SystemExit) as e:
        if meetings.known(e):
            raise
        error = e
    finally:
        meetings.inside = outer
    given = "" if answer.alike is None else told(answer.alike)
    meetings.meet(Word(f"{what}, in {outer}" if outer else what, given if error is None else ""), error)


def warn_on_one_rank(comm: MPI.Comm, text: str, category: type[Warning]) -> None:
    """Warn, on rank 0, of what all ranks know; a script that makes errors of warnings gets it on all of them.
    Collective."""
    with errors_on_all_ranks(comm):
        if comm.rank == 0:
            warn(text, category)
