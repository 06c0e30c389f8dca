"""Figures of material points and of load-displacement curves, on matplotlib.

Points are gathered on rank 0, where the axes are returned; other ranks get None. No display is needed.
matplotlib takes a second to start and is imported with the first figure.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from .errors import InputError
from .io.files import check_output
from .io.paraview import box_corners
from .parallel import collectively
from .points import Points

_GREY = "#9a9a9a"
_PALE = "#ececec"
_PLAIN = "#4c78a8"
# of the rendering in three dimensions
_LIGHT = np.array([0.35, -0.65, 0.68])
_MOST_FACES = 60_000
# corners of a box's faces, the first axis running fastest; lower and upper face of each axis
_FACES = {
    2: [[0, 2], [1, 3], [0, 1], [2, 3]],
    3: [[0, 2, 6, 4], [1, 3, 7, 5], [0, 1, 5, 4], [2, 3, 7, 6], [0, 1, 3, 2], [4, 5, 7, 6]],
}


def gather(comm: MPI.Comm, values: np.ndarray) -> np.ndarray | None:
    """Rows of all ranks, on rank 0; None elsewhere. Collective."""
    parts = comm.gather(values)
    return None if parts is None else np.concatenate(parts)


def subplots(
    rows: int = 1,
    columns: int = 1,
    *,
    figsize: tuple[float, float] | None = None,
    solid: Sequence[int] = (),
    **options: Any,
) -> tuple[Any, Any]:
    """A figure and its axes, as of `pyplot.subplots`, on every rank; no display is needed.

    Args:
        figsize: width and height (inches).
        solid: axes, counted row by row from 0, that are three-dimensional.
        **options: of `Figure.subplots`, without `solid`.
    """
    from matplotlib.figure import Figure  # not pyplot: no display, no global state

    figure = Figure(figsize or (6.0 * columns, 4.2 * rows), constrained_layout=True)
    if not solid:
        return figure, figure.subplots(rows, columns, **options)
    kind = {True: "3d", False: None}
    axes = [
        figure.add_subplot(rows, columns, k + 1, projection=kind[k in solid]) for k in range(rows * columns)
    ]
    return figure, np.array(axes, dtype=object).reshape((rows, columns) if min(rows, columns) > 1 else -1)


def plot_points(
    points: Points,
    values: np.ndarray | None = None,
    ax: Any = None,
    *,
    label: str = "",
    limits: tuple[float, float] | None = None,
    cmap: str = "viridis",
    undeformed: bool = True,
    domains: bool = False,
    length: tuple[float, str] = (1.0, "m"),
    view: tuple[float, float] = (22.0, -60.0),
) -> Any:
    """Draw points as patches coloured by a value, over the undeformed body in grey. Collective.

    In three dimensions the body's outer faces are drawn; beyond 60 000 of them, the points' centres.

    Args:
        values: of the local points (np,); None colours all alike.
        ax: axes to draw into (of rank 0; with projection "3d" in three dimensions); None makes a figure.
        label: of the colour bar, with unit: "displacement (m)".
        limits: of the colours; default: the values' range.
        domains: draw the weighting functions' domains, boxes along the axes, instead of the initial boxes
            as F deforms them.
        length: factor from metres to the axes' unit, and the unit: (1e3, "mm").
        view: elevation and azimuth of the camera (degrees), in three dimensions.

    Returns:
        The matplotlib axes on rank 0 (`ax.figure` is the figure), None elsewhere.

    Raises:
        InputError: not one value for each local point; on every rank alike.
    """
    error = None
    if values is not None and np.shape(values) != (len(points),):
        error = InputError(f"values: have the shape {np.shape(values)}, {len(points)} numbers are needed")
    collectively(points.comm, error)
    now = _boxes(points.x, points.F, points.half_length if domains else points.half_length0, domains)
    X, half, corners = (gather(points.comm, length[0] * a) for a in (points.X, points.half_length0, now))
    colour = None if values is None else gather(points.comm, np.asarray(values, float))
    if X is None or half is None or corners is None:
        return None
    body = _Body(X, half, corners, colour)
    if points.dim == 2:
        ax = ax or _figure(body.span)
        mappable = _draw_flat(ax, body, undeformed, cmap, limits)
    else:
        ax = ax or _figure(body.span, projection="3d")
        mappable = _draw_solid(ax, body, undeformed, cmap, limits, view)
        ax.set_zlabel(f"z ({length[1]})", labelpad=6)
    ax.set_xlabel(f"x ({length[1]})", labelpad=None if points.dim == 2 else 8)
    ax.set_ylabel(f"y ({length[1]})")
    if mappable is not None:
        _colour_bar(ax, mappable, label, points.dim)
    return ax


def load_displacement(
    curves: Mapping[str, tuple[Any, Any]],
    ax: Any = None,
    *,
    reference: Mapping[str, tuple[Any, Any]] | None = None,
    xlabel: str = "displacement (m)",
    ylabel: str = "load factor (-)",
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> Any:
    """Lines of load over displacement.

    Args:
        curves: displacements and loads (n,) by label; a label that starts with "_" stays out of the legend.
        ax: axes to draw into; None makes a figure.
        reference: other sources' curves, drawn as black marks.
        xlabel, ylabel: with units.

    Returns:
        The matplotlib axes on rank 0, None elsewhere.
    """
    if comm.rank:
        return None
    ax = ax or _figure(None)
    marks = "osD^v<>"
    for k, (name, (x, y)) in enumerate(curves.items()):
        ax.plot(x, y, "-", marker=marks[k % len(marks)], markersize=4, linewidth=1.5, label=name)
    for k, (name, (x, y)) in enumerate((reference or {}).items()):
        # the marks go around once more, so that they differ from those of the lines
        style = {"marker": "x+*1234"[k % 7], "markersize": 7, "markeredgewidth": 1.4}
        ax.plot(x, y, color="black", linestyle="none", label=name, zorder=3, **style)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    ax.grid(color="0.88", linewidth=0.8)
    ax.set_axisbelow(True)
    if ax.get_legend_handles_labels()[1]:
        ax.legend(frameon=False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return ax


def save(
    figure: Any, path: str | os.PathLike[str], *, dpi: float = 160, comm: MPI.Comm = MPI.COMM_WORLD
) -> None:
    """Write a figure (or the figure of axes) of rank 0 to a .png, .pdf or .svg file. Collective.

    Raises:
        InputError: the file can't be written, or its kind is unknown; on every rank alike.
    """
    file = check_output(comm, path)
    error: Exception | None = None
    if comm.rank == 0:
        try:
            whole = figure.figure
            # axes in three dimensions forget the label of z when they tell their size
            extra = [ax.zaxis.label for ax in whole.axes if hasattr(ax, "zaxis")]
            extra += whole.get_default_bbox_extra_artists()
            whole.savefig(file, dpi=dpi, bbox_inches="tight", pad_inches=0.15, bbox_extra_artists=extra)
        except (OSError, ValueError) as e:
            error = InputError(f"path = {str(file)!r} can't be written: {e}")
    collectively(comm, error)


# geometry -----------------------------------------------------------------------------------------
def _boxes(x: np.ndarray, F: np.ndarray, half_length: np.ndarray, straight: bool) -> np.ndarray:
    """Corners (np, 2^d, d) of the points' boxes, deformed by F unless they are straight."""
    edges = box_corners(np.zeros_like(x), half_length)
    if not straight:
        d = x.shape[1]
        edges = np.einsum("pij,pkj->pki", F[:, :d, :d], edges)
    return x[:, None] + edges


class _Body:
    """All points' boxes: undeformed centres and half-lengths, current corners, values."""

    def __init__(self, X: np.ndarray, half: np.ndarray, corners: np.ndarray, values: np.ndarray | None):
        self.X, self.half, self.corners, self.values = X, half, corners, values
        self.initial = box_corners(X, half)
        self.dim = X.shape[1]

    @property
    def span(self) -> np.ndarray:
        """Size of the space that both states take."""
        both = np.concatenate([self.initial, self.corners]).reshape(-1, self.dim)
        return np.ptp(both, axis=0)

    def outer_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Point and number of the faces that no other undeformed box has.

        On a uniform lattice that is the body's surface; boxes of other layouts overlap and keep all faces.
        """
        faces = _FACES[self.dim]
        centre = np.stack([self.initial[:, f].mean(axis=1) for f in faces], axis=1).reshape(-1, self.dim)
        # on a uniform lattice these are whole numbers up to rounding
        key = np.rint((centre - self.X[0]) / self.half.min(axis=0)).astype(np.int64)
        _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        alone = np.flatnonzero(count[inverse.ravel()] == 1)
        return alone // len(faces), alone % len(faces)


# drawing ------------------------------------------------------------------------------------------
def _figure(span: np.ndarray | None, **options: Any) -> Any:
    """Axes of a new figure, whose size suits the body's."""
    from matplotlib.figure import Figure

    size = (6.0, 4.2)
    if span is not None and len(span) == 3:
        size = (7.2, 6.0)
    elif span is not None:
        size = (7.2, float(np.clip(6.0 * span[1] / span[0] + 1.4, 2.4, 8.0)))
    return Figure(size, constrained_layout=True).add_subplot(**options)


def _colours(body: _Body, cmap: str, limits: tuple[float, float] | None) -> Any:
    """Values to colours; None without values."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if body.values is None:
        return None
    finite = body.values[np.isfinite(body.values)]
    low, high = limits or ((finite.min(), finite.max()) if len(finite) else (0.0, 1.0))
    if low == high:  # the colour bar needs a range
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    out = ScalarMappable(Normalize(low, high), cmap)
    out.set_array(body.values)
    return out


def _draw_flat(ax: Any, body: _Body, undeformed: bool, cmap: str, limits: Any) -> Any:
    from matplotlib.collections import PolyCollection

    ring = [0, 1, 3, 2]
    if undeformed:
        # thick edges below, the filling above: only the outline of all boxes together shows
        boxes = body.initial[:, ring]
        ax.add_collection(PolyCollection(boxes, facecolor=_GREY, edgecolor=_GREY, linewidth=2.4, zorder=1))
        ax.add_collection(PolyCollection(boxes, facecolor=_PALE, edgecolor=_PALE, linewidth=0.8, zorder=1.1))
    mappable = _colours(body, cmap, limits)
    fill = _PLAIN if mappable is None else mappable.to_rgba(body.values)
    # edges of the fill's colour close the hairlines between neighbours
    patches = PolyCollection(body.corners[:, ring], facecolor=fill, edgecolor="face", linewidth=0.3, zorder=2)
    ax.add_collection(patches)
    ax.autoscale_view()
    ax.set_aspect("equal", adjustable="datalim" if _shared(ax) else "box")
    ax.margins(0.04)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return mappable


def _shared(ax: Any) -> bool:
    """Whether other axes share this one's limits; the box can't follow them all then."""
    return len(ax.get_shared_x_axes().get_siblings(ax)) > 1


def _draw_solid(
    ax: Any, body: _Body, undeformed: bool, cmap: str, limits: Any, view: tuple[float, float]
) -> Any:
    from matplotlib.colors import to_rgba
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    mappable = _colours(body, cmap, limits)
    point, face = body.outer_faces()
    if len(point) > _MOST_FACES:
        if undeformed:
            ax.scatter(*body.X.T, s=0.5, color=_GREY, alpha=0.1, linewidth=0)
        colour = _PLAIN if mappable is None else mappable.to_rgba(body.values)
        ax.scatter(*body.corners.mean(axis=1).T, s=1.0, c=colour, linewidth=0)
    else:
        corner = np.array(_FACES[3])[face]
        if undeformed:
            # only what faces the camera: two layers of a translucent grey would show as stripes
            seen = _camera(view)[face // 2] * (2 * (face % 2) - 1) > 0
            ghost = Poly3DCollection(
                body.initial[point[seen, None], corner[seen]],
                facecolor=to_rgba(_GREY, 0.25),
                edgecolor="none",
            )
            ghost.set_antialiased(False)  # no hairlines between neighbours
            ax.add_collection3d(ghost)
        polygons = body.corners[point[:, None], corner]
        plain = np.tile(to_rgba(_PLAIN), (len(body.X), 1))
        base = (plain if mappable is None else mappable.to_rgba(body.values))[point]
        base[:, :3] *= _brightness(polygons)[:, None]
        ax.add_collection3d(Poly3DCollection(polygons, facecolor=base, edgecolor=base, linewidth=0.2))
    _equal_box(ax, body, undeformed)
    ax.view_init(*view)
    return mappable


def _camera(view: tuple[float, float]) -> np.ndarray:
    elevation, azimuth = np.radians(view)
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _brightness(polygons: np.ndarray) -> np.ndarray:
    """Matt shading (0.65 to 1) of quadrilaterals (n, 4, 3), alike from both sides."""
    normal = np.cross(polygons[:, 2] - polygons[:, 0], polygons[:, 3] - polygons[:, 1])
    size = np.linalg.norm(normal, axis=1)
    cosine = np.abs(normal @ _LIGHT) / np.where(size > 0, size, 1.0)
    return 0.65 + 0.35 * np.minimum(cosine / np.linalg.norm(_LIGHT), 1.0)


def _equal_box(ax: Any, body: _Body, undeformed: bool) -> None:
    """One scale on all three axes, around everything drawn so far."""
    from matplotlib.ticker import MaxNLocator

    seen: list[np.ndarray] = [body.corners.reshape(-1, 3)] + (
        [body.initial.reshape(-1, 3)] if undeformed else []
    )
    if getattr(ax, "_polarmpm_drawn", False):
        seen.append(np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()]).T)
    ax._polarmpm_drawn = True
    low, high = (f(np.concatenate(seen), axis=0) for f in (np.min, np.max))
    span = np.maximum(high - low, 0.15 * np.max(high - low))  # a thin body still gets room for its ticks
    middle = 0.5 * (low + high)
    for axis, name in enumerate("xyz"):
        ends = middle[axis] - 0.52 * span[axis], middle[axis] + 0.52 * span[axis]
        getattr(ax, f"set_{name}lim")(*ends)
        ticks = max(1, round(6 * span[axis] / span.max()))
        getattr(ax, f"{name}axis").set_major_locator(MaxNLocator(ticks))
        pane = getattr(ax, f"{name}axis").pane
        pane.set_facecolor("white")
        pane.set_edgecolor("0.85")
    ax.set_box_aspect(span)
    ax.grid(False)


def _colour_bar(ax: Any, mappable: Any, label: str, dim: int) -> None:
    below = {"ax": ax, "label": label, "location": "bottom", "pad": 0.02}
    if dim == 3:
        bar = ax.figure.colorbar(mappable, shrink=0.6, aspect=35, **below)
    elif np.ptp(ax.get_xlim()) > 2.5 * np.ptp(ax.get_ylim()):
        bar = ax.figure.colorbar(mappable, aspect=45, **below)
    else:
        # inside of the axes' own frame, so that it is as high as they become with equal scales
        place = ax.inset_axes([1.03, 0.0, 0.03, 1.0])
        bar = ax.figure.colorbar(mappable, cax=place, label=label)
    bar.outline.set_visible(False)


__all__ = ["gather", "load_displacement", "plot_points", "save", "subplots"]
