"""How a rigid body finds its place: forces on it are in balance there.

It has few unknowns q, but contact couples all of its sites with them. So they are no unknowns of the nodal
system: for given increments of the nodes there is one place at which the forces on the body are in balance,
and what the nodes see of it is a matrix of the rank of q beside their own tangent (`assembly.condensed`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..errors import LocalFailure
from ..forms.rigidcontact import motions
from ..kinematics.timesteps import TimeStep
from .base import Term

_ENOUGH = 1e-13  # out-of-balance forces over the sum of the sizes of all
_POOR = 1e-9  # the same where rounding allows no less
_EPSILONS = 4.0  # of places, that count as rounding
_MOST, _SHARES = 60, 20
_LEFT = 0.5  # of the slope along a correction, with which a share of it is good enough
_RESISTED = 0.1  # share of the forces that nothing resists, from which on they are followed
_GROWTH = 4.0
_FAR = 1e3  # times the lever: where a body that nothing resists has gone away
_NULL = 1e-13  # stiffness over the largest one that counts as none

Sums = tuple[np.ndarray, np.ndarray, np.ndarray]


class Settling(Term):
    """A body whose place follows from the increments of the nodes.

    Attributes:
        moved: unknowns q (k,), what the centre has moved in this step (m), and the turn (rad).
        free: those that aren't prescribed (k,), bool.
        active: a step is under way; frozen: and forces have come to balance in it.
        lever: length (m) at which a moment counts as a force.
        stiffness: (N/m) of all sites of contact together.
    """

    dim: int
    step: TimeStep | None
    moved: np.ndarray
    free: np.ndarray
    position: np.ndarray
    active: bool
    frozen: bool
    lever = 1.0
    stiffness = 1.0
    _outer: np.ndarray
    _settled: tuple[np.ndarray, np.ndarray] | None
    _pushed: np.ndarray
    _reactions: np.ndarray
    comm: Any

    @abstractmethod
    def _inertial(self, q: np.ndarray) -> Sums:
        """Forces and moments of inertia at unknowns q, their derivative, and their sizes."""

    def settle(self, x: np.ndarray, pushing: Iterable[Any]) -> None:
        """Find its place for increments of the nodes, at which `pushing` stands for what is in contact with
        it: each gives forces, their derivative and sizes at unknowns q. Collective.

        Raises:
            LocalFailure: there is none.
        """
        if not self.active or self.frozen or (self._settled is not None and self._settled[0] is x):
            return
        pushing = list(pushing)
        q = self.moved.copy()
        force, tangent, size = self._sums(q, pushing)
        for _ in range(_MOST):
            off = np.abs(force[self.free])
            if np.all(off <= _ENOUGH * size[self.free]):
                break
            found = self._along(q, *self._correction(tangent, force), force, pushing)
            less = np.linalg.norm(found[1] * self._weights) < _LEFT * np.linalg.norm(force * self._weights)
            if not less and np.all(off <= _POOR * size[self.free] + self._rounding()[self.free]):
                self._sums(q, pushing)
                break
            q, force, tangent, size = found
        else:
            raise self._unbalanced()
        self._settled = x, tangent
        self._reactions = np.where(self.free, 0.0, force)

    def _unbalanced(self) -> LocalFailure:
        hint = "" if self.step else "; does anything hold it?"
        return LocalFailure(f"{self.name}: there is no place at which the forces on it are in balance{hint}")

    @property
    def _weights(self) -> np.ndarray:
        return np.where(
            self.free, np.repeat([1.0, 1.0 / self.lever], [self.dim, motions(self.dim) - self.dim]), 0.0
        )

    def _rounding(self) -> np.ndarray:
        """Forces (k,) that rounding of places makes: what springs have of it."""
        reach = float(np.abs(self.position).max()) + self.lever
        force = _EPSILONS * np.finfo(float).eps * self.stiffness * reach
        return force * np.repeat([1.0, self.lever], [self.dim, motions(self.dim) - self.dim])

    def _inverse(self, tangent: np.ndarray) -> np.ndarray:
        """Of the derivative, of the free unknowns; zero for those that nothing resists."""
        w = self._weights
        scaled = w[:, None] * tangent * w
        found: np.ndarray = w[:, None] * np.linalg.pinv(scaled, rcond=_NULL) * w
        return found

    def _sums(self, q: np.ndarray, pushing: list[Any]) -> Sums:
        """All forces that are out of balance at unknowns q, their derivative, and what their sizes add up
        to. Collective."""
        k = motions(self.dim)
        self.moved = q
        here = np.zeros((k, k + 2))
        for one in pushing:
            force, tangent, size = one(q)
            here += np.column_stack([force, size, tangent])
        every: np.ndarray = np.sum(self.comm.allgather(here), axis=0)
        force, tangent, size = self._inertial(q)
        self._pushed = every[:, 0]
        return (
            force + every[:, 0] - self._outer,
            tangent + every[:, 2:],
            size + every[:, 1] + np.abs(self._outer),
        )

    def _correction(self, tangent: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, bool]:
        """Newton's correction; where nothing resists the forces, one along them, and that it may have to
        grow."""
        w, inverse = self._weights, self._inverse(tangent)
        left = w * (force - tangent @ (inverse @ force))
        if np.linalg.norm(left) > _RESISTED * np.linalg.norm(w * force):
            return -w * left / self.stiffness, True
        return -inverse @ force, False

    def _along(
        self, q: np.ndarray, step: np.ndarray, grows: bool, force: np.ndarray, pushing: list[Any]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A share of a correction, at which little is left of the slope of the potential along it; more than
        all of it where it grows."""
        start = of_low = float(force @ step)
        before = float(np.linalg.norm(self._weights * force))
        low, share, of_high, high = 0.0, 1.0, 0.0, None
        for _ in range(_SHARES):
            found = self._sums(q + share * step, pushing)
            slope = float(found[0] @ step)
            enough = high is None and slope <= 0.0 and not grows
            less = np.linalg.norm(self._weights * found[0]) <= _LEFT * before
            if less or enough or abs(slope) <= -_LEFT * start or not start < 0.0:
                break
            if slope <= 0.0:
                low, of_low = share, slope
            else:
                high, of_high = share, slope
            if high is None:
                share *= _GROWTH
                if share * float(np.abs(self._weights * step).max()) > _FAR * self.lever:
                    raise self._unbalanced()
                continue
            between = of_low / (of_low - of_high)
            share = low + (high - low) * min(max(between, 0.1), 0.9)
        return q + share * step, *found

    @property
    def inverse(self) -> np.ndarray:
        """Inverse of the forces' derivative at the place that has been found."""
        assert self._settled is not None
        return self._inverse(self._settled[1])

    @property
    def follows(self) -> bool:
        """Its place follows from the increments, so that the nodes' tangent knows of it."""
        return self.active and not self.frozen and self._settled is not None and bool(self.free.any())
