"""Shear bands in plane strain, with the thesis' numbers: the biaxial test and the column collapse."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.demos import run_demo


@pytest.mark.slow
@pytest.mark.mpi
def test_biaxial_bands_are_the_materials_own(tmp_path):
    """T 4.5.1: 21 mm wide, at 50 degrees, steeper with dilatancy, 0.68 rad; no matter how wide the cells."""
    found = run_demo("biaxial", tmp_path)["result"]
    assert found["cell"] == [2.5e-3, 2.5e-3, 2.5e-3, 1.25e-3]
    assert found["dilatancy"] == [0.0, 10.0, 20.0, 10.0]
    flat, coarse, steep, fine = range(4)
    for column in (coarse, fine):
        assert abs(found["width"][column] - 0.021) <= 0.003
        assert 50.0 <= found["inclination"][column] <= 60.0
        assert found["rotation"][column] == pytest.approx(0.68, rel=0.1)
        assert found["hardening"][column] == pytest.approx(1.1, rel=0.1)  # T's figure, read off
    assert found["peak"][coarse] == pytest.approx(found["peak"][fine], rel=0.05)
    assert found["residual"][coarse] == pytest.approx(found["residual"][fine], rel=0.05)
    assert found["residual"][fine] < 0.95 * found["peak"][fine]  # softening without any in the material
    assert found["inclination"][flat] < found["inclination"][coarse] < found["inclination"][steep]
    assert found["peak"][flat] < found["peak"][coarse] < found["peak"][steep]
    assert (tmp_path / "biaxial.png").stat().st_size > 0
    assert (tmp_path / "biaxial_2.5mm_10deg.pvd").stat().st_size > 0


@pytest.mark.mpi
def test_biaxial_on_two_ranks(tmp_path):
    options = ("--cells", "5e-3", "--dilatancies", "10", "--steps", "20", "--basis", "gimpm")
    one, two = (run_demo("biaxial", tmp_path / str(n), *options, ranks=n)["result"] for n in (1, 2))
    for name in ("peak", "residual", "rotation", "hardening", "inclination"):
        np.testing.assert_allclose(two[name], one[name], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.mpi
def test_column_collapses_far_past_its_limit_load(tmp_path):
    """T 4.5.3: 12 x 12 cells to 0.45 m; the thesis' 24 x 24 cells stop just past the elastic range."""
    found = run_demo("column_collapse", tmp_path, "--cells", "12", "24")["result"]
    assert np.all(np.array(found["settlement"]) >= 0.45)
    # load steps of 1 kN/m^3: points at the toe yield within the step that ends at 5 (T: at 6)
    assert np.all(np.abs(np.array(found["first_yield"]) - 5e3) <= 1.5e3)
    coarse, fine = found["limit"]
    assert fine < coarse  # the coarse one locks
    assert found["weight"][0] < 0.95 * coarse  # past a limit point, which load control can't pass
    assert max(found["ghost_share"]) < 0.05
