"""Meetings of the ranks: collective calls begin with one, so that none of them waits in vain for the others.

A meeting passes a few words along a binary tree of the ranks and back: which call each of them is in, what it
was given, what has gone wrong. Where words differ, every rank gets an error that tells them. A rank whose
script has ended goes on to meetings until all have (`tools.ends`), so that the others learn of it.

Messages go from rank to rank on the communicator itself, under a tag of their own: a rank that leaves needs
no partner to say so, and a communicator that only some ranks know by now needn't be made.
"""

from __future__ import annotations

import contextlib
import functools
import pickle
import re
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from typing import Any, NamedTuple, NoReturn, ParamSpec, TypeVar

from mpi4py import MPI

from ..errors import ErrorOnAnotherRank, InputError, PolarMPMError, RanksApart
from .alike import described

_TAG = 7362  # of messages of meetings
_PATIENCE = 5.0  # seconds that a rank that has failed waits for the others, who might wait for it elsewhere
_SHOWN = 200  # characters of what was given in a message

P = ParamSpec("P")
R = TypeVar("R")


class Word(NamedTuple):
    """What a rank says in a meeting.

    Attributes:
        call: in which it is.
        given: what the script gave to it, as far as ranks can compare that.
        error: what has gone wrong on this rank; the text of errors that aren't ours.
        ended: its script has ended.
    """

    call: str
    given: str = ""
    error: PolarMPMError | str | None = None
    ended: bool = False


Words = dict[Word, list[int]]  # and the ranks that say them


class Meetings:
    """All meetings of the ranks of a communicator.

    Attributes:
        number: of meetings so far.
        inside: the call in which this rank is, whose own calls hold no meetings; empty where there is none.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm, self.number, self.inside = comm, 0, ""
        self.above = (comm.rank - 1) // 2 if comm.rank else None
        self.below = [rank for rank in (2 * comm.rank + 1, 2 * comm.rank + 2) if rank < comm.size]
        self._told_above = False
        self._sent: list[MPI.Request] = []

    def meet(self, word: Word, error: BaseException | None = None) -> None:
        """Meet, and raise what has gone wrong on any rank, or that they aren't in the same call.

        Our own errors are the same everywhere, the lowest rank's. Others, such as those of a script's
        function, are raised as they are where they have happened, and as `ErrorOnAnotherRank` elsewhere.
        """
        if error is not None:
            word = word._replace(error=_told(error))
        words = self._wait(word, error)
        if words is not None or word.error is not None:
            words = words or {}
            if not any(
                self.comm.rank in ranks for ranks in words.values()
            ):  # another one has left the meeting
                words.setdefault(word, []).append(self.comm.rank)
            self._judge(words, error)

    def _wait(self, word: Word, error: BaseException | None) -> Words | None:
        """What the ranks have said; None: the same. An interrupt waits until they have met."""
        talk, interrupt = self.talk(word), None
        give_up = time.monotonic() + _PATIENCE
        while True:
            try:
                source = next(talk)
                if error is None:
                    self.comm.Probe(source, _TAG)
                elif time.monotonic() > give_up:
                    abort(report(error, f"rank {MPI.COMM_WORLD.rank} of {MPI.COMM_WORLD.size}"))
                else:
                    time.sleep(1e-3)
            except StopIteration as end:
                if interrupt is not None:
                    raise interrupt from None
                words: Words | None = end.value
                return words
            except KeyboardInterrupt as e:
                interrupt = e

    def talk(self, word: Word) -> Generator[int, None, Words | None]:
        """A meeting; yields the rank for which it has to wait."""
        self.number, self._told_above = self.number + 1, False
        found: Word | Words = word
        for rank in self.below:
            said = yield from self._from(rank)
            if isinstance(found, dict) or said != found:
                whole = self._spread(found, [self.comm.rank, *self._ranks(self.below[0], rank)])
                for one, ranks in self._spread(said, self._ranks(rank)).items():
                    whole.setdefault(one, []).extend(ranks)
                found = whole
        words = found if isinstance(found, dict) else None
        if self.above is not None:
            self._to(self.above, found)
            self._told_above = True
            words = yield from self._from(self.above)
        for rank in self.below:
            self._to(rank, words)
        return words

    def resign(self, word: Word) -> None:
        """Leave a meeting that the others may never come to; if they do they learn of it."""
        words = {word: [self.comm.rank]}
        if self.above is not None and not self._told_above:
            self._to(self.above, words)
        for rank in self.below:
            self._to(rank, words)

    def _from(self, rank: int) -> Generator[int, None, Any]:
        while True:
            while not self.comm.Iprobe(rank, _TAG):
                yield rank
            number, said = self.comm.recv(None, rank, _TAG)
            if number == self.number:  # others are of a meeting that was broken off
                return said

    def _to(self, rank: int, said: Word | Words | None) -> None:
        self._sent = [request for request in self._sent if not request.Test()]
        self._sent.append(self.comm.isend((self.number, said), rank, _TAG))

    def _ranks(self, top: int, before: int | None = None) -> list[int]:
        """Ranks below and at one, or at its neighbour before another one."""
        if top == before:
            return []
        level, out = [top], []
        while level:
            out += level
            level = [r for t in level for r in (2 * t + 1, 2 * t + 2) if r < self.comm.size]
        return out

    @staticmethod
    def _spread(said: Word | Words, ranks: list[int]) -> Words:
        return said if isinstance(said, dict) else {said: ranks}

    def _judge(self, words: Words, error: BaseException | None) -> NoReturn:
        failed = [(min(ranks), w.error) for w, ranks in words.items() if w.error is not None]
        if not failed:
            raise self._mark(_apart(words))
        rank, first = min(failed, key=lambda pair: pair[0])
        if error is not None and (rank == self.comm.rank or not isinstance(error, PolarMPMError)):
            if isinstance(first, PolarMPMError) and rank != self.comm.rank:
                raise self._mark(first)
            raise self._mark(error)
        raise self._mark(first if isinstance(first, PolarMPMError) else ErrorOnAnotherRank(rank, str(first)))

    def _mark(self, error: BaseException) -> BaseException:
        """Note that all ranks know of an error."""
        with contextlib.suppress(Exception):
            error.__dict__["_told_in"] = id(self), self.number
        return error

    def known(self, error: BaseException | None) -> bool:
        """Whether the last meeting has told all ranks of an error, or of one that it was made of."""
        for _ in range(20):
            if error is None:
                break
            if error.__dict__.get("_told_in") == (id(self), self.number):
                return True
            error = error.__cause__ or error.__context__
        return False


def _told(error: BaseException) -> PolarMPMError | str:
    """An error as others are told of it."""
    if isinstance(error, PolarMPMError):
        with contextlib.suppress(Exception):
            pickle.dumps(error)
            return error
    return described_error(error)


def described_error(error: BaseException) -> str:
    """Kind and text of an error, at most a few lines."""
    if isinstance(error, SystemExit):
        return f"sys.exit({error.code!r})"
    text = str(error)
    text = text if len(text) <= 1000 else text[:1000] + "..."
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _apart(words: Words) -> PolarMPMError:
    """The error of ranks that say different things."""
    calls = {word.call for word in words}
    by_rank = sorted(words.items(), key=lambda item: min(item[1]))
    if len(calls) == 1:
        parts = _differing([word.given for word, _ in by_rank])
        said = [f"{ranks_named(r)}: {part}" for part, (_, r) in zip(parts, by_rank, strict=True)]
        return InputError(f"{calls.pop()}: the same is needed on all ranks, but they give " + "; ".join(said))
    return RanksApart(
        {r: w.call for w, ranks in by_rank for r in ranks}, "; ".join(_doing(*i) for i in by_rank)
    )


def _beginning(texts: list[str]) -> str:
    """What all texts begin with."""
    least, most = min(texts), max(texts)
    return least[: next((k for k, (a, b) in enumerate(zip(least, most, strict=False)) if a != b), len(least))]


def _differing(texts: list[str]) -> list[str]:
    """Texts of arguments without what all of them begin and end with."""
    same = _beginning(texts)
    begin = max((m.start() for m in re.finditer(r"\w+=", same)), default=0)
    last = same.rfind(", ") + 2
    if last > begin and any(re.match(r"\w+=", text[last:]) for text in texts):
        begin = last
    rest = [text[begin:] for text in texts]
    same = _beginning([text[::-1] for text in rest])[::-1]
    end = len(same) - same.index(", ") if ", " in same else 0
    return [text[: len(text) - end][:_SHOWN] or "nothing" for text in rest]


def _doing(word: Word, ranks: list[int]) -> str:
    if word.ended:
        return f"{ranks_named(ranks)} ha{'ve' if len(ranks) > 1 else 's'} ended"
    return f"{ranks_named(ranks)}: {word.call}"


def ranks_named(ranks: list[int]) -> str:
    """'rank 1' or 'ranks 0, 2'."""
    shown = ", ".join(map(str, sorted(ranks)[:8])) + (", ..." if len(ranks) > 8 else "")
    return f"rank{'s' * (len(ranks) > 1)} {shown}"


# the communicators ----------------------------------------------------------------------------------
known: list[Meetings] = []  # of the communicators of which this rank knows; that of all ranks first
_CONGRUENT = MPI.Comm.Create_keyval(nopython=True)  # of communicators of all ranks: they meet as one
_OWN = MPI.Comm.Create_keyval(delete_fn=lambda comm, key, meetings: _forget(meetings))


def _forget(meetings: Meetings) -> None:
    if meetings in known:
        known.remove(meetings)


def of(comm: MPI.Comm) -> Meetings:
    """The meetings of a communicator's ranks."""
    if not known:
        known.append(Meetings(MPI.COMM_WORLD))
    if comm.Get_attr(_CONGRUENT):
        return known[0]
    own: Meetings | None = comm.Get_attr(_OWN)
    if own is not None:
        return own
    if MPI.Comm.Compare(comm, MPI.COMM_WORLD) in (MPI.IDENT, MPI.CONGRUENT):
        comm.Set_attr(_CONGRUENT, 1)
        return known[0]
    own = Meetings(comm)
    comm.Set_attr(_OWN, own)
    known.append(own)
    return own


# calls ------------------------------------------------------------------------------------------------
@contextlib.contextmanager
def together(comm: MPI.Comm, call: str, given: str = "") -> Iterator[None]:
    """A collective call, which begins with a meeting unless it is part of another one. Collective.

    Raises:
        RanksApart: not all ranks are in this call.
        InputError: they are, but the script gave them something else.
        ErrorOnAnotherRank: the script has failed on another rank.
    """
    if comm.size == 1:
        yield
        return
    meetings = of(comm)
    if meetings.inside:
        yield
        return
    meetings.meet(Word(call, given))
    meetings.inside = call
    try:
        yield
    except (Exception, KeyboardInterrupt, SystemExit) as e:
        if not meetings.known(e):  # the others may be at another place of this call, or through with it
            meetings.meet(Word(f"within {call}"), e)
        raise
    finally:
        meetings.inside = ""


def collective(
    call: str, *, comm: Callable[..., MPI.Comm] | str = "comm", compare: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Makes a public function one that all ranks have to be in, see `together`.

    Args:
        call: its name in messages.
        comm: of its ranks: an attribute of the first argument, or a function of the arguments. Arguments that
            have none are left to the function's own checks.
        compare: what the script gives has to be the same on all ranks.
    """

    def made(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def called(*args: P.args, **options: P.kwargs) -> R:
            try:
                ranks = getattr(args[0], comm) if isinstance(comm, str) else comm(*args, **options)
                alone = ranks.size == 1
            except Exception:
                alone = True
            if alone:
                return function(*args, **options)
            skipped = isinstance(comm, str) or "." in function.__qualname__
            given = described(args[1:] if skipped else args, options) if compare else ""
            with together(ranks, call, given):
                return function(*args, **options)

        return called

    return made


# the end ------------------------------------------------------------------------------------------------
def report(error: BaseException, who: str) -> str:
    """The traceback of an error, headed by the ranks that it is from."""
    return f"{who}:\n{''.join(traceback.format_exception(error))}"


def abort(text: str, status: int = 1) -> NoReturn:
    """End all ranks at once, with a message."""
    for stream, what in ((sys.stdout, ""), (sys.stderr, text)):
        with contextlib.suppress(Exception):
            stream.write(what)
            stream.flush()
    time.sleep(0.2)  # until mpirun has passed the message on
    MPI.COMM_WORLD.Abort(status)
    raise SystemExit(status)
