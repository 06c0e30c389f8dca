"""What a process knows of kernels that it has made before: their names in the cache, without the UFL.

To name a kernel takes its whole expression and a signature of it, which is most of a small problem's start
and the same work for each problem of a kind. What is kept here is the name alone. It is known by what the
expression is made of, which has to tell everything that it depends on.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")
_MOST = 1000  # a kernel's name and what it is known by take a kilobyte
_known: OrderedDict[Hashable, Any] = OrderedDict()


def recalled(of: Hashable, make: Callable[[], T]) -> T:
    """What `make` returns, or what it has returned for an equal `of`; nothing is kept for None. Rank-local:
    what is made must take no part of another rank."""
    if of is None:
        return make()
    if of in _known:
        _known.move_to_end(of)
        found: T = _known[of]
        return found
    found = _known[of] = make()
    if len(_known) > _MOST:
        _known.popitem(last=False)
    return found
