"""The look that figures share."""

from __future__ import annotations

import numpy as np
import pytest

from polarmpm import InputError, plot
from polarmpm.plot import drawing

pytest.importorskip("matplotlib")


def test_the_style_is_one_that_matplotlib_takes():
    """Journals' sizes, and colours that differ."""
    from matplotlib import rc_context, rcParams

    with rc_context(plot.STYLE):
        assert 7 <= rcParams["font.size"] <= 9
        assert 7 <= rcParams["xtick.labelsize"] <= 9
        assert rcParams["figure.figsize"][0] == plot.COLUMN
    assert len(set(plot.COLOURS)) == len(plot.COLOURS) >= 7
    with pytest.raises(AttributeError, match="'STILE'"):
        plot.STILE  # noqa: B018


def test_one_legend_stands_below_several_panels(tmp_path):
    """Each label once, those of the panels gone, and nothing of it over the panels in the file."""
    figure, axes = plot.subplots(1, 2)
    for ax in axes:
        ax.plot([0, 1], [0, 1], label="both")
        ax.legend()
    axes[1].plot([0, 1], [1, 0], label="one")
    legend = plot.legend_below(figure)
    assert [text.get_text() for text in legend.get_texts()] == ["both", "one"]
    assert not any(ax.get_legend() for ax in axes)
    figure.draw_without_rendering()
    assert legend.get_window_extent().y1 <= min(ax.get_tightbbox().y0 for ax in axes)
    assert plot.legend_below(plot.subplots()[0]) is None
    with pytest.raises(InputError, match="columns = -1"):
        plot.legend_below(figure, columns=-1)
    with pytest.raises(InputError, match="figure = 3"):
        plot.legend_below(3)


def test_panels_of_several_kinds_have_the_widths_asked_for():
    _, (left, right) = plot.subplots(1, 2, solid=[0], width_ratios=(2, 1))
    assert hasattr(left, "zaxis")
    assert not hasattr(right, "zaxis")
    assert tuple(left.get_subplotspec().get_gridspec().get_width_ratios()) == (2, 1)


def test_ends_of_axes_do_not_depend_on_what_is_drawn():
    """Frames of a movie stand still."""
    view, ends = (22.0, -60.0), (np.zeros(3), np.array([1.0, 2.0, 3.0]))
    found = []
    for large in (5.0, 0.1):
        _, ax = plot.subplots(subplot_kw={"projection": "3d"})
        drawing.finish_solid(ax, [np.array([[0.0, 0.0, 0.0], [large] * 3])], view)
        drawing.set_ends(ax, ends, view)
        found.append([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    np.testing.assert_array_equal(*found)
    assert found[0][2][0] < 0 < 3 < found[0][2][1] < 3.5
