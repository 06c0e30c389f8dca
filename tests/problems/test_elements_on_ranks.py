"""Finite elements on 1, 2 and 3 ranks: the same answers and the same errors, also on ranks without cells.

This file is also the script that the ranks run: `mpirun -n 2 python test_fem_parallel.py CASE OUTPUT`.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import polarmpm as pm
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, release_supports
from tests.helpers.bodies import box, cantilever, everywhere
from tests.helpers.ranks import close, on_ranks
from tests.problems.test_points_on_ranks import STRICT


def all_loads() -> pm.QuasiStaticFEM:
    """Every kind of load on a plane mesh, some on facets that few ranks have."""
    problem = cantilever("triangle", cells=(8, 3), controls=STRICT)
    problem.load(problem.elements.farthest((1, 0)), force=(4.0, -8.0), couple=3.0)
    problem.pressure(lambda x: (x[:, 1] > 0.99) & (x[:, 0] > 3.4), 20.0)
    problem.traction(pm.plane(y=0.0), force=lambda t, X: t * X, couple=2.0, follows=True)
    problem.body_load(force=lambda t, X: t * np.stack([X[:, 1], -X[:, 0]], axis=1))
    return problem


def quadratic() -> pm.QuasiStaticFEM:
    problem = cantilever("quadrilateral", degree=2, cells=(5, 2), distort=0.08, controls=STRICT)
    release_supports(problem)
    problem.fix(lambda x: x[:, 0] < 0.1, u=0, theta=0)
    problem.load(lambda x: x[:, 0] > 3.8, force=(4.0, -8.0), couple=3.0)
    return problem


def solid() -> pm.QuasiStaticFEM:
    """Couples in space, an unsymmetric tangent."""
    problem = cantilever("hexahedron", cells=(4, 2, 2), controls=STRICT)
    problem.load(pm.plane(x=4.0), force=(4.0, -8.0, 5.0), couple=(10.0, 5.0, -8.0))
    problem.body_load(couple=(0.5, -0.3, 0.2))
    return problem


def classical() -> pm.QuasiStaticFEM:
    problem = cantilever("tetrahedron", NEO_HOOKEAN, cells=(4, 2, 2), controls=STRICT)
    problem.load(pm.plane(x=4.0), force=(4.0, -8.0, 5.0))
    return problem


def two_materials() -> pm.QuasiStaticFEM:
    """A second material whose cells are on some ranks only."""
    from dolfinx import mesh as dmesh

    mesh = box("quadrilateral", (8, 2), (4.0, 1.0))
    count = mesh.topology.index_map(2).size_local + mesh.topology.index_map(2).num_ghosts
    cells = np.arange(count, dtype=np.int32)
    middle = dmesh.compute_midpoints(mesh, 2, cells)
    tags = dmesh.meshtags(mesh, 2, cells, np.where(middle[:, 0] < 0.6, 1, 2).astype(np.int32))
    stiff = pm.MicropolarElastic(lam=3e4, mu=2e4, kappa=7e3, alpha=11.0, beta=13.0, gamma=17.0)
    problem = pm.QuasiStaticFEM(
        pm.Elements(mesh, material={1: MICROPOLAR, 2: stiff}, cells=tags), controls=STRICT
    )
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(pm.plane(x=4.0), force=(4.0, -8.0))
    return problem


def two_cells() -> pm.QuasiStaticFEM:
    """Fewer cells than ranks, with a load whose tangent has its own form."""
    problem = cantilever(cells=(2, 1), controls=STRICT)
    problem.load(pm.plane(x=4.0), force=(4.0, -8.0), couple=3.0)
    problem.pressure(pm.plane(x=4.0), 10.0)
    return problem


# errors that only some ranks see
def nan_in_a_field() -> pm.QuasiStaticFEM:
    problem = cantilever(cells=(8, 2))
    problem.traction(pm.plane(y=1.0), force=lambda t, X: np.where(X > 3.9, np.nan, 0.0))
    return problem


def bad_predicate() -> pm.QuasiStaticFEM:
    problem = cantilever(cells=(8, 2))
    problem.load(lambda x: x[:, 0] > 9.0, force=1.0)
    return problem


def tangled() -> pm.QuasiStaticFEM:
    mesh = box("quadrilateral", (8, 2), (4.0, 1.0))
    x = mesh.geometry.x
    x[np.hypot(x[:, 0] - 3.5, x[:, 1] - 0.5) < 1e-6, 0] = 4.2
    return pm.QuasiStaticFEM(pm.Elements(mesh, material=MICROPOLAR))


def inside_out() -> pm.QuasiStaticFEM:
    problem = cantilever(cells=(8, 2))
    problem.fix(everywhere, ux=lambda t, x: -2.0 * t * np.maximum(x[:, 0] - 3.0, 0.0), uy=0, theta=0)
    return problem


RUNS = [all_loads, quadratic, solid, classical, two_materials, two_cells]
ERRORS = [nan_in_a_field, bad_predicate, tangled, inside_out]
CASES = {f.__name__: f for f in [*RUNS, *ERRORS]}


def by_number(values, numbers):
    order = np.argsort(np.concatenate(COMM.allgather(numbers)))
    return np.concatenate(COMM.allgather(values))[order].tolist()


def solve(case: str) -> dict:
    """Run a case; results by point id, or the error's message. Collective."""
    try:
        problem = CASES[case]()
        steps = [s.iterations for s in problem.march(1 if CASES[case] in ERRORS else 3)]
    except pm.PolarMPMError as e:
        return {"error": type(e).__name__, "message": str(e)}
    e, p = problem.elements, problem.points
    values = {
        "X": p.X,
        "u": p.displacement,
        "w": p.rotation_vector,
        "F": p.F.reshape(-1, 9),
        "wryness": p.wryness.reshape(-1, 9),
        "stress": problem.fields().stress.reshape(-1, 9),
    }
    out = {name: by_number(v, p.id) for name, v in values.items()}
    end = e.facets(lambda x: x[:, 0] > 3.8)
    force, couple = problem.reaction(problem.supports[0])
    out |= {"reaction": [*force, *couple], "unknowns": [problem.unknowns], "energy": [problem.energy()]}
    out |= {"end": [*e.mean_displacement(end), end.area], "mean": e.mean_displacement().tolist()}
    return {**out, "iterations": steps, "empty": COMM.allreduce(int(len(p) == 0))}


@functools.cache
def serial(case: str) -> dict:
    return solve(case)


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [2, 3])
@pytest.mark.parametrize("case", [f.__name__ for f in RUNS])
def test_same_answer_on_ranks(case, ranks):
    """All results by point id, reactions and mean values agree with the serial run to 1e-10."""
    expected = serial(case)
    assert "error" not in expected, expected
    assert abs(np.array(expected["u"])).max() > 1e-3
    found = on_ranks(ranks, case, script=__file__)[0]
    assert "error" not in found, found
    for name in set(expected) - {"iterations", "empty"}:
        if case != "classical" or name not in ("w", "wryness"):
            close(found[name], expected[name])
    if (ranks, case) == (3, "two_cells"):
        assert found["empty"] > 0


@pytest.mark.mpi
@pytest.mark.parametrize("case", [f.__name__ for f in ERRORS])
def test_same_error_on_ranks(case):
    """What only one rank can see is raised on both, with the serial message; no rank is left waiting."""
    expected = serial(case)
    assert "error" in expected
    try:
        found = on_ranks(2, case, timeout=40.0, script=__file__)
    except subprocess.TimeoutExpired:
        pytest.fail("ranks wait for each other")
    assert [(f["error"], f["message"]) for f in found] == [(expected["error"], expected["message"])] * 2


if __name__ == "__main__":
    Path(sys.argv[2], f"{COMM.rank}.json").write_text(json.dumps(solve(sys.argv[1])))
