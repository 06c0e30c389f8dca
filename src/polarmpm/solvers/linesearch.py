"""A share of a correction where all of it leads away from the solution.

Bodies that begin to flow answer a correction of the elastic-plastic tangent with other points that yield:
with large steps Newton's method then overshoots, and goes on to do so. The out-of-balance forces' work on the
correction is the slope of the step's potential along it (and without a potential still tells that the
correction went too far); a share of the correction is taken at which little of that slope is left.
"""

from __future__ import annotations

import math
from typing import Protocol

from ..errors import LocalFailure

_LEFT = 0.5  # of the slope, with which a share is good enough: more is gained by the next tangent
_MOST = 8  # shares that are tried
_INSIDE = 0.1  # of a bracket that the next share stays away from its ends


class Searched(Protocol):
    """A system whose corrections may be shortened."""

    def evaluate(self, tangent: bool) -> None:
        """See `newton.System`."""

    def slope(self, start: bool = False) -> float | None:
        """Work of the out-of-balance forces on the last correction, and of those from which it was made; None
        where it isn't to be shortened."""

    def take(self, share: float) -> None:
        """Put in this share of the last correction in the place of what has been put in of it."""


def shorten(system: Searched, tangent: bool) -> bool:
    """Shorten the last correction, at whose end the system has been evaluated, if it went too far; the system
    is then evaluated at the share that was taken. False: it stays as it is. Collective."""
    start = system.slope(start=True)
    if start is None or not start < 0.0:
        return False
    share = _share(system, start)
    if share is None:
        return False
    system.take(share)
    system.evaluate(tangent)
    return True


def _share(system: Searched, start: float) -> float | None:
    """Where |slope| is at most _LEFT of that at the start, by regula falsi; None: all of the correction."""
    end = system.slope()
    assert end is not None
    if abs(end) <= -_LEFT * start or -math.inf < end <= 0.0:
        return None
    low, of_low, high, of_high = 0.0, start, 1.0, end
    share = 1.0
    for _ in range(_MOST):
        where = 0.5 if not math.isfinite(of_high) else of_low / (of_low - of_high)
        share = low + (high - low) * min(max(where, _INSIDE), 1.0 - _INSIDE)
        system.take(share)
        slope = _slope(system)
        if abs(slope) <= -_LEFT * start:
            return share
        if slope <= 0.0:
            low, of_low = share, slope
        else:  # or not finite
            high, of_high = share, slope
    return share if math.isfinite(of_high) else low or None


def _slope(system: Searched) -> float:
    try:
        system.evaluate(False)
    except LocalFailure:
        return math.nan
    found = system.slope()
    assert found is not None
    return found
