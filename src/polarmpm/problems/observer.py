"""Hooks into a run, for what watches it or goes along with it."""

from __future__ import annotations

from typing import Any

from ..tools import checks

_TOLD = {  # what it is told, with which arguments
    "after_reset": ("problem",),
    "after_convergence": ("problem", "factor"),
    "after_commit": ("problem", "rebased"),
}


class Observer:
    """Told what happens in a run: derive from it, say what you want to hear, and append it to
    `problem.observers`. All methods are collective, and must leave the problem as it is.

    A step that anything ends early, an error of an observer too, hasn't been taken: attributes of observers,
    and what their lists and dicts contain, are put back with the problem's state, and they are told again
    when the step is taken after all.

    The decisions of a run can be replayed by another one: the reset policy (`reset=`) decides on resets,
    `problem.rotation_limit` on new bases of the rotations, and the steps' load factors are in
    `problem.steps`.
    """

    def check(self) -> None:
        """Raise InputError unless it can be told what happens."""
        for name, takes in _TOLD.items():
            checks.function(f"observers: {type(self).__name__}.{name}", getattr(self, name), takes=takes)

    def after_reset(self, problem: Any) -> None:
        """Increments count from the present state on: the grid has been reset, or, of elements, a step been
        committed. `problem.system` is that of the steps to come."""

    def after_convergence(self, problem: Any, factor: float) -> None:
        """A step to a load factor has converged and been found acceptable: `problem.system` has its
        increments, residual and tangent, the body still the state of the last step."""

    def after_commit(self, problem: Any, rebased: bool) -> None:
        """The solution has become the body's state; `rebased`: rotation increments count from it on."""
