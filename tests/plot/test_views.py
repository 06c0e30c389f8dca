"""Pictures and movies of problems."""

from __future__ import annotations

from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest

import polarmpm as pm
from polarmpm import plot
from polarmpm.errors import InputError
from tests.conftest import COMM, MICROPOLAR, beam
from tests.helpers.bodies import box

pytest.importorskip("matplotlib")


def by_points(dim: int = 2):
    problem = beam(dim, MICROPOLAR)
    problem.fix(pm.plane(x=3.0), u=(0.02, -0.2, 0.1)[:dim])
    return problem


def by_elements():
    body = pm.Elements(box("quadrilateral", (4, 2), (3.0, 1.0)), material=MICROPOLAR)
    problem = pm.QuasiStaticFEM(body)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.fix(pm.plane(x=3.0), u=(0.02, -0.2))
    return problem


def frames(path):
    from PIL import Image

    with Image.open(path) as image:
        out = []
        for k in range(image.n_frames):
            image.seek(k)
            out.append(np.asarray(image.convert("RGB")).astype(int))
    return out


def bar_label(ax):
    axes = [*ax.child_axes, *ax.figure.axes]
    return [label for a in axes for label in (a.get_xlabel(), a.get_ylabel())]


# views ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("make", "field", "component", "label"),
    [
        (by_points, "displacement", None, "displacement (m)"),
        (by_points, "stress", "xy", "stress xy (Pa)"),
        (by_points, "principal_stress", "1", "principal stress 1 (Pa)"),
        (by_points, pm.Field("height", lambda p: p.x[:, 1], "m"), None, "height (m)"),
        (by_elements, "rotation", "z", "rotation z (rad)"),
        (by_elements, "von_mises", None, "von Mises (Pa)"),
    ],
)
def test_a_view_shows_a_field(make, field, component, label):
    problem = make()
    list(problem.march(1, progress=False))
    view = problem.view(field, component)
    assert (view.ax is None) == (COMM.rank > 0)
    if view.ax is not None:
        assert label in bar_label(view.ax)


def test_a_view_is_written_and_shown(folder):
    """A .pdf stands beside the .png; a notebook gets a picture."""
    view = by_points().view()
    view.save(folder / "a.png")
    if view.ax is not None:
        assert (view._repr_png_() or b"").startswith(b"\x89PNG")
        assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")
        assert (folder / "a.pdf").read_bytes().startswith(b"%PDF")


def test_colours_are_those_of_the_component():
    problem = by_points()
    list(problem.march(1, progress=False))
    ax = problem.view("stress", "xx", undeformed=False).ax
    values = plot.gather(COMM, problem.fields().stress[:, 0, 0])
    if ax is not None and values is not None:
        (patches,) = ax.collections
        colours = patches.get_facecolor()
        from matplotlib import colormaps

        expected = colormaps["viridis"]([0.0, 1.0])
        np.testing.assert_allclose(colours[[np.argmin(values), np.argmax(values)]], expected, atol=1e-2)


def test_a_view_in_space(folder):
    problem = by_points(3)
    view = problem.view(None)
    view.save(folder / "solid.png", pdf=False)
    COMM.barrier()
    assert not (folder / "solid.pdf").exists()


@pytest.mark.skipif(find_spec("pyvista") is None, reason="PyVista isn't installed")
def test_pyvista_draws_off_screen(folder):
    by_points(3).view("displacement", renderer="pyvista").save(folder / "solid.png")


def test_views_are_checked():
    problem = by_points()
    for wrong, message in (
        ({"field": "strain"}, "'strain' is unknown"),
        ({"field": 3}, "neither a name nor"),
        ({"field": "stress", "component": "q"}, "xx, xy"),
        ({"field": "volume", "component": "x"}, "has none"),
        ({"field": None, "component": "x"}, "no field"),
        ({"renderer": "vtk"}, "matplotlib, pyvista|'matplotlib'"),
        ({"renderer": "pyvista"}, "in the plane"),
        ({"limits": (1, 0)}, "lower one"),
    ):
        with pytest.raises(InputError, match=message):
            problem.view(**wrong)
    if find_spec("pyvista") is None:
        with pytest.raises(InputError, match="PyVista isn't installed"):
            by_points(3).view(renderer="pyvista")
    if COMM.size == 1:
        with pytest.raises(InputError, match="opens no windows"):
            problem.view().show()


# movies ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("make", [by_points, by_elements])
def test_a_movie_has_a_frame_for_each_step(folder, make):
    problem = make()
    with plot.movie(folder / "a.png", problem, "displacement", "y", dpi=60) as film:
        for step in problem.march(2, progress=False):
            film.record(step)
    COMM.barrier()
    if COMM.rank == 0:
        found = frames(folder / "a.png")
        assert len(found) == 3
        assert len({f.shape for f in found}) == 1
        assert all(np.abs(a - b).max() > 50 for a, b in pairwise(found))
        # the axes stand still
        columns = found[0].shape[1] // 8
        np.testing.assert_array_equal(found[0][:, :columns], found[2][:, :columns])
    with pytest.raises(InputError, match="has been written"):
        film.record()


def test_a_movie_of_a_run_that_is_ended(folder):
    problem = by_points()

    def run():
        with plot.movie(folder / "a.gif", problem, dpi=60) as film:
            for step in problem.march(3, progress=False):
                film(step)
                if step.number == 1:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    if COMM.rank == 0:
        assert len(frames(folder / "a.gif")) == 2


def test_movies_are_checked(folder):
    problem = by_points()
    for path, options, message in (
        ("a.avi", {}, "ending in"),
        ("a.gif", {"fps": 0}, "fps"),
        ("a.gif", {"dpi": -1}, "dpi"),
        ("a.gif", {"field": "strain"}, "'strain' is unknown"),
        ("a.gif", {"also": 3}, "also"),
    ):
        with pytest.raises(InputError, match=message):
            plot.movie(folder / path, problem, **options)
    film = plot.movie(folder / "a.gif", problem, initial=False)
    with pytest.raises(InputError, match="no frame"):
        film.write()
    with pytest.raises(InputError, match="problem"):
        plot.movie(folder / "a.gif", 3)


# style ----------------------------------------------------------------------------------------------
def test_what_is_drawn_within_is_in_the_style():
    import matplotlib as mpl

    before = mpl.rcParams["axes.labelsize"]

    @plot.styled()
    def drawn():
        return mpl.rcParams["axes.labelsize"]

    assert drawn() == 8 != before
    assert mpl.rcParams["axes.labelsize"] == before
    figure, ax = plot.subplots()
    assert figure.get_size_inches()[0] == plot.COLUMN
    assert ax.xaxis.label.get_size() == 8
