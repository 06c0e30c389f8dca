"""Small runs whose answers depend on parameters, as `pm.Sensitivity` builds them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import polarmpm as pm
from tests.helpers.bodies import box
from tests.helpers.ranks import on_ranks, report

TIGHT = pm.Controls(force_tolerance=1e-12, energy_tolerance=1e-30, max_iterations=40)
BEAM = {"E": 12.5e6, "n": 0.5, "l": 0.3}
SOIL = {"mu": 8e6, "kappa": 4e6, "l": 5e-3, "c": 1e5, "H": -2e5}


def elastic(p: dict[str, float]) -> pm.Material:
    return pm.MicropolarElastic.from_engineering(E=p["E"], nu=0.25, n=p["n"], l_b=p["l"], l_t=p["l"], psi=1.0)


def soil(p: dict[str, float]) -> pm.Material:
    part = pm.MicropolarElastic.bounded_stiffness(lam=8e6, mu=p["mu"], kappa=p["kappa"], l_b=p["l"])
    return pm.DruckerPrager(part, cone="compression", phi=0.5, psi=0.15, c=p["c"], H=p["H"], l_p=2e-3)


def cantilever(p: dict[str, float], *, force: float = 4e4, reset: Any = 1, **options: Any) -> Any:
    """Its points cross planes of the grid; no two of them lie on one."""
    grid = pm.Grid.box((0, -3), (6, 3), 1.0)
    points = pm.seed(grid, bounds=((0, 0.13), (4.7, 1.21)), material=elastic(p), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=reset, **options)
    root, tip = problem.fix(pm.plane(x=0.0), u=0, theta=0), points.farthest((1, 0))
    problem.load(tip, force=(0, -force))
    return problem, {
        "tip": lambda: points.mean_displacement(tip),
        "root": lambda: problem.reaction(root).couple[0],
    }


def column(p: dict[str, float], *, pressed: float = 0.002, reset: Any = 1, **options: Any) -> Any:
    """A quarter of a column of soil under a platen, which softens."""
    grid = pm.Grid.box((0, 0), (0.03, 0.02), 5e-3)
    points = pm.seed(grid, bounds=((0, 0), (0.0125, 0.02)), material=soil(p), points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=reset, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    top = problem.fix(pm.plane(y=0.02, moving=True), ux=0, uy=-pressed)
    return problem, {"force": lambda: problem.reaction(top).force[1], "side": lambda: points.mean(points.x)}


def elements(p: dict[str, float], **options: Any) -> Any:
    """The same of elements."""
    body = pm.Elements(box("quadrilateral", (2, 3), (0.0125, 0.02)), material=soil(p), degree=2)
    problem = pm.QuasiStaticFEM(body, **options)
    problem.fix(pm.plane(x=0.0), ux=0)
    problem.fix(pm.plane(y=0.0), uy=0)
    top = problem.fix(pm.plane(y=0.02), ux=0, uy=-0.002)
    return problem, {"force": lambda: problem.reaction(top).force[1]}


def held_on_surfaces(p: dict[str, float], **options: Any) -> Any:
    """A strip that springs hold on its left side, under a pressure that turns with it."""
    grid = pm.Grid.box((0, -2), (5, 3), 1.0)
    points = pm.seed(grid, bounds=((0.1, 0.1), (4.2, 1.3)), material=elastic(p), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    left = _side(np.full(8, 0.1), 0.1 + 0.15 * (np.arange(8) + 0.5), 0.15, (-1.0, 0.0))
    top = _side(0.1 + 0.205 * (np.arange(20) + 0.5), np.full(20, 1.3), 0.205, (0.0, 1.0))
    support, tip = problem.fix(left, u=0), points.farthest((1, 0))
    problem.pressure(top, 2e5 * p["l"])
    return problem, {
        "tip": lambda: points.mean_displacement(tip),
        "held": lambda: problem.reaction(support).force,
    }


def _side(x: np.ndarray, y: np.ndarray, length: float, normal: Sequence[float]) -> pm.Surface:
    return pm.Surface(np.stack([x, y], axis=1), np.full(len(x), length), np.tile(normal, (len(x), 1)))


def arch(p: dict[str, float], **options: Any) -> Any:
    """Half of a shallow arch, which snaps through."""
    grid = pm.Grid.box((0, -4), (10, 3), 0.5)

    def inside(x: np.ndarray) -> np.ndarray:
        return np.abs(x[:, 1] - 0.15 * x[:, 0]) < 0.25

    points = pm.seed(grid, inside=inside, material=elastic(p), points_per_cell=3)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    root, tip = problem.fix(pm.plane(x=0.0), u=0), points.farthest((1, 0))
    problem.fix(pm.plane(x=10.0), ux=0, theta=0)
    problem.load(tip, force=(0, -2e4))
    return problem, {
        "factor": lambda: problem.progress.factor,
        "root": lambda: problem.reaction(root).force[0],
    }


def shaft(p: dict[str, float], **options: Any) -> Any:
    """A bar in space, turned and bent by couples."""
    grid = pm.Grid.box((-2, -2, 0), (4, 4, 5), 1.0)
    points = pm.seed(grid, bounds=((0, 0, 0), (1.7, 1.7, 3.0)), material=elastic(p), points_per_cell=2)
    problem = pm.QuasiStatic(grid, points, reset=1, **options)
    problem.fix(pm.plane(z=0.0), u=0, theta=0)
    end = points.where(lambda x: x[:, 2] > 2.4)
    problem.load(end, couple=(3e5, 0, 1e6), force=(1e5, 0, 0))
    return problem, {"end": lambda: points.mean_displacement(end)}


March = Callable[[Any], Any]


def rates(build: Any, values: dict[str, float], names: Sequence[str], march: March, **options: Any) -> Any:
    """Derivatives of all observables in the course of a run: by observable and parameter, (steps, ...)."""
    with pm.Sensitivity(build, values, names, **options) as run:
        found = [run.rates for _ in march(run)]
        assert max(run.check.values()) <= 1e-3
    return {o: {n: np.array([step[o][n] for step in found]) for n in names} for o in found[0]}


def differences(
    build: Any, values: dict[str, float], names: Sequence[str], march: March, h: float, **options: Any
) -> Any:
    """The same by differences of fourth order of whole runs."""

    def answers(changed: dict[str, float]) -> list[dict[str, Any]]:
        with warnings.catch_warnings(action="ignore"):
            problem, observables = build(changed, controls=TIGHT, **options)
            found = [{o: np.array(f()) for o, f in observables.items()} for _ in march(problem)]
        problem.close()
        return found

    out: dict[str, dict[str, np.ndarray]] = {}
    for n in names:
        at = {k: answers({**values, n: values[n] * (1 + k * h)}) for k in (-2, -1, 1, 2)}
        for o in at[1][0]:
            y = {k: np.array([step[o] for step in steps]) for k, steps in at.items()}
            slope = (8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h * values[n])
            out.setdefault(o, {})[n] = slope
    return out


def digits(found: Any, exact: Any) -> float:
    """To how many digits of its largest value each derivative is right, the least of them."""
    least = 16.0
    for observable, of in exact.items():
        for name, slope in of.items():
            off = np.abs(found[observable][name] - slope).max() / np.abs(slope).max()
            least = min(least, -np.log10(off + 1e-16))
    return least


# ranks ------------------------------------------------------------------------------------------
MOVING = {"twins": ["mu", "c"], "exact": ["kappa", "c"]}


def moving(method: str) -> dict[str, Any]:
    """Derivatives of a column whose points go to other ranks at resets. Collective."""
    options: dict[str, Any] = {"method": method, "pressed": 0.004, "rebalance": 1.0001}
    with pm.Sensitivity(column, SOIL, MOVING[method], **options) as run:
        points, found = run.problem.points, []
        first = points.id.copy()
        for _ in run.march(4):
            found.append(run.rates["force"])
        moved = points.comm.allreduce(int(np.setdiff1d(points.id, first).size))
    return {"moved": moved, "rates": {n: [step[n] for step in found] for n in MOVING[method]}}


def assert_two_ranks_agree(method: str, tolerance: float) -> None:
    """The same derivatives as on one."""
    one, two = (on_ranks(ranks, method, __file__)[0] for ranks in (1, 2))
    assert two["moved"] > 0
    for name, found in one["rates"].items():
        np.testing.assert_allclose(two["rates"][name], found, rtol=0, atol=tolerance * np.abs(found).max())


if __name__ == "__main__":
    report(moving)
