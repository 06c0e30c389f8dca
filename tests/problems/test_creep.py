"""Steps at which Newton's method fails, followed as the body creeps to its equilibrium."""

import math

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh

import polarmpm as pm

COMM = MPI.COMM_WORLD
HENCKY = pm.Hencky.from_engineering(E=1e4, nu=0.3)
SAND = pm.MohrCoulomb(HENCKY, phi=math.radians(25), psi=0.0, c=2.0)


def bank(kind: str, iterations: int, material=SAND) -> pm.QuasiStatic | pm.QuasiStaticFEM:
    """A steep bank under a weight that it bears, part of it flowing."""
    controls = pm.Controls(max_iterations=iterations)
    if kind == "elements":
        body = mesh.create_rectangle(COMM, [(0, 0), (2, 1)], [8, 4], mesh.CellType.quadrilateral)
        problem = pm.QuasiStaticFEM(pm.Elements(body, material=material, degree=2), controls=controls)
    else:
        grid = pm.Grid.box((0, 0), (2, 1), 0.25)
        points = pm.seed(grid, material=material, points_per_cell=2)
        problem = pm.QuasiStatic(grid, points, basis=kind, reset=None, controls=controls, boxes=False)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), u=0)
    problem.body_load(force=(0, -11.0))
    return problem


def furthest(problem) -> float:
    u = problem.points.displacement
    own = float(np.sqrt((u * u).sum(axis=1)).max(initial=0.0))
    return COMM.allreduce(own, op=MPI.MAX)


@pytest.mark.filterwarnings("ignore::polarmpm.TrustWarning")
@pytest.mark.parametrize("kind", ["elements", "bspline"])
def test_creep_ends_in_the_equilibrium(kind):
    """With so few iterations Newton's method fails in one step; the state is that of many iterations."""
    exact = bank(kind, 25)
    (whole,) = exact.march(1, progress=False)
    assert whole.iterations > 4
    problem = bank(kind, 4)
    assert not problem.attempt(1.0).converged
    assert problem.progress.step == 0
    (step,) = problem.march(1, progress=False)
    assert step.iterations > 8
    assert step.history[-1][0] < 1e-9
    assert furthest(problem) == pytest.approx(furthest(exact), rel=1e-6)
    assert problem.system.viscosity is None
    balance = problem.energies()
    assert balance["external"] == pytest.approx(exact.energies()["external"], rel=1e-6)


@pytest.mark.filterwarnings("ignore::polarmpm.TrustWarning")
def test_without_an_equilibrium_the_state_stays():
    """All iterations are used up, or points can't be returned; then a step goes on as if nothing had been."""
    problem = bank("elements", 4)
    problem.body_load(force=lambda factor: (0.0, -100.0 * (factor > 0.5)))
    outcome = problem.attempt_creeping(1.0)
    assert not outcome.converged
    assert outcome.reason
    assert furthest(problem) == 0.0
    (step,) = problem.march(1, to=0.4, progress=False)
    assert step.number == 1


def test_elastic_bodies_do_not_creep():
    problem = bank("elements", 4, HENCKY)
    outcome = problem.attempt_creeping(1.0)
    assert (outcome.converged, outcome.iterations) == (False, 0)
