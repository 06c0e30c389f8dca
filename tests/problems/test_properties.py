"""Whatever a problem is given: an error of the package, or the right answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import polarmpm as pm
from tests.conftest import MICROPOLAR
from tests.helpers.bodies import box
from tests.helpers.weird import anything, attempt, flags, numbers, predicates, thorough, vectors

pytestmark = pytest.mark.filterwarnings("ignore")
GRID = pm.Grid.box((-1.0, -1.0), (4.0, 3.0), 1.0)
END = (1.0, 0.0)
# a force that bends the body a little, and values that are close to it
LIGHT = st.tuples(st.floats(-3, 3), st.floats(-3, 3))
COUNTS = st.one_of(st.sampled_from([None, "from now", "total"]), anything)


def seeded() -> pm.Points:
    return pm.seed(GRID, material=MICROPOLAR, bounds=((0.0, 0.0), (2.0, 1.0)), points_per_cell=2)


def held(points: pm.Points | None = None, **options: Any) -> Any:
    """Points with their left end held."""
    problem = pm.QuasiStatic(GRID, points or seeded(), basis="mpm", **options)
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return problem


def meshed() -> Any:
    """Elements with their left end held."""
    problem = pm.QuasiStaticFEM(pm.Elements(box("quadrilateral", (2, 1), (2.0, 1.0)), material=MICROPOLAR))
    problem.fix(pm.plane(x=0.0), u=0, theta=0)
    return problem


def marched(problem: Any, to: float = 1.0) -> bool:
    """Whether there was an equilibrium, which then is one."""
    if attempt(lambda: list(problem.march(1, to=to, progress=False))) is None:
        return False
    in_balance(problem)
    return True


def in_balance(problem: Any) -> None:
    """The sum of all forces vanishes, but for rounding."""
    found = problem.balance()
    largest = max((float(np.linalg.norm(part.force)) for part in found.parts), default=0.0)
    turning = max((float(np.linalg.norm(part.moment)) for part in found.parts), default=0.0)
    assert np.linalg.norm(found.force) <= 1e-5 * largest + 1e-9 * (1.0 + turning)


def total(problem: Any, name: str = "loads") -> np.ndarray:
    """Force of a part of the balance."""
    found = [part.force for part in problem.balance().parts if part.name.startswith(name)]
    return np.sum(found, axis=0) if found else np.zeros(2)


def as_numbers(value: Any, size: int) -> np.ndarray:
    """What an accepted value is at load factor 1."""
    value = value(1.0) if callable(value) else value
    return np.broadcast_to(np.asarray(value, dtype=float), (size,))


def functions(plain: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Values, and functions of the load factor that give them or something else."""
    wrong = st.sampled_from([lambda: 0.0, lambda t, X, z: 0.0, lambda *, t: 0.0, lambda t: lambda: t])
    return st.one_of(plain, plain.map(lambda value: lambda t: value), wrong, anything)


def fields(plain: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Functions of load factor and positions."""

    def spoils(t: float, X: np.ndarray) -> np.ndarray:
        X[:] = np.nan
        return np.zeros(2)

    shapes = st.sampled_from(
        [spoils, lambda t, X: X[:, :1], lambda t, X: X[:, 0], lambda t, X: X[:-1], lambda t, X: X > 0]
    )
    return st.one_of(shapes, plain.map(lambda value: lambda t, X: value))


# loads ---------------------------------------------------------------------------------------------
@thorough(20)
@given(functions(st.one_of(LIGHT, vectors(2))), functions(st.one_of(st.floats(-1, 1), numbers)), COUNTS)
def test_loads_sum_up(force, couple, counts):
    problem = held()
    tip = problem.points.farthest(END)
    given_ = {name: v for name, v in (("force", force), ("couple", couple)) if v is not None}
    load = attempt(problem.load, tip, **given_, counts=counts)
    assert bool(problem.loads) == (load is not None)
    if load is not None and marched(problem):
        expected = as_numbers(force, 2) if "force" in given_ else np.zeros(2)
        if callable(force) and counts == "from now":  # what a constant gains from now on
            expected = np.zeros(2)
        scale = 1.0 + np.abs(expected).max()
        np.testing.assert_allclose(total(problem), expected, atol=1e-10 * scale, rtol=1e-10)


@thorough(20)
@given(fields(st.one_of(LIGHT, vectors(2))))
def test_loads_of_positions(force):
    problem = held()
    X = problem.points.X.copy()
    if attempt(problem.body_load, force=force) is not None and marched(problem):
        np.testing.assert_array_equal(problem.points.X, X)
        shape = (len(X), 2)
        density = np.broadcast_to(np.asarray(force(1.0, X.copy()), dtype=float), shape)
        expected = problem.comm.allreduce((density * problem.points.volume0[:, None]).sum(axis=0))
        np.testing.assert_allclose(total(problem), expected, rtol=1e-10, atol=1e-10)


@thorough(10)
@given(functions(st.one_of(LIGHT, vectors(2))), flags, st.sampled_from(["mesh", "surface"]))
def test_tractions_sum_up(force, follows, on):
    problem = meshed() if on == "mesh" else held()
    where = pm.plane(x=2.0) if on == "mesh" else pm.Surface.line((2.0, 0.0), (2.0, 1.0), 4)
    if attempt(problem.traction, where, force=force, follows=follows) is None:
        assert not problem.loads
        assert not problem.terms
    elif marched(problem) and not follows:
        expected = as_numbers(force, 2)
        found = total(problem) + total(problem, "traction")
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * (1 + np.abs(expected).max()))


@thorough(10)
@given(functions(numbers), st.sampled_from(["mesh", "surface"]))
def test_pressures(p, on):
    """Nothing but a number comes to an equilibrium."""
    problem = meshed() if on == "mesh" else held()
    where = pm.plane(x=2.0) if on == "mesh" else pm.Surface.line((2.0, 0.0), (2.0, 1.0), 4)
    if attempt(problem.pressure, where, p) is not None and marched(problem):
        assert as_numbers(p, 1).shape == (1,)


@thorough(8)
@given(anything)
def test_places_of_loads(where):
    problem, mesh = held(), meshed()
    for one in (problem, mesh):
        assert attempt(one.load, where, force=(0.0, 1.0)) is None or callable(where)
    assert attempt(problem.traction, where, force=(0.0, 1.0)) is None
    load = attempt(problem.body_load, force=(0.0, 1.0), on=where)
    assert (load is not None) == (where is None)


# supports -------------------------------------------------------------------------------------------
@thorough(10)
@given(
    functions(st.one_of(st.floats(-0.01, 0.01), numbers)), st.sampled_from(["ux", "uy", "theta", "u", "uz"])
)
def test_nodes_go_where_supports_say(value, component):
    problem = meshed()
    support = attempt(problem.fix, pm.plane(x=2.0), **{component: value})
    assert len(problem.supports) == 1 + (support is not None)
    if support is None or not marched(problem):
        return
    nodes = problem.elements.facets(pm.plane(x=2.0)).nodes
    if component == "theta":
        turned = problem.elements.rotation_vector[nodes, 2:] - as_numbers(value, 1)
        found, expected = np.remainder(turned + np.pi, 2 * np.pi), np.array([np.pi])  # but for whole turns
    else:
        columns = {"ux": [0], "uy": [1], "u": [0, 1]}[component]
        found = problem.elements.displacement[nodes][:, columns]
        expected = as_numbers(value, len(columns))
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-12)


@thorough(12)
@given(predicates(lambda x: x[:, 0] > 1.9), anything, st.sampled_from([held, meshed]))
def test_places_of_supports(where, counts, make):
    problem = make()
    support = attempt(problem.fix, where, ux=0.0, counts=counts)
    if support is not None and marched(problem):
        force = problem.reaction(support).force
        assert np.all(np.isfinite(force))


@thorough(20)
@given(numbers, numbers, flags, numbers)
def test_springs(stiffness, rotation_stiffness, augment, normal):
    """Springs hold: what they give way under a load is the load over their stiffness."""
    problem = held()
    line = pm.Surface.line((2.0, 0.0), (2.0, 1.0), 4)
    springs = {"stiffness": stiffness, "rotation_stiffness": rotation_stiffness, "augment": augment}
    support = attempt(problem.fix, line, ux=normal, theta=0, **springs)
    if support is not None:
        assert 0 < float(stiffness) < math.inf
        assert 0 < float(rotation_stiffness) < math.inf
        marched(problem)
    assert len(problem.surfaces) == (support is not None)


@thorough(15)
@given(st.one_of(st.none(), numbers), st.one_of(st.none(), numbers), st.booleans(), st.booleans())
def test_releases(over, until, of_load, stepped):
    """What is released over load factors has gone when they are reached."""
    problem = held()
    load = problem.load(problem.points.farthest(END), force=(0.0, 1.0))
    support = problem.fix(pm.plane(y=0.0), uy=0)
    if stepped:
        list(problem.march(1, progress=False))
    condition = load if of_load else support
    before = problem.supports, problem.loads
    attempt(problem.release, condition, over=over, until=until)
    given_ = problem.given.of(condition)
    if given_.released is None:
        assert (problem.supports, problem.loads) == before
        return
    end = 1.0 if given_.until is None else given_.until
    assume(abs(end) < 1e3)
    if marched(problem, end if end != problem.progress.factor else end + 1.0) and of_load:
        np.testing.assert_allclose(total(problem), 0.0, atol=1e-9)


# marches --------------------------------------------------------------------------------------------
SCHEDULES = st.fixed_dictionaries(
    {},
    optional={
        "to": st.one_of(st.floats(-2, 2), anything),
        "adaptive": flags,
        "smallest": st.one_of(st.floats(1e-3, 1), anything),
        "largest": st.one_of(st.none(), st.floats(0.5, 2), anything),
        "easy": st.one_of(st.integers(0, 9), anything),
    },
)


@thorough(25)
@given(st.one_of(st.integers(1, 3), st.none(), anything), SCHEDULES)
def test_marches_end_where_they_are_to(steps, options):
    problem = held()
    problem.load(problem.points.farthest(END), force=(0.0, 1.0))
    march = attempt(problem.march, steps, **options, progress=False)
    assert problem.progress.step == 0
    if march is None:
        return
    to = float(options.get("to", 1.0))
    number = 10 if steps is None else int(steps)
    largest = options.get("largest")
    assume(number <= 10 and abs(to) < 10 and (largest is None or abs(to) / largest < 50))
    if attempt(list, march) is not None:
        assert problem.progress.factor == to
        assert len(problem.steps) == number or options.get("adaptive") or to == 0.0
        np.testing.assert_allclose(total(problem), (0.0, to) if problem.steps else 0.0, atol=1e-9)


@thorough(20)
@given(
    st.one_of(st.floats(1e-5, 1e-3), anything),
    st.fixed_dictionaries(
        {},
        optional={
            "steps": st.one_of(st.integers(1, 3), anything),
            "to": st.one_of(st.none(), anything),
            "largest": st.one_of(st.none(), st.floats(1e-5, 1e-2), anything),
            "smallest": st.one_of(st.floats(1e-3, 1), anything),
            "until": st.one_of(st.just(lambda step: True), anything),
        },
    ),
)
def test_paths_end_where_they_are_to(first, options):
    problem = held()
    problem.load(problem.points.farthest(END), force=(0.0, 1.0))
    march = attempt(problem.march_arc_length, first, **options, progress=False)
    if march is None:
        return
    assume(options.get("until") is not None or int(options.get("steps") or 99) < 5)
    assume(options.get("until") is None or int(options.get("steps") or 99) < 5)
    found = attempt(list, march)
    if found is not None:
        assert 1 <= len(found) <= int(options["steps"])
        in_balance(problem)


@thorough(60)
@given(anything, anything, anything, anything)
def test_controls(force, energy, iterations, divergence):
    made = attempt(pm.Controls, force, energy, iterations, divergence)
    if made is not None:
        assert 0 < made.force_tolerance < 1
        assert 0 <= made.energy_tolerance < 1
        assert 1 <= made.max_iterations == int(made.max_iterations)
        assert made.divergence > 1


OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "basis": st.one_of(st.sampled_from(["mpm", "gimpm", "bspline"]), anything),
        "assembly": st.one_of(st.sampled_from(["direct", "projection"]), anything),
        "reset": st.one_of(st.integers(1, 3), st.just(pm.WhenDistorted), anything),
        "balanced_reset": flags,
        "ghost": st.one_of(st.sampled_from(["light", "thesis", pm.GhostPenalty]), anything),
        "rebalance": st.one_of(st.just(1.5), anything),
        "controls": st.one_of(st.just(pm.Controls()), anything),
        "solver": st.one_of(st.just("direct"), anything),
        "boxes": flags,
    },
)


@thorough(20)
@given(OPTIONS)
def test_problems(options):
    """A problem that can be made can be marched."""
    problem = attempt(pm.QuasiStatic, GRID, seeded(), **options)
    if problem is not None:
        problem.fix(lambda x: x[:, 0] < 0.6, u=0, theta=0)
        problem.body_load(force=(0.0, 1.0))
        list(problem.march(1, progress=False))
        np.testing.assert_allclose(total(problem), (0.0, 2.0), rtol=1e-10)


@thorough(20)
@given(anything, anything)
def test_bodies_of_problems(first, second):
    assert attempt(pm.QuasiStatic, first, second) is None
    assert attempt(pm.QuasiStatic, GRID, second) is None
    assert attempt(pm.QuasiStatic, first, seeded()) is None
    assert attempt(pm.QuasiStaticFEM, first) is None


# results --------------------------------------------------------------------------------------------
@thorough(15)
@given(vectors(2), anything)
def test_moments(about, support):
    problem = held()
    problem.load(problem.points.farthest(END), force=(0.0, 1.0))
    list(problem.march(1, progress=False))
    assert attempt(problem.reaction, support) is None
    found = attempt(problem.reaction, problem.supports[0], about=about)
    if found is not None and about is not None:
        point, origin = np.asarray(about, dtype=float), problem.reaction(problem.supports[0])
        arm = point[0] * origin.force[1] - point[1] * origin.force[0]
        scale = 1.0 + np.abs(point).max()
        np.testing.assert_allclose(found.moment, origin.moment - arm, rtol=1e-9, atol=1e-9 * scale)
    attempt(problem.balance, about=about)


@thorough(15)
@given(
    st.lists(
        st.one_of(st.sampled_from(["energy", "stress", "mean_pressure", "hardening"]), anything), max_size=3
    )
)
def test_fields(names):
    problem = held()
    found = attempt(problem.fields, *names)
    if found is not None and names:
        assert list(found) == list(dict.fromkeys(names))
        assert all(len(values) == len(problem.points) for values in found.values())


# one after the other ----------------------------------------------------------------------------------
CALLS = st.sampled_from(["march", "next", "other", "attempt", "new", "load", "fix", "release", "path", "bad"])


@thorough(12)
@given(st.lists(st.tuples(CALLS, st.integers(0, 1)), max_size=8))
def test_problems_take_turns(calls):
    """Marches, and problems of the same body, in any order: each step of a problem that isn't refused is an
    equilibrium under the loads it has been given."""
    points = seeded()
    problems, marches, force = [held(points), held(points)], [None, None], [0.0, 0.0]
    for problem, call in ((problems[which], call) for call, which in calls):
        which = problems.index(problem)
        factor = problem.progress.factor
        if call == "new":
            problems[which], marches[which], force[which] = held(points), None, 0.0
        elif call == "load" and factor == 0.0:
            problem.body_load(force=lambda t: (0.0, 0.5 * t))
            force[which] += 1.0
        elif call == "fix":
            problem.fix(pm.plane(y=0.0), uy=0, counts="from now")
        elif call == "release" and len(problem.supports) > 1:
            problem.release(problem.supports[-1])
        elif call == "bad":
            assert attempt(problem.load, None, force=(0.0, 1.0)) is None
        elif call == "path":
            attempt(lambda p=problem: list(p.march_arc_length(1e-4, steps=1, progress=False)))
        elif call == "attempt":
            attempt(problem.attempt, factor + 0.1)
        elif call == "march":
            marches[which] = attempt(problem.march, 3, to=factor + 1.0, progress=False)
        elif call == "next" and marches[which] is not None:
            attempt(next, marches[which], None)
        else:
            attempt(lambda p=problem, f=factor: list(p.march(1, to=f + 0.2, progress=False)))
        if problem.progress.factor != factor:
            in_balance(problem)
            expected = (0.0, force[which] * problem.progress.factor)
            np.testing.assert_allclose(total(problem), expected, atol=1e-9)
