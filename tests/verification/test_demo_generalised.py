"""The demos of generalised continua: a follower load, size effects, oriented sheets, excavations."""

import argparse
from functools import partial

import numpy as np
import pytest

from polarmpm.study.exact import pressed_cantilever
from tests.helpers.demos import demo_module, demo_result


@pytest.fixture
def run(folder):
    return partial(demo_result, folder)


# follower cantilever ----------------------------------------------------------------------------
def test_pressed_cantilever_is_the_elastica_by_points_and_by_elements(run):
    result = run("follower_cantilever", "--steps", "4", "--load", "8", "--points-per-cell", "2")
    exact = pressed_cantilever(8)[-1] - (1, 0)
    np.testing.assert_allclose(result["elastica"], exact)
    for name in ("elements", "micropolar", "points"):
        assert np.linalg.norm(result[name] - exact) < 0.2 * 0.02  # of the height
    np.testing.assert_allclose(result["points"], result["elements"], atol=0.01 * 0.02)


@pytest.mark.slow
def test_a_thinner_pressed_cantilever_is_nearer_to_the_elastica(run):
    thick = run("follower_cantilever")
    thin = run("follower_cantilever", "--height", "0.01", "--elements", "100")
    for name in ("elements", "micropolar", "points"):
        assert thick[f"distance_{name}"][-1] < 0.017
        assert thin[f"distance_{name}"][-1] < 0.5 * thick[f"distance_{name}"][-1]
    np.testing.assert_allclose(thick["path_points"], thick["path_elements"], atol=0.02 * 0.02)


# oriented sheets --------------------------------------------------------------------------------
RATIOS = {"20": (1.3877, 1.7717), "10": (2.5628, 4.0870), "4": (10.93, 20.29), "2": (41.0, 78.2)}  # e_1, both


def test_linear_stiffness_of_oriented_sheets_is_that_of_the_series():
    sheet = demo_module("oriented_sheet")
    for h, (one, two) in RATIOS.items():
        assert sheet.navier("e_1", 300 * float(h)) == pytest.approx(one, rel=1e-3)
        assert sheet.navier("e_2", 300 * float(h)) == pytest.approx(one, rel=1e-3)
        assert sheet.navier("both", 300 * float(h)) == pytest.approx(two, rel=1e-3)


def test_oriented_sheets_are_mirror_images(run):
    result = run("oriented_sheet", "--elements", "2", "--sides", "6000", "600", "--steps", "10")
    one, other, both, plain = (result[name] for name in ("e_1", "e_2", "both", "classical"))
    np.testing.assert_allclose(
        [other[k] for k in ("middle", "B", "A")], [one[k] for k in ("middle", "A", "B")], rtol=1e-9
    )
    assert both["A"] == pytest.approx(both["B"], rel=1e-9)
    assert plain["A"] == pytest.approx(plain["B"], rel=1e-9)
    assert one["A"] < one["B"]
    assert both["middle"] < one["middle"]
    for h in ("20", "2"):
        first, second = (result["linear_ratio"][name][h] for name in ("e_1", "e_2"))
        assert first[0] == pytest.approx(second[0], rel=1e-7)
        assert first[0] == pytest.approx(first[1], rel=0.1)


@pytest.mark.slow
def test_sheets_with_fibres_of_second_gradients_are_mirror_images(run):
    result = run("oriented_sheet", "--model", "gradient", "--elements", "2", "--steps", "20")
    one, other, plain = (result[name] for name in ("e_1", "e_2", "classical"))
    np.testing.assert_allclose(
        [other[k] for k in ("middle", "B", "A")], [one[k] for k in ("middle", "A", "B")], rtol=1e-9
    )
    assert plain["A"] == pytest.approx(plain["B"], rel=1e-9)
    assert one["middle"] < plain["middle"]
    assert one["A"] < one["B"]


@pytest.mark.slow
def test_large_deflection_of_oriented_sheets(run):
    result = run("oriented_sheet", "--sides", "6000", "3000", "1200", "600")
    for of_sides in result["linear_ratio"].values():
        assert sorted(of_sides) == sorted(RATIOS)
        for found, series in of_sides.values():
            assert found == pytest.approx(series, rel=0.02)
    one, both = result["e_1"], result["both"]
    found = [one["A"], one["B"], one["middle"], both["A"], both["B"], both["middle"]]
    np.testing.assert_allclose(found, [0.0682, 0.1827, 0.2142, 0.0414, 0.0414, 0.1649], rtol=0.03)


# size effects -----------------------------------------------------------------------------------
def test_thin_beams_bars_and_sheets_are_stiffer(run):
    result = run("size_effects", "--points-per-cell", "2", "--bar-cells", "2", "--sheet-cells", "2")
    beams, bars, sheets = (result[name] for name in ("beams", "bars", "sheets"))
    np.testing.assert_allclose(
        beams["micropolar, closed, nu = 0"], [1.0473, 1.1111, 1.4328, 2.5625], atol=6e-5
    )
    for nu, bound in (("0", 3e-3), ("0.3", 5e-3)):
        for method in ("elements", "points"):
            found, closed = (beams[f"micropolar, {how}, nu = {nu}"] for how in (method, "closed"))
            np.testing.assert_allclose(found, closed, rtol=bound)
    np.testing.assert_allclose(beams["second gradient, closed"], beams["Lam et al. 2003, fit"])
    for method in ("elements", "points"):
        found = beams[f"second gradient, {method}, nu = 0.3"]
        np.testing.assert_allclose(found, beams["second gradient, closed"], rtol=0.01)
    np.testing.assert_allclose(bars["micropolar, elements"], bars["micropolar, Ritz"], rtol=0.01)
    np.testing.assert_allclose(bars["second gradient, points"], bars["second gradient, Ritz"], rtol=0.01)
    free, held = (np.array(sheets[f"micropolar, elements, rotations {how}"]) for how in ("free", "held"))
    assert np.all(held > free)
    assert np.all(np.diff(held / free) > 0)  # the more so the thinner the sheet
    np.testing.assert_allclose(held, sheets["micropolar, closed"], rtol=0.1)
    np.testing.assert_allclose(
        sheets["second gradient, elements"], sheets["second gradient, closed"], rtol=0.1
    )


@pytest.mark.slow
def test_size_effects_are_those_of_the_closed_forms(run):
    result = run("size_effects", "--scenes", "bars", "sheets")
    found, ritz = (result["bars"][f"micropolar, {how}"] for how in ("elements", "Ritz"))
    np.testing.assert_allclose(found, ritz, rtol=3e-3)
    held, closed = (result["sheets"][f"micropolar, {k}"] for k in ("elements, rotations held", "closed"))
    np.testing.assert_allclose(held, closed, rtol=0.03)
    for method in ("elements", "points"):
        found, ritz = (result["bars"][f"second gradient, {how}"] for how in (method, "Ritz"))
        np.testing.assert_allclose(found, ritz, rtol=5e-3)
    found, closed = (result["sheets"][f"second gradient, {how}"] for how in ("elements", "closed"))
    np.testing.assert_allclose(found, closed, rtol=0.04)


def test_size_effects_do_not_depend_on_the_unit_of_length():
    """Beams in metres and pascals: h and l in m, the modulus in Pa."""
    scene = demo_module("size_effects")
    args = argparse.Namespace(cells=2, points_per_cell=2)
    ratios = []
    for unit, pascal in ((1.0, 1.0), (1e-6, 1e6)):
        scene.YOUNG = 1550.0 * pascal
        for make in (scene.beam_of_elements, scene.beam_of_points):
            plain = make(20.0 * unit, scene.classical(0.3), args)[1]
            ratios.append(plain / make(20.0 * unit, scene.micropolar(0.3, 25.0 * unit), args)[1])
    np.testing.assert_allclose(ratios[2:], ratios[:2], rtol=1e-7)


# excavations ------------------------------------------------------------------------------------
def test_round_excavation_is_that_of_the_closed_form_all_around(run):
    result = run("excavation", "--shapes", "round", "--cells", "0.5", "0.25", "--points-per-cell", "2")
    exact = {"hoop": 94.91, "radial": 49.99, "displacement": 9.4913}
    for name, value in exact.items():
        assert result["wall"][name] == pytest.approx(value, rel=3e-3)
        assert result["wall_spread"][name] < 3e-3 * value
        assert result["exact"][name] == pytest.approx(value, rel=1e-4)
        assert result["elements_wall_by_cell"]["0.25"][name] == pytest.approx(value, rel=1e-3)
    assert result["error"]["0.25"] < 1e-4
    assert result["classical_wall"]["hoop"] == pytest.approx(128.62, rel=0.01)
    assert result["classical_wall"]["displacement"] == pytest.approx(12.8616, rel=1e-3)


def test_round_excavation_without_the_slopes_of_symmetry_is_another_problem(run):
    options = ("--shapes", "round", "--cells", "0.5", "--symmetry", "displacement", "--no-elements")
    result = run("excavation", *options)
    assert result["wall"]["displacement"] > 1.04 * 9.4913
    assert result["wall_spread"]["displacement"] > 0.04  # mm
    # a classical body has no such slopes
    assert result["classical_wall"]["displacement"] == pytest.approx(12.8616, rel=1e-3)


def test_corner_of_a_square_excavation_has_a_stress_with_second_gradients_only(run):
    result = run("excavation", "--shapes", "square", "--cells", "0.5", "0.25")
    assert result["corner_peak"]["0.5"] == pytest.approx(118.0, abs=0.1)
    assert result["corner_peak"]["0.25"] == pytest.approx(120.3, abs=0.5)
    assert result["classical_corner_peak"]["0.5"] == pytest.approx(249.5, abs=0.5)
    assert result["classical_corner_growth"] == [pytest.approx(1.38, abs=0.02)]


@pytest.mark.slow
def test_excavations_converge(run):
    result = run("excavation")
    assert min(result["order"]) > 1.7
    assert [result["corner_peak"][cell] for cell in ("0.25", "0.125")] == pytest.approx([120.3] * 2, abs=0.5)
    assert result["corner_shear"]["0.125"] < result["classical_corner_shear"]["0.125"] / 6.5
    for growth in result["classical_corner_growth"]:
        assert growth == pytest.approx(1.38, abs=0.02)
    by_rings = run("excavation", "--shapes", "round", "--seeding", "mesh", "--cells", "0.25")
    for name, value in by_rings["exact"].items():
        assert by_rings["wall"][name] == pytest.approx(value, rel=1e-3)
        assert by_rings["wall_spread"][name] < (1e-3 if name == "displacement" else 6e-3) * value
