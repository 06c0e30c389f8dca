"""Conditions that are taken away again: at once, or by a load that fades."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..assembly.system import NodalSystem
from ..assembly.transfer import point_values
from ..conditions.amplitudes import Fade
from ..conditions.loads import HandedOver
from ..conditions.supports import Support
from ..errors import InputError
from ..kinematics import rotations
from .reactions import Equilibrium


def fading(factor: float, over: float | None, until: float | None) -> Fade | None:
    """How a condition that is released at a load factor fades; None: it is gone at once.

    Raises:
        InputError: both are given, or no time at all.
    """
    if over is not None and until is not None:
        raise InputError(f"release: over = {over!r} and until = {until!r}: one of them")
    for name, value in (("over", over), ("until", until)):
        if value is not None and (isinstance(value, bool) or not math.isfinite(value)):
            raise InputError(f"release: {name} = {value!r}: a finite load factor")
    if over is None and until is None:
        return None
    end = factor + over if over is not None else float(until or 0.0)
    if end == factor:
        raise InputError(f"release: nothing can fade between the load factors {factor:g} and {end:g}")
    return Fade(factor, end)


def hand_over(
    support: Support,
    still: tuple[Support, ...],
    equilibrium: Equilibrium,
    system: NodalSystem | None,
    fade: Fade,
) -> list[HandedOver]:
    """Dead forces and couples on the points that do what a support did in the last step. Collective.

    Raises:
        InputError: the support, or the state of the nodes, isn't that of the last step any more.
    """
    if system is None or system.nodes is not equilibrium.nodes:
        raise InputError(
            f"release: {support.name}: the grid has been reset since the last converged step; release it at "
            "once, without over and until, or after another step"
        )
    d, r = system.layout.dim, system.layout.rotations
    values = point_values(system, equilibrium.free_residual(support, still))
    if r == 3:  # a dead couple m at a point does the work J_r(Dw) m
        w = system.at_points(np.pad(equilibrium.w, ((0, 0), (d, 0))))[:, d:]
        values[:, d:] = np.linalg.solve(rotations.right_tangent(w), values[:, d:, None])[:, :, 0]
    out = []
    for couple, part in ((False, values[:, :d]), (True, values[:, d:])):
        if system.comm.allreduce(float(np.abs(part).max(initial=0.0))) > 0.0:
            name = f"{support.name}, released"
            out.append(HandedOver(name, couple, fade, np.ascontiguousarray(part)))
    return out


def described(condition: Any) -> str:
    """A condition's name, for messages."""
    return str(getattr(condition, "name", repr(condition)))
