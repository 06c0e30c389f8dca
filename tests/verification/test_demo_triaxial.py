"""The demo of triaxial compression, a body of revolution, against closed forms of its paths."""

import pytest

from tests.helpers.demos import demo_result


@pytest.mark.slow
@pytest.mark.parametrize(("basis", "cells"), [("fem1", "1"), ("gimpm", "2")])
def test_paths_of_clay_and_sand(folder, basis, cells):
    """Stresses return exactly where the flow keeps its direction, and the points of a surface integrate its
    pressure nearly so; elsewhere the error goes with the step."""
    exact = 1e-8 if basis == "fem1" else 1e-4
    result = demo_result(folder, "triaxial", "--basis", basis, "--cells", cells, "--steps", "30")
    assert sorted(result["path"]) == ["drained", "sand", "undrained"]
    for kind, curve in result["path"].items():
        assert curve["error"] < (exact if kind == "sand" else 0.02), kind
        assert len(curve["p"]) == len(curve["exact"]["p"]) >= 30
    clay = result["path"]["undrained"]
    assert max(map(abs, clay["volumetric strain"])) < 1e-12
    assert clay["q"][-1] == pytest.approx(clay["p"][-1], rel=1e-3)  # the critical state, q = M p
    assert clay["pore pressure"][-1] > 0
    assert result["error"] == max(curve["error"] for curve in result["path"].values())
