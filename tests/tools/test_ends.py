"""An error or exit on one rank ends the run with its message and a status other than 0, within seconds."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from tests.helpers.ranks import ending, environment

pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]

START = """
import os, sys, time
import numpy as np
from mpi4py import MPI
import polarmpm as pm
comm = MPI.COMM_WORLD
bad = comm.rank == comm.size - 1
def fails():
    if bad:
        raise ZeroDivisionError("of the script")
def body():
    grid = pm.Grid.box((-1, -1), (4, 2), 0.5)
    points = pm.seed(grid, material=pm.NeoHookean(lam=3e3, mu=2e3), bounds=((0, 0), (3, 1)))
    problem = pm.QuasiStatic(grid, points, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.body_load(force=(0, -3.0))
    return problem
def steps():
    return body().march(2, progress=False)
"""

# lines, ranks, status (None: any but 0), what is written and how often
ENDS = {
    "all is well": ("list(steps())", 3, 0, {"Error": 0, "rank": 0}),
    "an error": (
        "for step in steps(): fails()",
        2,
        1,
        {"rank 1 of 2:": 1, "Traceback": 1, "Error: of the script": 1},
    ),
    "an error at first": ("fails(); list(steps())", 3, 1, {"rank 2 of 3:": 1, "Traceback": 1}),
    "others at a barrier": ("body(); fails(); comm.Barrier()", 2, 1, {"rank 1 of 2:": 1, "Traceback": 1}),
    "in a function": (
        "body().points.where(lambda x: fails() or x[:, 0] > 1)",
        3,
        1,
        {"rank 2 of 3:": 1, "Traceback": 1},
    ),
    "the same error": ("list(steps()); 1 / 0", 3, 1, {"all 3 ranks:": 1, "Traceback": 1}),
    "exit with a status": (
        "for step in steps():\n    if bad: sys.exit(7)",
        2,
        None,
        {"rank 1 of 2: sys.exit(7)": 1},
    ),
    "exit with 0": (
        "for step in steps():\n    if bad: sys.exit()",
        3,
        1,
        {"rank 2 has ended": 1, "Traceback": 1},
    ),
    "all exit": ("body(); sys.exit(5)", 2, 5, {"of 2": 0}),
    "at another call": ("for step in steps():\n    if bad: body()", 2, 1, {"RanksApart": 1, "Traceback": 1}),
    "a function exits": (
        "body().points.where(lambda x: sys.exit(4) if bad else x[:, 0] > 1)",
        2,
        None,
        {"rank 1 of 2: sys.exit(4)": 1, "Traceback": 0},
    ),
    "killed": ("for step in steps():\n    if bad: os.kill(os.getpid(), 9)", 2, None, {}),
}


@pytest.mark.parametrize("name", ENDS)
def test_ends(name):
    code, ranks, status, written = ENDS[name]
    found, text = ending(ranks, f"{START}\n{code}\n")
    assert found == status if status is not None else found != 0, text
    kept = "\n".join(
        line for line in text.splitlines() if "Process name" not in line and "MPI_ABORT" not in line
    )
    for words, times in written.items():
        assert kept.count(words) == times, f"{words}: {kept}"


def test_what_is_inside_of_a_call_ends_too():
    """A rank that fails where the others can't learn of it ends all after a while."""
    code = """
from polarmpm.tools import meetings
meetings._PATIENCE = 2.0
problem = body()
problem._check = lambda increments: fails() or (comm.allreduce(1) and "")
try:
    list(problem.march(1, progress=False))
except ZeroDivisionError:
    pass
"""
    begin = time.monotonic()
    status, text = ending(2, START + code)
    assert status == 1
    assert "rank 1 of 2:\nTraceback" in text
    assert "of the script" in text
    assert time.monotonic() - begin < 60


def test_a_hook_that_is_there_is_called():
    code = (
        """
import sys
sys.excepthook = lambda kind, error, trace: sys.stdout.write(f"hooked {error}\\n")
"""
        + START
    )
    status, text = ending(2, f"{code}\nfor step in steps(): fails()\n")
    assert status == 1
    assert text.count("hooked of the script") == 1
    assert "Traceback" not in text


def test_one_rank_alone_has_no_hooks():
    code = "import sys; hook = sys.excepthook; leave = sys.exit; import polarmpm; "
    code += "assert sys.excepthook is hook and sys.exit is leave"
    subprocess.run([sys.executable, "-c", code], env=environment(), check=True, timeout=60)
    assert os.environ.get("OMPI_COMM_WORLD_SIZE") in (None, "1")
