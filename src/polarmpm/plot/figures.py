"""Figures of material points, meshes and load-displacement curves, on matplotlib.

Bodies are gathered on rank 0, where the axes are returned; other ranks get None. No display is needed.
matplotlib takes a second to start and is imported with the first figure.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO
from typing import Any

from mpi4py import MPI

import numpy as np

from ..bodies.elements import Elements
from ..bodies.points import Points
from ..errors import InputError
from ..io.files import check_output, not_written, replace_file
from ..io.paraview import box_corners
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, raise_on_all_ranks
from . import drawing
from .drawing import legend_below
from .meshfaces import Faces, gather_faces
from .options import Options, check_axes, check_curves, check_panels
from .style import COLUMN, PAGE, fitted, styled

_MOST_FACES = 60_000
# corners of a box's faces, the first axis running fastest; lower and upper face of each axis
BOX_FACES = {
    2: [[0, 2], [1, 3], [0, 1], [2, 3]],
    3: [[0, 2, 6, 4], [1, 3, 7, 5], [0, 1, 5, 4], [2, 3, 7, 6], [0, 1, 3, 2], [4, 5, 7, 6]],
}


def gather(comm: MPI.Comm, values: np.ndarray) -> np.ndarray | None:
    """Rows of all ranks, on rank 0; None elsewhere. Collective."""
    checks.communicator("comm", comm)
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
    """A figure in `STYLE` and its axes, as of `pyplot.subplots`, on every rank; no display is needed.

    What is drawn into it later takes matplotlib's settings of that time: `with plot.styled():` makes them
    these.

    Args:
        figsize: width and height (inches); default: as wide as a journal's column, or its page.
        solid: axes, counted row by row from 0, that are three-dimensional.
        **options: of `Figure.subplots`; with `solid` the ratios of widths and heights only.
    """
    from matplotlib.figure import Figure  # not pyplot: no display, no global state

    rows, columns, solid = check_panels(rows, columns, figsize, solid)
    width = COLUMN if columns == 1 else PAGE
    with styled():
        figure = Figure(figsize or (width, 0.72 * width / columns * rows), constrained_layout=True)
        return figure, _axes(figure, rows, columns, solid, options)


def _axes(figure: Any, rows: int, columns: int, solid: Sequence[int], options: dict[str, Any]) -> Any:
    if not solid:
        return figure.subplots(rows, columns, **options)
    kind = {True: "3d", False: None}
    ratios = {name: options[name] for name in ("width_ratios", "height_ratios") if name in options}
    cells = figure.add_gridspec(rows, columns, **ratios, **options.get("gridspec_kw", {}))
    axes = [figure.add_subplot(cell, projection=kind[k in solid]) for k, cell in enumerate(cells)]
    return np.array(axes, dtype=object).reshape((rows, columns) if min(rows, columns) > 1 else -1)


@collective("plot_points", comm=lambda points, *args, **options: points.comm)
def plot_points(
    points: Points,
    values: np.ndarray | None = None,
    ax: Any = None,
    *,
    label: str | None = "",
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
        label: of the colour bar, with unit: "displacement (m)"; None leaves the bar out.
        limits: of the colours; default: the values' range.
        domains: draw the domains of the weighting functions, boxes along the axes, instead of the initial
            boxes as F deforms them.
        length: factor from metres to the axes' unit, and the unit: (1e3, "mm").
        view: elevation and azimuth of the camera (degrees), in three dimensions.

    Returns:
        The matplotlib axes on rank 0 (`ax.figure` is the figure), None elsewhere.

    Raises:
        InputError: not one value for each local point, or another argument that isn't allowed; on every rank
            alike.
    """
    checks.instance("points", points, Points, "material points, such as seed makes, are")
    look = {"ax": ax, "label": label, "limits": limits, "cmap": cmap, "length": length, "view": view}
    options = Options(
        points.comm, points.dim, values, len(points), **look, undeformed=undeformed, domains=domains
    )
    body = points_scene(points, options.values, options.factor, domains)
    return None if body is None else draw(body, ax, options, label, cmap, undeformed)


@collective("plot_mesh", comm=lambda elements, *args, **options: elements.comm)
def plot_mesh(
    elements: Elements,
    values: np.ndarray | None = None,
    ax: Any = None,
    *,
    at: str = "nodes",
    label: str | None = "",
    limits: tuple[float, float] | None = None,
    cmap: str = "viridis",
    undeformed: bool = True,
    edges: bool = True,
    length: tuple[float, str] = (1.0, "m"),
    view: tuple[float, float] = (22.0, -60.0),
) -> Any:
    """Draw the deformed mesh coloured by a value, over the undeformed body in grey. Collective.

    Nodal values are interpolated in the plane; in three dimensions each outer face shows their mean. Edges
    of degree 2 and 3 are drawn through their nodes.

    Args:
        values: numbers (n,); None colours all alike.
        at: where the values are: at the local "nodes", on this rank's own "cells", or at its quadrature
            "points", of which each cell shows the mean.
        edges: draw the elements' edges.

    The other arguments are those of `plot_points`.

    Returns:
        The matplotlib axes on rank 0 (`ax.figure` is the figure), None elsewhere.

    Raises:
        InputError: not one value for each local node, cell or point, or a wrong option; on every rank alike.
    """
    count = _number_at(elements, at)
    look = {"ax": ax, "label": label, "limits": limits, "cmap": cmap, "length": length, "view": view}
    options = Options(elements.comm, elements.dim, values, count, **look, undeformed=undeformed, edges=edges)
    faces = mesh_scene(elements, options.values, at, options.factor)
    return None if faces is None else draw(faces, ax, options, label, cmap, undeformed, edges)


def points_scene(
    points: Points, values: np.ndarray | None, factor: float, domains: bool = False
) -> Body | None:
    """All points' boxes in units of 1/factor, on rank 0. Collective."""
    now = _boxes(points.x, points.F, points.half_length if domains else points.half_length0, domains)
    X, half, corners = (gather(points.comm, factor * a) for a in (points.X, points.half_length0, now))
    colour = None if values is None else gather(points.comm, values)
    if X is None or half is None or corners is None:
        return None
    return Body(X, half, corners, colour)


def mesh_scene(elements: Elements, values: np.ndarray | None, at: str, factor: float) -> Faces | None:
    """All faces in units of 1/factor, on rank 0. Collective."""
    if at == "points" and values is not None:
        values = elements.cell_mean(values)
    faces = gather_faces(elements, values, at == "nodes")
    if faces is not None:
        faces.scale(factor)
    return faces


def draw(
    scene: Body | Faces,
    ax: Any,
    options: Options,
    label: str | None,
    cmap: Any,
    undeformed: bool,
    edges: bool = True,
    ends: tuple[np.ndarray, np.ndarray] | None = None,
) -> Any:
    """Draw a gathered body, on rank 0, between the ends of the axes, if given; a new figure without axes."""
    with styled():
        dim, mappable = scene.dim, drawing.colours(scene.shown, cmap, options.limits)
        ax = ax or drawing.new_axes(scene.span, **({"projection": "3d"} if dim == 3 else {}))
        if isinstance(scene, Body):
            part = _draw_flat if dim == 2 else partial(_draw_solid, view=options.view)
            part(ax, scene, undeformed, mappable)
        elif dim == 2:
            _draw_flat_mesh(ax, scene, undeformed, edges, mappable)
        else:
            _draw_solid_mesh(ax, scene, undeformed, edges, mappable, options.view)
        if ends is not None:  # before the colour bar, which stands where they leave room
            drawing.set_ends(ax, ends, options.view)
        drawing.name_axes(ax, dim, options.unit)
        if mappable is not None and label is not None:
            drawing.colour_bar(ax, mappable, label, dim)
    return ax


def _number_at(elements: Elements, at: str) -> int:
    """How many values are needed on this rank, see `plot_mesh`."""
    checks.instance("elements", elements, Elements, "a meshed body, polarmpm.Elements(...), is")
    counts = {
        "nodes": len(elements.nodes),
        "cells": len(elements.live),
        "points": len(elements.points),
    }
    if not isinstance(at, str) or at not in counts:
        raise checks.refuse("at", at, f"allowed are {', '.join(counts)}")
    return counts[at]


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

    Raises:
        InputError: displacements and loads that don't go together.
    """
    if checks.communicator("comm", comm).rank:
        return None
    curves = check_curves("curves", curves)
    reference = {} if reference is None else check_curves("reference", reference)
    for name, text in (("xlabel", xlabel), ("ylabel", ylabel)):
        checks.instance(name, text, str, "a text is")
    check_axes(ax, solid=False)
    with styled():
        ax = ax or drawing.new_axes(None)
        marks = "osD^v<>"
        for k, (name, (x, y)) in enumerate(curves.items()):
            every = max(1, len(x) // 16)  # of many points a mark each would hide the line
            ax.plot(x, y, "-", marker=marks[k % len(marks)], markevery=every, label=name)
        for k, (name, (x, y)) in enumerate(reference.items()):
            # the marks go around once more, so that they differ from those of the lines
            style = {"marker": "x+*1234"[k % 7], "markersize": 5, "markeredgewidth": 1.0}
            ax.plot(x, y, color="black", linestyle="none", label=name, zorder=3, **style)
        ax.set_xlabel(xlabel)
        ax.set_ylabel(ylabel)
        drawing.finish_curves(ax)
    return ax


@collective("save of a figure", comm=lambda *args, comm=MPI.COMM_WORLD, **options: comm)
def save(
    figure: Any,
    path: str | os.PathLike[str],
    *,
    dpi: float = 220,
    pdf: bool = True,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> None:
    """Write a figure (or the figure of axes) of rank 0 to a .png, .pdf or .svg file. Collective.

    Args:
        dpi: pixels an inch of a .png, and of what a .pdf has as an image.
        pdf: write a .pdf beside a .png, which journals and LaTeX want.

    Raises:
        InputError: the file can't be written, or its kind is unknown; not a figure; on every rank alike.
        OutputError: the disc is full; an old file stays.
    """
    checks.communicator("comm", comm)
    dpi, pdf = checks.number("dpi", dpi, above=0.0), checks.flag("pdf", pdf)
    with errors_on_all_ranks(comm):
        if comm.rank == 0 and not hasattr(getattr(figure, "figure", None), "savefig"):
            raise checks.refuse("figure", figure, "a figure of matplotlib, or axes of one, are needed")
    file = check_output(comm, path)
    error: Exception | None = None
    if comm.rank == 0:
        try:
            whole = figure.figure
            # axes in three dimensions forget the label of z when they tell their size
            extra = [ax.zaxis.label for ax in whole.axes if hasattr(ax, "zaxis")]
            extra += whole.get_default_bbox_extra_artists()
            png = file = file if file.suffix else file.with_suffix(".png")
            options: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.05, "dpi": dpi}
            files = [png, png.with_suffix(".pdf")] if pdf and png.suffix == ".png" else [png]
            for file in files:
                content = BytesIO()
                with styled():
                    whole.savefig(content, format=file.suffix[1:], bbox_extra_artists=extra, **options)
                replace_file(file, content.getvalue())
        except OSError as e:
            error = not_written("figure", file, e)
        except ValueError as e:
            error = InputError(f"path = {str(file)!r} can't be written: {e}")
    raise_on_all_ranks(comm, error)


# geometry -----------------------------------------------------------------------------------------
def _boxes(x: np.ndarray, F: np.ndarray, half_length: np.ndarray, straight: bool) -> np.ndarray:
    """Corners (np, 2^d, d) of the points' boxes, deformed by F unless they are straight."""
    edges = box_corners(np.zeros_like(x), half_length)
    if not straight:
        d = x.shape[1]
        edges = np.einsum("pij,pkj->pki", F[:, :d, :d], edges)
    corners: np.ndarray = x[:, None] + edges
    return corners


class Body:
    """All points' boxes: undeformed centres and half-lengths, current corners, values."""

    def __init__(self, X: np.ndarray, half: np.ndarray, corners: np.ndarray, values: np.ndarray | None):
        self.X, self.half, self.corners, self.values = X, half, corners, values
        self.initial = box_corners(X, half)
        self.dim, self.shown = X.shape[1], values

    def positions(self, undeformed: bool) -> list[np.ndarray]:
        """Corners (n, d) of what is drawn."""
        both = [self.corners, self.initial] if undeformed else [self.corners]
        return [a.reshape(-1, self.dim) for a in both]

    @property
    def span(self) -> np.ndarray:
        """Size of the space that both states take."""
        size: np.ndarray = np.ptp(np.concatenate(self.positions(True)), axis=0)
        return size

    def outer_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Point and number of the faces that no other undeformed box has.

        On a uniform lattice that is the body's surface; boxes of other layouts overlap and keep all faces.
        """
        faces = BOX_FACES[self.dim]
        centre = np.stack([self.initial[:, f].mean(axis=1) for f in faces], axis=1).reshape(-1, self.dim)
        # on a uniform lattice these are whole numbers up to rounding
        key = np.rint((centre - self.X[0]) / self.half.min(axis=0)).astype(np.int64)
        _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        alone = np.flatnonzero(count[inverse.ravel()] == 1)
        return alone // len(faces), alone % len(faces)


# drawing ------------------------------------------------------------------------------------------
def _draw_flat(ax: Any, body: Body, undeformed: bool, mappable: Any) -> None:
    ring = [0, 1, 3, 2]
    if undeformed:
        drawing.flat_undeformed(ax, body.initial[:, ring])
    fill = drawing.PLAIN if mappable is None else mappable.to_rgba(body.values)
    drawing.flat_patches(ax, body.corners[:, ring], fill)
    drawing.finish_flat(ax)


def _draw_flat_mesh(ax: Any, faces: Faces, undeformed: bool, edges: bool, mappable: Any) -> None:
    if undeformed:
        drawing.flat_undeformed(ax, faces.before)
    if faces.of_nodes is not None and faces.middle is not None:
        # triangles around the middle of each cell
        n, k = faces.now.shape[:2]
        first, corner = (k + 1) * np.arange(n)[:, None], np.arange(k)
        table = np.stack(np.broadcast_arrays(first + corner, first + np.roll(corner, -1), first + k), axis=2)
        x = np.concatenate([faces.now, faces.middle[:, None]], axis=1).reshape(-1, 2)
        options = {"cmap": mappable.cmap, "norm": mappable.norm, "zorder": 2}
        ax.tripcolor(*x.T, table.reshape(-1, 3), faces.of_nodes.ravel(), shading="gouraud", **options)
    else:
        fill = drawing.PLAIN if mappable is None else mappable.to_rgba(faces.values)
        drawing.flat_patches(ax, faces.now, fill)
    if edges:
        drawing.flat_edges(ax, faces.now)
    drawing.finish_flat(ax)


def _draw_solid(ax: Any, body: Body, undeformed: bool, mappable: Any, view: tuple[float, float]) -> None:
    point, face = body.outer_faces()
    if len(point) > _MOST_FACES:
        if undeformed:
            ax.scatter(*body.X.T, s=0.5, color=drawing.GREY, alpha=0.1, linewidth=0)
        colour = drawing.PLAIN if mappable is None else mappable.to_rgba(body.values)
        ax.scatter(*body.corners.mean(axis=1).T, s=1.0, c=colour, linewidth=0)
    else:
        corner = np.array(BOX_FACES[3])[face]
        if undeformed:
            outward = np.eye(3)[face // 2] * (2.0 * (face % 2) - 1.0)[:, None]
            drawing.solid_undeformed(ax, body.initial[point[:, None], corner], outward, view)
        fill = drawing.rgba(mappable, body.values, len(body.X))[point]
        drawing.solid_faces(ax, body.corners[point[:, None], corner], fill)
    drawn = [body.corners, body.initial] if undeformed else [body.corners]
    drawing.finish_solid(ax, [a.reshape(-1, 3) for a in drawn], view)


def _draw_solid_mesh(
    ax: Any, faces: Faces, undeformed: bool, edges: bool, mappable: Any, view: tuple[float, float]
) -> None:
    if undeformed:
        drawing.solid_undeformed(ax, faces.before, faces.outward, view)
    fill = drawing.rgba(mappable, faces.values, len(faces.now))
    drawing.solid_faces(ax, faces.now, fill, edges)
    drawn = [faces.now, faces.before] if undeformed else [faces.now]
    drawing.finish_solid(ax, [a.reshape(-1, 3) for a in drawn], view)


__all__ = [
    "fitted",
    "gather",
    "legend_below",
    "load_displacement",
    "plot_mesh",
    "plot_points",
    "save",
    "styled",
    "subplots",
]
