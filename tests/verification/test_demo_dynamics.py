"""The demos of dynamics: waves in a micropolar solid, the collapse of a granular column, two discs."""

from __future__ import annotations

import pytest

from polarmpm.study.exact import micropolar_waves
from tests.helpers.demos import demo_result


def test_dispersion_relation():
    """The numbers of docs/dynamics.md, and the cut-off frequency."""
    moduli = {"mu": 4e9, "kappa": 4e8, "stiffness": 4e5, "rho": 2000.0, "j": 25e-6}
    assert micropolar_waves(50.0, **moduli)[0] == pytest.approx([7.18222e4, 2.28783e5], rel=1e-5)
    assert micropolar_waves(200.0, **moduli)[0] == pytest.approx([2.95015e5, 5.94110e5], rel=1e-5)
    assert micropolar_waves(1e-3, **moduli)[0][1] == pytest.approx(1.78885e5, rel=1e-5)


def test_waves(folder):
    """Points with resets, and elements of degree 2, to a hundred-thousandth of the closed form."""
    found = demo_result(folder, "waves", "--numbers", "200", "--periods", "1", "--reset", "1")
    assert found["error"] < 1e-5
    assert found["energy_error"] < 1e-8
    assert {row["method"] for row in found["waves"]} == {"points", "elements"}


@pytest.mark.slow
def test_granular_column(folder):
    """The first moments on a coarse grid: the front begins to run, without any cut step."""
    found = demo_result(folder, "granular_column", "--cells", "0.02", "--time", "0.08", "--steps", "40")
    (run,) = found["runs"]
    assert run["cell"] == 0.02
    assert 0.205 < run["front"] < 0.225
    assert run["cuts"] == 0
    assert abs(run["ledger"]) < 0.02
    assert 0.0 < run["surface_error"] < run["surface_worst"] < 0.05


@pytest.mark.parametrize(("reset", "least"), [("0", 0.965), ("1", 0.97)], ids=["never", "each-step"])
def test_discs_rebound(folder, reset, least):
    """On coarse cells: the discs meet when they touch, keep their momentum and energy, and bounce; resets
    take little of that."""
    options = ("--cells", "0.1", "--steps", "80", "--points-per-cell", "4", "--reset", reset)
    found = demo_result(folder, "discs", *options)
    assert found["momentum"] < 1e-12
    assert found["energy_error"] < 0.01
    assert least < found["restitution"] < 1.0  # of the centre of mass; on cells of half the size above .97
    assert abs(found["gap_cells"]) < 0.5


def test_discs_through_their_nodes(folder):
    """The same discs as one body: they feel each other from afar."""
    options = ("--cells", "0.1", "--steps", "80", "--points-per-cell", "4", "--reset", "1")
    found = demo_result(folder, "discs", *options, "--contact", "nodes")
    assert found["momentum"] < 1e-12
    assert found["energy_error"] < 0.05
    assert 0.8 < found["restitution"] < 1.0
    assert 1.0 < found["gap_cells"] < 4.0
