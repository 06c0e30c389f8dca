"""Figures: what is drawn is where the points are, and files are made."""

import os
import subprocess
import sys

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.plot import figures as plot

pytest.importorskip("matplotlib")

COMM = MPI.COMM_WORLD
MATERIAL = pm.MicropolarElastic(lam=1e6, mu=1e6, kappa=2e5, alpha=0.0, gamma=1e4, beta=0.0)  # Pa, N


def bar():
    """Two by one metres, turned by 30 degrees and stretched."""
    points = pm.seed(
        pm.Grid.box((0, 0), (4, 2), 0.5), bounds=((0, 0), (2, 1)), material=MATERIAL, points_per_cell=2
    )
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    points.F[:, :2, :2] = np.array([[c, -s], [s, c]]) @ np.diag([1.2, 0.9])
    points.x = np.einsum("ij,pj->pi", points.F[0, :2, :2] if len(points) else np.eye(2), points.X)
    return points


def block():
    """2 x 1 x 0.5 m, moved; 8 x 4 x 2 points."""
    grid = pm.Grid.box((0, 0, 0), (4, 2, 2), 0.5)
    points = pm.seed(grid, bounds=((0, 0, 0), (2, 1, 0.5)), material=MATERIAL)
    points.x = points.X + np.array([1.0, 0.0, 0.5])
    return points


def polygons(collection):
    return np.array([path.vertices[:4] for path in collection.get_paths()])


def area(quads):
    a, b = quads, np.roll(quads, -1, axis=1)
    return 0.5 * np.sum(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], axis=1)


def test_patches_are_the_deformed_boxes(folder):
    points = bar()
    ax = plot.plot_points(points, 1e3 * points.displacement[:, 0], label="$u_x$ (mm)", length=(1e3, "mm"))
    assert (ax is None) == (COMM.rank > 0)
    every, x = plot.gather(COMM, points.displacement[:, 0]), plot.gather(COMM, points.x)
    plot.save(ax, folder / "figures" / "bar.png")
    if ax is None:
        return
    outline, filling, patches = ax.collections
    quads = polygons(patches)
    np.testing.assert_allclose(quads.mean(axis=1), 1e3 * x)
    np.testing.assert_allclose(area(quads), 1e6 * 0.25**2 * 1.2 * 0.9)
    np.testing.assert_allclose(area(polygons(filling)).sum(), 1e6 * 2.0)
    assert outline.get_zorder() < filling.get_zorder() < patches.get_zorder()
    colours = patches.get_facecolor()
    assert np.abs(colours[np.argmax(every)] - colours[np.argmin(every)]).max() > 0.5
    assert ax.get_xlabel() == "x (mm)"
    assert ax.get_aspect() == 1.0
    assert "$u_x$ (mm)" in [a.get_ylabel() for a in (*ax.child_axes, *ax.figure.axes)]
    assert (folder / "figures" / "bar.png").read_bytes().startswith(b"\x89PNG")


def test_domains_stay_straight():
    points = bar()
    ax = plot.plot_points(points, domains=True, undeformed=False)
    half = plot.gather(COMM, points.half_length)
    if ax is not None:
        (patches,) = ax.collections
        np.testing.assert_allclose(np.ptp(polygons(patches), axis=1), 2 * half)


def test_the_surface_is_drawn_in_three_dimensions(folder):
    points = block()
    ax = plot.plot_points(points, np.linalg.norm(points.X, axis=1), label="distance (m)", limits=(0.0, 3.0))
    plot.save(ax, folder / "block.png")
    if ax is None:
        return
    ghost, solid = ax.collections
    faces = 2 * (8 * 4 + 4 * 2 + 8 * 2)
    assert len(solid.get_facecolor()) == faces
    assert 0 < len(ghost.get_facecolor()) < faces
    span = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    assert np.all(span[:, 0] <= [0, 0, 0])
    assert np.all(span[:, 1] >= [3, 1, 1])
    # one scale on all axes
    scale = np.ptp(span, axis=1) / ax.get_box_aspect()
    np.testing.assert_allclose(scale, scale[0])
    assert ax.get_zlabel() == "z (m)"
    # ticks of thin sides would run into each other
    assert len(ax.get_xticks()) > 3
    assert len(ax.get_yticks()) == len(ax.get_zticks()) == 1
    assert (folder / "block.png").stat().st_size > 5000


def test_many_points_become_dots(monkeypatch):
    monkeypatch.setattr(plot, "_MOST_FACES", 10)
    points = block()
    ax = plot.plot_points(points, points.x[:, 0])
    if ax is not None:
        assert [len(c.get_offsets()) for c in ax.collections] == [8 * 4 * 2] * 2


@pytest.mark.parametrize("value", [0.0, 2.0, np.nan])
def test_equal_values_have_colours(value, folder):
    points = bar()
    ax = plot.plot_points(points, np.full(len(points), value), label="nothing (Pa)")
    plot.save(ax, folder / "equal.png")
    if ax is not None:
        assert np.ptp(ax.collections[-1].get_facecolor(), axis=0).max() == 0


def test_load_displacement_lines(folder):
    curves = {"fine": ([0, 1, 2], [0, 0.5, 1]), "_coarse": ([0, 1.1, 2.2], [0, 0.5, 1])}
    ax = plot.load_displacement(curves, reference={"published": ([2.05], [1])}, ylabel="force (N)")
    plot.save(ax, folder / "curve.pdf")
    if COMM.rank:
        assert ax is None
        return
    np.testing.assert_array_equal(ax.lines[1].get_xydata(), np.transpose(curves["_coarse"]))
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["fine", "published"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("displacement (m)", "force (N)")
    assert (folder / "curve.pdf").read_bytes().startswith(b"%PDF")


def test_several_axes_in_a_figure(folder):
    figure, (left, right) = plot.subplots(1, 2, figsize=(10, 4), solid=[0])
    points = block()
    drawn = plot.plot_points(points, points.X[:, 0], left, label="x (m)")
    lines = plot.load_displacement({"a": ([0, 1], [0, 1])}, right)
    plot.save(figure, folder / "two.png")
    expected = (None, None) if COMM.rank else (left, right)
    assert (drawn, lines) == expected
    assert (left.name, right.name) == ("3d", "rectilinear")
    assert (folder / "two.png").stat().st_size > 5000
    _, axes = plot.subplots(2, 3, sharex=True)
    assert axes.shape == (2, 3)


def test_bad_arguments_are_refused_on_all_ranks(folder):
    points = bar()
    ax = plot.load_displacement({"a": ([0, 1], [0, 1])})
    with pytest.raises(pm.InputError, match="values: have the shape"):
        plot.plot_points(points, np.zeros(len(points) + 1 - COMM.rank))
    with pytest.raises(pm.InputError, match=r"a\.nonsense' can't be written: .*nonsense"):
        plot.save(ax, folder / "a.nonsense")
    if COMM.rank == 0:
        (folder / "file").write_text("in the way")
    COMM.barrier()
    with pytest.raises(pm.InputError, match=r"file/a\.png' can't be written"):
        plot.save(ax, folder / "file" / "a.png")


@pytest.mark.mpi  # a Python that initialises MPI can't be started by a rank
def test_the_package_starts_without_matplotlib_and_meshio():
    code = "import sys, polarmpm.io, polarmpm.plot; print({'matplotlib', 'meshio'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], timeout=60, capture_output=True, text=True, env=dict(os.environ)
    )
    assert done.stdout.splitlines()[-1] == "set()", done.stdout + done.stderr[-2000:]
