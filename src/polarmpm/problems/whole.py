"""Changes of a problem's state as a whole or not at all, and the end of a problem.

What a load step changes is spread over many objects, and anything may end it at any place: Ctrl-C, a timeout,
an error in a function of the script's. What there was at its beginning is then put back: attributes, and
what lists and dicts contain. No step writes to an array of the state, it puts a new one in its place; so to
remember what there was is to remember a few references.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from types import TracebackType
from typing import Any, Self, TypeVar

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..terms.base import Term
from ..tools.disposal import dispose_of_dropped
from ..tools.interrupts import undisturbed

T = TypeVar("T")
Changing = tuple[Any, tuple[str, ...] | None]  # an object, and which of its attributes; None: all


_CONTAINERS = (list, dict, set)
_PLAIN = frozenset({np.ndarray, bool, int, float, str, tuple, type(None)})  # what most attributes are


class Undo:
    """What some objects are like now, to be put back."""

    def __init__(self, changing: Iterable[Changing]):
        self._attributes: list[tuple[Any, dict[str, Any], bool]] = []
        self._contents: list[tuple[Any, Any]] = []
        for thing, names in changing:
            found = getattr(thing, "__dict__", {})
            kept = dict(found) if names is None else {name: found[name] for name in names if name in found}
            self._attributes.append((thing, kept, names is None))
            if isinstance(thing, Term):
                for value in kept.values():
                    self._remember(value, True)
                continue
            for value in kept.values():
                if type(value) in _PLAIN:
                    continue
                if isinstance(value, _CONTAINERS):
                    self._remember(value, False)

    def _remember(self, value: Any, arrays: bool) -> None:
        """What a container contains; of terms, which scripts may write, numbers in arrays, too."""
        if isinstance(value, list | set):
            self._contents.append((value, value.copy()))
        elif isinstance(value, dict):
            self._contents.append((value, dict(value)))
            for one in value.values() if arrays else ():
                self._remember(one, isinstance(one, np.ndarray))
        elif arrays and isinstance(value, np.ndarray) and value.flags.writeable:
            self._contents.append((value, value.copy()))

    def put_back(self) -> None:
        """Put back what there was. Local."""
        for thing, kept, all_ in self._attributes:
            now = vars(thing) if kept or hasattr(thing, "__dict__") else {}
            for name in [n for n in now if all_ and n not in kept]:
                if not isinstance(getattr(type(thing), name, None), cached_property):
                    del now[name]
            now.update(kept)
        for value, contents in self._contents:
            if isinstance(value, np.ndarray):
                value[...] = contents
                continue
            value.clear()
            if isinstance(value, list):
                value.extend(contents)
            else:
                value.update(contents)


class Whole(ABC):
    """A problem whose state changes as a whole or not at all.

    Attributes:
        closed: it has been closed, and takes no more steps.
    """

    comm: MPI.Comm
    closed = False
    _undo: Undo | None = None  # of the change that is under way

    def _changing(self) -> Iterator[Changing]:
        """What a load step changes. An object may be named more than once."""
        yield self, None

    def _put_back(self, undo: Undo) -> None:
        """Put back what there was before a change. Local, as one rank may be alone with its interrupt."""
        undo.put_back()

    def whole(self, work: Callable[[], T]) -> T:
        """Do work that changes the state: as a whole or, if anything ends it early, not at all. Work that is
        part of a larger whole is put back with that.

        Raises:
            InputError: the problem has been closed.
        """
        self.check_open()
        if self._undo is not None:
            return work()
        undo = Undo(self._changing())
        try:
            self._undo = undo
            done = work()
            self._undo = None  # from here on the work is done
        except BaseException:
            with undisturbed():
                if self._undo is not None:
                    self._put_back(undo)
            raise
        return done

    def tried(self, work: Callable[[], T]) -> T:
        """Do work, and put back all that it has changed."""
        self.check_open()
        undo = Undo(self._changing())
        try:
            return work()
        finally:
            with undisturbed():
                self._put_back(undo)

    # end ------------------------------------------------------------------------------------------
    def check_open(self) -> None:
        """Raise InputError if the problem has been closed."""
        if self.closed:
            raise InputError(
                "the problem has been closed: it takes no more steps and conditions, and can't be saved; "
                "results of its last step can still be read"
            )

    def close(self) -> None:
        """Free the memory of matrices, factors and of the grid's functions at once, instead of when the
        script drops the problem. Steps, points and the results of the last step stay: fields, energies,
        reactions. More steps or conditions, and `save_restart`, raise an InputError. Collective."""
        if not self.closed:
            self._free()
            self.closed = True
        dispose_of_dropped(self.comm)

    def _free(self) -> None:  # noqa: B027
        """Free what only further steps need. Collective."""

    def __enter__(self) -> Self:
        """`with pm.QuasiStatic(...) as problem:` closes the problem at the end."""
        return self

    def __exit__(self, kind: Any, error: Any, trace: TracebackType | None) -> None:
        if kind is None or self.comm.size == 1:  # an error may be one rank's alone
            self.close()
