"""Figures of studies: errors over cell size and over CPU time, and where the time went."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..plot import figures as plot
from ..plot.options import check_axes
from ..plot.style import COLUMN, PAGE
from ..tools import checks
from .discretisations import PHASES, Row
from .tables import check_name, check_rows, digits, error_names, methods

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f", "#000000")
_MARKERS = "osD^vP<>"
_PHASE_COLOURS = ("#0072B2", "#D55E00", "#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#999999", "#DDDDDD")
_AXES = {"h": "cell size (m)", "cpu_s": "CPU time of the load steps (s)"}


@plot.styled()
def errors(
    rows: Sequence[Row],
    name: str,
    ax: Any = None,
    *,
    over: str = "cpu_s",
    unit: str = "",
    published: Sequence[Row] = (),
    slopes: Sequence[int] = (),
    legend: bool = True,
) -> Any:
    """Draw an error, with logarithmic axes: one line for each method, failed discretisations left out.

    Args:
        name: of the error's reference.
        ax: matplotlib axes; None makes a figure.
        over: "cpu_s" or "h".
        unit: of the error.
        published: drawn as open markers; with the name of a method of `rows` in its colour.
        slopes: orders of convergence to be drawn as grey lines through the lower left.

    Raises:
        InputError: no row has an error of this name; unknown `over`.
    """
    if not isinstance(over, str) or over not in _AXES:
        raise checks.refuse("over", over, f"allowed are {', '.join(_AXES)}")
    check_name(rows, name)
    published = check_rows("published", published)
    if not isinstance(slopes, Sequence | np.ndarray) or isinstance(slopes, str):
        raise checks.refuse("slopes", slopes, "orders of convergence, such as (1, 2), are needed")
    slopes = [checks.whole("slopes", order) for order in slopes]
    check_axes(ax, solid=False)
    if ax is None:
        _, ax = plot.subplots()
    every = methods([*rows, *published])
    for method in every:
        k = every.index(method)
        # marks get smaller and lines thinner, so that one that is covered by a later one can still be seen
        style: dict[str, Any] = {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKERS[k % len(_MARKERS)]}
        style |= {"markersize": max(2.0, 6.0 - 0.8 * k), "linewidth": max(0.9, 1.7 - 0.2 * k)}
        line = _line(rows, method, name, over)
        if len(line):
            ax.loglog(*line.T, "-", label=method, **style)
        line = _line(published, method, name, over)
        if len(line):
            open_ = {"markerfacecolor": "none", "markeredgewidth": 0.9, "ls": ":", "linewidth": 0.8}
            ax.loglog(*line.T, **(style | open_), label=f"{method}, published")
    if slopes:
        _draw_slopes(ax, rows, name, slopes)
    _label_ticks(ax.xaxis, ax.get_xlim())
    _label_ticks(ax.yaxis, ax.get_ylim())
    ax.set_xlabel(_AXES[over])
    ax.set_ylabel(f"error, {name}" + (f" ({unit})" if unit else ""))
    ax.grid(True, which="major", color="0.88", linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    if legend:
        ax.legend(frameon=False)
    return ax


def _label_ticks(axis: Any, limits: tuple[float, float]) -> None:
    """Plain numbers at the decades; on short axes also between them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    decades = np.log10(limits[1] / limits[0])
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2.5 else (1.0,), numticks=30))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _number(value)))
    axis.set_minor_formatter(NullFormatter())


def _number(value: float) -> str:
    """As books write it: 0.001, but $2\\cdot 10^{-5}$."""
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    digit, power = f"{value:.0e}".split("e")
    return rf"${'' if digit == '1' else digit + chr(92) + 'cdot '}10^{{{int(power)}}}$"


def _line(rows: Sequence[Row], method: str, name: str, over: str) -> np.ndarray:
    """(h or CPU time, error) of a method's rows that have both, (n, 2)."""
    found = [(getattr(r, over), r.errors[name]) for r in rows if r.method == method and name in r.errors]
    return np.array([pair for pair in found if None not in pair], dtype=float).reshape(-1, 2)


def _draw_slopes(ax: Any, rows: Sequence[Row], name: str, slopes: Sequence[int]) -> None:
    h = np.array(sorted({r.h for r in rows if name in r.errors}))
    most = max(r.errors[name] for r in rows if name in r.errors)
    for order, style in zip(slopes, (":", "--", "-.", (0, (1, 4))), strict=False):
        ax.loglog(h, most * (h / h[-1]) ** order, color="0.55", ls=style, lw=1, label=f"order {order}")


@plot.styled()
def save_errors(
    rows: Sequence[Row],
    path: str | os.PathLike[str],
    *,
    over: str = "cpu_s",
    unit: str = "",
    published: Sequence[Row] = (),
    slopes: Sequence[int] = (),
) -> None:
    """Write a figure with one panel for each reference; see `errors`."""
    names = error_names(rows)
    columns = min(2, max(1, len(names)))
    lines = max(1, -(-len(names) // columns))
    figure, axes = plot.subplots(
        lines, columns, figsize=(PAGE if columns > 1 else COLUMN, 2.7 * lines + 0.3), squeeze=False
    )
    for ax, name in zip(axes.flat, names, strict=False):
        errors(rows, name, ax, over=over, unit=unit, published=published, slopes=slopes, legend=False)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    plot.legend_below(figure, columns=3)
    plot.save(figure, path, pdf=False)


@plot.styled()
def phases(rows: Sequence[Row], ax: Any = None) -> Any:
    """Draw the phases' shares in each discretisation's CPU time as stacked bars, the kernel's hatched."""
    rows = [r for r in check_rows("rows", rows) if r.phases and r.cpu_s]
    check_axes(ax, solid=False)
    if ax is None:
        _, ax = plot.subplots(figsize=(PAGE, 0.7 + 0.17 * len(rows)))
    total = np.array([r.cpu_s for r in rows], dtype=float)
    at, left = np.arange(len(rows)), np.zeros(len(rows))
    for phase, colour in zip(PHASES, _PHASE_COLOURS, strict=True):
        share = 100 * np.array([r.phases.get(phase, 0.0) for r in rows]) / total
        ax.barh(at, share, left=left, color=colour, label=phase, height=0.8)
        if phase == "assembly" and any(r.kernel_s for r in rows):
            kernel = 100 * np.array([r.kernel_s or 0.0 for r in rows]) / total
            ax.barh(at, kernel, color="none", edgecolor="white", hatch="////", lw=0, height=0.8)
            ax.barh(0, 0, color=colour, edgecolor="white", hatch="////", label="kernel, part of it")
        left += share
    ax.set_yticks(at, [f"{r.method}, {r.label}   {digits(r.cpu_s, 3)} s" for r in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0, 100)
    ax.set_xlabel("share of the CPU time (%)")
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return ax


def save_phases(rows: Sequence[Row], path: str | os.PathLike[str]) -> None:
    """Write the figure of `phases`."""
    plot.save(phases(rows).figure, path, pdf=False)
