"""When the background grid is reset: a policy of its own, apart from load steps.

Resets, not load steps, change the answer: the new basis can't balance all of the points' stresses, and what
it can't balance is lost unless it is carried along.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import numpy as np

from ..tools import checks


class ResetPolicy(Protocol):
    """Decides after each converged step."""

    def due(self, steps: int, gradient: np.ndarray, comm: MPI.Comm) -> bool:
        """Whether to reset, `steps` steps after the last reset, with du/dx~ (np, d, d) at the points."""


@dataclass(frozen=True)
class EverySteps:
    """Reset after every n-th load step; n = 1 is the method of the papers."""

    n: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "n", checks.whole("n", self.n, least=1))

    def due(self, steps: int, gradient: np.ndarray, comm: MPI.Comm) -> bool:
        return steps >= self.n


@dataclass(frozen=True)
class WhenDistorted:
    """Reset when the cells' Green strain exceeds `limit` at some point (rigid motion doesn't count)."""

    limit: float = 0.2

    def __post_init__(self) -> None:
        allowed = "a positive number is allowed"
        object.__setattr__(self, "limit", checks.number("limit", self.limit, above=0.0, allowed=allowed))

    def due(self, steps: int, gradient: np.ndarray, comm: MPI.Comm) -> bool:
        transposed = np.swapaxes(gradient, 1, 2)
        green = 0.5 * (gradient + transposed + transposed @ gradient)
        most = np.linalg.norm(green, axis=(1, 2)).max(initial=0.0)
        return bool(comm.allreduce(float(most), op=MPI.MAX) > self.limit)


@dataclass(frozen=True)
class InMotion(WhenDistorted):
    """`WhenDistorted`, and in dynamic problems also where the nodes, which go along with a moving body, don't
    know what it comes to: when it reaches nodes at which a support acts, and, while pieces of one body that
    were apart at the beginning are so near that they share nodes, whenever they have moved by `near` cells,
    as between two resets they are glued.
    """

    near: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "near", checks.number("near", self.near, least=0.0))


@dataclass(frozen=True)
class Never:
    """Keep the first weighting functions: a total Lagrangian method, for studies."""

    def due(self, steps: int, gradient: np.ndarray, comm: MPI.Comm) -> bool:
        return False


def make_policy(reset: int | ResetPolicy | None) -> ResetPolicy:
    """A number n means every n steps, None never.

    Raises:
        InputError: something else; a policy whose `due` can't be called as that of `ResetPolicy`.
    """
    if reset is None:
        return Never()
    allowed = "a positive whole number of steps, None, or a policy such as WhenDistorted(0.2)"
    if isinstance(reset, type) or not hasattr(reset, "due"):
        return EverySteps(checks.whole("reset", reset, least=1, allowed=allowed))
    policy: Any = reset
    checks.function(f"reset: {type(policy).__name__}.due", policy.due, takes=("steps", "gradient", "comm"))
    made: ResetPolicy = policy
    return made
