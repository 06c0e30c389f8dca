"""The look that figures share."""

from __future__ import annotations

import pytest

from polarmpm import plot

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
