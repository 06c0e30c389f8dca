"""Energy balance of a run: what loads and supports put in is what the body stores."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.io import read_table
from tests.conftest import HENCKY, MICROPOLAR, NEO_HOOKEAN, beam
from tests.helpers.bodies import cantilever

Make = Callable[[], Any]


def end_force(dim: int, material: pm.Material = MICROPOLAR, **options: Any) -> Any:
    problem = beam(dim, material, basis="mpm", **{"reset": None, **options})
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), force=(20.0, -120.0, 60.0)[:dim])
    return problem


def end_couple(dim: int, **options: Any) -> Any:
    """In space about an axis across the beam and along it: its work depends on the path of the spin."""
    problem = beam(dim, basis="gimpm", reset=None, **options)
    couple = -250.0 if dim == 2 else (27.0, 45.0, -60.0)
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), couple=couple)
    return problem


def weight(dim: int) -> Any:
    problem = beam(dim, basis="mpm", reset=None)
    problem.body_load(force=(0.0, -30.0, 10.0)[:dim], couple=None if dim == 3 else 8.0)
    return problem


def pulled(dim: int = 2, **options: Any) -> Any:
    """The end is moved and turned."""
    problem = beam(dim, basis="mpm", **{"reset": None, **options})
    theta = 0.8 if dim == 2 else (0.3, 0.2, 0.8)
    problem.fix(pm.plane(x=3.0), u=(0.4, -0.8, 0.2)[:dim], theta=theta)
    return problem


def pulled_while_loaded() -> Any:
    """Loads on nodes that are moved, and loads that don't grow in proportion."""
    problem = pulled()
    problem.load(problem.points.farthest((1.0, 0.0)), force=lambda t: (60.0 * t**2, 40.0 * np.sin(3 * t)))
    return problem


def turned_on() -> Any:
    """A long way round, so that rotations get a new base."""
    problem = beam(3, basis="mpm", reset=None)
    problem.fix(lambda x: x[:, 0] > 2.5, theta=(1.8, 0.0, 0.0))
    return problem


def on_surface(kind: str, **options: Any) -> Any:
    """Across cells, in no particular direction."""
    problem = beam(2, basis="mpm", **{"reset": None, **options})
    surface = pm.Surface.line((2.9, 1.1), (2.2, 0.5), 5)
    if kind == "pressure":
        problem.pressure(surface, 60.0)
    elif kind == "traction":
        problem.traction(surface, force=lambda t: (10.0 * t, -60.0 * t**2), couple=8.0)
    else:
        problem.fix(surface, u=(0.2, -0.5), stiffness=5e4)
    return problem


def elements(dim: int, kind: str) -> Any:
    problem = cantilever({2: "quadrilateral", 3: "hexahedron"}[dim], cells=(4, 1, 1)[:dim], degree=4 - dim)
    end = problem.elements.farthest((1.0, 0.0, 0.0)[:dim])
    if kind == "force":
        problem.load(end, force=(20.0, -60.0, 30.0)[:dim])
        problem.body_load(force=(5.0, -10.0, 3.0)[:dim])
    elif kind == "couple":
        problem.load(end, couple=-150.0 if dim == 2 else (60.0, 100.0, -120.0))
    elif kind == "moved":
        problem.fix(end, u=(0.4, -0.8, 0.2)[:dim])
    else:
        problem.pressure(problem.elements.farthest((0.0, 1.0, 0.0)[:dim]), 30.0)
    return problem


def residues(make: Make, numbers: tuple[int, ...]) -> list[float]:
    """Residue relative to the stored energy, of runs with more and more steps."""
    out = []
    for steps in numbers:
        problem = make()
        list(problem.march(steps, progress=False))
        e = problem.energies()
        assert e["stored"] == pytest.approx(problem.energy(), rel=1e-13)
        assert e["dissipated"] == 0.0
        assert (e["ghost"] > 0.0) == (getattr(problem, "ghost", None) is not None)
        sums = e["external"] + e["carried"] - e["stored"] - e["ghost"]
        assert e["residue"] == pytest.approx(sums, abs=1e-12 * e["stored"])
        out.append(abs(e["residue"]) / e["stored"])
    return out


CASES: dict[str, Make] = {
    "force-2d": lambda: end_force(2),
    "force-3d": lambda: end_force(3),
    "classical": lambda: end_force(2, NEO_HOOKEAN),
    "hencky": lambda: end_force(2, HENCKY),
    "splines": lambda: splines(),
    "couple-2d": lambda: end_couple(2),
    "couple-3d": lambda: end_couple(3),
    "weight-2d": lambda: weight(2),
    "weight-3d": lambda: weight(3),
    "pulled-2d": lambda: pulled(2),
    "pulled-3d": lambda: pulled(3),
    "pulled-and-loaded": pulled_while_loaded,
    "new-bases": turned_on,
    **{k: lambda k=k: on_surface(k) for k in ("pressure", "traction", "springs")},
    "ghost": lambda: end_force(2, ghost="thesis"),
    "projection": lambda: end_force(2, assembly="projection"),
    **{
        f"elements-{kind}-{dim}d": lambda dim=dim, kind=kind: elements(dim, kind)
        for dim in (2, 3)
        for kind in ("force", "couple", "moved", "pressure")
    },
}


def splines() -> Any:
    """Held on a wall of the grid and loaded at its end."""
    grid = pm.Grid.box((0.0, -3.0), (6.0, 3.0), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, points_per_cell=3, bounds=((0.0, 0.0), (4.0, 1.0)))
    problem = pm.QuasiStatic(grid, points, basis="bspline", reset=None, balanced_reset=False)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.load(points.farthest((1.0, 0.0)), force=(10.0, -60.0))
    return problem


@pytest.mark.parametrize("case", CASES)
def test_the_balance_closes_with_the_square_of_the_step(case):
    """Without resets only the trapezoidal rule is in error."""
    few, many = residues(CASES[case], (8, 16))
    assert many < 5e-3
    assert 3.4 < few / many < 4.6


@pytest.mark.parametrize("make", [end_force, pulled])
@pytest.mark.parametrize("dim", [2, 3])
def test_balanced_resets_close_it_too(dim, make):
    """With a reset at each step; forces that are carried along do work of their own."""
    few, many = residues(lambda: make(dim, reset=1, balanced_reset=True), (8, 16))
    assert many < 5e-3
    assert few / many > 3.4
    problem = make(dim, reset=1, balanced_reset=True)
    list(problem.march(8, progress=False))
    assert abs(problem.energies()["carried"]) > few * problem.energy()


def test_resets_let_energy_go():
    """The papers' resets relax what the new basis can't balance: the residue shows it."""
    relaxed = residues(lambda: end_force(2, reset=1), (16,))[0]
    kept = residues(lambda: end_force(2, reset=1, balanced_reset=True), (16,))[0]
    assert relaxed > 5 * kept


def test_work_of_a_dead_force():
    """Mean force times the displacement of the points, summed by hand."""
    problem = end_force(2, reset=2)
    tip, force = problem.loads[0].selection, np.array([20.0, -120.0])
    work, factor, u = 0.0, 0.0, np.zeros(2)
    for step in problem.march(6, progress=False):
        now = problem.points.mean_displacement(tip)
        work += 0.5 * (factor + step.factor) * force @ (now - u)
        factor, u = step.factor, now
        assert problem.energies()["external"] == pytest.approx(work, rel=1e-10)


@pytest.mark.parametrize("make", [pulled, lambda: elements(2, "moved")], ids=["points", "elements"])
def test_work_of_a_support(make, strict):
    """Mean reaction times the prescribed displacement and rotation, summed by hand."""
    problem = make()
    problem.controls = strict
    end = problem.supports[-1]
    total = np.array([0.4, -0.8, 0.8 if 2 in end.columns else 0.0])
    work, before = 0.0, np.zeros(3)
    for _ in problem.march(5, progress=False):
        now = np.concatenate(problem.reaction(end))
        work += 0.5 * (before + now) @ total / 5
        before = now
    assert problem.energies()["external"] == pytest.approx(work, rel=1e-9)


def test_unloading_gives_everything_back():
    problem = end_force(2)
    list(problem.march(8, progress=False))
    most = problem.energies()["external"]
    list(problem.march(8, to=0.0, progress=False))
    e = problem.energies()
    assert abs(e["external"]) < 1e-9 * most
    assert abs(e["stored"]) < 1e-9 * most


def test_failed_steps_do_no_work():
    problem, undisturbed = end_force(2), end_force(2)
    for p in (problem, undisturbed):
        list(p.march(2, to=0.5, progress=False))
    assert not problem.attempt(1e5).converged
    for p in (problem, undisturbed):
        list(p.march(2, progress=False))
    for name, value in undisturbed.energies().items():
        assert problem.energies()[name] == pytest.approx(value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("make", [lambda: end_couple(3), lambda: elements(2, "moved")], ids=["mpm", "fem"])
def test_restart_keeps_the_sums(folder: Path, make):
    straight, first, second = make(), make(), make()
    list(straight.march(4, progress=False))
    for step in first.march(4, progress=False):
        if step.number == 2:
            break
    pm.save_restart(first, folder / "state.h5")
    pm.load_restart(second, folder / "state.h5")
    assert second.energies() == pytest.approx(first.energies(), rel=1e-13, abs=1e-12)
    list(second.march(2, progress=False))
    assert second.energies() == pytest.approx(straight.energies(), rel=1e-12, abs=1e-12)


def test_columns_of_a_table(folder: Path):
    """A dictionary becomes one column for each entry."""
    problem = end_force(2)
    wall = problem.supports[0]

    def reactions() -> dict[str, Any]:
        force, couple = problem.reaction(wall)
        return {"force": force, "couple": couple}

    seen = []
    with pm.Table(folder / "run.csv", energies=problem.energies, wall=reactions) as table:
        for step in problem.march(3, progress=False):
            table.record(step)
            seen.append((problem.energies(), problem.reaction(wall)))
    columns = read_table(folder / "run.csv")
    for name in ("external", "carried", "stored", "dissipated", "ghost", "residue"):
        np.testing.assert_array_equal(columns[f"energies_{name}"], [e[name] for e, _ in seen])
    np.testing.assert_array_equal(columns["wall_force_y"], [r[0][1] for _, r in seen])
    np.testing.assert_array_equal(columns["wall_couple"], [r[1][0] for _, r in seen])
