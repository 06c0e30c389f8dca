"""Curves from files, in SI units."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.identification.reading import unit

COMM = MPI.COMM_WORLD


@pytest.fixture
def written(folder):
    def write(text):
        COMM.barrier()
        if COMM.rank == 0:
            (folder / "curve.csv").write_text(text, encoding="utf-8")
        COMM.barrier()
        return folder / "curve.csv"

    return write


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("m", 1.0), ("mm", 1e-3), ("µm", 1e-6), ("um", 1e-6), ("kN", 1e3), ("MPa", 1e6), ("mN m", 1e-3),
        ("N mm", 1e-3), ("N·mm", 1e-3), ("kN/m", 1e3), ("MN/m^2", 1e6), ("N/mm²", 1e6), ("1/m", 1.0),
        ("1/mm", 1e3), ("m^-1", 1.0), ("deg", np.pi / 180), ("%", 0.01), ("-", 1.0), ("", 1.0),
        ("g", 1e-3), ("kg", 1.0), ("min", 60.0), ("ms", 1e-3), ("kN m/m", 1e3), ("mm2", 1e-6),
        ("cm^3", 1e-6), ("psi", 6894.757293168361),
    ],
)  # fmt: skip
def test_units(text, size):
    np.testing.assert_allclose(unit(text), size, rtol=1e-14)


@pytest.mark.parametrize("text", ["furlong", "kdeg", "m^x", "N//foo"])
def test_unknown_units(text):
    with pytest.raises(pm.InputError, match="unit = "):
        unit(text)


def test_units_in_the_header(written):
    file = written(
        "# a wire\n\ntwist (deg), torque [mN m],sd (mN m)\n0,0,.1\n90,2.5,.1\n\n"
        "180,,0.1\n,4,0.1\n270, nan,.1\n"
    )
    curve = pm.read_curve(file, "twist", "torque", sigma="sd")
    np.testing.assert_allclose(curve.x, np.pi * np.array([0, 0.5, 1.0, 1.5]))
    np.testing.assert_allclose(curve.y, [0, 2.5e-3, np.nan, np.nan])
    np.testing.assert_allclose(curve.sigma, 1e-4)
    np.testing.assert_allclose(curve.at([np.pi / 4, 3.0]), [1.25e-3, np.nan])
    assert len(curve) == 4


def test_units_by_the_script_and_other_dialects(written):
    file = written("Weg;Kraft\n0,5;1,5\n1,0;-\n")
    curve = pm.read_curve(file, ("Weg", "mm"), ("Kraft", "kN"), decimal=",")
    np.testing.assert_allclose(curve.x, [5e-4, 1e-3])
    np.testing.assert_allclose(curve.y, [1500, np.nan])
    assert curve.sigma is None


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("a,b\n1,2\n", {"x": "a", "y": "b"}, "unit isn't stated"),
        ("a (mm),b (N)\n1,2\n", {"x": ("a", "m"), "y": "b"}, "the file says 'mm'"),
        ("a (mm),b (N)\n1,2\n", {"x": "a", "y": "c"}, "y = 'c'"),
        ("a (mm),b (N)\n1,two\n", {"x": "a", "y": "b"}, "'two' in row 1"),
        ("a (mm),a (m),b (N)\n1,2,3\n", {"x": "a", "y": "b"}, "one column only"),
        ("a (mm),b (N)\n,2\n", {"x": "a", "y": "b"}, "no numbers"),
        ("a (mm);b (N)\n0,5;1.200\n", {"x": "a", "y": "b", "decimal": ","}, "'1.200' in row 1"),
        ("# nothing\n", {"x": "a", "y": "b"}, "no table"),
        ("a (mm);b (N)\n0,5;1,5\n", {"x": "a", "y": "b"}, r"'0,5' in row 1 .* one with decimal=','"),
        ("a (mm);b (N)\n0.5;1.5\n", {"x": "a", "y": "b", "decimal": ","}, "it is one with decimal='.'"),
        ("a (mm);b (N)\n1.000,5;1\n", {"x": "a", "y": "b", "decimal": ","}, "'1.000,5' in row 1"),
        ("a (mm),b (N)\n0,5,1,5\n", {"x": "a", "y": "b"}, "has 4 entries, its header 2, with ','"),
        ("a (mm);b (N)\n1;2\n", {"x": "a", "y": "b", "delimiter": ","}, "the delimiter is ','"),
        ("a (mm) b (N)\n1 2\n", {"x": "a", "y": "b"}, "the delimiter is ','"),
        ("a (mm),b (N)\n1,2\n", {"x": "a", "y": "b", "decimal": ";"}, "decimal"),
        ("a (mm),b (N)\n1,2\n", {"x": "a", "y": "b", "delimiter": "ab"}, "delimiter"),
    ],
)  # fmt: skip
def test_refused(written, text, options, message):
    with pytest.raises(pm.InputError, match=message):
        pm.read_curve(written(text), **options)


def test_rows_that_lack_something(written):
    """Without an abscissa they are left out; what else isn't there is missing."""
    file = written("u (mm),F (kN),s (kN),\n0,0,0.1,\n0.5\n,1,1\n\n1,2,,\n")
    curve = pm.read_curve(file, "u", "F", sigma="s")
    np.testing.assert_allclose(curve.x, [0, 5e-4, 1e-3])
    np.testing.assert_allclose(curve.y, [0, np.nan, 2e3])
    np.testing.assert_allclose(curve.sigma, [100, np.nan, np.nan])


def test_a_file_that_is_not_there(folder):
    with pytest.raises(pm.InputError, match="can't be read"):
        pm.read_curve(folder / "none.csv", "a", "b")


def test_fields(written):
    file = written("x [mm];y [mm];u [um];v [um]\n0;0;1;2\n1;0;;4\n;1;5;6\n1;1;7;8\n")
    field = pm.read_field(file, ("x", "y"), ("u", ("v", "µm")))
    np.testing.assert_allclose(field.X, [(0, 0), (1e-3, 0), (1e-3, 1e-3)])
    np.testing.assert_allclose(field.values, [(1e-6, 2e-6), (np.nan, 4e-6), (7e-6, 8e-6)])
    with pytest.raises(pm.InputError, match=r"values\[0\] = 'w'"):
        pm.read_field(file, ("x", "y"), ("w",))
    with pytest.raises(pm.InputError, match="places = 'x'"):
        pm.read_field(file, "x", ("u",))
    with pytest.raises(pm.InputError, match="no row has a place"):
        pm.read_field(written("x (mm),u (mm)\n,1\n"), ["x"], ["u"])
