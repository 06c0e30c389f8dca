"""One look for all figures, such as journals print them: `pyplot.style.use(plot.STYLE)`, or for a while
`with plot.styled():`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..tools import checks

# inches: one column and the whole page of the usual journals (90 and 190 mm)
COLUMN, PAGE = 3.54, 7.48

# Okabe and Ito's colours, which all people tell apart; without their yellow, pale on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def _style() -> dict[str, Any]:
    from cycler import cycler

    small = dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 7)
    plain = dict.fromkeys(("axes.labelsize", "axes.titlesize", "font.size"), 8)
    return {
        **small,
        **plain,
        "axes.prop_cycle": cycler(color=COLOURS),
        "axes.linewidth": 0.6,
        "axes.spines.right": False,
        "axes.spines.top": False,
        "axes.axisbelow": True,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "lines.linewidth": 1.1,
        "lines.markersize": 3.0,
        "legend.frameon": False,
        "figure.figsize": (COLUMN, 0.7 * COLUMN),
        "figure.constrained_layout.use": True,
        "figure.constrained_layout.w_pad": 0.07,
        "figure.dpi": 150,
        "savefig.dpi": 300,
        "image.cmap": "viridis",
        "pdf.fonttype": 42,  # text stays text
    }


def fitted(width: float, height: float) -> tuple[float, float]:
    """Width and height (inches) of a figure of these proportions, as wide as a column or, where it is wider
    than two, as the page: panels are planned in the size in which they're easily seen.

    Raises:
        InputError: not positive lengths.
    """
    width, height = checks.number("width", width, above=0.0), checks.number("height", height, above=0.0)
    wide = COLUMN if width <= 2 * COLUMN else PAGE
    return wide, height * wide / width


@contextmanager
def styled() -> Iterator[None]:
    """What is drawn within, or in a function that it decorates, is in `STYLE`; matplotlib's settings are put
    back at the end."""
    from matplotlib import rc_context

    with rc_context(_style()):
        yield


def __getattr__(name: str) -> Any:
    """STYLE, made when it's asked for: matplotlib's settings by name."""
    if name == "STYLE":
        return _style()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
