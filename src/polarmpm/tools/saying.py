"""Lines that a run says by itself."""

from __future__ import annotations

import logging
import sys
from functools import cache

_log = logging.getLogger("polarmpm")


def say(level: int, text: str) -> None:
    """One line on standard error, or to the handlers of the logger "polarmpm" if it has been given some.

    Its level silences it. The root logger's handlers aren't asked: ffcx gives it one when it's imported.
    """
    if _log.level == logging.NOTSET:
        _log.setLevel(logging.INFO)  # silenced by a higher one
    if not _log.isEnabledFor(level):
        return
    if _log.handlers:
        _log.log(level, text)
    elif sys.stderr is not None:
        print(f"polarmpm: {text}", file=sys.stderr, flush=True)


@cache
def say_once(level: int, text: str) -> None:
    """The same, once a process."""
    say(level, text)
