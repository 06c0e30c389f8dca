"""Polygons, colours and axes of figures; what is drawn is up to `plot.figures`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..tools import checks
from .style import COLUMN

GREY = "#9a9a9a"
PALE = "#ececec"
PLAIN = "#56b4e9"
_MANY = 3000  # polygons
# of the rendering in three dimensions
_LIGHT = np.array([0.35, -0.65, 0.68])


def new_axes(span: np.ndarray | None, **options: Any) -> Any:
    """Axes of a new figure, whose size suits the body's."""
    from matplotlib.figure import Figure

    size = (COLUMN, 0.72 * COLUMN)
    if span is not None and len(span) == 3:
        size = (1.4 * COLUMN, 1.2 * COLUMN)
    elif span is not None:
        width = COLUMN if span[1] > 0.5 * span[0] else 1.4 * COLUMN
        size = (width, float(np.clip(0.85 * width * span[1] / span[0] + 0.8, 0.4 * width, 1.3 * width)))
    return Figure(size, constrained_layout=True).add_subplot(**options)


def name_axes(ax: Any, dim: int, unit: str) -> None:
    if dim == 3:
        ax.zaxis.set_rotate_label(False)  # or it stands on its head, seen from some sides
        ax.set_zlabel(f"z ({unit})", labelpad=6, rotation=90)
    ax.set_xlabel(f"x ({unit})", labelpad=None if dim == 2 else 12)
    ax.set_ylabel(f"y ({unit})")


# colours ------------------------------------------------------------------------------------------
def colours(values: np.ndarray | None, cmap: str, limits: tuple[float, float] | None) -> Any:
    """Values to colours; None without values."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if values is None:
        return None
    finite = values[np.isfinite(values)]
    low, high = limits or ((finite.min(), finite.max()) if len(finite) else (0.0, 1.0))
    if low == high:  # the colour bar needs a range
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    out = ScalarMappable(Normalize(low, high), cmap)
    out.set_array(values)
    return out


def rgba(mappable: Any, values: np.ndarray | None, count: int) -> np.ndarray:
    """Colours (count, 4) of values, or all alike."""
    from matplotlib.colors import to_rgba

    return np.tile(to_rgba(PLAIN), (count, 1)) if mappable is None else mappable.to_rgba(values)


def colour_bar(ax: Any, mappable: Any, label: str, dim: int) -> None:
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    below = {"ax": ax, "label": label, "location": "bottom", "pad": 0.02}
    if dim == 3:
        bar = ax.figure.colorbar(mappable, shrink=0.6, aspect=35, **below | {"pad": 0.06})
    elif np.ptp(ax.get_xlim()) > 2.5 * np.ptp(ax.get_ylim()):
        bar = ax.figure.colorbar(mappable, aspect=45, **below)
    else:
        # inside of the axes' own frame, so that it is as high as they become with equal scales
        wide = 0.03 * max(1.0, np.ptp(ax.get_ylim()) / np.ptp(ax.get_xlim()))
        place = ax.inset_axes([1.0 + wide, 0.0, wide, 1.0])
        bar = ax.figure.colorbar(mappable, cax=place, label=label)
    bar.outline.set_visible(False)
    along = bar.ax.xaxis if bar.orientation == "horizontal" else bar.ax.yaxis
    along.set_major_locator(MaxNLocator(4 if bar.orientation == "horizontal" else 6))
    numbers = ScalarFormatter(useMathText=True)
    numbers.set_powerlimits((-3, 4))  # 12 x 10^4 rather than 120000, which would run into its neighbour
    along.set_major_formatter(numbers)


# in the plane -------------------------------------------------------------------------------------
def flat_undeformed(ax: Any, polygons: np.ndarray) -> None:
    """The undeformed body in grey, of polygons (n, k, 2) that go round."""
    from matplotlib.collections import PolyCollection

    # thick edges below, the filling above: only the outline of all polygons together shows
    ax.add_collection(PolyCollection(polygons, facecolor=GREY, edgecolor=GREY, linewidth=2.4, zorder=1))
    ax.add_collection(PolyCollection(polygons, facecolor=PALE, edgecolor=PALE, linewidth=0.8, zorder=1.1))


def flat_patches(ax: Any, polygons: np.ndarray, colour: Any) -> None:
    from matplotlib.collections import PolyCollection

    # edges of the fill's colour close the hairlines between neighbours
    patches = PolyCollection(polygons, facecolor=colour, edgecolor="face", linewidth=0.5, zorder=2)
    patches.set_rasterized(len(polygons) > _MANY)  # an image in a .pdf, which would be large
    ax.add_collection(patches)


def flat_edges(ax: Any, polygons: np.ndarray) -> None:
    from matplotlib.collections import PolyCollection

    lines = PolyCollection(polygons, facecolor="none", edgecolor="black", linewidth=0.3, alpha=0.6, zorder=3)
    ax.add_collection(lines)


def finish_curves(ax: Any, fontsize: float | None = None) -> None:
    """Grid, a legend of what has a label, and no frame."""
    ax.grid(color="0.88", linewidth=0.6)
    ax.set_axisbelow(True)
    if ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False, fontsize=fontsize)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def legend_below(figure: Any, axes: Iterable[Any] | None = None, columns: int = 0) -> Any:
    """One legend for several panels, below all of them, where it hides no line; those of the panels go.

    Nothing is drawn on ranks without axes.

    Args:
        axes: the panels; None: all of the figure's.
        columns: of the legend; 0: all labels side by side, at most four.

    Returns:
        The legend, or None where nothing has a label.

    Raises:
        InputError: not a figure of matplotlib, a number of columns below 0.
    """
    columns = checks.whole("columns", columns, least=0)
    if not hasattr(figure, "legend") or not hasattr(figure, "axes"):
        raise checks.refuse("figure", figure, "a figure of matplotlib is needed")
    found: dict[str, Any] = {}
    for ax in figure.axes if axes is None else axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
        if ax.get_legend():
            ax.get_legend().remove()
    if not found:
        return None
    # outside of the figure: `save` makes room for it
    where = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "frameon": False}
    return figure.legend(list(found.values()), list(found), ncol=columns or min(4, len(found)), **where)


def finish_flat(ax: Any) -> None:
    """One scale on both axes."""
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim" if _shared(ax) else "box")
    ax.margins(0.04)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _shared(ax: Any) -> bool:
    """Whether other axes share this one's limits; the box can't follow them all then."""
    return len(ax.get_shared_x_axes().get_siblings(ax)) > 1


# in space -----------------------------------------------------------------------------------------
def solid_undeformed(ax: Any, polygons: np.ndarray, outward: np.ndarray, view: tuple[float, float]) -> None:
    """The undeformed body in grey, of faces (n, k, 3) with outward normals (n, 3)."""
    from matplotlib.colors import to_rgba
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    # only what faces the camera: two layers of a translucent grey would show as stripes
    seen = outward @ _camera(view) > 0
    body = Poly3DCollection(polygons[seen], facecolor=to_rgba(GREY, 0.25), edgecolor="none", zorder=1)
    ax.computed_zorder = False  # it would stand in front of the body, which it isn't sorted with
    body.set_antialiased(False)  # no hairlines between neighbours
    body.set_rasterized(len(polygons) > _MANY)
    ax.add_collection3d(body)


def solid_faces(ax: Any, polygons: np.ndarray, colour: np.ndarray, edges: bool = False) -> None:
    """Faces (n, k, 3) with colours (n, 4), shaded."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    colour = colour.copy()
    colour[:, :3] *= _brightness(polygons)[:, None]
    line = colour * [0.5, 0.5, 0.5, 1.0] if edges else colour
    body = Poly3DCollection(polygons, facecolor=colour, edgecolor=line, linewidth=0.2, zorder=2)
    body.set_rasterized(len(polygons) > _MANY)
    ax.add_collection3d(body)


def _camera(view: tuple[float, float]) -> np.ndarray:
    elevation, azimuth = np.radians(view)
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _brightness(polygons: np.ndarray) -> np.ndarray:
    """Matt shading (0.65 to 1) of polygons (n, k, 3), alike from both sides."""
    # twice the area vector, of warped polygons too
    normal = np.cross(polygons, np.roll(polygons, -1, axis=1)).sum(axis=1)
    size = np.linalg.norm(normal, axis=1)
    cosine = np.abs(normal @ _LIGHT) / np.where(size > 0, size, 1.0)
    light: np.ndarray = 0.65 + 0.35 * np.minimum(cosine / np.linalg.norm(_LIGHT), 1.0)
    return light


def finish_solid(ax: Any, drawn: Sequence[np.ndarray], view: tuple[float, float]) -> None:
    """One scale on all three axes, around positions (n, 3) and everything drawn so far."""
    from matplotlib.ticker import MaxNLocator

    seen = list(drawn)
    if getattr(ax, "_polarmpm_drawn", False):
        seen.append(np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T)
    ax._polarmpm_drawn = True
    low, high = (f(np.concatenate(seen), axis=0) for f in (np.min, np.max))
    span = np.maximum(high - low, 0.15 * np.max(high - low))  # a thin body still gets room for its ticks
    middle = 0.5 * (low + high)
    width = ax.figure.get_figwidth() * ax.get_position(original=True).width
    most = min(6.0, max(3.0, 1.4 * width))  # of the ticks, which have to be told apart
    for axis, name in enumerate("xyz"):
        ends = middle[axis] - 0.52 * span[axis], middle[axis] + 0.52 * span[axis]
        getattr(ax, f"set_{name}lim")(*ends)
        ticks = round(most * span[axis] / span.max())
        getattr(ax, f"{name}axis").set_major_locator(MaxNLocator(ticks) if ticks > 2 else _one_tick(*ends))
        pane = getattr(ax, f"{name}axis").pane
        pane.set_facecolor("white")
        pane.set_edgecolor("0.85")
    ax.set_box_aspect(span, zoom=0.85)  # labels stay clear of what is beside the axes
    ax.grid(False)
    ax.view_init(*view)


def set_ends(ax: Any, ends: Sequence[np.ndarray], view: tuple[float, float]) -> None:
    """Axes around the lowest and highest coordinates, whatever is drawn."""
    low, high = ends
    if len(low) == 3:
        ax._polarmpm_drawn = False
        finish_solid(ax, [np.array(ends)], view)
        return
    margin = 0.04 * np.max(high - low)
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)


def _one_tick(low: float, high: float) -> Any:
    """A tick near the middle: more of them would run into each other along a thin side."""
    from matplotlib.ticker import FixedLocator, MaxNLocator

    places = MaxNLocator(2, steps=[1, 2, 5, 10]).tick_values(low, high)
    return FixedLocator([places[np.argmin(abs(places - 0.5 * (low + high)))]])
