"""A picture of a problem's present state, to be looked at."""

from __future__ import annotations

import os
from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np

from ..errors import InputError
from ..problems.elements import QuasiStaticFEM
from ..tools import checks
from ..tools.meetings import collective
from . import figures, rendering
from .options import Options
from .style import styled
from .values import check_problem, shown

RENDERERS = ("matplotlib", "pyvista")


class View:
    """A picture, which shows itself in a notebook.

    Attributes:
        ax: the matplotlib axes on rank 0, None elsewhere.
    """

    def __init__(self, ax: Any, comm: Any):
        self.ax, self._comm = ax, comm

    @property
    def figure(self) -> Any:
        return None if self.ax is None else self.ax.figure

    def save(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Write it, as `plot.save`. Collective."""
        figures.save(self.ax, path, comm=self._comm, **options)

    def show(self) -> None:
        """Open a window, where there is a display, until it is closed; on rank 0.

        Raises:
            InputError: there is none.
        """
        if self.ax is None:
            return
        import matplotlib as mpl
        import matplotlib.pyplot as plt

        if mpl.get_backend().lower() in ("agg", "pdf", "svg", "ps", "cairo"):
            raise InputError(
                f"show: matplotlib draws with {mpl.get_backend()!r}, which opens no windows; write "
                'the picture with .save("now.png"), or set MPLBACKEND'
            )
        window = plt.figure()
        manager = window.canvas.manager
        manager.canvas.figure = self.figure
        self.figure.set_canvas(manager.canvas)
        plt.show()

    def _repr_png_(self) -> bytes | None:
        """The picture in a notebook."""
        if self.ax is None:
            return None
        content = BytesIO()
        with styled():
            self.figure.savefig(content, format="png", dpi=160, bbox_inches="tight")
        return content.getvalue()

    def __repr__(self) -> str:
        return "<View of another rank's picture>" if self.ax is None else "<View: .save(path), .show(), .ax>"


@collective("view of a problem", comm=lambda problem, *args, **options: problem.comm)
def view(
    problem: Any,
    field: Any = "displacement",
    component: str | None = None,
    *,
    ax: Any = None,
    label: str | None = "",
    limits: Sequence[float] | None = None,
    cmap: Any = "viridis",
    undeformed: bool = True,
    edges: bool = True,
    length: tuple[float, str] = (1.0, "m"),
    view: tuple[float, float] = (22.0, -60.0),
    renderer: str = "matplotlib",
) -> View:
    """Draw the present state of a problem, coloured by a field. Collective.

    Args:
        field: a name, or a field of your own, as of `Recorder`; None: one colour.
        component: of it, such as "x", "xy" or "1"; by default the size of a vector or tensor.
        label: of the colour bar; "": the field's name and unit, None: no bar.
        edges: draw the edges of elements.
        renderer: of bodies in space: "matplotlib", or "pyvista", where it is installed: surfaces with light
            and shade that hide what is behind them, drawn off screen.

    The other arguments are those of `plot_points`.

    Returns:
        A `View`: `.save(path)`, `.show()`, and `.ax`, the matplotlib axes on rank 0.

    Raises:
        InputError: an unknown field or component, a wrong option, PyVista where it isn't installed or in the
            plane; on every rank alike.
    """
    check_problem(problem)
    what = shown(field, component)
    checks.choice("renderer", renderer, RENDERERS)
    dim = problem.points.dim
    if renderer == "pyvista":
        rendering.check(problem.comm, dim, ax)
    values, at = what.of(problem)
    bar = what.label if label == "" else label
    meshed = isinstance(problem, QuasiStaticFEM)
    look = {"ax": ax, "label": bar, "limits": limits, "cmap": cmap, "length": length, "view": view}
    count = figures._number_at(problem.elements, at) if meshed else len(problem.points)
    flags = {"undeformed": undeformed, "edges": edges}
    options = Options(problem.comm, dim, values, count, **look, **flags)
    scene: Any
    if meshed:
        scene = figures.mesh_scene(problem.elements, options.values, at, options.factor)
    else:
        scene = figures.points_scene(problem.points, options.values, options.factor)
    if scene is None:
        return View(None, problem.comm)
    draw = rendering.draw if renderer == "pyvista" else figures.draw
    return View(draw(scene, ax, options, bar, cmap, undeformed, edges), problem.comm)


def limits_of(scenes: Sequence[Any]) -> tuple[float, float] | None:
    """The range of what all scenes show; None where they show nothing."""
    every = [s.shown[np.isfinite(s.shown)] for s in scenes if s.shown is not None]
    every = [values for values in every if len(values)]
    if not every:
        return None
    return float(min(v.min() for v in every)), float(max(v.max() for v in every))


__all__ = ["RENDERERS", "View", "limits_of", "view"]
