"""Load steps of a problem take turns: with one another, and with other problems of the same body."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..bodies.points import Points
from ..errors import InputError
from .state import Progress


class Turns:
    """Whether a problem's body and progress are as its last load step has left them.

    What is kept between steps (increments, carried forces, work) belongs to that state. A body may be taken
    on by a problem that is made of it later; the earlier one ends there.

    Args:
        body: what a script knows the points as, "points" or "elements".
    """

    def __init__(self, points: Points, body: str):
        self.points, self.body = points, body
        self.busy = False  # a load step is being solved
        self.left(Progress())

    def left(self, progress: Progress, changed: bool = False) -> None:
        """Note the state as it is now; `changed`: the problem has changed the points itself."""
        self.points.steps += changed
        self._steps, self._reached = self.points.steps, (progress.factor, progress.step)

    def check(self, progress: Progress) -> None:
        """Raise InputError unless all is as it was left."""
        if self.points.steps != self._steps:
            raise InputError(
                f"{self.body}: another problem has taken them on since this problem was made of them, or "
                f"since its last step; what this one knows of them is past. Make a new problem of them, or "
                f"{self.body} for each problem"
            )
        if (progress.factor, progress.step) != self._reached:
            factor, step = self._reached
            raise InputError(
                f"progress: factor = {progress.factor!r} and step = {progress.step!r} were put in by hand; "
                f"of the last converged state they are {factor!r} and {step!r}, from which march leads on"
            )

    @contextmanager
    def take(self, what: str, progress: Progress) -> Iterator[None]:
        """While a load step is being solved.

        Raises:
            InputError: another one is, or something has been changed.
        """
        self.outside(what)
        self.check(progress)
        self.busy = True
        try:
            yield
        finally:
            self.busy = False

    def outside(self, what: str) -> None:
        """Raise InputError within a load step."""
        if self.busy:
            raise InputError(
                f"{what}: a load step of this problem is being solved; functions and observers that it calls "
                "must leave the problem as it is"
            )
