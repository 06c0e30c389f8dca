"""Checks of what a script says about a figure. They start matplotlib on rank 0 alone, which draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools import checks
from ..tools.parallel import errors_on_all_ranks


class Options:
    """Options of a figure of a body, checked. Collective.

    Args:
        dim: dimensions of the body.
        values, count: numbers to show, of which so many are needed on this rank.
        flags: what is to be drawn, by name.

    Attributes:
        values: (count,), or None.
        limits: of the colours, or None.
        factor, unit: of lengths.
        view: elevation and azimuth (degrees).
    """

    def __init__(
        self,
        comm: MPI.Comm,
        dim: int,
        values: Any,
        count: int,
        *,
        ax: Any,
        label: Any,
        limits: Any,
        cmap: Any,
        length: Any,
        view: Any,
        **flags: Any,
    ):
        with errors_on_all_ranks(comm):
            self.values = None if values is None else _values(values, count)
            if label is not None and not isinstance(label, str):
                raise checks.refuse("label", label, "a text, or None, is needed")
            self.limits = None if limits is None else _pair("limits", limits, "the lowest and highest value")
            if self.limits is not None and self.limits[0] > self.limits[1]:
                raise checks.refuse("limits", limits, "the lower one comes first")
            factor, self.unit = checks.sequence("length", length, 2, 'things, such as (1e3, "mm"),')
            self.factor = checks.number("length", factor, above=0.0)
            if not isinstance(self.unit, str):
                raise checks.refuse(
                    "length", length, 'a factor and the name of a unit, (1e3, "mm"), are needed'
                )
            self.view = _pair("view", view, "elevation and azimuth (degrees)")
            for name, value in flags.items():
                checks.flag(name, value)
            if comm.rank == 0:
                _check_colours(cmap)
                check_axes(ax, dim == 3)


def _values(values: Any, count: int) -> np.ndarray:
    found = checks.numeric("values", values)
    if found.shape != (count,):
        raise InputError(f"values: have the shape {found.shape}, {count} numbers are needed")
    return found


def _pair(name: str, value: Any, what: str) -> tuple[float, float]:
    a, b = checks.vector(name, value, 2, what)
    return float(a), float(b)


def _check_colours(cmap: Any) -> None:
    import matplotlib
    from matplotlib.colors import Colormap

    known = isinstance(cmap, Colormap) or (isinstance(cmap, str) and cmap in matplotlib.colormaps)
    if not known:
        allowed = "the name of a colour map of matplotlib, such as 'viridis', or a Colormap is needed"
        raise checks.refuse("cmap", cmap, allowed)


def check_axes(ax: Any, solid: bool) -> None:
    """Raise InputError unless these are axes of matplotlib, three-dimensional for solid bodies; or None."""
    from matplotlib.axes import Axes

    if ax is None:
        return
    checks.instance("ax", ax, Axes, "axes of matplotlib, or None, are")
    if solid != hasattr(ax, "get_zlim"):
        allowed = 'with projection "3d"' if solid else "without a third dimension"
        raise InputError(f"ax: axes {allowed} are needed")


def check_curves(name: str, curves: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Abscissae and ordinates (n,) by label.

    Raises:
        InputError: something else.
    """
    if not isinstance(curves, Mapping):
        raise checks.refuse(name, curves, 'pairs of arrays by label are needed, {"label": (x, y)}')
    found = {}
    for label, pair in curves.items():
        checks.text(f"{name}: a label", label, "a text is needed")
        x, y = (
            checks.numeric(f"{name}: {label}", part)
            for part in checks.sequence(f"{name}: {label}", pair, 2, "arrays, displacements and loads,")
        )
        if x.ndim > 1 or x.shape != y.shape:
            raise InputError(
                f"{name}: {label}: displacements of shape {x.shape} and loads of shape {y.shape}; as many of "
                "both are needed"
            )
        found[label] = np.atleast_1d(x), np.atleast_1d(y)
    return found


def check_panels(rows: Any, columns: Any, figsize: Any, solid: Any) -> tuple[int, int, Sequence[int]]:
    """Numbers of rows and columns of axes, and which of them are three-dimensional.

    Raises:
        InputError: something else.
    """
    rows, columns = checks.whole("rows", rows, least=1), checks.whole("columns", columns, least=1)
    if figsize is not None and min(_pair("figsize", figsize, "width and height (inches)")) <= 0:
        raise checks.refuse("figsize", figsize, "positive lengths (inches) are needed")
    if isinstance(solid, str) or not isinstance(solid, Sequence | np.ndarray | range):
        raise checks.refuse("solid", solid, "numbers of axes, such as [0], are needed")
    return rows, columns, [checks.whole("solid", k, least=0, most=rows * columns - 1) for k in solid]
