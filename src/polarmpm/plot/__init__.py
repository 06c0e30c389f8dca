"""Figures of points, meshes, grids and load-displacement curves."""

from typing import Any

from .figures import gather, legend_below, load_displacement, plot_mesh, plot_points, save, subplots
from .gridlines import plot_grid
from .movies import Movie, movie
from .style import COLOURS, COLUMN, PAGE, fitted, styled
from .viewing import View, view

__all__ = [
    "COLOURS",
    "COLUMN",
    "PAGE",
    "STYLE",
    "Movie",
    "View",
    "fitted",
    "gather",
    "legend_below",
    "load_displacement",
    "movie",
    "plot_grid",
    "plot_mesh",
    "plot_points",
    "save",
    "styled",
    "subplots",
    "view",
]


def __getattr__(name: str) -> Any:
    """STYLE needs a part of matplotlib, and is made when it's asked for."""
    if name == "STYLE":
        from . import style

        return style.STYLE
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
