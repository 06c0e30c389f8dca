"""Load steps of a problem take turns: with one another, and with other problems of the same body."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..bodies.points import Points
from ..errors import InputError
from .state import Progress


class Turns:
    """Whether a problem's body and progress are as its last load step has left them.

    What is kept between steps (increments, carried forces, work) belongs to that state. A body may be taken
    on by a problem that is made of it later; the earlier one ends there.

    Attributes:
        body: what a script knows the points as, for messages.
    """

    body = "points"
    points: Points
    progress: Progress
    _busy = False  # a load step is being solved
    _as_left: tuple[int, float, int]  # steps of the points, load factor and number of steps

    def _leave(self, changed: bool = False) -> None:
        """Note the state as it is now; `changed`: the problem has changed the points itself."""
        self.points.steps += changed
        self._as_left = self.points.steps, self.progress.factor, self.progress.step

    def _check_left(self) -> None:
        """Raise InputError unless all is as it was left."""
        steps, factor, step = self._as_left
        if self.points.steps != steps:
            raise InputError(
                f"{self.body}: another problem has taken them on since this problem was made of them, or "
                f"since its last step; what this one knows of them is past. Make a new problem of them, or "
                f"{self.body} for each problem"
            )
        now = self.progress.factor, self.progress.step
        if now != (factor, step):
            raise InputError(
                f"progress: factor = {now[0]!r} and step = {now[1]!r} were put in by hand; of the last "
                f"converged state they are {factor!r} and {step!r}, from which march leads on"
            )

    def _check_outside(self, what: str) -> None:
        """Raise InputError within a load step."""
        if self._busy:
            raise InputError(
                f"{what}: a load step of this problem is being solved; functions and observers that it calls "
                "must leave the problem as it is"
            )

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise InputError(
            f"there is no copy or pickle of a problem, as its {self.body} and matrices are on several ranks: "
            "save_restart writes its state to a file, from which load_restart goes on in another problem"
        )

    @contextmanager
    def _turn(self, what: str) -> Iterator[None]:
        """While a load step is being solved.

        Raises:
            InputError: another one is, or something has been changed.
        """
        self._check_outside(what)
        self._check_left()
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
