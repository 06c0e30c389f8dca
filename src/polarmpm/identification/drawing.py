"""Figures of fits, in the style of `polarmpm.plot`; matplotlib is imported with the first one."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..plot.style import COLOURS, COLUMN, PAGE
from ..tools import checks
from .judging import quantile

_MOST_PANELS, _ACROSS = 12, 3
_GREY = "0.35"


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure((width, height), constrained_layout=True)


def _styled() -> Any:
    from matplotlib import rc_context

    from ..plot import STYLE

    return rc_context(STYLE)


def fit_against_data(fit: Any, names: Any = None) -> Any:
    """A panel for each observable, with the curves of its experiments; of fields the residuals over measured
    values. See `Fit.plot_data`."""
    if names is not None:
        known = list(dict.fromkeys(c.name for c in fit.compared))
        wanted = [names] if isinstance(names, str) else list(names)
        names = [checks.choice("names", n, known) for n in wanted]
    panels: dict[tuple[str, bool], list[Any]] = {}
    for c in fit.compared:
        if names is None or c.name in names:
            panels.setdefault((c.name, c.measured.ndim == 1), []).append(c)
    keys = list(panels)[:_MOST_PANELS]
    across = min(len(keys), _ACROSS)
    rows = -(-len(keys) // across)
    with _styled():
        figure = _figure(PAGE if across > 1 else COLUMN, 0.75 * COLUMN * rows)
        axes = np.atleast_1d(figure.subplots(rows, across, squeeze=False)).ravel()
        for ax, key in zip(axes, keys, strict=False):
            (_curves if key[1] else _field)(ax, key[0], panels[key])
        for ax in axes[len(keys) :]:
            ax.remove()
    return axes[: len(keys)]


def _curves(ax: Any, name: str, compared: list[Any]) -> None:
    many = len(compared) > len(COLOURS)
    for k, c in enumerate(compared):
        colour, order = COLOURS[k % len(COLOURS)], np.argsort(c.at, kind="stable")
        one_way = bool((np.diff(c.at) >= 0).all() or (np.diff(c.at) <= 0).all())
        rows = order if one_way else np.arange(len(c.at))
        marks = {"marker": "o", "markersize": 3, "elinewidth": 0.6, "capsize": 1.5, "ls": "none", "zorder": 2}
        label = None if many or len(compared) == 1 else c.label or f"experiment {c.experiment + 1}"
        ax.errorbar(c.at, c.measured, c.sigma, color=colour, alpha=0.8, **marks)
        ax.plot(c.at[rows], c.model[rows], "-", color=colour, label=label, marker="_", markersize=6, zorder=3)
    ax.set_xlabel("load factor, or abscissa")
    ax.set_ylabel(name)
    if any(ax.get_legend_handles_labels()[1]):
        ax.legend()


def _field(ax: Any, name: str, compared: list[Any]) -> None:
    """Residuals of all values of fields over the measured ones."""
    for k, c in enumerate(compared):
        there = np.isfinite(c.measured)
        ax.plot(c.measured[there], c.residuals[there], ".", color=COLOURS[k % len(COLOURS)], markersize=2.5)
    for level in (-2, 0, 2):
        ax.axhline(level, ls="-" if level == 0 else "--", color=_GREY, lw=0.6, zorder=0)
    ax.set_xlabel(f"{name}, measured")
    ax.set_ylabel("(computed − measured) / σ (-)")


def correlations(fit: Any, ax: Any = None) -> Any:
    """Correlations of the parameters as a coloured table. See `Fit.plot_correlation`."""
    names, c = fit.names, fit.correlation
    with _styled():
        if ax is None:
            size = max(0.55 * COLUMN, 0.32 * len(names) + 1.2)
            ax = _figure(size + 0.5, size).subplots()
        image = ax.imshow(c, vmin=-1, vmax=1, cmap="RdBu_r")
        ax.set_xticks(range(len(names)), names, rotation=45, ha="right")
        ax.set_yticks(range(len(names)), names)
        for i in range(len(names)):
            for j in range(len(names)):
                colour = "white" if abs(c[i, j]) > 0.6 else "black"
                ax.text(j, i, f"{c[i, j]:.2f}", ha="center", va="center", color=colour, fontsize=5.5)
        ax.spines[:].set_visible(False)
        ax.tick_params(length=0)
        ax.figure.colorbar(image, ax=ax, label="correlation (-)", shrink=0.8)
    return ax


def profile_curve(profile: Any, ax: Any = None) -> Any:
    """The rise of the misfit over the held parameter. See `Profile.plot`."""
    with _styled():
        if ax is None:
            ax = _figure(COLUMN, 0.7 * COLUMN).subplots()
        ax.plot(profile.values, profile.rise, "o-", color=COLOURS[0])
        for level in (0.683, 0.954):
            ax.axhline(quantile(level) ** 2, color=_GREY, lw=0.6, ls="--")
            at = 1.0, quantile(level) ** 2
            ax.annotate(f"{100 * level:.0f} %", at, xycoords=("axes fraction", "data"), fontsize=6)
        ax.set_xlabel(profile.name)
        ax.set_ylabel(r"rise of $\chi^2$ (-)")
        ax.set_ylim(bottom=0)
    return ax
