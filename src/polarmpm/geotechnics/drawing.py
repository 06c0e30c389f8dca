"""The figure of a strength reduction."""

from __future__ import annotations

from typing import Any

from ..errors import InputError
from ..plot import drawing
from ..plot.options import check_axes
from ..plot.style import COLOURS
from ..tools import checks


def draw_trials(found: Any, ax: Any, length: tuple[float, str]) -> Any:
    """See `StrengthReduction.plot`, of which `found` is one."""
    factor, unit = checks.sequence("length", length, 2, 'things, such as (1e3, "mm"),')
    scale = checks.number("length", factor, above=0.0)
    if not isinstance(unit, str):
        raise InputError(f"length = {checks.shown(length)}: the name of a unit is needed")
    if found.standing.comm.rank:
        return None
    check_axes(ax, solid=False)
    ax = ax or drawing.new_axes(None)
    top, red = 2.0 * found.limit * scale, COLOURS[1]
    trials = sorted(found.trials, key=lambda trial: trial.factor)
    stand = [(t.factor, t.displacement * scale) for t in trials if t.stands]
    lost = [(t.factor, min(t.displacement * scale, top)) for t in trials if not t.converged]
    far = [
        (t.factor, min(t.displacement * scale, 0.98 * top)) for t in trials if t.converged and not t.stands
    ]
    ax.axvspan(*found.factor, color="0.85", lw=0, label="bracket", zorder=0)
    ax.axhline(found.limit * scale, color="0.35", lw=1.0, ls="--", label="counts as failure")
    ax.plot(*zip(*stand, strict=True), "-o", ms=4, lw=1.5, color=COLOURS[0], label="stands")
    for fails, mark, label in ((far, "^", "fails, moves on"), (lost, "x", "fails, no equilibrium")):
        if fails:
            ax.plot(*zip(*fails, strict=True), mark, ms=6, mew=1.5, color=red, label=label)
    ax.set_ylim(0.0, top)
    ax.set_xlabel("strength divided by (-)")
    ax.set_ylabel(f"largest displacement ({unit})")
    drawing.finish_curves(ax)
    return ax
