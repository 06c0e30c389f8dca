"""Paths past limit points of the load."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import LocalFailure
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, beam, by_id
from tests.helpers.bodies import box

RISE, DEPTH = 0.08, 0.04
DOWN = (0.0, -1.0)


def height(x: np.ndarray) -> np.ndarray:
    """The half arch's lower face: level at the support and at the crown."""
    return RISE * (3 * x**2 - 2 * x**3)


class Elements:
    """A shallow arch, built in at x = 0, of which x = 1 is the plane of symmetry, as a mesh."""

    def __init__(self, *, pushed: float | None = None, comm: Any = COMM, **options: Any):
        mesh = box("quadrilateral", (12, 1), (1.0, DEPTH), comm=comm)
        mesh.geometry.x[:, 1] += height(mesh.geometry.x[:, 0])
        elements = pm.Elements(mesh, material=NEO_HOOKEAN, degree=2)
        self.problem = problem = pm.QuasiStaticFEM(elements, **options)
        self.wall = problem.fix(pm.plane(x=0.0), u=0)
        end = elements.farthest((1.0, 0.0))
        if pushed is None:
            problem.fix(pm.plane(x=1.0), ux=0)
            problem.load(end, force=DOWN)
        else:
            problem.fix(pm.plane(x=1.0), ux=0, uy=-pushed)
        self.crown = lambda: -elements.mean_displacement(end)[1]


class PointBody:
    """The same arch of material points."""

    def __init__(self, *, pushed: float | None = None, comm: Any = COMM, **options: Any):
        grid = pm.Grid.box((0.0, -0.4), (1.0, 0.2), 0.02, comm)
        points = pm.seed(grid, inside=self.inside, material=NEO_HOOKEAN, points_per_cell=2)
        self.problem = problem = pm.QuasiStatic(
            grid, points, **{**pm.PUBLISHED, "basis": "mpm", "reset": None, **options}
        )
        self.wall = problem.fix(pm.plane(x=0.0), u=0)
        end = points.farthest((1.0, 0.0))
        if pushed is None:
            problem.fix(pm.plane(x=1.0), ux=0)
            problem.load(end, force=DOWN)
        else:
            problem.fix(pm.plane(x=1.0), ux=0, uy=-pushed)
        self.crown = lambda: -points.mean_displacement(end)[1]

    @staticmethod
    def inside(x: np.ndarray) -> np.ndarray:
        above = x[:, 1] - height(x[:, 0])
        return (above > 0) & (above < DEPTH)


BODIES = pytest.mark.parametrize("body", [Elements, PointBody], ids=["elements", "points"])


def follow(body: Any, steps: int = 9, **options: Any) -> tuple[np.ndarray, np.ndarray, list[pm.Step]]:
    """Crown's way and load factor along the path, from the start."""
    way, factors, done = [0.0], [0.0], []
    for step in body.problem.march_arc_length(0.005, largest=0.02, steps=steps, progress=False, **options):
        way.append(body.crown())
        factors.append(step.factor)
        done.append(step)
    return np.array(way), np.array(factors), done


@BODIES
def test_a_shallow_arch_snaps_through(body):
    """The load rises, falls and rises again, while the crown goes down all the way."""
    arch = body()
    way, factors, _ = follow(arch, 10)
    rising = np.sign(np.diff(factors))
    assert rising[0] == rising[-1] == 1.0
    assert np.sum(rising[1:] != rising[:-1]) == 2
    peak = int(np.argmax(rising < 0))
    assert factors[peak:].min() < 0.6 * factors[peak]
    assert np.all(np.diff(way) > 0)


@BODIES
def test_every_state_is_in_equilibrium(body):
    """The wall carries the load of the factor, on falling parts of the path too."""
    arch = body()
    for step in arch.problem.march_arc_length(0.01, steps=7, progress=False):
        force = arch.problem.reaction(arch.wall)[0]
        np.testing.assert_allclose(force[1], step.factor, rtol=1e-6, atol=1e-6 * abs(force[0]))


@pytest.mark.parametrize(("body", "tolerance"), [(Elements, 0.01), (PointBody, 0.03)])
def test_beyond_the_limit_the_path_is_that_of_displacement_control(body, tolerance):
    """Another way to the falling part: the crown's way is prescribed, the reaction is the load.

    It is prescribed evenly over the section, while the load's shear is even: the ends differ a little.
    """
    way, factors, _ = follow(body(), 6)
    peak, chosen = factors.max(), len(way) - 2
    assert factors[chosen] < 0.6 * peak
    assert factors[chosen] < factors[chosen - 1]
    pushed = body(pushed=way[chosen])
    list(pushed.problem.march(20, progress=False))
    load = pushed.problem.reaction(pushed.wall)[0][1]
    assert abs(load - factors[chosen]) < tolerance * peak


@BODIES
def test_convergence_is_quadratic(body):
    """Of residual and length together: the next residual is a few times the last one's square."""
    controls = pm.Controls(force_tolerance=1e-11, energy_tolerance=1e-30)
    _, _, steps = follow(body(controls=controls), 6)
    pairs = []
    for step in steps:
        force = [f for f, _ in step.history]
        pairs += [(a, b) for a, b in pairwise(force[1:]) if a < 1e-2]
    assert len(pairs) >= 10
    assert max(b / a**2 for a, b in pairs if a > 1e-6) < 25.0
    assert max(step.iterations for step in steps) <= 6


@BODIES
def test_steps_have_their_length(body):
    """The root of the mean square displacement increment; the grid's nodes sum it as the body does."""
    arch = body()
    points, before = arch.problem.points, arch.problem.points.x
    for _ in arch.problem.march_arc_length(0.004, steps=5, progress=False):
        square = np.sum((points.x - before) ** 2, axis=1) @ points.volume0
        size = COMM.allreduce(float(square)) / COMM.allreduce(float(points.volume0.sum()))
        assert np.sqrt(size) == pytest.approx(0.004, rel=0.02)
        before = points.x


def test_a_bar_in_closed_form():
    """Small strain e = f / (lam + 2 mu) of a bar held at its sides: s^2 is the trapezoidal sum of (e x)^2."""
    n, stiffness = 8, NEO_HOOKEAN.lam + 2 * NEO_HOOKEAN.mu
    elements = pm.Elements(box("quadrilateral", (n, 1), (2.0, 1.0)), material=NEO_HOOKEAN)
    problem = pm.QuasiStaticFEM(elements)
    problem.fix(pm.plane(x=0.0), u=0)
    problem.fix(lambda x: np.ones(len(x), dtype=bool), uy=0)
    problem.load(elements.farthest((1.0, 0.0)), force=(1.0, 0.0))
    s = 1e-7
    mean_square = 2.0**2 / 3 * (1 + 0.5 / n**2)
    for step in problem.march_arc_length(s, steps=4, progress=False):
        expected = step.number * s / np.sqrt(mean_square) * stiffness
        assert step.factor == pytest.approx(expected, rel=1e-5)


@BODIES
@pytest.mark.parametrize("to", [0.02, -0.01])
def test_the_march_ends_at_a_factor(body, to):
    """Exactly, on a rising part; a factor that isn't met leaves the number of steps to decide."""
    arch = body()
    way, factors, _ = follow(arch, 4, to=to)
    if to > 0:
        assert factors[-1] == arch.problem.progress.factor == to
        assert np.all(np.diff(factors) > 0)
        force = arch.problem.reaction(arch.wall)[0]
        np.testing.assert_allclose(force[1], to, rtol=1e-6)
        assert not list(arch.problem.march_arc_length(0.01, to=to, progress=False))
    else:
        assert len(way) == 5


def test_it_ends_on_a_falling_part_too():
    arch = Elements()
    way, factors, _ = follow(arch, 5)
    to = 0.5 * (factors.max() + factors[-1])
    again = Elements()
    list(again.problem.march_arc_length(0.005, largest=0.02, until=lambda s: s.number == 4, progress=False))
    list(again.problem.march_arc_length(0.02, to=to, progress=False))
    assert again.problem.progress.factor == to
    assert way[-2] < again.crown() < way[-1] or way[-3] < again.crown() < way[-1]
    np.testing.assert_allclose(again.problem.reaction(again.wall)[0][1], to, rtol=1e-6)


def test_until_gets_the_steps():
    """It is asked after each step, on all ranks; rank 0's answer counts."""
    arch, asked = Elements(), []

    def far(step: pm.Step) -> bool:
        asked.append(step.number)
        return arch.crown() > 0.03 and COMM.rank == 0

    steps = list(arch.problem.march_arc_length(0.005, until=far, progress=False))
    assert asked == [s.number for s in steps] == list(range(1, len(steps) + 1))
    assert arch.crown() > 0.03
    assert len(steps) > 2


@BODIES
def test_the_share_of_the_ranks_does_not_matter(body):
    controls = pm.Controls(force_tolerance=1e-11, energy_tolerance=1e-26)
    alone = follow(body(comm=MPI.COMM_SELF, controls=controls), 6)
    shared = follow(body(controls=controls), 6)
    np.testing.assert_allclose(shared[0], alone[0], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(shared[1], alone[1], rtol=1e-6)


@pytest.mark.parametrize("balanced", [True, False])
def test_with_resets(balanced):
    """The direction survives a new grid; balanced resets keep to the path."""
    way, factors, _ = follow(PointBody(basis="gimpm", reset=None), 6)
    w, f, _ = follow(PointBody(basis="gimpm", reset=1, balanced_reset=balanced), 6)
    assert np.all(np.diff(w) > 0)
    assert np.argmax(f) == np.argmax(factors)
    if balanced:
        at_same_way = np.interp(w, way, factors)
        assert abs(f - at_same_way)[:4].max() < 0.15 * factors.max()


@BODIES
def test_restart_goes_on_along_the_path(body, folder: Path):
    """Past the limit point the load goes on to fall; the direction is in the file."""
    way, factors, _ = follow(body(), 6)
    first, second = body(), body()
    follow(first, 4)
    assert factors[4] < factors[3]
    pm.save_restart(first.problem, folder / "state.h5")
    pm.load_restart(second.problem, folder / "state.h5")
    list(second.problem.march_arc_length(0.02, steps=2, progress=False))
    assert second.problem.progress.factor == pytest.approx(factors[6], rel=1e-6)
    assert second.crown() == pytest.approx(way[6], rel=1e-6)


def test_after_load_steps_the_path_goes_on():
    """Both kinds of marches may alternate; back down, too."""
    up, down = Elements(), Elements()
    for arch in (up, down):
        list(arch.problem.march(2, to=0.03, progress=False))
    list(up.problem.march_arc_length(0.003, steps=1, progress=False))
    assert up.problem.progress.factor > 0.03
    list(down.problem.march(1, to=0.02, progress=False))
    list(down.problem.march_arc_length(0.003, steps=1, progress=False))
    assert down.problem.progress.factor < 0.02


def test_constant_loads_stay():
    """What doesn't grow is there all the time: here it bends a cantilever that is then pulled."""
    problem = beam(2, basis="mpm", reset=None)
    tip = problem.points.farthest((1.0, 0.0))
    problem.load(tip, force=lambda t: (50.0 * t, -20.0))
    list(problem.march_arc_length(0.05, to=1.0, progress=False))
    straight = beam(2, basis="mpm", reset=None)
    straight.load(tip, force=(50.0, -20.0))
    list(straight.march(3, progress=False))
    expected = by_id(straight.points, straight.points.x)
    np.testing.assert_allclose(by_id(problem.points, problem.points.x), expected, atol=1e-7)


def test_the_energy_balance_closes():
    """Across the limit point, with the square of the length of the steps."""
    residues = []
    for s in (0.004, 0.002):
        arch = Elements()
        list(arch.problem.march_arc_length(s, steps=round(0.06 / s), progress=False))
        e = arch.problem.energies()
        residues.append(abs(e["residue"]) / e["stored"])
    assert residues[1] < 1e-3
    assert residues[0] / residues[1] > 3.0


@BODIES
def test_a_failed_step_leaves_everything(body):
    arch, undisturbed = body(), body()
    for a in (arch, undisturbed):
        follow(a, 3)
    x, progress = arch.problem.points.x.copy(), arch.problem.progress.factor
    outcome, _ = arch.problem.attempt_along(50.0)
    assert not outcome.converged
    with pytest.raises(pm.NotConverged, match=r"(?s)intact. Tried:\n  length 50 m from load factor .*") as e:
        list(arch.problem.march_arc_length(50.0, smallest=0.4, steps=1, progress=False))
    assert len(e.value.tried) == 2
    np.testing.assert_array_equal(arch.problem.points.x, x)
    assert arch.problem.progress.factor == progress
    for a in (arch, undisturbed):
        list(a.problem.march_arc_length(0.01, steps=1, progress=False))
    assert arch.problem.progress.factor == pytest.approx(undisturbed.problem.progress.factor, rel=1e-9)


@BODIES
def test_a_failure_at_the_points_shortens_the_step(body, monkeypatch):
    """As one of the return mapping does: here large increments fail."""
    arch = body()
    follow(arch, 2)
    system = type(arch.problem.system)
    assemble = system.assemble

    def fails(self: Any, tangent: bool, lift: Any = None) -> Any:
        if self.comm.allreduce(float(np.abs(self.x).max(initial=0.0)), op=MPI.MAX) > limit:
            raise LocalFailure("too far for the points")
        return assemble(self, tangent, lift)

    limit = abs(arch.problem.system.x).max() + 0.015
    limit = COMM.allreduce(limit, op=MPI.MAX)
    monkeypatch.setattr(system, "assemble", fails)
    outcome, _ = arch.problem.attempt_along(0.03)
    assert (outcome.converged, outcome.reason) == (False, "too far for the points")
    (step,) = arch.problem.march_arc_length(0.03, steps=1, progress=False)
    assert step.cuts > 0


def test_long_steps_are_cut_and_grow_again():
    arch = Elements()
    first, *later = arch.problem.march_arc_length(3.0, steps=4, progress=False)
    assert first.cuts > 1
    assert first.iterations > 6
    assert all(step.cuts == 0 for step in later)
    again, way = Elements(), [0.0]
    for _ in again.problem.march_arc_length(3.0, steps=4, progress=False):
        way.append(again.crown())
    lengths = np.diff(way)
    assert lengths[3] > 1.3 * lengths[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"first": 0.0, "steps": 1}, r"first = 0\.0"),
        ({"first": "a", "steps": 1}, "first = 'a'"),
        ({"first": 0.1}, "one of until, to and steps"),
        ({"first": 0.1, "steps": 0}, "steps = 0"),
        ({"first": 0.1, "steps": 1.5}, r"steps = 1\.5"),
        ({"first": 0.1, "steps": True}, "steps = True"),
        ({"first": 0.1, "steps": 1, "largest": 0.05}, r"largest = 0\.05: at least first = 0\.1"),
        ({"first": 0.1, "steps": 1, "largest": np.inf}, "largest = inf"),
        ({"first": 0.1, "steps": 1, "smallest": 0}, "smallest = 0"),
        ({"first": 0.1, "to": np.nan}, "to = nan"),
        ({"first": 0.1, "until": True}, "until = True"),
    ],
)
def test_bad_arguments(options, message):
    """Named before anything is solved."""
    with pytest.raises(pm.InputError, match=message):
        beam(2).march_arc_length(**options)


def loaded(dim: int = 2, **load: Any) -> pm.QuasiStatic:
    problem = beam(dim)
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[:dim]), **load)
    return problem


def test_loads_that_cannot_be():
    """The message names the load."""
    for problem, message in (
        (beam(2), "no load grows"),
        (loaded(force=lambda t: (1.0, 0.0)), "no load grows"),
        (loaded(force=lambda t: (t**2, 0.0)), "load 1, force is not linear"),
        (loaded(3, couple=(0.0, 0.0, 1.0)), "load 1, couple: couples in space"),
    ):
        with pytest.raises(pm.InputError, match=message):
            problem.march_arc_length(0.1, steps=1)


def test_supports_that_cannot_be():
    problem = loaded(force=(1.0, 0.0))
    problem.fix(pm.plane(x=3.0), uy=0.1)
    with pytest.raises(pm.InputError, match=r"support 2 \(x = 3\), uy depends on the load factor"):
        problem.march_arc_length(0.1, steps=1)


def test_followers_are_refused():
    problem = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (2, 2)), material=MICROPOLAR))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    problem.pressure(problem.elements.farthest((1.0, 0.0)), 1.0)
    with pytest.raises(pm.InputError, match="pressure turns with the body"):
        problem.march_arc_length(0.1, steps=1)
