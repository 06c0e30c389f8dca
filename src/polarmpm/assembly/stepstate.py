"""Where the iterations of a load step stand, and what an assembly sums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .condensed import Condensed
from .pointboxes import BoxTangent


@dataclass
class Assembled:
    """Sums over a body and its terms, complete on owned rows.

    Attributes:
        forces: internal minus external ones (nodes, block).
        lifted: what the prescribed increments that are still to be put in add to them through the tangent;
            None where there are none, or no tangent was asked for.
    """

    forces: np.ndarray
    lifted: np.ndarray | None = None


@dataclass
class StepState:
    """Where the iterations of a load step stand; made when it begins. Arrays are (nodes, block).

    Attributes:
        lift: what prescribed unknowns still have to move, zero at the others.
        pending: some rank's lift isn't zero.
        initial: residual of the first evaluation; None before it.
        lifted: of the last evaluation, see `Assembled`.
        correction: the last one, the share of it that was taken; None before the first.
        direction: all of it.
        rounding: squares of the forces that rounding makes, see `rounding.squares`; None before
            the first tangent.
        tangents: how many there have been.
        boxes: what the points' boxes have added to the last tangent; None before the first one.
        began_with: the same of the first tangent.
        solutions: how many linear ones there have been.
        projected: what the last tangent says of projected stresses, by batch; None before the first one.
        origin: from where the last correction was made: unknowns, residual, and `projected`; None where it
            put in prescribed values.
        condensed: what rigid bodies add to the last tangent; None where there are none.
    """

    lift: np.ndarray
    pending: bool = False
    initial: np.ndarray | None = None
    lifted: np.ndarray | None = None
    correction: np.ndarray | None = None
    direction: np.ndarray | None = None
    rounding: np.ndarray | None = None
    tangents: int = 0
    boxes: BoxTangent | None = None
    began_with: BoxTangent | None = None
    solutions: int = 0
    projected: list[Any] | None = None
    origin: tuple[np.ndarray, np.ndarray, list[Any] | None] | None = None
    condensed: Condensed | None = None
