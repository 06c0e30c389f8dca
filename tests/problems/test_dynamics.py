"""Dynamic problems: closed forms, conservation, and the orders of the method in time (docs/dynamics.md)."""

from __future__ import annotations

import pickle
import warnings
from contextlib import nullcontext
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.kinematics import rotations
from tests.conftest import MICROPOLAR, NEO_HOOKEAN

COMM = MPI.COMM_WORLD
LENGTH, PERIOD = (
    25.0,
    10.0,
)  # of a fixed-free bar with E = 100, rho = 1: four times its length over sqrt(E/rho)
BAR = pm.SaintVenantKirchhoff(lam=0.0, mu=50.0)
SOFT = pm.NeoHookean.from_engineering(E=1e5, nu=0.3)


def first_mode(x: np.ndarray) -> np.ndarray:
    return np.column_stack([1e-3 * np.sin(0.5 * np.pi * x[:, 0] / LENGTH), 0.0 * x[:, 0]])


def bar(basis: str = "bspline", **options: Any) -> pm.Dynamic:
    """Fixed at x = 0, in its first mode."""
    grid = pm.Grid.box((0.0, 0.0), (30.0, 5.0), 2.5)
    points = pm.seed(grid, bounds=((0.0, 0.0), (LENGTH, 2.5)), material=BAR, points_per_cell=3)
    problem = pm.Dynamic(grid, points, density=1.0, basis=basis, **options)
    problem.fix(pm.plane(x=0.0), ux=0.0)
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.velocity(v=first_mode)
    return problem


def bar_of_elements(degree: int = 2, **options: Any) -> pm.DynamicFEM:
    from dolfinx import mesh

    sides, kind = [[0.0, 0.0], [LENGTH, 2.5]], mesh.CellType.quadrilateral
    body = mesh.create_rectangle(COMM, [np.array(x) for x in sides], [10, 1], kind)
    elements = pm.Elements(body, material=BAR, degree=degree)
    problem = pm.DynamicFEM(elements, density=1.0, **options)
    problem.fix(pm.plane(x=0.0), ux=0.0)
    problem.fix(pm.plane(y=0.0), uy=0.0)
    problem.velocity(v=first_mode)
    return problem


def end_of(problem: Any, time: float, steps: int) -> np.ndarray:
    """Displacements of all points, by their ids, at a time."""
    for _ in problem.march(time, steps=steps):
        pass
    return by_id(problem.points, problem.points.displacement)


def by_id(points: pm.Points, values: np.ndarray) -> np.ndarray:
    """Of all ranks."""
    rows = COMM.allgather((points.id, values))
    ids = np.concatenate([r[0] for r in rows])
    found: np.ndarray = np.concatenate([r[1] for r in rows])[np.argsort(ids)]
    return found


@pytest.mark.parametrize("make", [bar, bar_of_elements])
@pytest.mark.parametrize("rho_inf", [1.0, 0.8])
def test_second_order_in_time(make: Any, rho_inf: float):
    fine = end_of(make(rho_inf=rho_inf), PERIOD, 320)
    errors = [np.linalg.norm(end_of(make(rho_inf=rho_inf), PERIOD, n) - fine) for n in (40, 80)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("make", [bar, bar_of_elements])
def test_a_bar_has_the_frequency_of_the_method(make: Any):
    steps = 40
    problem = make(rho_inf=1.0)
    end = end_of(problem, PERIOD, steps)
    # the midpoint rule turns by 2 atan(omega dt / 2) in a step
    exact, dt = 2 * np.pi / PERIOD, PERIOD / steps
    omega = 2 / dt * np.arctan(0.5 * exact * dt)
    mode = first_mode(by_id(problem.points, problem.points.X)) / exact
    assert np.abs(end - mode * np.sin(omega * PERIOD))[:, 0].max() < 3e-4 * np.abs(mode).max()
    e = problem.energies()
    assert e["kinetic"] + e["stored"] == pytest.approx(e["external"], rel=1e-6)
    assert abs(e["residue"]) < 1e-6 * e["external"]
    balance = problem.balance()
    assert balance.residue[0] < 1e-9
    assert {part.name for part in balance.parts} >= {"inertia", "support 1 (x = 0)"}


@pytest.mark.parametrize("rho_inf", [1.0, 0.8])
@pytest.mark.parametrize("basis", ["bspline", "gimpm", "mpm"])
def test_free_fall(basis: str, rho_inf: float):
    grid = pm.Grid.box((0.0, 0.0), (3.0, 12.0), 1.0)
    points = pm.seed(grid, bounds=((0.7, 10.2), (2.3, 11.4)), material=MICROPOLAR, points_per_cell=3)
    problem = pm.Dynamic(
        grid, points, density=2.0, microinertia=0.1, basis=basis, rho_inf=rho_inf, reset=1, boxes=False
    )
    problem.body_load(force=lambda t: (0.0, -2.0 * 9.81))
    with warnings.catch_warnings():
        warnings.simplefilter("error", pm.TrustWarning)  # what isn't strained isn't doubted
        for _ in problem.march(1.4, steps=28):
            pass
    assert np.abs(points.velocity - (0.0, -9.81 * 1.4)).max(initial=0.0) < 1e-9
    assert np.abs(points.F - np.eye(3)).max(initial=0.0) < 1e-11
    assert np.abs(points.displacement[:, 1] + 0.5 * 9.81 * 1.4**2).max(initial=0.0) < 1e-9


def spinning(micropolar: bool, **options: Any) -> tuple[pm.Dynamic, np.ndarray]:
    """A free block that isn't fitted to the grid and turns once in a second."""
    grid = pm.Grid.box((0.0, 0.0), (2.5, 2.5), 0.25)
    middle = np.array([1.21, 1.27])
    kinds: dict[str, Any] = {"material": NEO_HOOKEAN}
    if micropolar:
        kinds = {"material": MICROPOLAR}
        options["microinertia"] = 1e-2
    points = pm.seed(grid, bounds=(middle - 0.5, middle + 0.5), points_per_cell=3, **kinds)
    problem = pm.Dynamic(grid, points, density=5.0, **options)
    turn = 2 * np.pi

    def v(x: np.ndarray) -> np.ndarray:
        return turn * np.column_stack([-(x - middle)[:, 1], (x - middle)[:, 0]])

    problem.velocity(v=v, **({"spin": turn} if micropolar else {}))
    return problem, middle


@pytest.mark.parametrize("micropolar", [False, True])
def test_resets_keep_momenta(micropolar: bool):
    problem, middle = spinning(micropolar, rho_inf=1.0, reset=1)
    energy, spin = problem.energies()["kinetic"], problem.angular_momentum(middle)
    for _ in problem.march(0.25, dt=0.0125):
        pass
    e = problem.energies()
    assert problem.angular_momentum(middle) == pytest.approx(spin, rel=1e-8)
    assert np.abs(problem.momentum()).max() < 1e-10 * 5 * 2 * np.pi
    assert e["kinetic"] + e["stored"] == pytest.approx(energy, rel=5e-3)
    assert e["external"] == pytest.approx(energy, rel=1e-12)


def test_drag_slows_down_exponentially():
    grid = pm.Grid.box((0.0, 0.0), (4.0, 2.0), 1.0)
    points = pm.seed(grid, bounds=((0.2, 0.3), (1.4, 1.6)), material=NEO_HOOKEAN)
    problem = pm.Dynamic(grid, points, density=2.0, drag=1.5)
    problem.velocity(v=(0.5, 0.0))
    for _ in problem.march(duration=1.0, dt=0.01):
        pass
    e = problem.energies()
    assert np.abs(points.velocity[:, 0] - 0.5 * np.exp(-1.5)).max(initial=0.0) < 1e-5
    assert e["damped"] == pytest.approx(e["external"] - e["kinetic"], rel=1e-3)


def test_what_cannot_be_is_refused():
    grid = pm.Grid.box((0.0, 0.0), (2.0, 2.0), 1.0)

    def make(material: Any = NEO_HOOKEAN, **options: Any) -> pm.Dynamic:
        points = pm.seed(grid, bounds=((0.2, 0.3), (1.4, 1.6)), material=material)
        return pm.Dynamic(grid, points, **options)

    for options in (
        {"density": 0.0},
        {"density": -1.0},
        {"density": [1.0, 2.0]},
        {"density": "steel"},
        {"density": lambda x: x},
        {"density": 1.0, "rho_inf": 1.1},
        {"density": 1.0, "drag": -1.0},
        {"density": 1.0, "microinertia": 1.0},
        {"density": 1.0, "material": MICROPOLAR},
        {"density": 1.0, "material": MICROPOLAR, "microinertia": -1.0},
    ):
        with pytest.raises(pm.InputError):
            make(**options)
    problem = make(density=np.float32(2.0))
    for march in ({}, {"time": 1.0}, {"time": 0.0, "dt": 0.1}, {"duration": 1.0, "steps": 2, "dt": 0.1}):
        with pytest.raises(pm.InputError):
            problem.march(**march)
    for velocity in ({}, {"v": 1.0}, {"v": (1.0, np.nan)}, {"spin": 1.0}, {"v": lambda x: x[:, 0]}):
        with pytest.raises(pm.InputError):
            problem.velocity(**velocity)
    with pytest.raises(pm.InputError, match="time"):
        problem.attempt(0.0)
    with pytest.raises(pm.InputError, match="march"):
        problem.march_arc_length(0.1, steps=1)


@pytest.mark.parametrize("make", [bar, bar_of_elements])
@pytest.mark.parametrize("rho_inf", [1.0, 0.9])
def test_a_pulse_leaves_through_an_absorbing_boundary(make: Any, rho_inf: float):
    """To the right runs what has v = -c du/dx; here half of a pulse of v alone goes either way, and what is
    thrown back at the fixed end follows."""
    problem = make(rho_inf=rho_inf)
    points, grid = problem.points, 5.0
    pulse = 1e-3

    def v(x: np.ndarray) -> np.ndarray:
        return np.column_stack([pulse * np.exp(-(((x[:, 0] - 8.0) / grid) ** 2)), 0.0 * x[:, 0]])

    problem.velocity(v=v)
    begin = problem.energies()["kinetic"]
    if isinstance(problem, pm.Dynamic):
        end = problem.absorb(pm.Surface.line((LENGTH, 0.0), (LENGTH, 2.5), 4))
    else:
        end = problem.absorb(pm.plane(x=LENGTH))
    for _ in problem.march(6.0, dt=0.05):
        pass
    e = problem.energies()
    assert e["kinetic"] + e["stored"] < 5e-3 * begin
    assert e["terms"] == pytest.approx(begin, rel=0.06 if rho_inf < 1 else 6e-3)
    problem.release(end)
    assert len(points.velocity) == len(points)


@pytest.mark.parametrize(("rho_inf", "reset"), [(1.0, None), (0.9, 1)])
def test_the_error_of_a_step_is_known(rho_inf: float, reset: int | None):
    """Of a mode that swings with w it is dt^3/12 w^2 v, whatever resets do."""
    problem, dt, errors = bar(rho_inf=rho_inf, reset=reset), PERIOD / 80, []
    for _ in problem.march(4 * dt, steps=4):
        errors.append(problem.error)
    w = 2 * np.pi / PERIOD
    size = np.sqrt(0.5) * 1e-3 * w**2 * dt**3 / 12
    assert errors[0] is None
    assert errors[1] == pytest.approx(size, rel=0.05)
    assert errors[3] == pytest.approx(size * np.cos(3 * w * dt), rel=0.05)


def test_steps_follow_the_tolerance():
    steps = []
    for tolerance in (1e-6, 1.25e-7):
        problem = bar()
        marching = problem.march(PERIOD, dt=0.5, adaptive=True, tolerance=tolerance, largest=2.0)
        steps.append(sum(1 for _ in marching))
        assert problem.error is not None
        assert problem.error < 8 * tolerance
    assert steps[1] / steps[0] == pytest.approx(2.0, rel=0.15)
    with pytest.raises(pm.InputError, match="adaptive"):
        problem.march(duration=1.0, dt=0.1, tolerance=1e-6)


def turning(kind: type, steps: int) -> np.ndarray:
    """Quaternions of points that turn in space on the springs of the couple modulus, from 1 rad on."""
    start = rotations.from_vector(np.array([[0.6, -0.5, 0.62]]) / np.linalg.norm([0.6, -0.5, 0.62]))
    options = {"density": 100.0, "microinertia": 1.0, "rho_inf": 1.0}
    if kind is pm.Dynamic:
        grid = pm.Grid.box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 1.0)
        points = pm.seed(grid, material=MICROPOLAR)
        points.q = np.tile(start, (len(points), 1))
        problem: Any = pm.Dynamic(grid, points, **options)
    else:
        from dolfinx import mesh

        body = mesh.create_unit_cube(COMM, 1, 1, 1, mesh.CellType.hexahedron)
        elements = pm.Elements(body, material=MICROPOLAR)
        elements.points.q = np.tile(start, (len(elements.points), 1))
        problem = pm.DynamicFEM(elements, **options)
    problem.fix(lambda x: np.ones(len(x), dtype=bool), u=0.0)
    problem.velocity(spin=(0.3, -2.0, 3.0))
    for _ in problem.march(1.0, steps=steps):
        pass
    return by_id(problem.points, problem.points.q)


@pytest.mark.parametrize("kind", [pm.Dynamic, pm.DynamicFEM])
def test_microrotations_in_space_are_of_second_order(kind: type):
    fine = turning(kind, 100)
    errors = [np.linalg.norm(turning(kind, n) - fine, axis=1).max() for n in (20, 40)]
    # the reference has 0.16 of the error of the finer one
    assert np.log2(errors[0] / errors[1]) == pytest.approx(
        np.log2((1 / 20**2 - 1 / 100**2) / (1 / 40**2 - 1 / 100**2)), abs=0.1
    )


@pytest.mark.parametrize("make", [bar, bar_of_elements])
def test_viscosity_damps_by_the_square_of_the_frequency(make: Any):
    """Half a period of u'' + tau w^2 u' + w^2 u = 0 from u = 0."""
    problem, tau = make(rho_inf=1.0, viscosity=0.3), 0.3
    begin, w = problem.energies()["kinetic"], 2 * np.pi / PERIOD
    damped = np.sqrt(w**2 - (0.5 * tau * w**2) ** 2)
    for _ in problem.march(np.pi / damped, steps=100):
        pass
    e = problem.energies()
    assert e["kinetic"] == pytest.approx(begin * np.exp(-tau * w**2 * np.pi / damped), rel=2e-3)
    assert e["damped"] == pytest.approx(begin - e["kinetic"] - e["stored"], rel=1e-3)


def test_a_step_that_fails_names_its_time():
    """And says so after it has been sent to another process."""
    grid = pm.Grid.box((0, 0), (2, 2), 0.5)
    points = pm.seed(grid, bounds=((0, 0), (1, 1)), material=NEO_HOOKEAN)
    problem = pm.Dynamic(grid, points, density=1e3, controls=pm.Controls(max_iterations=1))
    problem.fix(pm.plane(y=0.0), u=0)
    problem.body_load(force=lambda t: (0.0, -0.3 * NEO_HOOKEAN.mu))
    with pytest.raises(pm.NotConverged) as error:
        list(problem.march(1.5, steps=1, progress=False))
    text = str(pickle.loads(pickle.dumps(error.value)))
    assert "no equilibrium at time 1.5;" in text
    assert "  time 1.5: no convergence" in text


def test_domains_reach_over_the_walls():
    """A body whose free sides are walls of the grid bulges over them, where nodes have hardly any mass: as on
    a grid that goes on."""
    ends = []
    for beyond in (0.0, 0.4):
        grid = pm.Grid.box((-0.4 - beyond, 0.0), (0.4 + beyond, 0.6), 0.1, comm=COMM)
        points = pm.seed(grid, bounds=((-0.4, 0.0), (0.4, 0.3)), material=SOFT)
        problem = pm.Dynamic(
            grid, points, density=1e3, basis="gimpm", ghost=pm.GhostPenalty(100.0), reset=1, rho_inf=1.0
        )
        problem.fix(pm.plane(y=0.0), u=0)
        problem.velocity(v=lambda x: np.column_stack([0.5 * x[:, 0], -0.3 * x[:, 1]]))
        ends.append(end_of(problem, 0.05, 20))
    assert np.abs(ends[0] - ends[1]).max() < 1e-4 * np.abs(ends[1]).max()


@pytest.mark.parametrize("kind", ["points", "elements"])
def test_what_a_plastic_body_dissipates_is_by_the_forces_of_its_steps(kind):
    """A column of soil hits its base: its pressure, and with it its strength, grows within a step. By the
    stresses at the steps' ends the sum of energies was off by 5 and 3 %."""
    soil = pm.DruckerPrager(pm.Hencky(lam=6e5, mu=4e5), phi=0.5, psi=0.0, c=200.0, cone="plane strain")
    for dt, most in ((2e-3, 6e-3), (1e-3, 2e-3)):
        if kind == "points":
            grid = pm.Grid.box((0.0, 0.0), (1.5, 1.5), 0.125, comm=COMM)
            points = pm.seed(grid, bounds=((0.0, 0.0), (0.5, 1.0)), material=soil)
            problem = pm.Dynamic(grid, points, density=1e3, rho_inf=1.0, reset=None, locking=None)
        else:
            from dolfinx import mesh

            body = mesh.create_rectangle(
                COMM, [np.zeros(2), np.array([0.5, 1.0])], [4, 8], mesh.CellType.quadrilateral
            )
            elements = pm.Elements(body, material=soil)
            problem = pm.DynamicFEM(elements, density=1e3, rho_inf=1.0, locking=None)
        problem.fix(pm.plane(y=0.0), u=0)
        problem.velocity(v=(0.0, -2.0))
        for _ in problem.march(0.03, dt=dt, progress=False):
            pass
        found = problem.energies()
        assert found["dissipated"] > 0.3 * found["external"]
        assert abs(found["residue"]) < most * found["external"]


@pytest.mark.parametrize("make", [bar, bar_of_elements])
def test_numbers_are_told_to_be_rates(make: Any):
    """A weight that is given as a number would grow from nothing; functions and zeros are what they say."""
    problem = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.body_load(force=lambda t: (0, -9.81))
        problem.body_load(force=(0, 0))
    with pytest.warns(pm.TrustWarning, match=r"-9.81\).*rate") if COMM.rank == 0 else nullcontext():
        problem.body_load(force=(0, -9.81))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.body_load(force=(0, -9.81))  # once is enough
    problem = make()
    with pytest.warns(pm.TrustWarning, match="uy = 0.1.*rate") if COMM.rank == 0 else nullcontext():
        problem.fix(pm.plane(y=0.0), uy=0.1)
