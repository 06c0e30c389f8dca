"""Warnings of a fit's runs: each is said once, however many of the runs say it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from mpi4py import MPI

from ..errors import TrustWarning
from ..tools.caller import warn
from ..tools.parallel import errors_on_all_ranks

_NUMBERS = re.compile(r"\d[\d.,]*(e[+-]?\d+)?")


class Doubts:
    """What has been said."""

    def __init__(self, comm: MPI.Intracomm):
        self._comm = comm
        self._said: set[str] = set()

    def tell(self, texts: Iterable[str]) -> None:
        """Warn of what hasn't been said yet; other numbers don't make it another warning. Collective."""
        with errors_on_all_ranks(self._comm):  # of warnings a script may make errors
            for text in texts:
                kind = _NUMBERS.sub("#", text)
                if kind not in self._said:
                    self._said.add(kind)
                    warn(text, TrustWarning)


@contextmanager
def doubts_kept() -> Iterator[list[str]]:
    """Keep the texts of `TrustWarning`s that would be shown within; all other warnings are, and these too
    where an error ends it."""
    texts: list[str] = []
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: object) -> None:
            if issubclass(category, TrustWarning):
                texts.append(str(message))
            else:
                shown(message, category, *place)  # type: ignore[arg-type]

        warnings.showwarning = show  # type: ignore[assignment]
        try:
            yield texts
        except BaseException:
            warnings.showwarning = shown
            for text in texts:
                warn(text, TrustWarning)
            raise
