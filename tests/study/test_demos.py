"""Every demo runs at a coarse setting, serially and on two ranks, writes its files, and finds its number."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.helpers.demos import DEMOS, run_demo

KEYS = {
    "case",
    "parameters",
    "result",
    "iterations",
    "points",
    "unknowns",
    "cpu_s",
    "peak_memory_mb",
    "version",
}

# demo, options, files written
CASES = {
    "manufactured_solution": (
        ["--cell", "0.125"],
        ["manufactured.pvd", "convergence.png"],
    ),
    "cantilever_2d": (
        ["--points-per-cell", "2", "--steps", "10"],
        ["cantilever_a.pvd", "cantilever_b.csv", "cantilever.png"],
    ),
    "torsion": (
        ["--cell", "0.5", "--steps", "4", "--moment", "4e6"],
        ["shaft.pvd", "shaft.csv", "shaft.png"],
    ),
    "curved_cantilever": (
        ["--cell", "2"],
        ["arch.pvd", "arch_grid.pvd", "arch.csv", "arch.png", "arch.pdf"],
    ),
    "curved_cantilever_fem": ([], ["arch.pvd", "arch.csv", "arch.png"]),
}
ELEMENTS = {"curved_cantilever_fem"}  # demos with finite elements


def run(name, folder, ranks=1):
    """The JSON object that a demo prints as its last line."""
    options, files = CASES[name]
    found = run_demo(name, folder, *options, ranks=ranks)
    for file in files:
        assert (folder / file).stat().st_size > 0, file
    return found


def numbers(name, result):
    """The numbers by which serial and parallel runs are compared."""
    keys = {
        "manufactured_solution": ["errors"],
        "cantilever_2d": ["tip_a", "tip_b"],
        "torsion": ["turns", "length"],
        "curved_cantilever": ["displacement"],
        "curved_cantilever_fem": ["displacement"],
    }[name]
    flat = [result[k] for k in keys]
    if name == "manufactured_solution":
        flat = [list(e.values()) for e in result["errors"]]
    return np.concatenate([np.atleast_1d(v) for v in flat])


@pytest.mark.mpi
@pytest.mark.parametrize("name", sorted(CASES))
def test_demo_finds_its_number_and_two_ranks_find_the_same(name, tmp_path):
    """Also: the JSON has the same keys in every demo, and a figure and ParaView files are written."""
    serial = run(name, tmp_path / "serial")
    assert set(serial) == KEYS | ({"elements"} if name in ELEMENTS else set())
    assert serial["case"] == name
    assert serial["cpu_s"]["total"] > 0
    parallel = run(name, tmp_path / "parallel", ranks=2)
    assert parallel["parameters"]["ranks"] == 2
    assert parallel["points"] == serial["points"]
    np.testing.assert_allclose(
        numbers(name, parallel["result"]), numbers(name, serial["result"]), rtol=1e-8, atol=1e-10
    )
    check = {
        "manufactured_solution": lambda r: r["orders"]["displacement"][-1] > 1.5,
        "cantilever_2d": lambda r: -7.2 < r["tip_a"][1] < -6.2 and -0.95 < r["tip_b"][1] < -0.8,
        "torsion": lambda r: 0.14 < r["turns"] < 0.18,
        "curved_cantilever": lambda r: r["error"] < 6.1,
        "curved_cantilever_fem": lambda r: np.allclose(r["displacement"], r["published"], rtol=0, atol=0.005),
    }[name]
    assert check(serial["result"]), serial["result"]


@pytest.mark.mpi
@pytest.mark.parametrize("name", sorted(CASES))
def test_demo_explains_itself(name):
    done = subprocess.run(
        [sys.executable, str(DEMOS / f"{name}.py"), "--help"],
        capture_output=True,
        text=True,
        timeout=120,
        env=dict(os.environ),
        check=False,
    )
    assert done.returncode == 0
    of_body = ("--elements", "--degree") if name in ELEMENTS else ("--cell", "--points-per-cell", "--basis")
    for option in (*of_body, "--steps", "--output", "--json"):
        assert option in done.stdout
