"""What a script has given, in order: which conditions act, since when, and which have been released.

A restart file holds this; the script gives its conditions again before it reads the file, the same as before
in the same order, and those that had been released by then are released again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ..conditions.amplitudes import Fade
from ..errors import InputError


class Present(tuple[Any, ...]):
    """The conditions that act, to look at: they come and go by the methods of the problem."""

    __slots__ = ()

    def __getattr__(self, name: str) -> Any:
        if name in ("append", "clear", "extend", "insert", "pop", "remove"):
            raise InputError(
                f"{name}: the conditions of a problem can't be changed here; fix, load, add and their like "
                "put one in, problem.release takes one away"
            )
        raise AttributeError(f"a tuple of conditions has no attribute {name!r}")


@dataclass
class Given:
    """A condition of a script's.

    Attributes:
        condition: a support, a term, or what `load` has returned.
        begun: load factor of the last converged state when it was given.
        counts: "from now" (from then on), "total", or None: the default of loads.
        released: the same when it was released; None: it acts.
        until: load factor at which it has faded out, if it was released over load factors.
        faded: it has.
    """

    name: str
    condition: Any
    begun: float
    counts: str | None = None
    released: float | None = None
    until: float | None = None
    faded: bool = False

    @property
    def fade(self) -> Fade | None:
        """How it vanishes; None: it acts, or was gone at once."""
        if self.released is None or self.until is None:
            return None
        return Fade(self.released, self.until, self.faded)

    @property
    def gone(self) -> bool:
        """It doesn't act any more."""
        return self.released is not None and self.until is None


@dataclass
class Register:
    """All that a script has given."""

    entries: list[Given] = field(default_factory=list)
    _numbers: dict[str, int] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Given]:
        return iter(self.entries)

    def next(self, kind: str) -> int:
        """Number of the next condition of a kind, for its name."""
        return self._numbers.get(kind, 0) + 1

    def add(self, given: Given, kind: str) -> None:
        """Note what a script has given."""
        self.entries.append(given)
        self._numbers[kind] = self.next(kind)

    def of(self, condition: Any) -> Given | None:
        """The entry of a condition or of one of its parts."""
        for given in self.entries:
            parts = (given.condition, *getattr(given.condition, "parts", ()))
            if any(part is condition for part in parts):
                return given
        return None

    def saved(self) -> str:
        """For a restart file."""
        rows = [
            {
                "name": g.name,
                "begun": g.begun,
                "released": g.released,
                "until": g.until,
                "faded": g.faded,
                "counts": g.counts,
                "met": getattr(g.condition, "met", None),
                "applied": getattr(g.condition, "applied", None),
            }
            for g in self.entries
        ]
        return json.dumps(rows)

    def match(self, text: str) -> tuple[list[tuple[Given, dict[str, Any] | None]], list[str]]:
        """The entries, each with what was saved of it (None: it is new), and the names of those that were
        saved but haven't been given."""
        rows: list[dict[str, Any]] = json.loads(text)
        found: list[tuple[Given, dict[str, Any] | None]] = []
        for given in self.entries:
            at = next((k for k, row in enumerate(rows) if row["name"] == given.name), None)
            found.append((given, None if at is None else rows.pop(at)))
        return found, [row["name"] for row in rows]
