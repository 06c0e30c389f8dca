"""The demos of contact: Hertz, and bodies on inclines."""

from functools import partial

import pytest

from tests.helpers.demos import demo_result


@pytest.fixture
def run(folder):
    return partial(demo_result, folder)


def test_hertz_on_coarse_cells(run):
    result = run("hertz", "--cell", "2e-3")
    assert abs(result["half_width_error"]) < 0.025
    assert abs(result["pressure_error"]) < 0.02
    assert result["penetration_cells"] < 5e-3
    assert result["out_of_balance"] < 1e-6
    assert result["load"] == pytest.approx(494.6, rel=0.01)


@pytest.mark.slow
def test_hertz(run):
    result = run("hertz")
    assert abs(result["half_width_error"]) < 0.015
    assert abs(result["pressure_error"]) < 0.015


def test_a_disc_begins_to_slip_and_roll(run):
    """A fifth of a second of it."""
    result = run("incline", "--cases", "slipping", "--time", "0.2", "--dt", "4e-3")
    assert abs(result["slipping"]) < 0.01
    assert abs(result["slipping_turn"]) < 0.03
    assert result["slipping_ratio"] == pytest.approx(0.3, rel=1e-3)


@pytest.mark.slow
def test_inclines(run):
    """Two fifths of the way; the whole is in the benchmarks."""
    result = run("incline", "--time", "0.4", "--dt", "4e-3")
    assert abs(result["rolling"]) < 3e-3
    assert abs(result["rolling_turn"]) < 0.015
    assert abs(result["slipping"]) < 2e-3
    assert abs(result["smooth"]) < 2e-3
    assert abs(result["block"]) < 0.02
    for name in ("slipping", "block"):
        assert result[f"{name}_ratio"] == pytest.approx(0.3, abs=1e-3)
    for name in ("rolling", "slipping", "smooth", "block"):
        assert result[f"{name}_iterations"] < 5


@pytest.mark.slow
def test_a_micropolar_body_is_harder_under_a_small_wedge(run):
    result = run("penetration", "--cells", "32", "--lengths", "0.02", "0.08", "--steps", "2")
    assert abs(result["classical_error"]) < 0.12
    assert 1.0 < result["loads"][0] < result["loads"][1] < 1.4
    assert 1.05 < result["hardness"][0] < result["hardness"][1]
