"""Pictures of grids: their lines, and an indicator beside them."""

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.plot import plot_grid

pytest.importorskip("matplotlib")


def test_lines_are_drawn_where_they_are():
    grid = pm.Grid.graded(x=[0, 1, 2, 4], y=[0, 0.5, 1.5], z=[0, 1, 3])
    values = {"x": (np.array([0.0, 4.0]), np.array([0.0, 2.0])), "z": (np.array([0.0, 3.0]), np.ones(2))}
    ax = plot_grid(grid, axes="xz", length=(1e3, "mm"), indicator=values)
    if grid.comm.rank:
        assert ax is None
        return
    vertical, horizontal = ax.collections[:2]
    np.testing.assert_allclose([s[0, 0] for s in vertical.get_segments()], [0, 1e3, 2e3, 4e3])
    np.testing.assert_allclose([s[0, 1] for s in horizontal.get_segments()], [0, 1e3, 3e3])
    assert ax.get_xlabel() == "x (mm)"
    assert len(ax.collections) == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": "xq"}, "axes = 'xq'"),
        ({"axes": "xx"}, "axes = 'xx'"),
        ({"length": (0, "m")}, "length = 0"),
        ({"indicator": {"x": ([0, 1], [1, 2])}}, "indicator = "),
        ({"indicator": {"x": ([0, 1], [1, 2]), "y": ([0, 1], [1])}}, "indicator y: places of shape"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    with pytest.raises(pm.InputError, match=message):
        plot_grid(pm.Grid.box((0, 0), (1, 1), 0.5), **options)
