"""A picture of a grid's lines, and of the indicator that they were made from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..tools import checks
from . import drawing
from .options import check_axes

_ROOM = 0.18  # of the grid's extent, for the curve of an indicator beside it


def plot_grid(
    grid: Grid,
    ax: Any = None,
    *,
    indicator: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
    axes: str = "xy",
    length: tuple[float, str] = (1.0, "m"),
) -> Any:
    """Draw the lines of a grid, in space those along two axes. Only rank 0 draws; nothing is exchanged.

    Args:
        ax: axes to draw into, of rank 0; None makes a figure.
        indicator: of a pilot run (`polarmpm.study.pilot.indicator`), drawn above and beside the grid.
        axes: the two axes to be seen, horizontal and vertical.
        length: factor from metres to the axes' unit, and the unit: (1e3, "mm").

    Returns:
        The matplotlib axes on rank 0, None elsewhere.

    Raises:
        InputError: no grid, or another argument that isn't so.
    """
    checks.instance("grid", grid, Grid, "a background grid, such as Grid.box makes it, is")
    names = "xyz"[: grid.dim]
    if not isinstance(axes, str) or len(axes) != 2 or len(set(axes)) != 2 or not set(axes) <= set(names):
        raise checks.refuse("axes", axes, f"two of {', '.join(names)}, such as 'xy'")
    factor, unit = checks.sequence("length", length, 2, 'things, such as (1e3, "mm"),')
    factor = checks.number("length", factor, above=0.0)
    curves = _curves(indicator, axes, factor)
    if grid.comm.rank:
        return None
    check_axes(ax, False)
    horizontal, vertical = (factor * grid.lines[names.index(name)] for name in axes)
    ax = ax or drawing.new_axes(np.array([np.ptp(horizontal), np.ptp(vertical)]))
    ax.vlines(horizontal, vertical[0], vertical[-1], color="0.35", linewidth=0.5)
    ax.hlines(vertical, horizontal[0], horizontal[-1], color="0.35", linewidth=0.5)
    for k, (at, value) in enumerate(curves):
        along = vertical if k == 0 else horizontal  # where the curve stands
        base = along[-1] + 0.03 * np.ptp(along)
        height = base + _ROOM * np.ptp(along) * value / (value.max() or 1.0)
        fill = ax.fill_between if k == 0 else ax.fill_betweenx
        fill(at, base, height, color="C0", alpha=0.35, linewidth=0)
    drawing.finish_flat(ax)
    ax.set_xlabel(f"{axes[0]} ({unit})")
    ax.set_ylabel(f"{axes[1]} ({unit})")
    return ax


def _curves(indicator: Any, axes: str, factor: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places in the axes' unit and values along the two axes; none without an indicator."""
    if indicator is None:
        return []
    if not isinstance(indicator, Mapping) or not set(axes) <= set(indicator):
        raise checks.refuse("indicator", indicator, "places and values by the names of axes are needed")
    found = []
    for name in axes:
        at, value = (checks.numeric(f"indicator {name}", a) for a in indicator[name])
        if at.ndim != 1 or at.shape != value.shape or not len(at):
            raise InputError(
                f"indicator {name}: places of shape {at.shape} and values of shape {value.shape}; as many of "
                "both are needed"
            )
        found.append((factor * at, value))
    return found
