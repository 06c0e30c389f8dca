"""Signals: they wait while something is done that must not be left half done, and Python hears of pipes."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGALRM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGVTALRM", "SIGPROF")
_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))


def heed_pipes() -> None:
    """Let Python hear of a reader that has gone, as of `script.py | head`, in place of PETSc, which ends the
    process with a page of text."""
    if hasattr(signal, "SIGPIPE") and threading.current_thread() is threading.main_thread():
        known = signal.getsignal(signal.SIGPIPE)  # Python's own, whatever PETSc has put in its place
        if known is not None:
            signal.signal(signal.SIGPIPE, known)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Functions that handle signals, such as what makes a KeyboardInterrupt of Ctrl-C, are called at the end.

    Only the main thread is ever disturbed by them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[tuple[int, Any]] = []
    handlers: dict[int, Any] = {}
    try:
        for number in _SIGNALS:
            if callable(signal.getsignal(number)):
                handlers[number] = signal.signal(number, lambda *caught: waiting.append(caught))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in waiting:
            handlers[number](number, frame)
