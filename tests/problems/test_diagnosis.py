"""What a failed load step says of its cause, and what it doesn't say; marches that nobody iterates; reprs."""

from __future__ import annotations

import gc
import pickle
import warnings
from typing import Any

from petsc4py import PETSc

import numpy as np
import pytest
import ufl

import polarmpm as pm
from polarmpm.assembly.parts import Parts, joined
from polarmpm.problems import diagnosis, divergence
from polarmpm.problems import points as points_problem
from polarmpm.solvers.weakest import WeakTangent
from tests.conftest import COMM, MICROPOLAR, NEO_HOOKEAN, by_id
from tests.helpers.bodies import cantilever

SERIAL = pytest.mark.skipif(COMM.size > 1, reason="a mesh that dolfinx cuts apart on several ranks")


def bar(dim: int = 2, material: pm.Material = MICROPOLAR, **options: Any) -> pm.QuasiStatic:
    """4 x 1 (x 1) cells without supports."""
    grid = pm.Grid.box((-2.0, -3.0, -2.0)[:dim], (9.0, 4.0, 3.0)[:dim], 1.0)
    upper = options.pop("upper", (4.0, 1.0, 1.0)[:dim])
    seeded = {name: options.pop(name) for name in ("inside", "points_per_cell") if name in options}
    bounds = (np.zeros(dim), np.array(upper))
    points = pm.seed(grid, material=material, bounds=bounds, **{"points_per_cell": 2, **seeded})
    return pm.QuasiStatic(grid, points, **options)


def near_the_wall(x: np.ndarray) -> np.ndarray:
    return x[:, 0] < 0.3


def clamp(problem: pm.QuasiStatic) -> pm.QuasiStatic:
    problem.fix(near_the_wall, u=0, **({"theta": 0} if problem.layout.rotations else {}))
    return problem


def push(problem: pm.QuasiStatic, *force: float) -> pm.QuasiStatic:
    problem.load(problem.points.farthest((1.0, 0.0, 0.0)[: problem.points.dim]), force=force)
    return problem


def failure(problem: Any, steps: int | None = 2, **options: Any) -> pm.NotConverged:
    """The error of a march that has to fail, the same on all ranks."""
    with pytest.raises(pm.NotConverged) as caught:
        list(problem.march(steps, progress=False, **options))
    error = caught.value
    assert len(set(COMM.allgather(str(error)))) == 1
    assert 0 < len(error.findings) <= 6
    assert all(finding.text in str(error) for finding in error.findings)
    return error


def kinds(error: pm.NotConverged) -> list[str]:
    return [finding.kind for finding in error.findings]


# free motions -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_without_supports(basis, dim):
    """Nothing else is found than that it can go anywhere."""
    error = failure(push(bar(dim, basis=basis), *[0.0] * (dim - 1), 10.0))
    assert kinds(error) == ["free rigid motion"]
    assert "the body can move in all directions and turn: no support holds it" in str(error)


def test_elements_without_supports():
    problem = cantilever()
    problem.release(problem.supports[0])
    problem.traction(problem.elements.farthest((1.0, 0.0)), force=(0.0, 1.0))
    assert "the body can move in all directions and turn" in failure(problem).findings[0].text


@pytest.mark.parametrize(
    ("held", "text", "direction"),
    [
        ({"ux": 0}, "can move along y: ", (0, 1)),
        ({"uy": 0}, "can move along x and turn: ", (1, 0)),  # about a point of the column of nodes
        ({"theta": 0}, "can move in all directions: ", None),
        ({"theta": 0, "ux": 0}, "can move along y: ", (0, 1)),
    ],
)
def test_what_a_support_leaves_free(held, text, direction):
    """The motion, and the support that holds some of the body, are named."""
    problem = bar()
    support = problem.fix(near_the_wall, **held)
    finding = failure(push(problem, 3.0, 10.0)).findings[0]
    assert text in finding.text
    assert f"{support.name}: {', '.join(held)}" in finding.text or "theta" in held
    if direction is not None:
        np.testing.assert_allclose(finding.direction, direction, atol=1e-9)


def test_a_classical_body_turns_about_a_pin():
    """And about a line, in space."""
    problem = bar(material=NEO_HOOKEAN, basis="mpm")
    problem.fix(lambda x: np.linalg.norm(x, axis=1) < 0.1, u=0)
    finding = failure(push(problem, 0.0, 10.0)).findings[0]
    assert "the body can turn about (0, 0) m" in finding.text
    np.testing.assert_allclose(np.abs(finding.direction), (0, 0, 1))
    solid = cantilever("hexahedron", NEO_HOOKEAN)
    solid.release(solid.supports[0])
    solid.fix(lambda x: np.hypot(x[:, 0], x[:, 2]) < 1e-9, u=0)
    solid.body_load(force=(0, 0, 1.0))
    finding = failure(solid).findings[0]
    assert "turn about the axis along y through (0, 0.5, 0) m" in finding.text


def test_a_part_that_floats():
    """The part that isn't held is the one that is named, with its points and its place."""
    apart = {"inside": lambda x: (x[:, 0] < 2) | (x[:, 0] > 5), "upper": (7.0, 1.0)}
    problem = push(clamp(bar(**apart)), 10.0, 0.0)
    finding = failure(problem).findings[0]
    assert "the part of 8 point(s) around (6, 0.5) m can move" in finding.text
    np.testing.assert_allclose(finding.places, [(6, 0.5)])
    parts = Parts.of(problem.system_at(1.0), problem.points)
    assert parts.count.tolist() == [8, 8]
    number, right = by_id(problem.points, parts.points), by_id(problem.points, problem.points.x[:, 0] > 5)
    assert len(set(number[right])) == len(set(number[~right])) == 1
    assert len(set(number)) == 2


def test_springs_hold_what_they_hold():
    """Along the normal only, the body is free along the surface; else it is not."""
    for springs, free in (({"normal": 0}, True), ({"u": 0, "theta": 0}, False)):
        problem = bar()
        problem.fix(pm.Surface.line((1e-9, 1.0), (1e-9, 0.0), 4), **springs)
        error = failure(push(problem, 0.0, 10.0 if free else 1e7))
        assert (kinds(error) == ["free rigid motion"]) is free
        assert ("can move along y" in str(error)) is free
        assert "can move" in str(error) or "times its size" in str(error)


def test_a_support_that_is_released():
    problem = push(clamp(bar()), 0.0, 1.0)
    list(problem.march(1, to=0.5, progress=False))
    problem.release(problem.supports[0])
    assert "the body can move in all directions" in failure(problem).findings[0].text


def test_a_path_of_a_free_body():
    """At the very start of a path there is no load yet; it counts by what it grows."""
    problem = bar(basis="mpm")
    problem.fix(near_the_wall, ux=0)
    push(problem, 0.0, 10.0)
    with pytest.raises(pm.NotConverged, match=r"can move along y.*the load pushes it") as caught:
        list(problem.march_arc_length(0.1, to=1.0, progress=False))
    assert kinds(caught.value) == ["free rigid motion"]


def test_a_free_part_without_a_load_is_told_last():
    """It need not be the cause."""
    apart = {"inside": lambda x: (x[:, 0] < 2) | (x[:, 0] > 5), "upper": (7.0, 1.0)}
    problem = clamp(bar(basis="mpm", **apart))
    problem.load(problem.points.nearest((1.75, 0.75)), force=(0.0, 1e5))
    error = failure(problem)
    assert kinds(error)[0] == "too large"
    assert kinds(error)[-1] == "free rigid motion"
    assert "is in balance" in error.findings[-1].text


# others -------------------------------------------------------------------------------------------------
HELD = {"free rigid motion", "linear system", "not finite", "too few points", "no diagnosis"}


@pytest.mark.parametrize("basis", ["mpm", "gimpm", "bspline"])
@pytest.mark.parametrize("material", [MICROPOLAR, NEO_HOOKEAN])
def test_too_large_a_load(basis, material):
    """No free motion, no singular tangent: the step is too large, and equal steps aren't cut."""
    error = failure(push(clamp(bar(material=material, basis=basis)), 0.0, 1e7))
    assert kinds(error)[0] == "too large"
    assert not HELD & set(kinds(error))
    assert "march(adaptive=True)" in str(error)


def test_inside_out():
    problem = push(clamp(bar(material=NEO_HOOKEAN)), -5e4, 0.0)
    error = failure(problem)
    finding = next(f for f in error.findings if f.kind == "inside out")
    assert set(finding.ids) <= set(np.concatenate(COMM.allgather(problem.points.id)).tolist())
    x = by_id(problem.points, problem.points.x)[finding.ids[0]]
    np.testing.assert_allclose(finding.places[0], x)
    assert "NeoHookean" in finding.text
    assert not HELD & set(kinds(error))


def test_adaptive_steps_are_not_advised_to_adapt():
    error = failure(push(clamp(bar()), 0.0, 1e9), adaptive=True, smallest=0.5)
    assert "load steps" not in kinds(error)


def plastic(H: float) -> pm.Material:
    return pm.VonMises(pm.Hencky(lam=3e3, mu=2e3), k=20.0, H=H)


def test_a_limit_load():
    """Perfect plasticity: more load than the cross section can take."""
    body = bar(material=plastic(0.0), locking=None)
    error = failure(push(clamp(body), 45.0, 0.0), adaptive=True, smallest=0.05)
    assert kinds(error)[0] == "limit load"
    assert "march_arc_length" in str(error)
    assert not HELD & set(kinds(error))


def user(energy: Any) -> pm.QuasiStatic:
    return push(clamp(bar(material=pm.UserEnergy(energy, {"a": 1.0}))), 0.0, 1.0)


def test_an_energy_that_is_not_finite(monkeypatch):
    """At no strain already, in the points' boxes too. (Problems refuse it; others come to that later.)"""
    monkeypatch.setattr(points_problem, "try_energy", lambda material, comm: None)
    error = failure(user(lambda E, G, p: p.a * ufl.ln(ufl.tr(E)) + ufl.inner(E, E) + ufl.inner(G, G)))
    assert kinds(error) == ["not finite"]
    assert "UserEnergy" in str(error)
    assert error.findings[0].ids


@pytest.mark.parametrize(
    ("energy", "unknowns"),
    [
        (lambda E, G, p: 0.0 * p.a, ("ux", "uy", "theta")),
        (lambda E, G, p: p.a * ufl.inner(ufl.sym(E), ufl.sym(E)), ("theta",)),
    ],
)
def test_unknowns_without_stiffness(energy, unknowns, monkeypatch):
    monkeypatch.setattr(points_problem, "try_energy", lambda material, comm: None)
    finding = failure(user(energy)).findings[0]
    assert finding.kind == "linear system"
    assert finding.unknowns == unknowns
    assert "nodes have no stiffness" in finding.text


def test_a_microrotation_that_nothing_holds():
    """Without kappa and with theta free, a couple turns the points on the spot; a force does not."""
    loose = pm.MicropolarElastic(lam=3e3, mu=2e3, kappa=0.0, alpha=1.0, beta=1.0, gamma=1.0)
    problem = bar(material=loose)
    problem.fix(near_the_wall, u=0)
    problem.load(problem.points.farthest((1.0, 0.0)), couple=1.0)
    finding = failure(problem).findings[0]
    assert finding.kind == "linear system"
    assert set(finding.unknowns) == {"theta"}
    assert "is singular" in finding.text


def test_negative_stiffness():
    """Of an energy with the wrong sign."""
    error = failure(user(lambda E, G, p: -p.a * ufl.inner(E, E) + ufl.inner(G, G)))
    assert "negative stiffness: see the energy of UserEnergy" in error.findings[0].text


@pytest.mark.parametrize("basis", ["mpm", "gimpm"])
def test_too_few_points(basis):
    problem = bar(material=NEO_HOOKEAN, basis=basis, points_per_cell=1, upper=(4.0, 2.0))
    problem.points.x += 0.13 * np.array([1.0, 0.7])
    error = failure(push(clamp(problem), 3.0, 2e3))
    assert "8 points in 8 cells are too few" in str(error)
    assert "free rigid motion" not in kinds(error)


@SERIAL
def test_a_hinge():
    """Two squares that meet in a corner: the tangent names the nodes that turn about it."""
    from dolfinx import mesh as dm

    from polarmpm.tools import compat

    x = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [2, 1], [1, 2], [2, 2]], float)
    cells = np.array([[0, 1, 2, 3], [3, 4, 5, 6]], dtype=np.int64)
    try:
        made = compat.create_mesh(COMM, cells, x, "quadrilateral")
    except (AttributeError, TypeError):
        made = dm.create_mesh(COMM, cells, x, ufl.Mesh(ufl.VectorElement("Lagrange", "quadrilateral", 1)))
    problem = pm.QuasiStaticFEM(pm.Elements(made, material=NEO_HOOKEAN, degree=1))
    problem.fix(lambda x: (x[:, 0] < 0.5) | (x[:, 1] < 0.5), u=0)
    problem.traction(problem.elements.farthest((0.0, 1.0)), force=(1.0, 0.0))
    finding = failure(problem).findings[0]
    assert finding.kind == "linear system"
    assert "doesn't resist" in finding.text
    assert (2.0, 2.0) in {tuple(np.round(p, 9)) for p in finding.places}
    assert finding.ids == (1,)


def test_too_few_iterations():
    controls = pm.Controls(max_iterations=5)
    error = failure(push(clamp(bar(controls=controls)), 0.0, 30.0), 1)
    assert "max_iterations=5" in str(error)
    assert not HELD & set(kinds(error))


# what it leaves -------------------------------------------------------------------------------------------
def test_the_last_state_stays():
    """Bit for bit, and the run goes on as if nothing had been."""
    problems = [push(clamp(bar()), 0.0, 8.0) for _ in range(2)]
    for problem in problems:
        list(problem.march(2, to=0.5, progress=False))
    tried, straight = problems
    before = {name: a.tobytes() for name, a in tried.points.arrays().items()}
    x = tried.system.x.copy()
    failure(tried, 1, to=1e9)
    assert before == {name: a.tobytes() for name, a in tried.points.arrays().items()}
    np.testing.assert_array_equal(tried.system.x, x)
    assert tried.failed_at is None
    for problem in problems:
        list(problem.march(2, progress=False))
    expected = by_id(straight.points, straight.points.displacement)
    np.testing.assert_allclose(by_id(tried.points, tried.points.displacement), expected, rtol=1e-9)
    assert tried.energies()["external"] == pytest.approx(straight.energies()["external"], rel=1e-9)


@pytest.mark.parametrize("kind", ["plastic points", "elements", "plastic elements", "after a reset"])
def test_other_states_stay(kind):
    if kind == "plastic points":
        problem = push(clamp(bar(material=plastic(500.0))), 25.0, 0.0)
    elif kind == "after a reset":
        problem = push(clamp(bar(reset=1)), 0.0, 8.0)
    else:
        problem = cantilever(material=plastic(500.0) if kind == "plastic elements" else MICROPOLAR)
        problem.traction(problem.elements.farthest((1.0, 0.0)), force=(25.0, 0.0))
    list(problem.march(2, progress=False))
    if "plastic" in kind:
        assert COMM.allreduce(float(problem.points.hardening.sum())) > 0.0
    arrays = problem.points.arrays()
    if "elements" in kind:
        arrays |= {"displacement": problem.elements.displacement, "turned": problem.elements.q}
    before = {name: a.tobytes() for name, a in arrays.items()}
    progress = dict(vars(problem.progress), reset_due=None, since_reset=None)
    failure(problem, 1, to=1e9)
    arrays = problem.points.arrays()
    if "elements" in kind:
        arrays |= {"displacement": problem.elements.displacement, "turned": problem.elements.q}
    if kind != "after a reset" or COMM.size == 1:  # points may go to other ranks
        assert before == {name: a.tobytes() for name, a in arrays.items()}
    assert problem.progress.factor == progress["factor"]
    assert problem.progress.external_work == progress["external_work"]
    assert next(problem.march(1, to=1.01, progress=False)).factor == 1.01


def test_an_error_in_the_diagnosis(monkeypatch):
    """Is no other error than that of the step."""

    def fails(*arguments: Any) -> None:
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(divergence, "repeat", fails)
    error = failure(push(bar(), 0.0, 10.0))
    assert kinds(error) == ["no diagnosis"]
    assert "ZeroDivisionError: nothing to divide by" in str(error)


def test_an_interrupt_in_the_diagnosis(monkeypatch):
    """Passes, and the run can go on from the last converged state."""

    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    problem = push(clamp(bar()), 0.0, 8.0)
    list(problem.march(1, to=0.5, progress=False))
    x = problem.system.x.copy()
    with monkeypatch.context() as patch:
        patch.setattr(divergence, "repeat", interrupted)
        with pytest.raises(KeyboardInterrupt):
            list(problem.march(1, to=1e9, progress=False))
    np.testing.assert_array_equal(problem.system.x, x)
    assert next(problem.march(1, progress=False)).factor == 1.0


def test_steps_that_converge_are_not_diagnosed(monkeypatch):
    monkeypatch.setattr(diagnosis, "explain", lambda *arguments: pytest.fail("diagnosed"))
    assert len(list(push(clamp(bar()), 0.0, 8.0).march(2, progress=False))) == 2


def test_findings_pickle():
    error = failure(push(bar(), 0.0, 10.0))
    again = pickle.loads(pickle.dumps(error))
    assert again.findings == error.findings
    assert str(again) == str(error)


# parts of it ------------------------------------------------------------------------------------------------
def test_what_hangs_together():
    """Against the paths of a small graph."""
    random = np.random.default_rng(5)
    for _ in range(20):
        rows = random.integers(0, 40, (12, 3))
        mask = random.random((12, 3)) < 0.8
        reach = np.eye(40, dtype=bool)
        for nodes, which in zip(rows, mask, strict=True):
            reach[np.ix_(nodes[which], nodes[which])] = True
        for _ in range(6):
            reach = (reach.astype(int) @ reach.astype(int)) > 0
        np.testing.assert_array_equal(joined(40, [(rows, mask)]), reach.argmax(axis=1))


def test_the_weakest_motion():
    """Of a chain of springs that nothing holds, and of one that pushes apart."""
    for last, negative in ((0.0, 0), (-1e-3, 1)):
        dense = np.diag([1.0, 2, 2, 1]) - np.eye(4, k=1) - np.eye(4, k=-1)
        dense[3, 3] += last
        matrix = PETSc.Mat().createDense((4, 4), array=dense, comm=PETSc.COMM_SELF).convert("aij")
        weak = WeakTangent(matrix, True)
        mode = weak.mode(np.array([0.0, 0.0, 0.0, 1.0]))
        assert mode is not None
        assert weak.negative == negative
        assert (abs(mode.curvature) < 1e-14) is (negative == 0)
        if not negative:
            np.testing.assert_allclose(mode.values / mode.values[0], 1.0, rtol=1e-9)
        weak.destroy()
        matrix.destroy()


# marches ----------------------------------------------------------------------------------------------------
def warned(action: Any) -> list[warnings.WarningMessage]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        action()
        gc.collect()
    return [w for w in caught if "never iterated" in str(w.message)]


@pytest.mark.parametrize("method", ["march", "march_arc_length"])
def test_a_march_that_is_never_iterated(method):
    """Warns once, on rank 0, and names this file."""
    problem = push(clamp(bar()), 0.0, 1.0)
    arguments: Any = (2,) if method == "march" else (0.1,)
    options = {} if method == "march" else {"steps": 2}
    found = warned(lambda: getattr(problem, method)(*arguments, **options))
    assert len(found) == (COMM.rank == 0)
    if found:
        assert f"for step in problem.{method}(...)" in str(found[0].message)
        assert found[0].filename == __file__
    assert problem.progress.step == 0


def test_marches_that_do_not_warn():
    problem = push(clamp(bar()), 0.0, 1.0)
    assert not warned(lambda: next(problem.march(2, progress=False)))
    assert not warned(lambda: list(problem.march(1, progress=False)))
    assert not warned(lambda: problem.march(2).close())

    def refused() -> None:
        with pytest.raises(pm.InputError):
            problem.march(0)

    assert not warned(refused)


def test_a_march_ends_where_it_is_closed():
    problem = push(clamp(bar()), 0.0, 1.0)
    march = problem.march(4, progress=False)
    assert iter(march) is march
    assert next(march).number == 1
    march.close()
    assert list(march) == []
    assert problem.progress.factor == 0.25


# reprs ----------------------------------------------------------------------------------------------------
def test_things_in_a_line():
    """On one rank alone, too."""
    problem = push(clamp(bar()), 0.0, 1.0)
    problem.fix(pm.Surface.line((2.0, 0.0), (3.0, 0.0), 2), ux=0, stiffness=1.0)
    step = list(problem.march(1, progress=False))[-1]
    balance, reaction = problem.balance(), problem.reaction(problem.supports[0])
    fem = cantilever()
    fem.traction(fem.elements.farthest((1.0, 0.0)), force=(0.0, 1.0))
    outcome = problem.attempt(2.0)
    if COMM.rank == 0:
        things = [problem, fem, step, outcome, balance, reaction, problem.controls, *balance.parts]
        things += [*problem.supports, *problem.loads, *problem.terms, *fem.surface_loads, problem.fields]
        for thing in things:
            assert "\n" not in repr(thing)
            assert len(repr(thing)) < 400
        assert "basis 'bspline'" in repr(problem)
        assert "1 support, 1 load, 1 term; load factor 2 after 2 steps" in repr(problem)
        assert "quadrilaterals" in repr(fem)
        assert "N m about (0, 0) m" in repr(reaction)
        assert repr(problem.loads[0]).startswith("Load('load 1, force': [0.0, 1.0] N on 2 point")
