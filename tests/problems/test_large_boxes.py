"""Points with boxes as large as a cell, which resets would leave in two cells.

This file is also the script that the ranks run: `mpirun -n 3 python test_large_boxes.py CASE OUTPUT`.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.bodies.splitting import parts_of_large
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN
from tests.helpers.ranks import close, on_ranks, report

STEPS = 8
GRID = pm.Grid.box((0, -6), (7, 2), 0.5)


def cantilever(
    number: int = 1, material: pm.Material = NEO_HOOKEAN, **options: Any
) -> tuple[Any, pm.Selection]:
    """6 x 1 m, two cells across, with a load at its end under which it bends far."""
    points = pm.seed(GRID, bounds=((0, 0), (6, 1)), material=material, points_per_cell=number)
    problem = pm.QuasiStatic(GRID, points, **{"reset": 1, **options})
    problem.fix(pm.plane(x=0.0), u=0)
    tip = points.farthest((1, 0))
    problem.load(tip, force=(0, -25.0))
    return problem, tip


def march(problem: Any, steps: int = STEPS) -> None:
    list(problem.march(steps - problem.progress.step, to=steps / STEPS, progress=False))


def test_resets_of_points_with_one_a_cell_move_the_answer_by_little(capfd):
    """Without splitting they are 4.3 % off."""
    problem, tip = cantilever()
    number = problem.points.total
    march(problem, 1)
    assert problem.points.total == number  # without a reset nothing has to be split
    march(problem)
    points = problem.points
    assert points.total == 4 * number
    other, _ = cantilever(reset=pm.Never())
    march(other)
    far, expected = points.mean_displacement(tip), other.points.mean_displacement(tip)
    assert np.linalg.norm(far - expected) < 1e-2 * np.linalg.norm(far)
    assert max(problem.balance().residue) < 1e-7
    lines = [line for line in capfd.readouterr().err.splitlines() if "split" in line]
    assert len(lines) == (COMM.rank == 0)
    assert all("step 2: 24 of 24 points have been split, 96 since" in line for line in lines)


@pytest.mark.parametrize(
    ("number", "options"),
    [(2, {}), (1, {"reset": pm.Never()}), (1, {"boxes": False}), (1, pm.PUBLISHED)],
    ids=["two points", "no resets", "no boxes", "published"],
)
def test_other_points_stay_whole(number, options):
    problem, _ = cantilever(number, **options)
    before = problem.points.total
    for load in problem.loads:
        problem.release(load)
    march(problem, 3)
    assert problem.points.total == before
    assert problem.points.lineage is None


def test_how_large_boxes_are():
    """Over the cells in which they were seeded, along their own axes; in space, and graded, too."""
    grid = pm.Grid.graded(x=[0, 1, 2, 4, 8], y=np.linspace(0, 4, 5), z=np.linspace(0, 2, 3))
    x = np.array([[0.5, 0.5, 0.5], [3.0, 0.5, 0.5], [1.5, 2.5, 0.5], [1.5, 2.5, 0.5]])
    turn = np.array([[1, 1, 0], [-1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    axes = np.stack([np.diag([0.5, 0.25, 0.37]), np.diag([0.5, 0.38, 1.0]), 0.5 * turn, 0.24 * turn])
    points = pm.Points(x, np.ones(4), np.full((4, 3), 0.5), NEO_HOOKEAN, COMM, half_axes=axes)
    expected = [[2, 1, 1], [1, 2, 4], [2, 2, 2], [1, 1, 1]]
    np.testing.assert_array_equal(parts_of_large(points, grid), expected)


def test_restart(tmp_path):
    whole, tip = cantilever(material=MICROPOLAR)
    march(whole, 5)
    path = COMM.bcast(str(tmp_path / "state"))
    part, _ = cantilever(material=MICROPOLAR)
    march(part, 3)
    pm.save_restart(part, path)
    again, held = cantilever(material=MICROPOLAR)
    pm.load_restart(again, path)
    assert again.points.total == part.points.total == 96
    march(again, 5)
    np.testing.assert_allclose(
        again.points.mean_displacement(held), whole.points.mean_displacement(tip), rtol=1e-9
    )
    with pytest.raises(pm.InputError, match="points have been split since it was made"):
        pm.load_restart(again, path)


def answers(case: str = "micropolar") -> dict[str, Any]:
    problem, tip = cantilever(material=MICROPOLAR)
    march(problem, 4)
    return {"end": problem.points.mean_displacement(tip).tolist(), "points": problem.points.total}


@pytest.mark.mpi
@pytest.mark.timeout(120)
def test_ranks_agree():
    serial = answers()
    for found in on_ranks(3, "micropolar", script=__file__):
        close(found["end"], serial["end"])
        assert found["points"] == serial["points"]


def test_points_that_cannot_be_split_are_doubted():
    """Contact goes along with points one by one."""
    problem, _ = cantilever()
    problem.obstacle(pm.HalfSpace((0, -5.9), (0, 1)))
    before = problem.points.total
    march(problem, 1)
    told = pytest.warns(pm.TrustWarning, match="24 points have boxes as large as a cell")
    with told if COMM.rank == 0 else nullcontext():
        march(problem, 2)
    assert problem.points.total == before


def test_derivatives_of_runs_that_split():
    """Twins go along; the tangent-linear run is refused."""

    def build(p: dict[str, float]) -> Any:
        problem, tip = cantilever(material=pm.NeoHookean(lam=3e3, mu=p["mu"]))
        return problem, {"end": lambda: problem.points.mean_displacement(tip)[1]}

    def value(mu: float) -> float:
        problem, observables = build({"mu": mu})
        march(problem, 3)
        return float(observables["end"]())

    with pm.Sensitivity(build, {"mu": 2e3}, method="twins") as run:
        list(run.march(3, to=3 / STEPS, progress=False))
        found = run.rates["end"]["mu"]
    assert found == pytest.approx((value(2000.2) - value(1999.8)) / 0.4, rel=1e-5)
    with pm.Sensitivity(build, {"mu": 2e3}, method="exact") as run:
        march_of_run = run.march(3, to=3 / STEPS, progress=False)
        next(march_of_run)
        with pytest.raises(pm.InputError, match="points that a reset splits"):
            next(march_of_run)


if __name__ == "__main__":
    report(answers)
