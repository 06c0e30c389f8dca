"""CPU time by phase."""

from __future__ import annotations

import time
from types import TracebackType


class Timer:
    """Adds up CPU seconds of this process by named phase; phases don't nest."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def __call__(self, phase: str) -> Phase:
        return Phase(self.seconds, phase)


class Phase:
    """While it lasts, its time counts; a generator would cost more than what some phases do."""

    def __init__(self, seconds: dict[str, float], name: str):
        self._seconds, self._name = seconds, name

    def __enter__(self) -> None:
        self._begin = time.process_time()

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        spent = time.process_time() - self._begin
        self._seconds[self._name] = self._seconds.get(self._name, 0.0) + spent
