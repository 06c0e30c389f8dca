"""Bodies in space with light and shade, by PyVista where it is installed, as an image in matplotlib's axes.

matplotlib sorts faces by their distance, which fails where they are long or cut each other; VTK sorts pixels.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import InputError
from ..tools.parallel import errors_on_all_ranks
from . import drawing
from .figures import BOX_FACES, Body
from .meshfaces import Faces
from .options import Options
from .style import COLUMN, styled

_PIXELS = 1400  # of the longer side


def check(comm: MPI.Comm, dim: int, ax: Any) -> None:
    """Raise InputError unless PyVista can draw here. Collective."""
    with errors_on_all_ranks(comm):
        if dim != 3:
            raise InputError("renderer = 'pyvista': bodies in space only; this one is in the plane")
        if ax is not None and hasattr(ax, "get_zlim"):
            raise InputError("ax: a picture by PyVista needs axes without a third dimension, or None")
        if comm.rank == 0 and find_spec("pyvista") is None:
            raise InputError(
                "renderer = 'pyvista': PyVista isn't installed (pip install pyvista); 'matplotlib' needs "
                "nothing"
            )


def draw(
    scene: Body | Faces,
    ax: Any,
    options: Options,
    label: str | None,
    cmap: Any,
    undeformed: bool,
    edges: bool,
) -> Any:
    """Draw a gathered body, on rank 0, as `figures.draw` does."""
    mappable = drawing.colours(scene.shown, cmap, options.limits)
    before, now, values = _surface(scene)
    picture = _rendered(before if undeformed else None, now, values, mappable, options.view, edges)
    with styled():
        if ax is None:
            ax = drawing.new_axes(None)
            ax.figure.set_size_inches(1.4 * COLUMN, 1.1 * COLUMN)
        ax.imshow(picture)
        ax.set_axis_off()
        if mappable is not None and label is not None:
            drawing.colour_bar(ax, mappable, label, 3)
        size = np.ptp(now.reshape(-1, 3), axis=0)
        lengths = " × ".join(f"{s:.3g}" for s in size)  # axes would be in the way: the size instead
        ax.set_title(f"{lengths} {options.unit}", fontsize=7, color="0.35")
    return ax


def _surface(scene: Body | Faces) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Polygons (n, k, 3) before and now, and a value for each (n,)."""
    if isinstance(scene, Faces):
        return scene.before, scene.now, scene.values
    point, face = scene.outer_faces()
    corner = np.array(BOX_FACES[3])[face]
    values = None if scene.values is None else scene.values[point]
    return scene.initial[point[:, None], corner], scene.corners[point[:, None], corner], values


def _rendered(
    before: np.ndarray | None,
    now: np.ndarray,
    values: np.ndarray | None,
    mappable: Any,
    view: tuple[float, float],
    edges: bool,
) -> np.ndarray:
    """The picture (rows, columns, 3), without margins."""
    import pyvista as pv

    plotter = pv.Plotter(off_screen=True, window_size=[_PIXELS, _PIXELS], lighting="light kit")
    try:
        plotter.set_background("white")
        if before is not None:
            plotter.add_mesh(_mesh(pv, before), color=drawing.GREY, opacity=0.15, show_edges=False)
        mesh = _mesh(pv, now)
        look: dict[str, Any] = {
            "show_edges": edges and len(now) < 5000,
            "edge_color": "#404040",
            "line_width": 1,
            # sides in the shade keep the colours of the bar
            "ambient": 0.5,
            "diffuse": 0.55,
            "specular": 0.0,
        }
        if values is None or mappable is None:
            plotter.add_mesh(mesh, color=drawing.PLAIN, **look)
        else:
            mesh.cell_data["colour"] = (255 * mappable.to_rgba(values)[:, :3]).astype(np.uint8)
            plotter.add_mesh(mesh, scalars="colour", rgb=True, **look)
        plotter.enable_parallel_projection()
        elevation, azimuth = np.radians(view)
        level = np.cos(elevation)
        direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        plotter.view_vector(direction, viewup=(0, 0, 1))
        plotter.reset_camera()
        picture = np.asarray(plotter.screenshot(None, return_img=True))[:, :, :3]
    finally:
        plotter.close()
    drawn = np.any(picture < 250, axis=2)
    rows, columns = (np.flatnonzero(drawn.any(axis=k)) for k in (1, 0))
    return picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] if len(rows) else picture


def _mesh(pv: Any, polygons: np.ndarray) -> Any:
    n, k = polygons.shape[:2]
    numbers = np.arange(n * k).reshape(n, k)
    return pv.PolyData(polygons.reshape(-1, 3), np.column_stack([np.full(n, k), numbers]).ravel())
