"""Movies of a run: a frame for each recorded step, all with the same axes and colours."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..io.files import check_output, not_written
from ..problems.elements import QuasiStaticFEM
from ..solvers.stepping import Step
from ..tools import checks
from ..tools.meetings import collective
from ..tools.parallel import errors_on_all_ranks, raise_on_all_ranks
from . import drawing, figures
from .options import Options
from .style import styled
from .values import check_problem, shown
from .viewing import limits_of

BY_PILLOW, BY_FFMPEG = (".gif", ".png", ".webp"), (".mp4", ".webm", ".mov")


class Movie:
    """A movie in the making, see `movie`. All methods are collective.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path, problem: Any, what: Any, options: Options, look: dict[str, Any]):
        self.path, self._problem, self._what, self._options, self._look = path, problem, what, options, look
        self._scenes: list[Any] = []
        self._titles: list[str] = []
        self._done = False

    def __enter__(self) -> Movie:
        if self._look["initial"]:
            self.record()
        return self

    @collective("record of a movie", comm=lambda self, *args, **options: self._problem.comm)
    def record(self, step: Step | None = None) -> None:
        """Take the present state as the next frame.

        Raises:
            InputError: the movie has been written; the step isn't the last one.
        """
        problem = self._problem
        if self._done:
            raise InputError(f"movie {self.path}: has been written; it takes no more frames")
        if step is not None:
            checks.instance("step", step, Step, "a step of march is")
            if step.number != problem.progress.step:
                raise InputError(
                    f"step {step.number} can't be recorded: the problem is at step {problem.progress.step}"
                )
        values, at = self._what.of(problem)
        factor = self._options.factor
        scene: Any
        if isinstance(problem, QuasiStaticFEM):
            scene = figures.mesh_scene(problem.elements, values, at, factor)
        else:
            scene = figures.points_scene(problem.points, values, factor, self._look["domains"])
        if scene is not None:
            self._scenes.append(scene)
            clock, unit = (
                ("time", " s") if hasattr(problem, "clock") and problem.clock == "time" else ("", "")
            )
            self._titles.append(f"{clock or 'load factor'} {problem.progress.factor:.4g}{unit}")

    __call__ = record

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Write what has been recorded, also of a run that an error or Ctrl-C has ended."""
        if kind is None:
            self.write()
        elif self._scenes:  # on rank 0, without the others, which may be elsewhere
            try:
                self._write()
            except Exception as e:
                warnings.warn(f"movie {self.path}: {e}", stacklevel=2)

    @collective("write of a movie", comm=lambda self, *args, **options: self._problem.comm)
    def write(self) -> None:
        """Draw all frames and write the file; done at the end of the `with` statement.

        Raises:
            InputError: no frame has been recorded, or the file can't be written.
            OutputError: the disc is full.
        """
        comm = self._problem.comm
        error: Exception | None = None
        if comm.rank == 0:
            try:
                if not self._scenes:
                    raise InputError(f"movie {self.path}: no frame has been recorded")
                self._write()
            except OSError as e:
                error = not_written("movie", self.path, e)
            except (InputError, ValueError) as e:
                error = e if isinstance(e, InputError) else InputError(f"movie {self.path}: {e}")
        raise_on_all_ranks(comm, error)
        self._done = True

    def _write(self) -> None:
        from matplotlib.figure import Figure

        look, options = self._look, self._options
        if options.limits is None:
            options.limits = limits_of(self._scenes)
        low, high = _corners(self._scenes, look["undeformed"])
        size = drawing.new_axes(high - low).figure.get_size_inches()
        part = self.path.with_name(f"{self.path.stem}.part{self.path.suffix}")
        with styled():
            figure, writer = Figure(size, constrained_layout=True), _writer(self.path.suffix, look["fps"])
            even = 2.0 / look["dpi"]  # video codecs want even numbers of pixels
            figure.set_size_inches(*(np.ceil(size / even) * even))
            try:
                with writer.saving(figure, str(part), look["dpi"]):
                    for k, scene in enumerate(self._scenes):
                        self._frame(figure, scene, self._titles[k], (low, high))
                        writer.grab_frame()
                os.replace(part, self.path)
            finally:
                part.unlink(missing_ok=True)

    def _frame(self, figure: Any, scene: Any, title: str, ends: tuple[np.ndarray, np.ndarray]) -> None:
        look, options, dim = self._look, self._options, scene.dim
        figure.clear()
        ax = figure.add_subplot(**({"projection": "3d"} if dim == 3 else {}))
        figures.draw(scene, ax, options, look["label"], look["cmap"], look["undeformed"], look["edges"], ends)
        ax.set_title(title)
        if look["also"] is not None:
            with checks.evaluating("also"):
                look["also"](ax)


def _corners(scenes: Sequence[Any], undeformed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the space that all frames take."""
    both = [part for scene in scenes for part in scene.positions(undeformed)]
    return np.min([x.min(axis=0) for x in both], axis=0), np.max([x.max(axis=0) for x in both], axis=0)


def _writer(kind: str, fps: float) -> Any:
    from matplotlib import animation

    made = animation.PillowWriter if kind in BY_PILLOW else animation.FFMpegWriter
    return made(fps=fps)


def _check_kind(path: Path) -> None:
    from matplotlib import animation

    if path.suffix not in BY_PILLOW + BY_FFMPEG:
        allowed = f"the name of a movie, ending in {', '.join(BY_PILLOW + BY_FFMPEG)}, is needed"
        raise checks.refuse("path", str(path), allowed)
    if path.suffix in BY_FFMPEG and not animation.FFMpegWriter.isAvailable():
        raise InputError(
            f"path = {str(path)!r}: {path.suffix} needs the program ffmpeg, which isn't installed "
            f"(apt-get install ffmpeg); {', '.join(BY_PILLOW)} need nothing"
        )


@collective("movie", comm=lambda path, problem, *args, **options: problem.comm)
def movie(
    path: str | os.PathLike[str],
    problem: Any,
    field: Any = "displacement",
    component: str | None = None,
    *,
    label: str | None = "",
    limits: tuple[float, float] | None = None,
    cmap: Any = "viridis",
    undeformed: bool = False,
    edges: bool = True,
    domains: bool = False,
    length: tuple[float, str] = (1.0, "m"),
    view: tuple[float, float] = (22.0, -60.0),
    fps: float = 10.0,
    dpi: float = 150.0,
    initial: bool = True,
    also: Callable[[Any], Any] | None = None,
) -> Movie:
    """A movie of a run: a frame for each recorded step, drawn when the `with` statement ends. Collective.

        with plot.movie("collapse.gif", problem, "velocity") as film:
            for step in problem.march(50):
                film.record(step)

    All frames have the same axes and, from the least value of all of them to the largest, the same colours.

    Args:
        path: of the file: .gif, .webp, or .png (animated, in all colours) need nothing, .mp4, .webm and .mov
            the program ffmpeg.
        field, component, label, limits, cmap, undeformed, edges, length, view: as of `plot.view`.
        domains: of points, as of `plot_points`: for bodies that flow, whose boxes F draws out into needles.
        fps: frames a second.
        dpi: pixels an inch.
        initial: the present state is the first frame.
        also: a function of the axes, called with those of each frame: `also=lambda ax: ax.axhline(0)`.

    Raises:
        InputError: another kind of file, no ffmpeg where it is needed, an unknown field or component, a wrong
            option; on every rank alike.
    """
    comm = check_problem(problem).comm
    what = shown(field, component)
    file = check_output(comm, path)
    with errors_on_all_ranks(comm):
        if comm.rank == 0:
            _check_kind(file)
        if also is not None:
            checks.function("also", also, "a function of axes, or None, is", takes=("ax",))
        number = {"fps": checks.number("fps", fps, above=0.0), "dpi": checks.number("dpi", dpi, above=0.0)}
    what.of(problem)  # an unknown field shows now
    bar = what.label if label == "" else label
    same: dict[str, Any] = {"label": bar, "limits": limits, "cmap": cmap, "length": length, "view": view}
    flags = {"undeformed": undeformed, "edges": edges, "domains": domains, "initial": initial}
    options = Options(comm, problem.points.dim, None, 0, ax=None, **same, **flags)
    look = {"label": bar, "cmap": cmap, "also": also, **flags, **number}
    return Movie(file, problem, what, options, look)
