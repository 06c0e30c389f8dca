"""1, 2 and 3 ranks give the same displacements, and the same errors; nobody waits for ever.

This file is also the script that the ranks run: `mpirun -n 2 python test_points_on_ranks.py CASE OUTPUT`.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import release_supports
from tests.helpers.ranks import close, on_ranks

COMM = MPI.COMM_WORLD
MATERIAL = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=7e2, alpha=11.0, beta=13.0, gamma=17.0)
CLASSICAL = pm.NeoHookean(lam=3e3, mu=2e3)
STRICT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-26)


def body(dim: int, material: pm.Material = MATERIAL, **options) -> pm.QuasiStatic:
    """A cantilever between grid planes, so that domains overlap many cells."""
    grid = pm.Grid.box((-1, -3, -2)[:dim], (6, 3, 3)[:dim], 0.5 if dim == 2 else 1.0)
    lower, upper = np.full(dim, 0.12), np.array([4.3, 1.2, 1.2])[:dim]
    points = pm.seed(grid, material=material, bounds=(lower, upper))
    problem = pm.QuasiStatic(grid, points, controls=STRICT, **{**pm.PUBLISHED, **options})
    theta = {"theta": 0} if material.micropolar else {}
    problem.fix(pm.plane(x=0.5 if dim == 2 else 0.0), u=0, **theta)
    return problem


def plane_strain() -> pm.QuasiStatic:
    problem = body(2)
    problem.load(problem.points.farthest((1, 0)), force=(4.0, -8.0), couple=3.0)
    problem.body_load(force=lambda t, X: t * np.stack([X[:, 1], -X[:, 0]], axis=1))
    return problem


def kept_weights() -> pm.QuasiStatic:
    problem = body(2, reset=None, basis="mpm")
    problem.load(problem.points.farthest((1, 0)), force=(4.0, -60.0), couple=30.0)
    return problem


def balanced() -> pm.QuasiStatic:
    """Resets after which initial stresses are carried along."""
    problem = body(2, balanced_reset=True)
    problem.load(problem.points.farthest((1, 0)), force=(4.0, -60.0), couple=30.0)
    return problem


def classical() -> pm.QuasiStatic:
    problem = body(2, CLASSICAL, basis="mpm")
    problem.load(problem.points.farthest((1, 0)), force=(4.0, -8.0))
    return problem


def solid() -> pm.QuasiStatic:
    problem = body(3)
    problem.load(problem.points.farthest((1, 0, 0)), force=(4.0, -8.0, 5.0))
    problem.fix(lambda x: (x[:, 2] < 0.5) & (x[:, 0] > 0.5), uz=lambda t, x: 0.02 * t * x[:, 0])
    return problem


def couples() -> pm.QuasiStatic:
    problem = body(3)
    problem.load(problem.points.farthest((1, 0, 0)), force=(4.0, -8.0, 5.0), couple=(10.0, 5.0, -8.0))
    problem.body_load(couple=(0.5, -0.3, 0.2))
    return problem


def two_points(dim: int = 2, **options) -> pm.QuasiStatic:
    """Fewer points than ranks; all nodes are held but two."""
    grid = pm.Grid.box((0, 0, 0)[:dim], (2, 1, 1)[:dim], 1.0)
    points = pm.seed(grid, material=MATERIAL, points_per_cell=1)
    assert points.total == 2
    options = {**pm.PUBLISHED, "basis": "mpm", **options}
    problem = pm.QuasiStatic(grid, points, controls=STRICT, **options)
    problem.fix(lambda x: (x[:, 0] < 0.5) | np.any(x[:, 1:] > 0.5, axis=1), u=0, theta=0)
    force, couple = (60.0, -40.0, 20.0)[:dim], 10.0 if dim == 2 else (10.0, 20.0, -10.0)
    problem.load(points.farthest((1, 0, 0)[:dim]), force=force, couple=couple)
    return problem


def two_points_with_couples() -> pm.QuasiStatic:
    """The same with an unsymmetric tangent."""
    return two_points(3)


def two_materials() -> pm.QuasiStatic:
    """A second material whose points are on some ranks only."""
    grid = pm.Grid.box((-1, -2), (6, 3), 1.0)
    points = pm.seed(grid, material=MATERIAL, bounds=((0, 0), (2, 1)))
    stiff = pm.MicropolarElastic(lam=3e4, mu=2e4, kappa=7e3, alpha=11.0, beta=13.0, gamma=17.0)
    points.join(pm.seed(grid, material=stiff, bounds=((2, 0), (4, 1))))
    problem = pm.QuasiStatic(grid, points, controls=STRICT, **pm.PUBLISHED)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0)), force=(1.0, -5.0))
    return problem


def splines() -> pm.QuasiStatic:
    """Quadratic B-splines with resets; thin layers of the body in cells that ranks share."""
    grid = pm.Grid.box((0, -3, -2), (6, 3, 3), 1.0)
    points = pm.seed(grid, material=MATERIAL, bounds=((0, 0.2, 0.2), (4.3, 1.8, 1.8)), points_per_cell=3)
    points.x = points.X = points.x + np.array((0.0, 0.24, 0.21))
    problem = pm.QuasiStatic(grid, points, basis="bspline", controls=STRICT, reset=1, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1, 0, 0)), force=(4.0, -8.0, 5.0))
    return problem


def projected() -> pm.QuasiStatic:
    """Cells on other ranks than some of their points."""
    problem = body(3, basis="mpm", assembly="projection")
    problem.load(problem.points.farthest((1, 0, 0)), force=(4.0, -8.0, 5.0), couple=(10.0, 5.0, -8.0))
    problem.fix(lambda x: (x[:, 2] < 0.5) & (x[:, 0] > 0.5), uz=lambda t, x: 0.02 * t * x[:, 0])
    return problem


def projected_corner() -> pm.QuasiStatic:
    """Cells of two ranks that touch at a corner only, the one node that is free."""
    grid = pm.Grid.box((0, 0), (2, 2), 1.0)
    points = pm.seed(grid, lambda x: (x[:, 0] < 1) == (x[:, 1] < 1), material=MATERIAL)
    problem = pm.QuasiStatic(
        grid, points, basis="mpm", assembly="projection", controls=STRICT, reset=1, balanced_reset=False
    )
    problem.fix(lambda x: np.any(x != 1.0, axis=1), u=0, theta=0)
    problem.body_load(force=(100.0, -200.0), couple=30.0)
    return problem


def projected_two_points() -> pm.QuasiStatic:
    """Ranks without cells."""
    return two_points(assembly="projection")


# errors that only some ranks see
def nan_in_a_field() -> pm.QuasiStatic:
    problem = body(2)
    problem.body_load(force=lambda t, X: np.where(X > 4.0, np.nan, 0.0))
    return problem


def contradiction() -> pm.QuasiStatic:
    problem = body(2)
    problem.fix(lambda x: abs(x[:, 0] - 0.5) < 0.1, ux=1.0)
    return problem


def outside() -> pm.QuasiStatic:
    problem = body(2, basis="mpm")
    release_supports(problem)
    problem.fix(lambda x: np.ones(len(x), dtype=bool), ux=lambda t, x: t * x[:, 0], uy=0, theta=0)
    return problem


def far_domains() -> pm.QuasiStatic:
    problem = body(2)
    problem.points.half_length0[problem.points.id == 0] = 10.0
    return problem


def not_converged() -> pm.QuasiStatic:
    problem = body(2)
    problem.load(problem.points.farthest((1, 0)), force=(0.0, -1e6))
    return problem


RUNS = [
    plane_strain,
    kept_weights,
    balanced,
    classical,
    solid,
    couples,
    two_points,
    two_points_with_couples,
    two_materials,
    splines,
    projected,
    projected_corner,
    projected_two_points,
]
ERRORS = [nan_in_a_field, contradiction, outside, far_domains, not_converged]
CASES = {f.__name__: f for f in [*RUNS, *ERRORS]}


def solve(case: str) -> dict:
    """Run a case; results by point id, or the error's message. Collective."""
    problem = CASES[case]()
    try:
        steps = [s.iterations for s in problem.march(3)]
    except pm.PolarMPMError as e:
        return {"error": type(e).__name__, "message": str(e)}
    points = problem.points
    order = np.argsort(np.concatenate(COMM.allgather(points.id)))
    values = {
        "u": points.displacement,
        "w": points.rotation_vector,
        "F": points.F.reshape(-1, 9),
        "wryness": points.wryness.reshape(-1, 9),
        "stress": problem.fields().stress.reshape(-1, 9),
    }
    out = {k: np.concatenate(COMM.allgather(v))[order].tolist() for k, v in values.items()}
    force, couple = problem.reaction(problem.supports[0])
    out |= {"reaction": [*force, *couple], "unknowns": problem.unknowns, "energy": problem.energy()}
    return {**out, "iterations": steps, "ranks_without_points": COMM.allreduce(int(len(points) == 0))}


@functools.cache
def serial(case: str) -> dict:
    return solve(case)


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [2, 3])
@pytest.mark.parametrize("case", [f.__name__ for f in RUNS])
def test_same_answer_on_ranks(case, ranks):
    """Displacements (and all other results) by point id agree with the serial run to 1e-10."""
    expected = serial(case)
    assert "error" not in expected
    assert abs(np.array(expected["u"])).max() > 1e-3
    found = on_ranks(ranks, case, __file__)[0]
    assert "error" not in found, found
    for key in ("u", "F", "stress", "reaction"):
        close(found[key], expected[key])
    if case != "classical":
        close(found["w"], expected["w"])
        close(found["wryness"], expected["wryness"])
    assert found["unknowns"] == expected["unknowns"]
    assert found["energy"] == pytest.approx(expected["energy"], rel=1e-9)
    if ranks == 3 and "two_points" in case:
        assert found["ranks_without_points"] == 1


@pytest.mark.mpi
@pytest.mark.parametrize("case", [f.__name__ for f in ERRORS])
def test_same_error_on_ranks(case):
    """What only one rank can see is raised on both, with the serial message; no rank is left waiting."""
    expected = serial(case)
    assert "error" in expected
    try:
        found = on_ranks(2, case, __file__, timeout=40.0)
    except subprocess.TimeoutExpired:
        pytest.fail("ranks wait for each other")
    assert [f["error"] for f in found] == [expected["error"]] * 2
    if case != "not_converged":  # rounding differs in a diverging run
        assert [f["message"] for f in found] == [expected["message"]] * 2


if __name__ == "__main__":
    result = solve(sys.argv[1])
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps(result))
