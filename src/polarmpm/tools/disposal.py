"""PETSc's objects of owners that a script has dropped.

petsc4py doesn't destroy what Python has dropped: on several ranks that is collective, and Python drops things
when it likes. It puts them aside for the end of the process, on one rank too, with matrices and factors
(https://gitlab.com/petsc/petsc/-/issues/1309). Here an owner says how its objects are destroyed: on one rank
that happens when it is dropped, on several at the next collective call, once all of them have dropped it.
"""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from mpi4py import MPI

T = TypeVar("T")

_Key = tuple[int, ...]  # world ranks: meshes have communicators of their own for the same ranks
_made: Counter[_Key] = Counter()
_dropped: dict[_Key, dict[int, Disposal]] = {}


def _key(comm: MPI.Comm) -> _Key:
    mine, world = comm.Get_group(), MPI.COMM_WORLD.Get_group()
    ranks = tuple(MPI.Group.Translate_ranks(mine, list(range(comm.size)), world))
    mine.Free()
    world.Free()
    return ranks


def weakly(method: Callable[[], T]) -> Callable[[], T]:
    """A method of an object that whoever calls it doesn't keep alive."""
    own = weakref.WeakMethod(method)

    def call() -> T:
        found = own()
        assert found is not None
        return found()

    return call


class Disposal:
    """Destroys objects, once; whoever owns them may call it before it is dropped."""

    def __init__(self, destroy: Callable[[], None]):
        self._destroy: Callable[[], None] | None = destroy

    def __call__(self) -> None:
        destroy, self._destroy = self._destroy, None
        if destroy is not None:
            destroy()


def dispose_with(owner: Any, comm: MPI.Comm, destroy: Callable[[], None]) -> Disposal:
    """Destroy objects when their owner is dropped, unless that has been done by then. Collective.

    Args:
        destroy: must not keep the owner alive.
    """
    disposal = Disposal(destroy)
    if comm.size == 1:
        weakref.finalize(owner, disposal).atexit = False
        return disposal
    key = _key(comm)
    _made[key] += 1
    aside = _dropped.setdefault(key, {})
    weakref.finalize(owner, aside.__setitem__, _made[key], disposal).atexit = False
    return disposal


def dispose_of_dropped(comm: MPI.Comm) -> None:
    """Destroy the objects of owners that all ranks have dropped. Collective."""
    if comm.size == 1:
        return
    aside = _dropped.setdefault(_key(comm), {})
    everywhere = set.intersection(*map(set, comm.allgather(list(aside))))
    for number in sorted(everywhere):
        aside.pop(number)()
