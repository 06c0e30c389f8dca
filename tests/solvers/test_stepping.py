"""Load stepping, resets, and what a failed step leaves behind."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import polarmpm as pm
from polarmpm.errors import LocalFailure
from polarmpm.problems import ongrid
from polarmpm.solvers import newton
from polarmpm.solvers.newton import Outcome
from polarmpm.solvers.stepping import Schedule, march
from tests.conftest import COMM, GENERAL, HENCKY, MICROPOLAR, NEO_HOOKEAN, beam, by_id, rotation


class Stub:
    """Converges for steps up to `limit`; remembers what was attempted."""

    comm = COMM

    def __init__(self, limit: float, iterations: int = 3, creeps: bool = False):
        self.limit, self.iterations, self.creeps = limit, iterations, creeps
        self.progress, self.steps = SimpleNamespace(factor=0.0, step=0), []
        self.attempts: list[float] = []

    def whole(self, work):
        return work()

    def attempt(self, factor: float) -> Outcome:
        self.attempts.append(factor)
        history = [(1.0, 1.0)] * (self.iterations + 1)
        if abs(factor - self.progress.factor) > self.limit * (1 + 1e-12):
            return Outcome(False, history, "too far")
        return self.reach(factor, history)

    def attempt_creeping(self, factor: float) -> Outcome:
        return self.reach(factor, [(1.0, 1.0)] * 8) if self.creeps else Outcome(False, [], "still too far")

    def reach(self, factor, history):
        self.progress.factor, self.progress.step = factor, self.progress.step + 1
        return Outcome(True, history)


def run(stub: Stub, steps: int | None, **options) -> list[pm.Step]:
    return list(march(stub, Schedule(steps, **options)))


def loaded(dim: int = 2, size: float = 1.0, **options) -> pm.QuasiStatic:
    """A cantilever with a force at its end."""
    problem = beam(dim, **options)
    tip = problem.points.farthest((1.0, 0.0, 0.0)[:dim])
    problem.load(tip, force=np.multiply(size, (4.0, -8.0, 5.0)[:dim]))
    return problem


def snapshot(problem: pm.QuasiStatic) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in problem.points.arrays().items()}


# schedules ----------------------------------------------------------------------------------------
def test_equal_steps():
    """The given number of equal steps, the last one exactly at the end."""
    steps = run(Stub(1.0), 7)
    np.testing.assert_allclose([s.factor for s in steps], np.arange(1, 8) / 7, rtol=1e-11)
    assert steps[-1].factor == 1.0
    assert [s.number for s in steps] == list(range(1, 8))
    assert all(s.cuts == 0 and s.iterations == 3 for s in steps)


def test_parts_of_a_path():
    """Further marches go on from where the last one ended, up or down."""
    stub = Stub(1.0)
    run(stub, 2, to=0.5)
    run(stub, 1)
    run(stub, 2, to=-1.0)
    np.testing.assert_allclose(stub.attempts, [0.25, 0.5, 1.0, 0.0, -1.0])


@pytest.mark.parametrize(("begin", "to"), [(0.0, 1.0), (0.0, 0.3), (1.0, 0.0), (0.25, -2.0), (0.0, 1e-9)])
def test_a_restarted_run_passes_the_same_factors(begin, to):
    """From wherever it goes on, as its load steps are counted from the factor in the file."""
    for steps in (3, 7, 30, 60, 97, 1000):
        whole = Stub(limit=np.inf)
        whole.progress.factor = begin
        factors = [step.factor for step in run(whole, steps, to=to)]
        np.testing.assert_allclose(
            factors,
            begin + (to - begin) * np.arange(1, steps + 1) / steps,
            rtol=0,
            atol=4e-15 * max(1, abs(to)),
        )
        for stop in range(1, steps, max(1, steps // 20)):
            again = Stub(limit=np.inf)
            again.progress.factor = factors[stop - 1]
            assert [step.factor for step in run(again, steps - stop, to=to)] == factors[stop:]


def test_equal_steps_give_up():
    """No retry without `adaptive`: the factor and the reason are told."""
    with pytest.raises(pm.NotConverged, match=r"load factor 0\.5.*\n.*too far after 3 iterations") as e:
        run(Stub(0.3), 2)
    assert e.value.factor == 0.5
    assert len(e.value.tried) == 1
    assert len(e.value.history) == 4


def test_steps_that_cannot_be_cut_creep():
    """Those that can are cut first; iterations of both ways count."""
    (step,) = run(Stub(0.3, creeps=True), 1)
    assert (step.factor, step.cuts, len(step.history)) == (1.0, 0, 12)
    stub = Stub(0.13, creeps=True)
    assert [step.cuts for step in run(stub, 1, adaptive=True, smallest=0.5)] == [1, 0]
    assert stub.attempts == [1.0, 0.5, 1.0]


def test_adaptive_cuts_retries_and_grows():
    """A failed step is halved from the last converged factor; easy steps grow again up to the first."""
    stub = Stub(0.13)
    steps = run(stub, 2, adaptive=True)
    assert stub.attempts[:4] == [0.5, 0.25, 0.125, 0.125 + 1.5 * 0.125]
    assert steps[0].cuts == 2
    assert stub.progress.factor == steps[-1].factor == 1.0
    stub.limit = 10.0
    later = run(stub, 4, adaptive=True, to=3.0)
    np.testing.assert_allclose([s.factor for s in later], [1.5, 2.0, 2.5, 3.0])


def test_adaptive_does_not_grow_after_hard_steps():
    """More iterations than `easy` keep the size."""
    stub = Stub(0.13, iterations=9)
    steps = run(stub, 2, adaptive=True, easy=6)
    np.testing.assert_allclose(np.diff([0.0] + [s.factor for s in steps]), 0.125)
    assert len(stub.attempts) == len(steps) + 2


def test_adaptive_grows_to_the_largest():
    """Beyond the first step where it is allowed; smaller than the first where that is too much."""
    factors = [s.factor for s in run(Stub(10.0), 20, adaptive=True, largest=0.1)]
    np.testing.assert_allclose(np.diff(factors)[:4], [0.075, 0.1, 0.1, 0.1])
    assert factors[0] == 0.05
    np.testing.assert_allclose(
        np.diff([s.factor for s in run(Stub(10.0), 2, adaptive=True, largest=0.2)]), 0.2
    )


def test_adaptive_unloads():
    """A smaller final factor works the same way."""
    stub = Stub(0.3)
    stub.progress.factor = 1.0
    steps = run(stub, 1, adaptive=True, to=-0.5)
    assert steps[-1].factor == -0.5
    assert np.all(np.diff([1.0] + [s.factor for s in steps]) < 0)


def test_adaptive_gives_up():
    """When steps get too small every attempt since the last success is told."""
    stub = Stub(1e-6)
    with pytest.raises(pm.NotConverged) as e:
        run(stub, 2, adaptive=True, smallest=0.1)
    np.testing.assert_allclose(stub.attempts, [0.5, 0.25, 0.125, 0.0625])
    assert len(e.value.tried) == 4
    assert stub.progress.factor == 0.0


@pytest.mark.parametrize(
    ("steps", "options", "message"),
    [
        (0, {}, "steps = 0"),
        (2.5, {}, r"steps = 2\.5"),
        (True, {}, "steps = True"),
        (None, {}, "number of steps"),
        (2, {"to": np.nan}, "to = nan"),
        (2, {"adaptive": True, "smallest": 0.0}, r"smallest = 0\.0"),
        (2, {"adaptive": True, "largest": 0.0}, r"largest = 0\.0"),
        (2, {"largest": 0.1}, r"largest = 0\.1.*adaptive"),
    ],
)
def test_bad_schedules(steps, options, message):
    """The argument and its value are named, before anything is solved."""
    with pytest.raises(pm.InputError, match=message):
        beam(2).march(steps, **options)


# real problems ------------------------------------------------------------------------------------
def test_adaptive_steps_reach_a_load_that_is_too_much_for_one():
    """One step fails, adaptive steps get there, to where many equal steps lead."""
    options = {"basis": "mpm", "reset": None}
    with pytest.raises(pm.NotConverged):
        list(loaded(size=60.0, **options).march(1))
    adaptive, equal = loaded(size=60.0, **options), loaded(size=60.0, **options)
    steps = list(adaptive.march(1, adaptive=True))
    assert sum(s.cuts for s in steps) > 0
    assert steps[-1].factor == 1.0
    list(equal.march(40))
    expected = by_id(equal.points, equal.points.x)
    np.testing.assert_allclose(by_id(adaptive.points, adaptive.points.x), expected, atol=1e-6)


@pytest.mark.parametrize("reset", [1, 2, None])
@pytest.mark.parametrize("dim", [2, 3])
def test_failure_leaves_the_last_state(dim, reset):
    """After NotConverged points, bit for bit, and progress are those of the last converged step; and a run
    that goes on gives what a run without the failure gives."""
    problem, undisturbed = loaded(dim, reset=reset), loaded(dim, reset=reset)
    list(problem.march(3, to=0.3))
    list(undisturbed.march(3, to=0.3))
    before = snapshot(problem)
    with pytest.raises(pm.NotConverged, match="last converged state is intact"):
        list(problem.march(1, to=1e5))
    assert snapshot(problem) == before
    assert (problem.progress.factor, problem.progress.step, len(problem.steps)) == (0.3, 3, 3)
    list(problem.march(2, to=0.5))
    list(undisturbed.march(2, to=0.5))
    assert problem.progress.step == undisturbed.progress.step
    expected = by_id(undisturbed.points, undisturbed.points.x)
    np.testing.assert_allclose(by_id(problem.points, problem.points.x), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("reset", [1, 2, None])
def test_reactions_after_a_failure(reset):
    """Reactions belong to the last converged state, not to the last attempt."""
    problem = loaded(reset=reset)
    list(problem.march(1, to=0.3))
    force = problem.reaction(problem.supports[0])[0]
    np.testing.assert_allclose(force, [-1.2, 2.4], rtol=1e-6)
    with pytest.raises(pm.NotConverged):
        list(problem.march(1, to=1e5))
    np.testing.assert_allclose(problem.reaction(problem.supports[0])[0], force, rtol=1e-6)


def test_points_that_leave_the_grid():
    """The ids of the points that left are told; their state is the last converged one, not a mixture."""
    grid = pm.Grid.box((0, 0), (4, 2), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (3, 2)))
    problem = pm.QuasiStatic(grid, points, basis="mpm", reset=1, balanced_reset=False)
    problem.fix(lambda x: np.ones(len(x), dtype=bool), ux=lambda t: 2.0 * t, uy=0, theta=0)
    done = []
    with pytest.raises(pm.PointsOutsideGrid, match=r"outside the grid.*ids") as e:
        done.extend(problem.march(8))
    x, ids = by_id(points, points.x), by_id(points, points.id)
    outside = ids[x[:, 0] > 4.0]
    assert len(outside) > 0
    assert e.value.ids == outside[:20].tolist()
    assert str(outside[0]) in str(e.value)
    factor = problem.progress.factor
    np.testing.assert_allclose(x[:, 0], by_id(points, points.X)[:, 0] + 2.0 * factor, atol=1e-12)


# resets -------------------------------------------------------------------------------------------
@pytest.fixture
def resets(monkeypatch) -> list[int]:
    """Grows by one entry with every new set of weighting functions."""
    count: list[int] = []
    original = ongrid.Interpolation

    def counting(*args, **options):
        count.append(1)
        return original(*args, **options)

    monkeypatch.setattr(ongrid, "Interpolation", counting)
    return count


@pytest.mark.parametrize(
    ("reset", "expected"), [(1, 6), (2, 3), (4, 2), (None, 1), (pm.EverySteps(3), 2), (pm.Never(), 1)]
)
def test_resets_are_counted(reset, expected, resets):
    """Weighting functions are made anew as often as the policy says, not more."""
    list(loaded(reset=reset).march(6))
    assert len(resets) == expected


def test_reset_when_distorted(resets):
    """Rigid motion resets nothing; strain beyond the limit does, once it is there."""
    vector = np.array([0.0, 0.0, 1.5])
    grid = pm.Grid.box((-4, -4), (4, 4), 1.0)
    for stretch, expected in ((0.0, 1), (0.5, 3)):
        points = pm.seed(grid, material=MICROPOLAR, bounds=((0, 0), (2, 2)))
        problem = pm.QuasiStatic(grid, points, basis="mpm", reset=pm.WhenDistorted(0.2), balanced_reset=False)

        def move(t, x, stretch=stretch):
            return x @ (rotation(t * vector) * (1 + stretch * t) - np.eye(3))[:2, :2].T

        problem.fix(lambda x: np.ones(len(x), dtype=bool), u=move, theta=1.5)
        del resets[:]
        for step in problem.march(4):
            if stretch and step.number == 1:
                # E = ((1 + 0.125)^2 - 1) / 2 I, of norm 0.188
                assert len(resets) == 1
                assert not problem.progress.reset_due
            if stretch and step.number == 2:
                assert problem.progress.reset_due
            if stretch == 0.0 and step.number == 4:
                assert len(resets) == expected
        if stretch:
            assert len(resets) > 1


@pytest.mark.parametrize("bad", [0, -1, 1.5, True, "always"])
def test_bad_reset(bad):
    """The value and what is allowed are named."""
    with pytest.raises(pm.InputError, match="reset"):
        beam(2, reset=bad)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_bad_distortion_limit(bad):
    """A limit is a positive number."""
    with pytest.raises(pm.InputError, match="limit = "):
        pm.WhenDistorted(bad)


@pytest.mark.parametrize(("dim", "material"), [(2, MICROPOLAR), (2, GENERAL), (3, MICROPOLAR)])
def test_resets_not_steps_move_the_answer(dim, material, strict):
    """30 steps with a reset every 2 equal 15 steps with a reset every step, to 1e-7."""
    answers = []
    for steps, reset in ((30, 2), (15, 1), (30, 1)):
        problem = loaded(dim, material=material, reset=reset, controls=strict)
        list(problem.march(steps))
        answers.append(by_id(problem.points, problem.points.displacement))
    size = abs(answers[0]).max()
    np.testing.assert_allclose(answers[0], answers[1], rtol=0, atol=1e-7 * size)
    assert abs(answers[2] - answers[1]).max() > 1e-6 * size  # while further resets do


@pytest.mark.parametrize("material", [MICROPOLAR, HENCKY])
def test_without_resets_the_path_does_not_matter(material, strict):
    """A total Lagrangian method gives the same answer in 1, 3 and 7 steps, and comes back when unloaded."""
    answers = []
    for steps in (1, 3, 7):
        problem = loaded(material=material, basis="mpm", reset=None, controls=strict)
        list(problem.march(steps))
        answers.append(by_id(problem.points, problem.points.x))
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-10)
    np.testing.assert_allclose(answers[2], answers[0], atol=1e-10)
    list(problem.march(3, to=0.1))
    assert (
        abs(problem.points.displacement).max(initial=0.0)
        < 0.15 * abs(answers[0] - by_id(problem.points, problem.points.X)).max()
    )


def torsion(steps: int, turns: float, **options) -> tuple[pm.QuasiStatic, list[pm.Step], list[np.ndarray]]:
    """A bar along z whose upper end is turned about its axis; also the quaternions after each step."""
    length, angle = 6.0, 2 * np.pi * turns
    grid = pm.Grid.box((-2, -2, -1), (2, 2, 7), 1.0)
    points = pm.seed(grid, material=MICROPOLAR, bounds=((-1, -1, 0), (1, 1, length)))
    problem = pm.QuasiStatic(grid, points, **{**pm.PUBLISHED, "basis": "mpm", **options})
    problem.fix(pm.plane(z=0.0), u=0, theta=0)

    def turned(t, x):
        c, s = np.cos(t * angle), np.sin(t * angle)
        return np.stack(
            [(c - 1) * x[:, 0] - s * x[:, 1], s * x[:, 0] + (c - 1) * x[:, 1], 0 * x[:, 2]], axis=1
        )

    problem.fix(pm.plane(z=length), u=turned, theta=(0, 0, angle))
    done, history = [], []
    for step in problem.march(steps):
        done.append(step)
        history.append(by_id(points, points.q))
    return problem, done, history


def test_torsion_beyond_a_full_turn(strict):
    """Without resets rotations get new bases: convergence stays the same past 2 pi, and the twist is smooth.

    The number of steps matters a little: rotations about different axes are interpolated from base to base.
    """
    problem, steps, history = torsion(24, 1.2, reset=None, controls=strict)
    assert max(s.iterations for s in steps) <= 8
    assert steps[-1].iterations <= steps[0].iterations + 3
    jumps = [np.sum(a * b, axis=1).min() for a, b in zip(history[1:], history[:-1], strict=True)]
    assert min(jumps) > np.cos(0.5 * 1.05 * 2 * np.pi * 1.2 / 24)  # no point turns more than the end does
    X = by_id(problem.points, problem.points.X)
    # quaternions keep count: the angle of the upper points is beyond 2 pi / 2, where q0 < 0
    upper = X[:, 2] > 5.5
    half = np.arctan2(history[-1][upper, 3], history[-1][upper, 0]) % (2 * np.pi)
    np.testing.assert_allclose(2 * half, 2 * np.pi * 1.2 * X[upper, 2] / 6.0, rtol=0.05)
    other, _, _ = torsion(30, 1.2, reset=None, controls=strict)
    expected = by_id(problem.points, problem.points.x)
    np.testing.assert_allclose(by_id(other.points, other.points.x), expected, atol=5e-3)
    # a turn by symmetry: opposite points stay opposite
    np.testing.assert_allclose(expected[:, :2], -expected[find_opposite(X), :2], atol=1e-8)


def find_opposite(X: np.ndarray) -> np.ndarray:
    """Row of the point at (-x, -y, z) for each point."""
    target = X * [-1, -1, 1]
    return np.array([int(np.argmin(np.linalg.norm(X - t, axis=1))) for t in target])


class Local:
    """A system whose points fail at the n-th evaluation."""

    def __init__(self, at: int):
        self.left = at

    def evaluate(self, tangent: bool) -> None:
        self.left -= 1
        if self.left == 0:
            raise LocalFailure("3 points: no return to the yield surface")

    def convergence_measures(self) -> tuple[float, float]:
        return 1.0, 1.0

    def waits(self) -> bool:
        return False

    def pending(self) -> bool:
        return False

    def update(self, fresh: bool, accuracy: float) -> None:
        """The state doesn't change."""

    def backtrack(self) -> bool:
        return False

    def slope(self, start: bool = False) -> float | None:
        return None


class Shortened(Local):
    """Points have stresses again once the correction has been halved twice."""

    def __init__(self) -> None:
        super().__init__(2)
        self.halved = 0

    def evaluate(self, tangent: bool) -> None:
        self.left -= 1
        if self.left <= 0 and self.halved < 2:
            raise LocalFailure("3 points: no return to the yield surface")
        assert tangent or not self.halved  # what backtracking leaves pending is put in with it

    def convergence_measures(self) -> tuple[float, float]:
        return (0.0, 0.0) if self.halved == 2 else (1.0, 1.0)

    def backtrack(self) -> bool:
        self.halved += 1
        return True


def test_corrections_are_halved_until_the_points_have_stresses():
    system = Shortened()
    outcome = newton.solve(system, pm.Controls())
    assert outcome.converged
    assert system.halved == 2


def test_backtracking_leaves_prescribed_values_to_be_put_in():
    """Half of a correction is taken back; the supports' part of it is pending again."""
    problem = beam(2)
    problem.fix(pm.plane(x=4.0), ux=0.2)
    system = problem.system_at(1.0)
    system.set_prescribed(system.prescribed.increments(1.0))
    assert not system.backtrack()
    system.evaluate(True)
    system.update(True)
    whole = system.x.copy()
    assert not system.pending()
    assert system.backtrack()
    assert system.pending()
    np.testing.assert_allclose(system.x, 0.5 * whole, rtol=1e-14)
    system.evaluate(True)
    system.update(True)
    fixed = system.prescribed.fixed
    np.testing.assert_allclose(system.x[fixed], whole[fixed], rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("at", [1, 3])
def test_a_failure_at_the_points_is_a_reason(at):
    """What the points report fails the attempt and is told."""
    outcome = newton.solve(Local(at), pm.Controls())
    assert not outcome.converged
    assert outcome.reason == "3 points: no return to the yield surface"
    assert outcome.iterations == max(0, at - 2)


@pytest.mark.parametrize("material", [MICROPOLAR, NEO_HOOKEAN], ids=["micropolar", "neo-hookean"])
def test_predicted_stresses_save_iterations(material):
    """A slender beam bends through half its length in a few steps: to the same state in fewer iterations."""

    def bar(x):
        return (x[:, 0] < 10) & (abs(x[:, 1] - 0.5) < 0.5)

    kind = type(material)
    plain = type(kind.__name__, (kind,), {"stress_prediction": False})(**material.parameters())
    tips, iterations = [], []
    for m in (material, plain):
        grid = pm.Grid.box((0.0, -8.0), (12.0, 4.0), 0.5)
        points = pm.seed(
            grid, lambda x: (x[:, 0] < 10) & (abs(x[:, 1] - 0.5) < 0.5), material=m, points_per_cell=3
        )
        problem = pm.QuasiStatic(
            grid,
            points,
            reset=None,
            controls=pm.Controls(force_tolerance=1e-11),
            basis="gimpm",
            balanced_reset=False,
        )
        problem.fix(pm.plane(x=0.0), u=0)
        problem.load(points.farthest((1.0, 0.0)), force=(0, -0.01 * m.mu))
        iterations.append(sum(step.iterations for step in problem.march(4)))
        tips.append(points.mean_displacement(points.farthest((1.0, 0.0))))
    np.testing.assert_allclose(*tips, rtol=1e-8)
    assert abs(tips[0][1]) > 4.0
    assert iterations[0] < 0.8 * iterations[1]
