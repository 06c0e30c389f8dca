"""What other libraries write stays off the terminal where their errors are handled."""

from __future__ import annotations

import os
import subprocess
import sys

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.solvers.direct import DirectSolver
from polarmpm.solvers.linear import SingularTangent
from polarmpm.tools import quiet
from tests.helpers.ranks import environment


def test_errors_of_ufl_are_raised_and_not_printed(capfd):
    grid = pm.Grid.box((0.0, 0.0), (2.0, 2.0), 1.0)
    for energy in (lambda E, G, p: p.k * (E[0, 0] + E), lambda E, G, p: p.k * E[5, 5]):
        material = pm.UserEnergy(energy, {"k": 1.0})
        with pytest.raises(pm.InputError, match="can't be evaluated"):
            pm.QuasiStatic(grid, pm.seed(grid, bounds=((0, 0), (1, 1)), material=material))
    assert capfd.readouterr() == ("", "")


def matrix(diagonal):
    """The upper triangle of a diagonal matrix with an entry beside it."""
    n = len(diagonal)
    out = PETSc.Mat().createSBAIJ([n, n], 1, nnz=n, comm=MPI.COMM_SELF)
    for i, d in enumerate(diagonal):
        out[i, i] = d
    out[0, 1] = 0.5
    out.assemble()
    return out


@pytest.mark.parametrize("repeated", [False, True])
def test_indefinite_and_singular_tangents_print_nothing(capfd, repeated):
    """CHOLMOD and MUMPS fail, and others are tried."""
    diagonal = np.ones(20)
    diagonal[7] = -1.0
    for _ in range(1 + repeated):
        solver = DirectSolver(matrix(diagonal), symmetric=True)
        solver.factor()
        np.testing.assert_allclose(solver.solve(diagonal)[2:], 1.0)
        solver.destroy()
    singular = DirectSolver(matrix(np.zeros(20)), symmetric=True)
    try:
        singular.factor()
        singular.solve(np.ones(20))
    except SingularTangent:
        pass
    singular.destroy()
    assert capfd.readouterr() == ("", "")


def test_what_is_written_while_compiling_is_in_the_error(capfd):
    class VerificationError(Exception):
        """Of the name of cffi's."""

    def fail():
        with quiet.compiler():
            os.system("echo from a child >&2")
            raise VerificationError("bad code")

    with pytest.raises(pm.KernelError, match=r"form: bad code; install gcc.*\nfrom a child"):
        fail()
    with quiet.compiler():
        os.write(2, b"a warning")
    os.write(2, b"after")
    assert capfd.readouterr() == ("", "after")


def test_without_standard_error(capfd):
    kept = os.dup(2)
    os.close(2)
    try:
        with quiet.compiler():
            pass
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def test_warnings_stay_warnings_and_the_root_logger_as_it_is():
    """The form compiler's import would turn all warnings into log records."""
    script = """
import logging, warnings
show, root = warnings.showwarning, logging.getLogger()
import polarmpm, dolfinx.fem
assert warnings.showwarning is show
assert not root.handlers and root.level == logging.WARNING
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60, env=environment())
