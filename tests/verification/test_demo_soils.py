"""The demo of a slope, and that of a footing on frictional soil."""

import argparse
import math
from functools import partial

import pytest

import polarmpm as pm
from tests.helpers.demos import demo_module, demo_result


@pytest.fixture
def run(folder):
    return partial(demo_result, folder)


@pytest.mark.slow
def test_factor_of_safety_of_a_slope_on_coarse_cells(run):
    """Cells of a tenth of the height: a little too strong. What trials say is what the bracket says."""
    options = ("--cell", "1", "--points-per-cell", "2", "--low", "1.3", "--high", "1.5", "--width", "0.1")
    result = run("slope", *options)
    low, high = result["factor"]
    assert 1.3 <= low < high <= low + 0.1 + 1e-12
    assert pytest.approx((low + high) / 2, rel=0.06) == 1.38
    for factor, (displacement, load, _) in result["trials"].items():
        if float(factor) < low + 1e-3:
            assert load == 1.0
            assert displacement < result["limit"]
    assert result["limit"] == pytest.approx(5 * result["reference"])
    elastic = 0.379 * 20e3 * 10**2 / 1e8  # m, Griffiths and Lane
    assert result["reference"] == pytest.approx(elastic, rel=0.03)


@pytest.mark.slow
def test_factor_of_safety_of_a_slope_on_fine_cells(run):
    """Griffiths and Lane find 1.4, Bishop and Morgenstern 1.380. The demo's own 4 x 4 points a cell have the
    same bracket (`benchmarks/locking.py --only demos`)."""
    options = ("--points-per-cell", "3", "--low", "1.36", "--high", "1.4", "--width", "0.04")
    low, high = run("slope", *options)["factor"]
    assert (low, high) == (1.36, 1.4)  # the first stands and the second fails: within 3 % of both
    assert low > 0.97 * 1.4
    assert high < 1.03 * 1.38


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "edges", "settlement", "size"),
    [(20, "sharp", 0.02, (7.0, 3.5)), (30, "rounded", 0.04, (11.0, 5.0))],
)
def test_footing_on_frictional_soil(folder, degrees, edges, settlement, size):
    """Prandtl's N_c with psi = phi, 14.835 and 30.14, on coarse cells."""
    demo, phi = demo_module("strip_footing"), math.radians(degrees)
    elastic = pm.Hencky.from_engineering(E=demo.YOUNG, nu=demo.POISSON)
    demo.soil = lambda: pm.MohrCoulomb(elastic, phi=phi, psi=phi, c=demo.STRENGTH, edges=edges)
    demo.SETTLEMENT, (demo.LENGTH, demo.DEPTH) = settlement, size
    args = argparse.Namespace(cells=4, points_per_cell=2, steps=20, locking="cured", grid="equal")
    _, loads, _ = demo.solve("bspline", args, folder)
    limit = (math.tan(math.pi / 4 + phi / 2) ** 2 * math.exp(math.pi * math.tan(phi)) - 1) / math.tan(phi)
    assert limit == pytest.approx({20: 14.835, 30: 30.14}[degrees], rel=1e-4)
    assert loads[-1] == pytest.approx(limit, rel=0.05)
