"""The end of a process among others: an error or exit on one rank ends the run, and leaves no other waiting.

Importing the package on several ranks installs two hooks. When an uncaught error, `sys.exit` or the end of
the script ends a rank, it tells the others so at their next meeting (`tools.meetings`). After an error, or
a status other than 0, all have to come to their end within a short grace; otherwise MPI ends them. Errors
that are the same on all ranks are printed once.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, NoReturn

from mpi4py import MPI

from . import meetings
from .meetings import Word, Words, ranks_named

GRACE = 3.0  # seconds that the other ranks have to come to their end after an error
_TIDY = 1.0  # seconds for meetings of some ranks to end after those of all
_ENDED = "has ended"

Hook = Callable[[type[BaseException], BaseException, TracebackType | None], Any]


class _Ends:
    """What is known of this process' end.

    Attributes:
        before: the hook for uncaught errors that was there before.
        status: of `sys.exit`.
        done: the ranks have ended together.
    """

    def __init__(self) -> None:
        self.before: Hook = sys.excepthook
        self.exit = sys.exit
        self.process, self.status, self.done = os.getpid(), 0, False
        self.words = ""

    @property
    def ours(self) -> bool:
        """Whether this process is a rank about to end: not a child of one, and no interactive session."""
        interactive = hasattr(sys, "ps1") or sys.flags.interactive or sys.flags.inspect
        return os.getpid() == self.process and not interactive and not self.done and not MPI.Is_finalized()

    def exits(self, status: Any = None, /) -> NoReturn:
        """`sys.exit`, which notes the status."""
        if threading.current_thread() is threading.main_thread():
            self.status = status if isinstance(status, int) else int(status is not None)
            self.words = f"sys.exit({status!r})"
        self.exit(status)

    def fails(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        """An uncaught error ends this rank."""
        if not self.ours:
            self.before(kind, error, trace)
            return
        word, words = Word(_ENDED, "", meetings.described_error(error), True), None
        with contextlib.suppress(Exception):
            words = leave(word, GRACE)
        if words is None:
            self._print(kind, error, trace, [MPI.COMM_WORLD.rank])
            meetings.abort("", 1)
        self.done = True
        alike = words.get(word, [MPI.COMM_WORLD.rank])
        elsewhere = {w.error for w in words} - {word.error, None}
        if min(alike) == MPI.COMM_WORLD.rank and getattr(error, "error", None) not in elsewhere:
            self._print(kind, error, trace, alike)

    def _print(
        self, kind: type[BaseException], error: BaseException, trace: TracebackType | None, ranks: list[int]
    ) -> None:
        size = MPI.COMM_WORLD.size
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            who = f"all {size} ranks" if len(ranks) == size else f"{ranks_named(ranks)} of {size}"
            print(f"{who}:", file=sys.stderr)
        self.before(kind, error, trace)

    def ends(self) -> None:
        """This rank's script is over."""
        if not self.ours:
            return
        self.done = True
        with contextlib.suppress(Exception):
            sys.stdout.flush()
        word = Word(_ENDED, "", self.words if self.status else None, True)
        words = leave(word, GRACE if self.status else None)
        world = MPI.COMM_WORLD
        text = f"rank {world.rank} of {world.size}: {self.words}\n"
        if words is None and self.status:
            meetings.abort(text, self.status)
        elif words is not None and len(words) > 1 and min(words.get(word, [0])) == world.rank:
            sys.stderr.write(text if self.words else "")


def leave(word: Word, grace: float | None) -> Words | None:
    """Go to the meetings of all communicators until all ranks have ended; None: they haven't in the grace.

    Ranks that have never met may never do: there a rank that ends well doesn't wait for long.
    """
    world = meetings.of(MPI.COMM_WORLD)
    patience = GRACE if grace is None and world.number == 0 else grace
    begin = time.monotonic()
    talks = {m: m.talk(word) for m in meetings.known}
    found: Words | None = None
    limit = None if patience is None else begin + patience
    pause = 1e-4
    while talks:
        for m, talk in list(talks.items()):
            try:
                next(talk)
            except StopIteration as end:
                words: Words = end.value or {word: list(range(m.comm.size))}
                there = {m.comm.rank}.union(*words.values())
                if len(there) < m.comm.size or not all(w.ended for w in words):
                    talks[m] = m.talk(word)  # the others have been told; the next meeting tells what they do
                    continue
                del talks[m]
                if m is world:
                    found, limit = words, time.monotonic() + _TIDY
        if limit is not None and time.monotonic() > limit:
            if world in talks and grace is None:
                world.resign(word)
            return found
        time.sleep(pause)
        pause = min(1.5 * pause, 0.01)
    return found


def install() -> None:
    """Put in the hooks, where there are several ranks; once."""
    if MPI.COMM_WORLD.size > 1 and not isinstance(getattr(sys.exit, "__self__", None), _Ends):
        own = _Ends()
        sys.excepthook = own.fails
        sys.exit = own.exits
        atexit.register(own.ends)
